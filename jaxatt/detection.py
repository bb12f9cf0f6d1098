"""Detection: from residuals to alarms, from alarms to a cause.

An evaluation is any number that is large when something is wrong; here mostly J = r' M^-1 r, chi-square with as many
degrees of freedom as the residual has where the filter is consistent. How good a detector is: `jaxatt.evaluation`.

May import: check, delays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaincc

from jaxatt import check
from jaxatt.delays import pushed

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


# sequential detectors: (state, value, tuning) -> state, statistic; a value that is missing is not fed


class Cusum(NamedTuple):
    """State of a two-sided CUSUM."""

    up: Any = 0.0  # [1] evidence of a mean above zero
    down: Any = 0.0  # [1] of one below


def cusum(state: Cusum, value, slack, valid: Any = True) -> tuple[Cusum, Any]:
    """Page's CUSUM for a shift of the mean, two-sided: up' = max(0, up + value - slack), down' = max(0, down - value - slack).

    Args:
        state: `Cusum()` at the start and after an alarm that was dealt with.
        value: residual normalised to unit variance [1].
        slack: half the smallest shift that matters [1].
        valid: where False, or value is NaN, the state stays.

    Returns:
        The state and the larger of the two sums; `jaxatt.thresholds.cusum_threshold` gives the threshold of a
        false-alarm rate where values are independent.
    """
    fed = valid & ~jnp.isnan(value)
    value = jnp.where(fed, value, 0)
    ahead = Cusum(jnp.maximum(state.up + value - slack, 0), jnp.maximum(state.down - value - slack, 0))
    state = jax.tree.map(lambda new, old: jnp.where(fed, new, old), ahead, state)
    return state, jnp.maximum(state.up, state.down)


def glr(sums, value, valid: Any = True):
    """Generalised likelihood ratio of a jump of the mean at one of the last M values, of unit variance before and after.

    max over m <= M of (sum of the last m values)^2 / (2 m): the log-likelihood ratio of the best jump.

    Args:
        sums: (M,) sums of the last 1, ..., M values; zeros at the start.
        value: residual normalised to unit variance [1].
        valid: where False, or value is NaN, the state stays.

    Returns:
        The sums, the statistic [1], and how many values ago, counting the last, the best jump lies.
    """
    fed = valid & ~jnp.isnan(value)
    sums = jnp.where(fed, pushed(sums, 0) + jnp.where(fed, value, 0), sums)
    ratio = sums * sums / (2 * jnp.arange(1, sums.shape[0] + 1))
    return sums, jnp.max(ratio, axis=0), 1 + jnp.argmax(ratio, axis=0)


def persistence(count, up, most, valid: Any = True):
    """How long something persists: one more where it is up, one less where not, between 0 and most.

    An alarm at ``count >= most`` needs most ticks more with it than without. valid: where False the count stays.
    """
    ahead = jnp.where(up, jnp.minimum(count + 1, most), jnp.maximum(count - 1, 0))
    return jnp.where(valid, ahead, count)
