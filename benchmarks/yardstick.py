"""What the yardstick costs: nanoseconds of one core a packet of each baseline, and a tick of the board's sweep."""

from __future__ import annotations

import time

import jax
import numpy as np

from jaxatt.yardstick import NAMES, leo4, rules, tune, worlds
from jaxatt.yardstick.harness import run


def rows(quick: bool) -> list[dict]:
    """Each detector alone on recorded telemetry, 256 days side by side; all classical rows in the loop."""
    names = ("chi2_10", "cusum", "glr") if quick else NAMES[:10]
    detectors = [tune(name) for name in names]
    found = [
        {"name": f"{d.name}, a packet of one day", "value": rules.checked(d).nanoseconds, "unit": "core-ns"}
        for d in detectors
    ]
    days = worlds.days(worlds.WORLDS["leo4"], jax.random.key(0), np.arange(256), None)
    spent = []
    for _ in range(2 if quick else 4):  # the first compiles
        started = time.process_time()
        run(worlds.WORLDS["leo4"], detectors, jax.random.key(1), days)
        spent.append(time.process_time() - started)
    ticks = 256 * worlds.PACKETS * leo4.TICKS
    name = f"{len(names)} rows in the loop, a tick of 10 Hz"
    return [*found, {"name": name, "value": 1e9 * min(spent[1:]) / ticks, "unit": "core-ns"}]
