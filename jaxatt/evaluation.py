"""How good a detector is: ROC curves, delays, chance levels, intervals, confusion.

Values of an evaluation (`jaxatt.detection`) in runs without a fault are called healthy, in runs with one faulty.

May import: check, detection.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.detection import CAUSES


class Roc(NamedTuple):
    """False-alarm and detection rates over falling thresholds; every field has shape (thresholds,)."""

    threshold: Any  # [unit of the evaluation]
    false_alarm: Any  # [1] share of healthy values above it
    detection: Any  # [1] share of faulty values above it


def roc(healthy, faulty, thresholds=None) -> Roc:
    """The ROC curve of an evaluation.

    Args:
        healthy, faulty: its values without and with a fault, of any shapes. A run that alarms at least once in a window
            is described by its largest value there.
        thresholds: where to take the curve; None takes every value that occurs.

    Raises:
        ValueError: no value, or NaN among them.

    Example:
        >>> area(roc([1.0, 2.0], [2.0, 3.0]))
        0.875
    """
    healthy, faulty = _values("healthy", healthy), _values("faulty", faulty)
    if thresholds is None:
        at = np.unique(np.concatenate([healthy, faulty, [-np.inf]]))[::-1]
    else:
        at = _values("thresholds", thresholds)[::-1]
    above = lambda values: 1 - np.searchsorted(values, at, side="right") / len(values)
    return Roc(at, above(healthy), above(faulty))


def detection_at(healthy, faulty, false_alarm) -> float:
    """The detection rate at the lowest threshold whose false-alarm rate is at most false_alarm.

    healthy, faulty: values of the evaluation, of any shapes. Raises ValueError for no value, NaN, and a rate that is not
    in [0, 1].
    """
    healthy, faulty = _values("healthy", healthy), _values("faulty", faulty)
    check.number("false_alarm", false_alarm)
    check.share("false_alarm", false_alarm)
    allowed = int(np.floor(false_alarm * len(healthy) + 1e-9))
    threshold = healthy[len(healthy) - 1 - allowed] if allowed < len(healthy) else -np.inf
    return float(np.mean(faulty > threshold))


def area(curve: Roc) -> float:
    """Area under a ROC curve: the probability that a faulty value exceeds a healthy one.

    Raises ValueError for rates that are not two series of one length.
    """
    check.kind("curve", curve, Roc)
    shapes = (
        np.shape(check.real("curve.false_alarm", curve.false_alarm)),
        np.shape(check.real("curve.detection", curve.detection)),
    )
    if shapes[0] != shapes[1] or len(shapes[0]) != 1:
        check.refuse("curve", "hold rates of shape (thresholds,)", "of shapes {} and {}".format(*shapes))
    x = np.concatenate([[0], curve.false_alarm, [1]])
    y = np.concatenate([[0], curve.detection, [1]])
    return float(np.sum(np.diff(x) * (y[1:] + y[:-1]) / 2))


def first_alarm(alarms, t, since: Any = 0.0):
    """Time [s] from since to the first alarm not before it, inf if never, shape (...).

    alarms: bool (T, ...), at the times t (T,) [s]; since: [s], one number or one for each run. Raises ValueError where
    alarms and times differ in number.
    """
    for name, value in (("alarms", alarms), ("t", t), ("since", since)):
        if check.concrete(value):
            check.real(name, value)
    alarms, t = jnp.asarray(alarms, bool), jnp.asarray(t)
    if alarms.ndim == 0 or t.shape != alarms.shape[:1] or len(t) == 0:
        check.refuse("alarms", f"lead with as many ticks as `t`, of shape {t.shape}, at least one", f"{alarms.shape}")
    if np.shape(since) not in ((), alarms.shape[1:]):
        check.refuse("since", f"be one number or have shape {alarms.shape[1:]}", f"of shape {np.shape(since)}")
    t = t.reshape(-1, *(1,) * (alarms.ndim - 1))
    return jnp.min(jnp.where(alarms & (t >= since), t - since, jnp.inf), axis=0)


def detected_by(delays, times):
    """Share of runs detected within each of the times [s]: the distribution of their delays [s], inf for never.

    Raises ValueError for no delay, and NaN.
    """
    delays = _values("delays", delays)
    times = check.real("times", times)
    check.a_number("times", times)
    return np.searchsorted(delays, times, side="right") / len(delays)


def chance(false_alarm, samples):
    """Probability of an alarm in so many independent healthy samples: what a detection is worth against.

    false_alarm: probability of an alarm in one sample. Raises ValueError for one outside [0, 1] and samples < 0.
    """
    check.share("false_alarm", false_alarm)
    check.not_negative("samples", samples)
    check.fits("samples", samples, "false_alarm", false_alarm)
    return -jnp.expm1(jnp.asarray(samples, float) * jnp.log1p(-jnp.asarray(false_alarm, float)))


def interval(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Clopper and Pearson's confidence interval of a probability from successes in independent trials.

    It covers the true probability with at least the confidence ``level``, whatever that is; of shorter intervals, such as
    Wilson's, this holds on average only, and least for the rare failures that one counts. Raises ValueError for no trial,
    more successes than trials, and a level outside (0, 1).

    >>> low, high = interval(0, 1000)  # 0 and 0.003682
    """
    from scipy.special import betaincinv

    k, n = check.whole("successes", successes, 0), check.whole("trials", trials)
    if k > n:
        check.refuse("successes", f"be at most the {n} trials", k)
    check.between("level", check.number("level", level), 0, 1, "a probability")
    tail = (1 - level) / 2
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else 1 - float(betaincinv(n - k, k + 1, tail))
    return low, high


