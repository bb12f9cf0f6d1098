"""Thresholds from a stated false-alarm rate, off line: by theory where residuals are white, else by a healthy loop.

Colour decides: with CUSUM 5 at slack .5 white noise alarms every 465 values, AR(1) noise of coefficient .5 every 53,
differenced noise of a momentum residual never in 8e6. `tail` measures on the loop's own residual.

May import: check.
"""

from __future__ import annotations

from functools import cache
from math import erfc
from typing import NamedTuple

import numpy as np

from jaxatt import check


def cusum_arl(threshold: float, slack: float, shift: float = 0.0) -> float:
    """Average run length to the alarm of a two-sided CUSUM of independent unit normal values, in values.

    The one-sided length solves L(s) = 1 + L(0) F(k - s) + integral over (0, h) of L(y) f(y - s + k) dy, on 120
    Gauss-Legendre nodes; the two sides combine by 1/L = 1/L+ + 1/L-.

    Args:
        threshold: h of the statistic [1].
        slack: k of `jaxatt.detection.cusum` [1].
        shift: mean of the values [1]; 0 gives the time between false alarms, else the delay from a fresh start.

    Raises:
        ValueError: a threshold or slack that is not positive.

    Example:
        >>> round(cusum_arl(5.0, 0.5), 1)
        465.4
    """
    check.positive("threshold", threshold)
    check.positive("slack", slack)
    up = _arl(threshold, slack, shift)
    down = _arl(threshold, slack, -shift) if shift else up
    return up * down / (up + down)


def _arl(h: float, k: float, mean: float) -> float:
    nodes, weights = _gauss()
    nodes, weights = h * (nodes + 1) / 2, h * weights / 2
    density = np.exp(-0.5 * (nodes - nodes[:, None] + k - mean) ** 2) / np.sqrt(2 * np.pi)
    start = np.exp(-0.5 * (nodes + k - mean) ** 2) / np.sqrt(2 * np.pi)
    kernel = np.block([[np.array([[_normal_cdf(k - mean)]]), (weights * start)[None]],
                       [_normal_cdf(k - mean - nodes)[:, None], weights * density]])  # fmt: skip
    return float(np.linalg.solve(np.eye(121) - kernel, np.ones(121))[0])


@cache
def _gauss() -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights on (-1, 1)."""
    return np.polynomial.legendre.leggauss(120)


_normal_cdf = np.vectorize(lambda x: 0.5 * erfc(-x / np.sqrt(2)))


def cusum_threshold(values_between_alarms: float, slack: float) -> float:
    """The threshold of a two-sided CUSUM from the mean distance of its false alarms: the inverse of `cusum_arl`.

    Args:
        values_between_alarms: how many independent unit normal values lie between two alarms on average.
        slack: k of `jaxatt.detection.cusum` [1].

    Raises:
        ValueError: a number of values that no threshold between .01 and 25 gives.

    Example:
        >>> round(cusum_threshold(1000, 0.5), 3)
        5.757
    """
    low, high = 0.01, 25.0
    found = [cusum_arl(h, slack) for h in (low, high)]
    if not found[0] <= values_between_alarms <= found[1]:
        check.refuse("values_between_alarms", f"lie between {found[0]:.3g} and {found[1]:.3g}", values_between_alarms)
    while high - low > 1e-10 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if cusum_arl(middle, slack) < values_between_alarms else (low, middle)
    return (low + high) / 2


class Tail(NamedTuple):
    """Exponential tail of the largest values of a statistic in blocks of a healthy loop."""

    level: float  # .9 quantile of the maxima
    top: float  # .999 quantile; rates beyond it are extrapolated
    scale: float  # [unit of the statistic]
    rate: float  # [1/h] of blocks above the level


def tail(maxima, seconds: float) -> Tail:
    """The tail between the .9 and .999 quantiles of block maxima: rate(x) = rate exp(-(x - level) / scale).

    Args:
        maxima: (n,) largest statistic in each of n blocks of healthy runs, long against the memory of the residual.
        seconds: length of a block [s].

    Raises:
        ValueError: fewer than 1000 maxima, NaN among them, a length that is not positive, maxima without a tail.

    Example:
        >>> found = tail(maxima, seconds=100.0)
        >>> threshold = threshold_at(found, per_hour=1e-3)
        >>> extrapolated = rate_above(found, found.top) / 1e-3  # more than 100: doubt it
    """
    check.positive("seconds", seconds)
    maxima = check.real("maxima", maxima).astype(float).ravel()
    check.a_number("maxima", maxima)
    if len(maxima) < 1000:
        check.refuse("maxima", "be 1000 or more, for the .999 quantile is read", len(maxima))
    level, top = np.quantile(maxima, (0.9, 0.999))
    if not top > level:
        check.refuse("maxima", "have a tail, .9 and .999 quantiles that differ", f"{top:g} at both")
    return Tail(float(level), float(top), float((top - level) / np.log(100)), 360 / seconds)


def rate_above(found: Tail, threshold):
    """False alarms per hour at a threshold above the level of the tail."""
    return found.rate * np.exp(-(threshold - found.level) / found.scale)


def threshold_at(found: Tail, per_hour: float) -> float:
    """The threshold that a healthy loop exceeds per_hour times an hour; ValueError for a rate beyond that of the level."""
    check.between("per_hour", per_hour, 0, found.rate, "the rate at the .9 quantile")
    return float(found.level + found.scale * np.log(found.rate / per_hour))
