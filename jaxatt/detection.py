"""Detection: from residuals to alarms, from alarms to a cause, and how good a detector is.

Time leads, lanes trail. An evaluation is any number that is large when something is wrong; here mostly
J = r' M^-1 r, chi-square with as many degrees of freedom as the residual has where the filter is consistent. Values
of it in healthy and in faulty runs are called healthy and faulty.

May import: check, vec, attitude, faults, mounting, scores.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaincc

from jaxatt import check
from jaxatt.check import door

NONE, FIRST, SECOND, COMMON = 0, 1, 2, 3  # causes that two residual generators can tell apart
CAUSES = ("none", "first sensor", "second sensor", "common to both")

# windows and thresholds


@door
def windowed(evaluation, n: int):
    """Sum of the evaluation's last n values at every time, Yuan et al., eq. (18); fewer where fewer were seen.

    Shapes (T, *lanes). Raises ValueError for n < 1.
    """
    n = check.whole("n", n)
    a = jnp.asarray(evaluation)
    ones = (1,) * (a.ndim - 1)
    pad = ((n - 1, 0),) + ((0, 0),) * (a.ndim - 1)
    return jax.lax.reduce_window(a, 0.0, jax.lax.add, (n, *ones), (1,) * a.ndim, pad)


@door
def threshold_nsigma(n, dof):
    """n^2 dof: every component of the residual n standard deviations off at once. dof = 3 N for N values of J."""
    _numbers(n=n, dof=dof)
    return n * n * dof


@door
def threshold_moment(n, dof):
    """dof + n sqrt(2 dof): the mean of a chi-square number and n of its standard deviations."""
    return dof + n * jnp.sqrt(2.0 * dof)


@door
def threshold_mean(n, dof):
    """n dof: n times the mean of a chi-square number."""
    _numbers(n=n, dof=dof)
    return n * dof


def _numbers(**given) -> None:
    for name, value in given.items():
        if not check.is_number(value):  # a list times a number is a longer list
            raise TypeError(f"`{name}` must be a number or an array, but it is {check.short(value)}.")


@door
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


@door
def alarm(evaluation, threshold):
    """Whether the evaluation exceeds its threshold; NaN alarms."""
    return ~(evaluation <= threshold)


@door
def isolate(first, second):
    """The cause that the alarms of two residual generators point to, eq. (20): one of `NONE` ... `COMMON`.

    first, second: their alarms, bool (*lanes). One alarm blames its own sensor; both blame what the two share, the gyro
    (docs/loops/star_isolation.md, choice 3).
    """
    return jnp.where(first & second, COMMON, jnp.where(first, FIRST, jnp.where(second, SECOND, NONE)))


@door
def isolate_first(first, second, patience):
    """The cause when the verdict waits patience [s] for the other alarm.

    first, second: times [s] of first alarm of the two residual generators, inf for never, (*lanes).
    """
    seen = jnp.minimum(first, second)
    return isolate(jnp.isfinite(first) & (first <= seen + patience), jnp.isfinite(second) & (second <= seen + patience))


# how good a detector is


class Roc(NamedTuple):
    """False-alarm and detection rates over falling thresholds; every field has shape (thresholds,)."""

    threshold: Any  # [evaluation unit]
    false_alarm: Any  # [1] share of healthy values above it
    detection: Any  # [1] share of faulty values above it


@door
def roc(healthy, faulty, thresholds=None) -> Roc:
    """The ROC curve of values of an evaluation without fault, healthy, and with it, faulty, each flattened.

    thresholds: where to take it; None takes every value that occurs. A run that alarms at least once in a window is
    described by its largest value there.
    """
    healthy, faulty = np.sort(np.ravel(healthy)), np.sort(np.ravel(faulty))
    if thresholds is None:
        thresholds = np.unique(np.concatenate([healthy, faulty, [-np.inf]]))
    at = np.sort(np.asarray(thresholds, float))[::-1]
    above = lambda values: 1 - np.searchsorted(values, at, side="right") / len(values)
    return Roc(at, above(healthy), above(faulty))


@door
def detection_at(healthy, faulty, false_alarm) -> float:
    """The detection rate (faulty) at the lowest threshold whose false-alarm rate (healthy) is at most false_alarm."""
    healthy = np.sort(np.ravel(healthy))
    allowed = int(np.floor(false_alarm * len(healthy) + 1e-9))
    threshold = healthy[len(healthy) - 1 - allowed] if allowed < len(healthy) else -np.inf
    return float(np.mean(np.ravel(faulty) > threshold))


@door
def area(curve: Roc) -> float:
    """Area under a ROC curve: the probability that a faulty value exceeds a healthy one."""
    x = np.concatenate([[0], curve.false_alarm, [1]])
    y = np.concatenate([[0], curve.detection, [1]])
    return float(np.sum(np.diff(x) * (y[1:] + y[:-1]) / 2))


@door
def first_alarm(alarms, t, since=0.0):
    """Time [s] from since to the first alarm not before it, inf if never, (*lanes).

    alarms: bool (T, *lanes), at the times t [s], (T,).
    """
    t = jnp.asarray(t).reshape(-1, *(1,) * (jnp.ndim(alarms) - 1))
    return jnp.min(jnp.where(alarms & (t >= since), t - since, jnp.inf), axis=0)


@door
def detected_by(delays, times):
    """Share of runs detected within each of the times [s]: the distribution of delays [s], (runs,), inf for never."""
    delays = np.sort(np.ravel(delays))
    return np.searchsorted(delays, np.asarray(times), side="right") / len(delays)


@door
def chance(false_alarm, samples):
    """Probability of an alarm in so many independent healthy samples, false_alarm being that of one.

    What a detection is worth against.
    """
    return -jnp.expm1(samples * jnp.log1p(-jnp.asarray(false_alarm, float)))


@door
def interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's confidence interval of successes in trials, 95 % by default; z: standard deviations on either side."""
    p, n = successes / trials, trials
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * float(np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)))
    return max(0.0, centre - half), min(1.0, centre + half)


@door
def confusion(truth, verdict, causes: int = len(CAUSES)):
    """Counts of runs, shape (causes, causes): row what was wrong, ``truth``, column what was blamed, ``verdict``."""
    table = np.zeros((causes, causes), int)
    np.add.at(table, (np.ravel(truth).astype(int), np.ravel(verdict).astype(int)), 1)
    return table


# chi-square of the innovation, channel by channel


@door
def smoothed(mean, value, memory):
    """The moving mean of normalised innovations after one more, ``value``; memory in (0, 1], 1 for no memory."""
    return mean + memory * (value - mean)


@door
def chi_square(mean, memory):
    """Square of a mean of unit white noise, `smoothed` with this memory, over its variance: chi-square, one degree."""
    return mean * mean * (2 - memory) / memory


@door
def worst_above(statistic, threshold):
    """Which channel, at most one, has the largest statistic and that above the threshold; (n, *lanes) bool."""
    largest = jnp.max(statistic, axis=0)
    channel = jnp.arange(statistic.shape[0]).reshape(-1, *(1,) * largest.ndim)
    return (largest > threshold) & (channel == jnp.argmax(statistic, axis=0))
