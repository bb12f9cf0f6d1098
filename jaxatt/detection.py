"""Detection: from residuals to alarms, from alarms to a cause.

An evaluation is any number that is large when something is wrong; here mostly J = r' M^-1 r, chi-square with as many
degrees of freedom as the residual has where the filter is consistent. How good a detector is: `jaxatt.evaluation`.

May import: check.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaincc

from jaxatt import check

NONE, FIRST, SECOND, COMMON = 0, 1, 2, 3  # causes that two residual generators can tell apart
CAUSES = ("none", "first sensor", "second sensor", "common to both")

# windows and thresholds


def window_sum(recent, value):
    """The window of the last values with one more, and its sum: the evaluation of Yuan et al., eq. (18), on board.

    recent: shape (N, ...), zeros at the start; value: shape (...).
    """
    recent = jnp.concatenate([recent[1:], jnp.asarray(value)[None]])
    return recent, recent.sum(axis=0)


def windowed(evaluation, n: int):
    """Sum of the last n values at every time of a run: what `window_sum` gives tick by tick.

    evaluation: shape (T, ...), time first. Raises ValueError for n < 1.
    """
    n = check.whole("n", n)
    a = jnp.asarray(evaluation)
    ones = (1,) * (a.ndim - 1)
    pad = ((n - 1, 0),) + ((0, 0),) * (a.ndim - 1)
    return jax.lax.reduce_window(a, 0.0, jax.lax.add, (n, *ones), (1,) * a.ndim, pad)


def threshold_nsigma(n, dof):
    """n^2 dof: every component of the residual n standard deviations off at once. dof = 3 N for N values of J."""
    return jnp.multiply(jnp.square(n), dof)


def threshold_moment(n, dof):
    """dof + n sqrt(2 dof): the mean of a chi-square number and n of its standard deviations."""
    return dof + n * jnp.sqrt(2.0 * dof)


def threshold_mean(n, dof):
    """n dof: n times the mean of a chi-square number."""
    return jnp.multiply(n, dof)


def threshold_quantile(false_alarm, dof):
    """The value that a chi-square number of dof degrees of freedom exceeds with probability false_alarm.

    By bisection on the survival function, to 1e-9 of it in float64. Raises ValueError for a probability outside (0, 1)
    or dof outside (0, 1e7).
    """
    check.between("false_alarm", false_alarm, 0, 1, "a probability")
    check.between("dof", dof, 0, 1e7, "where the series of the survival function still ends")
    return _exceeded(jnp.asarray(false_alarm, float), jnp.asarray(dof, float))


@jax.jit
def _exceeded(target, dof):
    target, dof = jnp.broadcast_arrays(target, dof)
    high = dof + 40 * jnp.sqrt(2 * dof) + 1500  # survival below 1e-300

    def halve(_, interval):
        low, high = interval
        middle = (low + high) / 2
        beyond = gammaincc(dof / 2, middle / 2) > target
        return jnp.where(beyond, middle, low), jnp.where(beyond, high, middle)

    low, high = jax.lax.fori_loop(0, 100, halve, (jnp.zeros_like(high), high))
    return (low + high) / 2


# alarms and causes


def alarm(evaluation, threshold):
    """Whether the evaluation exceeds its threshold; NaN alarms."""
    return ~(evaluation <= threshold)


def isolate(first, second):
    """The cause that the alarms of two residual generators point to, eq. (20): one of `NONE` ... `COMMON`.

    first, second: whether they alarm. One alarm blames its own sensor; both blame what the two share, the gyro
    (docs/loops/star_isolation.md, choice 3).
    """
    return jnp.where(first & second, COMMON, jnp.where(first, FIRST, jnp.where(second, SECOND, NONE)))


def isolate_first(first, second, patience):
    """The cause when the verdict waits patience [s] for the other alarm.

    first, second: times [s] of first alarm of the two residual generators, inf for never.
    """
    seen = jnp.minimum(first, second)
    return isolate(jnp.isfinite(first) & (first <= seen + patience), jnp.isfinite(second) & (second <= seen + patience))


# chi-square of the innovation, channel by channel


def smoothed(mean, value, memory):
    """The moving mean of normalised innovations after one more, value; memory in (0, 1], 1 for no memory."""
    return mean + memory * (value - mean)


def chi_square(mean, memory):
    """Square of a mean of unit white noise, `smoothed` with this memory, over its variance: chi-square, one degree."""
    return mean * mean * (2 - memory) / memory


def worst_above(statistic, threshold):
    """Which of n channels, at most one, has the largest statistic and that above the threshold: bool (n,); NaN is above."""
    worst = jax.nn.one_hot(jnp.argmax(statistic, axis=0), len(statistic), dtype=bool, axis=0)
    return worst & alarm(jnp.max(statistic, axis=0), threshold)
