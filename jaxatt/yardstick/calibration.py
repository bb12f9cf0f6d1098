"""Thresholds of a stated false-alarm rate, mode by mode, and what rate fresh windows show.

The rate r belongs to windows of T seconds, 600 in leo4: P(no alarm in T) = exp(-r T). The threshold is that quantile of the largest
score of healthy windows, whatever the scores' correlation in time; formulas for single samples miss the rate by orders.
It has a gradient: as the numbers of a detector change, the threshold moves with the largest scores that lie next to it.

May import: harness, rules, telemetry, worlds, check, loss, noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxatt import check
from jaxatt.loss import wilson
from jaxatt.noise import one_key
from jaxatt.yardstick import worlds
from jaxatt.yardstick.harness import Found, run, slopes
from jaxatt.yardstick.rules import validated
from jaxatt.yardstick.telemetry import Detector
from jaxatt.yardstick.worlds import World

DISTINCT = 1000  # run maxima below which a rate is an interval
NEAREST = 0.06  # share of the windows that tell how the threshold moves: those with a largest score next to it


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
    slope: Any = None  # (detectors, modes, k) gradient of the threshold, where one was asked for
    slope_error: Any = None  # its standard error


def threshold_of(maxima, rate: float, window: float) -> tuple[float, float, float]:
    """Threshold and its 95 % interval from the largest scores of n windows [s]: level exp(-rate T), linear between them."""
    maxima = np.sort(np.where(np.isnan(maxima), np.inf, maxima).astype(float))
    n, level = len(maxima), np.exp(-rate * (window / 3600))
    spread = 1.96 * np.sqrt(n * level * (1 - level))
    at = np.clip(np.array([n * level - spread, n * level + spread]).round().astype(int), 0, n - 1)
    with np.errstate(invalid="ignore"):
        found = float(np.quantile(maxima, level))
    return (float(maxima[-1]) if np.isnan(found) else found), float(maxima[at[0]]), float(maxima[at[1]])


def threshold_slope(maxima, slopes, threshold: float, share: float = NEAREST) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of a threshold and its standard error, (k,) each: dh/dx = E[dM/dx | M = h].

    maxima: (n,) largest scores M; slopes: (n, k) their gradients dM/dx. The mean is over the ``share`` of the windows whose
    maxima are nearest to h in order, as many below as above: fewer windows where there are not so many above.
    """
    maxima, slopes = np.asarray(maxima, float), np.asarray(slopes, float)
    order, n = np.argsort(maxima, kind="stable"), len(maxima)
    below = int(np.sum(maxima <= threshold))
    half = max(1, min(round(share * n / 2), below, n - below))
    near = order[max(0, below - half) : below + half]
    return slopes[near].mean(0), slopes[near].std(0, ddof=1) / np.sqrt(len(near))


def threshold_slopes(peaks, moved, thresholds) -> tuple[np.ndarray, np.ndarray]:
    """`threshold_slope` of all detectors and modes, (detectors, modes, k) each.

    peaks: (n, detectors), modes in turn; moved: (n, detectors, k + modes), by the numbers and then by the thresholds.
    """
    modes = np.shape(thresholds)[1]
    each = [
        [threshold_slope(peaks[m::modes, d], moved[m::modes, d, :-modes], h) for m, h in enumerate(row)]
        for d, row in enumerate(thresholds)
    ]
    slope, error = np.moveaxis(np.array(each), 2, 0)
    return slope, error


def rate_of(k, n, window: float) -> tuple[Any, Any, Any]:
    """Alarms per hour and their 95 % interval from k of n windows [s] with an alarm: -ln(1 - k / n) / T."""
    with np.errstate(divide="ignore"):
        return tuple(
            -np.log1p(-np.asarray(share, float)) / (window / 3600) for share in (np.divide(k, n), *wilson(k, n))
        )  # pyright: ignore[reportReturnType]


def windows_of(hours, window: float) -> int:
    """Windows [s] of so many hours, as many of each of two modes; refuses hours outside [100, 1e6]."""
    between = "below 100 no rate of .1/h is known to a third"
    check.between("hours", check.number("hours", hours), 99.999, 1e6, between)
    return 2 * int(np.ceil(hours / (2 * (window / 3600)) - 1e-9))


def typed(key):
    """One key, typed; refuses what is none."""
    return jax.random.wrap_key_data(jax.numpy.asarray(one_key(key)))


def windows(world: World, detectors: Sequence[Detector], key, n: int, progress: bool = False) -> Found:
    """What n healthy days leave, modes in turn."""
    return run(world, detectors, key, worlds.days(world, key, np.arange(n), None), progress=progress)


