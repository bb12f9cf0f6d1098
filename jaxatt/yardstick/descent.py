"""Tune numbers of one detector at a fixed rate of false alarms: the threshold moves with them.

D(x, h(x)), the expected min(delay, 60 s) of an alarm that comes softly at the threshold h, has the gradient
dD/dx = D_x + D_h dh/dx, with dh/dx of `calibration.threshold_slope`. Tune on faulty days, judge on fresh ones.

May import: calibration, harness, kinds, metrics, telemetry, worlds, check.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxatt import check
from jaxatt.yardstick import metrics, worlds
from jaxatt.yardstick.calibration import threshold_of, threshold_slopes, typed, windows_of
from jaxatt.yardstick.harness import slopes
from jaxatt.yardstick.kinds import effects
from jaxatt.yardstick.telemetry import Detector
from jaxatt.yardstick.worlds import World

WIDTH = 0.15  # of the softened alarm, over the spread of the healthy score's largest values


class Step(NamedTuple):
    """A cost at fixed false-alarm rate, and its gradient."""

    cost: Any  # [s] soft macro RMD60
    gradient: Any  # (k,) in all
    partial: Any  # (k,) at a threshold that stays
    threshold: Any  # (modes,)
    slope: Any  # (modes, k) of the threshold
    error: Any  # (modes, k) its standard error


def at_fixed_rate(
    world: World, detector: Detector, key, numbers, params_of: Callable, *, hours: float = 2000, days: int = 16, rate: float = 0.1
) -> Step:  # fmt: skip
    """Soft macro RMD60 of a detector and its gradient at a fixed rate of false alarms.

    Args:
        world: of the days.
        detector: whose init and step are run.
        key: of healthy windows, ``fold_in(key, 1)``, and of faulty days, ``fold_in(key, 3)``; the same key, the same noise.
        numbers: x, (k,).
        params_of: x -> (params,).
        hours: of healthy windows, both modes together.
        days: of each of the sized cells.
        rate: of false alarms [1/h].

    Example:
        >>> slack = lambda x: (cusum.params._replace(slack=x[0]),)
        >>> found = at_fixed_rate(WORLDS["leo4"], cusum, jax.random.key(0), [0.25], slack, hours=1000)
    """
    days, key, n, modes = check.whole("days", days, 1), typed(key), windows_of(hours, world.window), len(world.modes)
    calm, test = (jax.random.fold_in(key, i) for i in (1, 3))
    told, moved = slopes(world, [detector], calm, worlds.days(world, calm, np.arange(n), None), numbers, params_of)
    maxima = [told.peak[m::modes, 0] for m in range(modes)]
    h = [threshold_of(a, rate, world.window)[0] for a in maxima]
    slope, error = (a[0] for a in threshold_slopes(told.peak, moved.peak, [h]))
    width = WIDTH * float(np.mean([np.std(a) for a in maxima]))
    cells = [(kind, size) for kind, sizes in world.sized.items() for size in sizes]
    weights = np.repeat(metrics.weights_of(cells, world.sized), days) / days
    both = jax.tree.map(lambda *a: np.repeat(np.array(a, np.float32), days), *(effects(cell) for cell in cells))
    faulty = worlds.days(world, test, np.tile(np.arange(days), len(cells)), both)
    told, moved = slopes(world, [detector], test, faulty, numbers, params_of, threshold=[h], width=width)
    here = np.einsum("n,nk->k", weights, moved.delay[:, 0])
    k = len(np.ravel(numbers))
    return Step(float(weights @ told.delay[:, 0]), here[:k] + here[k:] @ slope, here[:k], np.array(h), slope, error)
