"""Speed of `star_isolation`: truth, sensors, two filters and alarms of a whole sweep, per scenario and tick."""

from __future__ import annotations

import jax
import numpy as np

from benchmarks.measure import cpu_ns
from jaxatt import sweep
from jaxatt.loops import star_isolation as star
from jaxatt.star_filters import LMMSE, MEKF, WITH_BIAS

N, TICKS = 1024, 3000


def rows(quick: bool):
    """CPU time of a sweep of N scenarios, by filter and precision; and its scenarios of 300 s per second."""
    filters = {"LMMSE, 4 states": LMMSE, "with gyro bias, 7 states": WITH_BIAS, "MEKF, 3 states": MEKF}
    for dtype in (np.float64, np.float32):
        for name, star_filter in filters.items():
            if quick and (dtype, star_filter) != (np.float64, LMMSE):
                continue
            each = measured(star.system_of(star_filter), dtype)
            kind = f"{name}, {np.dtype(dtype).name}"
            yield dict(name=f"sweep of {N}, {kind}", value=each, unit="CPU ns per scenario-tick")
            yield dict(name=f"scenarios of 300 s, {kind}", value=1e9 / (each * TICKS), unit="per CPU second")


def measured(system, dtype) -> float:
    """CPU time per scenario and tick [ns]."""
    params, one = jax.tree.map(lambda a: np.asarray(a, dtype), (star.params, star.scenario))
    scenarios = jax.tree.map(lambda a: np.broadcast_to(a, (N, *a.shape)), one)
    key = jax.random.key(0)
    return cpu_ns(
        lambda: sweep(system, params, scenarios, key, ticks=TICKS, score=star.score, progress=False), N * TICKS
    )