def calibrate(
    world: World, detectors: Sequence[Detector], key, *, hours: float = 4000, rate: float = 0.1,
    gradient: tuple[Any, Callable] | None = None, progress: bool = False,
) -> Calibration:  # fmt: skip
    """Thresholds of a false-alarm rate, and the rate on as many fresh windows.

    Args:
        world: whose healthy days are run.
        detectors: a sequence of `Detector` of different names; they share the simulation.
        key: the test key; days to calibrate on and to validate on are ``fold_in(key, 1)`` and ``fold_in(key, 2)``.
        hours: of windows to calibrate on, both modes together, and as many again to validate.
        rate: wanted [1/h].
        gradient: numbers x (k,), and a function of them that gives the params of all detectors, a tuple: the thresholds
            are those of these params, and come with their gradient by x. 2000 hours or more: it is a mean over the few
            windows whose largest score is next to the threshold.
        progress: show a bar.

    Returns:
        `Calibration`; its ``slope`` and ``slope_error`` are None without ``gradient``.

    Raises:
        ValueError: no detector, two of one name, hours outside [100, 1e6], a rate outside (0, one alarm a window), numbers of another shape than (k,).
        TypeError: a detector whose step does not return a `Verdict` of a score () and a blame (channels,); a function that
            gives no params for each detector.

    Example:
        >>> found = calibrate(WORLDS["leo4"], [BASELINES["glr"]], jax.random.key(7), hours=400)
        >>> slack = lambda x: (BASELINES["cusum"].params._replace(slack=x[0]),)
        >>> found = calibrate(WORLDS["leo4"], [BASELINES["cusum"]], jax.random.key(7), gradient=([0.25], slack))
    """
    check.kind("world", world, World)
    key, n = typed(key), windows_of(hours, world.window)
    check.between("rate", check.number("rate", rate), 0, 3600 / world.window, "one alarm a window")
    if gradient is not None:
        detectors = _with_numbers(validated(detectors, world), gradient)
    detectors = validated(detectors, world)
    healthy = windows(world, detectors, jax.random.fold_in(key, 1), n, progress)
    fresh = windows(world, detectors, jax.random.fold_in(key, 2), n, progress)
    found = calibration(world, healthy, fresh.peak, rate)
    if gradient is None:
        return found
    days = worlds.days(world, jax.random.fold_in(key, 1), np.arange(n), None)
    softly, moved = slopes(world, detectors, jax.random.fold_in(key, 1), days, *gradient)
    slope, error = threshold_slopes(softly.peak, moved.peak, found.threshold)
    return found._replace(slope=slope, slope_error=error)


def _with_numbers(detectors: tuple[Detector, ...], gradient) -> tuple[Detector, ...]:
    """The detectors with the params that the numbers give."""
    if not isinstance(gradient, tuple) or len(gradient) != 2:
        check.refuse("gradient", "be None or numbers and a function of them, a tuple", check.short(gradient))
    numbers, params_of = gradient
    check.function("gradient[1]", params_of)
    x = check.real("gradient[0]", numbers)
    if x.ndim != 1 or not x.size or not np.isfinite(x).all():
        check.refuse("gradient[0]", "be finite numbers of shape (k,)", check.short(numbers))
    given = params_of(x.astype(np.float32))
    if not isinstance(given, tuple) or len(given) != len(detectors):
        raise TypeError(f"`gradient[1]` must return a tuple of params, one a detector, but it is {check.short(given)}.")
    return tuple(d._replace(params=p) for d, p in zip(detectors, given))


def calibration(world: World, healthy: Found, fresh, rate: float) -> Calibration:
    """`calibrate` of windows that were run; fresh: (n, detectors) largest scores."""
    modes, window = len(world.modes), world.window
    peak = np.asarray(healthy.peak)
    names = ("threshold", "low", "high", "rate", "rate_low", "rate_high", "distinct", "reachable_low", "reachable_high")
    rows: dict[str, list] = {name: [] for name in names}
    for d in range(peak.shape[1]):
        of = {name: [] for name in rows}
        for m in range(modes):
            maxima, other = peak[m::modes, d], np.asarray(fresh)[m::modes, d]
            h, low, high = threshold_of(maxima, rate, window)
            k, n = np.sum(~(other <= h)), len(other)
            values = (h, low, high, *rate_of(k, n, window), len(np.unique(maxima)), rate_of(np.sum(~(maxima <= h)), len(maxima), window)[0],
                      rate_of(np.sum(~(maxima < h)), len(maxima), window)[0])  # fmt: skip
            for name, value in zip(names, values, strict=True):
                of[name].append(value)
        for name in of:
            rows[name].append(of[name])
    arrays = {name: np.array(values, float) for name, values in rows.items()}
    pointing = np.asarray(healthy.pointing)
    arrays["excess"] = np.array([np.quantile(pointing[m::modes], 0.99) for m in range(modes)])
    given: dict[str, Any] = arrays | {"windows": len(peak) // modes}
    return Calibration(**given)
