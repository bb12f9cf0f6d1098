"""Thresholds of a stated false-alarm rate, mode by mode, and what rate fresh windows show.

The rate r belongs to windows of T = 600 s: P(no alarm in T) = exp(-r T). The threshold is that quantile of the largest
score of healthy windows, whatever the scores' correlation in time; formulas for single samples miss the rate by orders.

May import: harness, rules, telemetry, worlds, check, loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxatt import check
from jaxatt.loss import wilson
from jaxatt.yardstick import worlds
from jaxatt.yardstick.harness import Found, run
from jaxatt.yardstick.rules import validated
from jaxatt.yardstick.telemetry import Detector
from jaxatt.yardstick.worlds import WINDOW, World

HOURS = WINDOW / 3600  # of a window
DISTINCT = 1000  # run maxima below which a rate is an interval


class Calibration(NamedTuple):
    """Thresholds of detectors in each mode: arrays of shape (detectors, modes) but for two."""

    threshold: Any
    low: Any  # 95 % interval of the threshold, by order statistics
    high: Any
    rate: Any  # [1/h] on fresh windows
    rate_low: Any  # its 95 % interval, Wilson's of the share of windows with an alarm
    rate_high: Any
    windows: int  # of each mode, calibrated on
    excess: Any  # (modes,) [rad] 99 % of the healthy pointing error
    distinct: Any  # (detectors, modes) how many different run maxima there were
    reachable_low: Any  # [1/h] rates next to the wanted one that a threshold can have; both the same where all can
    reachable_high: Any


def threshold_of(maxima, rate: float) -> tuple[float, float, float]:
    """Threshold and its 95 % interval from the largest scores of n windows: level exp(-rate T), linear between them."""
    maxima = np.sort(np.where(np.isnan(maxima), np.inf, maxima).astype(float))
    n, level = len(maxima), np.exp(-rate * HOURS)
    spread = 1.96 * np.sqrt(n * level * (1 - level))
    at = np.clip(np.array([n * level - spread, n * level + spread]).round().astype(int), 0, n - 1)
    with np.errstate(invalid="ignore"):
        found = float(np.quantile(maxima, level))
    return (float(maxima[-1]) if np.isnan(found) else found), float(maxima[at[0]]), float(maxima[at[1]])


def rate_of(k, n) -> tuple[Any, Any, Any]:
    """Alarms per hour and their 95 % interval from k of n windows with an alarm: -ln(1 - k / n) / T."""
    with np.errstate(divide="ignore"):
        return tuple(-np.log1p(-np.asarray(share, float)) / HOURS for share in (np.divide(k, n), *wilson(k, n)))  # pyright: ignore[reportReturnType]


def windows(world: World, detectors: Sequence[Detector], key, n: int, progress: bool = False) -> Found:
    """What n healthy days leave, modes in turn."""
    return run(world, detectors, key, worlds.days(world, key, np.arange(n), None), progress=progress)


def calibrate(
    world: World, detectors: Sequence[Detector], key, *, hours: float = 4000, rate: float = 0.1, progress: bool = False
):
    """Thresholds of a false-alarm rate, and the rate on as many fresh windows.

    Args:
        world: whose healthy days are run.
        detectors: a sequence of `Detector` of different names; they share the simulation.
        key: the test key; days to calibrate on and to validate on are ``fold_in(key, 1)`` and ``fold_in(key, 2)``.
        hours: of windows to calibrate on, both modes together, and as many again to validate.
        rate: wanted [1/h].
        progress: show a bar.

    Returns:
        `Calibration`.

    Raises:
        ValueError: no detector, two of one name, hours < 100, a rate outside (0, 6).
        TypeError: a detector whose step does not return a `Verdict` of a score () and a blame (11,).

    Example:
        >>> found = calibrate(WORLDS["leo4"], [BASELINES["glr"]], jax.random.key(7), hours=400)
    """
    detectors = validated(detectors)
    check.above("hours", check.number("hours", hours), 99.999, "below it no rate of .1/h is known to a third")
    check.between("rate", check.number("rate", rate), 0, 6, "one alarm a window")
    n = 2 * int(np.ceil(hours / (2 * HOURS) - 1e-9))
    healthy = windows(world, detectors, jax.random.fold_in(key, 1), n, progress)
    fresh = windows(world, detectors, jax.random.fold_in(key, 2), n, progress)
    return calibration(len(world.modes), healthy, fresh.peak, rate)


def calibration(modes: int, healthy: Found, fresh, rate: float) -> Calibration:
    """`calibrate` of windows that were run; fresh: (n, detectors) largest scores."""
    peak = np.asarray(healthy.peak)
    rows: dict[str, list] = {name: [] for name in Calibration._fields}
    for d in range(peak.shape[1]):
        of = {name: [] for name in rows}
        for m in range(modes):
            maxima, other = peak[m::modes, d], np.asarray(fresh)[m::modes, d]
            h, low, high = threshold_of(maxima, rate)
            k, n = np.sum(~(other <= h)), len(other)
            values = (h, low, high, *rate_of(k, n), len(np.unique(maxima)), rate_of(np.sum(~(maxima <= h)), len(maxima))[0],
                      rate_of(np.sum(~(maxima < h)), len(maxima))[0])  # fmt: skip
            names = ("threshold", "low", "high", "rate", "rate_low", "rate_high", "distinct", "reachable_low", "reachable_high")  # fmt: skip
            for name, value in zip(names, values):
                of[name].append(value)
        for name in of:
            rows[name].append(of[name])
    arrays = {name: np.array(values, float) for name, values in rows.items()}
    pointing = np.asarray(healthy.pointing)
    arrays["excess"] = np.array([np.quantile(pointing[m::modes], 0.99) for m in range(modes)])
    given: dict[str, Any] = arrays | {"windows": len(peak) // modes}
    return Calibration(**given)
