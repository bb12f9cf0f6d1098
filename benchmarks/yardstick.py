"""What the yardstick costs: nanoseconds of one core a tick of 10 Hz, of the loop, of each baseline in it, and of all."""

from __future__ import annotations

import time

import jax
import numpy as np

from jaxatt.yardstick import NAMES, leo4, rules, tune, worlds
from jaxatt.yardstick.harness import run

DAYS = 256


def rows(quick: bool) -> list[dict]:
    """Sweeps of 256 days with other rows in the loop, in turn, medians; then the GLR alone on recorded telemetry."""
    names = ("chi2_10", "cusum", "glr") if quick else NAMES
    sets: dict[str, tuple[str, ...]] = {"loop without rows": ("null",), f"all {len(names)} rows": tuple(names)}
    sets.update({name: ("null", name) for name in names if name != "null"})
    world, key = worlds.WORLDS["leo4"], jax.random.key(1)
    days = worlds.days(world, key, np.arange(DAYS), None)
    detectors = {label: [tune(name) for name in members] for label, members in sets.items()}
    spent: dict[str, list] = {label: [] for label in sets}
    for turn in range(3 if quick else 6):
        for label, members in detectors.items():
            started = time.process_time()
            run(world, members, key, days)
            if turn:  # the first compiles
                spent[label].append(time.process_time() - started)
    ticks = DAYS * world.packets * leo4.TICKS
    cost = {label: 1e9 * float(np.median(times)) / ticks for label, times in spent.items()}
    alone = cost["loop without rows"]
    whole = [{"name": label, "value": cost[label], "unit": "core-ns"} for label in ("loop without rows", f"all {len(names)} rows")]  # fmt: skip
    each = [{"name": f"{name} in the loop, more", "value": cost[name] - alone, "unit": "core-ns"} for name in sets if name in names]  # fmt: skip
    ratio = {"name": "all rows over the loop", "value": cost[f"all {len(names)} rows"] / alone, "unit": "x"}
    packet = {"name": "glr alone, a packet of one day", "value": rules.checked(tune("glr"), world, rules.records(world)).nanoseconds, "unit": "core-ns"}  # fmt: skip
    return [*whole, ratio, *each, packet]