def quantile_interval(values, shares, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Confidence intervals of quantiles from independent values, by order statistics, whatever their distribution.

    Each covers its quantile with at least the confidence ``level``. An end is infinite where there are too few values to
    bound it. Raises ValueError for no value, NaN, shares outside [0, 1], and a level outside (0, 1).

    Args:
        values: one of each run, of any shape; infinities are values like others.
        shares: of the distribution below the quantile, of any shape; 0.5 is the median.
        level: confidence of each interval.

    Returns:
        Lower and upper ends, each of the shape of the shares, in the unit of the values.

    Example:
        >>> low, high = quantile_interval(np.arange(1, 101), 0.5)  # 40 and 61
    """
    from scipy.stats import binom

    values, shares = _values("values", values), check.real("shares", shares).astype(float)
    check.share("shares", shares)
    check.between("level", check.number("level", level), 0, 1, "a probability")
    n, tail = len(values), (1 - level) / 2
    padded = np.concatenate([[-np.inf], values, [np.inf]])
    # as many values lie below the quantile as there are successes in n trials
    low, high = binom.ppf(tail, n, shares), binom.isf(tail, n, shares) + 1
    return padded[np.maximum(low, 0).astype(int)], padded[np.minimum(high, n + 1).astype(int)]


def confusion(truth, verdict, causes: int = len(CAUSES)) -> np.ndarray:
    """Counts of runs, shape (causes, causes): row what was wrong, ``truth``, column what was blamed, ``verdict``.

    truth, verdict: a cause for each run, 0 to causes - 1. Raises ValueError for other numbers, and where the two differ in
    shape.
    """
    causes = check.whole("causes", causes)
    truth, verdict = check.real("truth", truth), check.real("verdict", verdict)
    if truth.shape != verdict.shape:
        check.refuse("verdict", f"have the shape {truth.shape} of `truth`", f"of shape {verdict.shape}")
    for name, a in (("truth", truth), ("verdict", verdict)):
        check.each(name, f"be a cause, 0 to {causes - 1}", a, np.isin(a, range(causes)))
    table = np.zeros((causes, causes), int)
    np.add.at(table, (truth.ravel().astype(int), verdict.ravel().astype(int)), 1)
    return table


def _values(name: str, values) -> np.ndarray:
    """Sorted, flat values, at least one and none of them NaN."""
    a = np.ravel(check.real(name, values))
    if not a.size:
        check.refuse(name, "hold at least one number", "empty")
    check.a_number(name, a)
    return np.sort(a)
