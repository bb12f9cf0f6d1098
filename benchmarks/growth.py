"""How the cost of a sweep grows: with scenarios, ticks, states of a filter, channels that may fail and scores; on disk.

float32. A cost is CPU time of the second call, without compilation; memory is the peak of a process of its own.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxatt
from benchmarks import observer_pd as bench
from benchmarks.measure import cpu_ns
from jaxatt import Fault, System, scores
from jaxatt.faults import Reading, channel, read
from jaxatt.filters import Belief, predict, update

ROWS = 3  # measurements of the filter
SCORES = 1, 5, 15
KEY = jax.random.key(0)


def rows(quick: bool):
    """The table, one quantity after the other."""
    repeats = 3 if quick else 5
    for n in (1, 128, 1024, 16384) if quick else (1, 128, 1024, 10_000, 100_000, 1_000_000):
        spent = _observer(n, 10, None, 1 if n > 10_000 else repeats)
        yield row(f"{n} scenarios of 10 ticks", spent * 1e-6, "ms")
        yield row("  for each scenario and tick", spent / n / 10)
    for ticks in (10, 100, 1000) if quick else (10, 100, 1000, 10_000, 100_000):
        spent = _observer(128, ticks, None, 1 if ticks > 10_000 else repeats)
        yield row(f"128 scenarios of {ticks} ticks", spent * 1e-6, "ms")
        yield row("  for each scenario and tick", spent / 128 / ticks)
    for few in SCORES:
        yield row(f"{few} of the scores", _observer(128, 200, few, repeats) / 128 / 200)
    for states in (4, 8, 16) if quick else (4, 8, 16, 32):
        loop = System(partial(_init_filter, states), _tick_filter, _rest, dt=0.1, normals=ROWS)
        yield row(f"a filter of {states} states, {ROWS} measurements", _small(loop, 0.0, repeats))
    for channels in (1, 4, 16) if quick else (1, 4, 16, 64):
        loop = System(_init_channels, _tick_channels, _rest, dt=0.1, normals=channels)
        faults = [Fault(onset=5.0, bias=1.0, random=0.1)] * channels
        yield row(f"{channels} channels with a fault", _small(loop, faults, repeats))
    yield from _disk(*((1000, 10_000) if quick else (10_000, 1_000_000)))


def row(name: str, value: float, unit: str = "ns a tick") -> dict:
    """One line of the table."""
    return {"name": name, "value": float(value), "unit": unit}


def _observer(n: int, ticks: int, few: int | None, repeats: int) -> float:
    """CPU time [ns] of a sweep of `jaxatt.loops.observer_pd`, with the first few of its scores or all."""
    p = jax.tree.map(lambda a: np.asarray(a, np.float32), bench.params)
    score = bench.score if few is None else partial(_first, few)
    s = bench.scenarios(n, np.float32)
    return cpu_ns(lambda: jaxatt.sweep(bench.system, p, s, KEY, ticks=ticks, score=score, progress=False), 1, repeats)


def _first(few: int, params, scenario, now, log):
    return bench.score(params, scenario, now, log)[:few]


def _small(loop: System, scenario: Any, repeats: int, n: int = 256, ticks: int = 100) -> float:
    """CPU time [ns] of a scenario's tick of a loop below."""
    s = jax.tree.map(lambda a: np.full(n, a, np.float32), scenario)
    p = np.zeros((), np.float32)
    run = lambda: jaxatt.sweep(loop, p, s, KEY, ticks=ticks, score=_last, progress=False)
    return cpu_ns(run, n * ticks, repeats)


def _last(params, scenario, now, log):
    return scores.final(log)


def _rest(params, scenario, t, x, z):
    return jax.tree.map(jnp.zeros_like, x)


# a filter of any number of states, in a ring each of which drives the next


def _init_filter(states: int, params, scenario):
    return (), Belief(jnp.zeros(states), jnp.eye(states))


def _tick_filter(params, scenario, now, x, belief: Belief, noise):
    prior = predict(belief, lambda x: jnp.roll(x, 1) - x, jnp.zeros(0), 1e-3, now.dt)
    belief, _ = update(prior, Reading(noise, jnp.ones(ROWS, bool)), lambda x: x[:ROWS], 1.0)
    return x, belief, belief.mean[0]


# any number of channels that may fail


def _init_channels(params, faults):
    return (), [jnp.zeros(()) for _ in faults]


def _tick_channels(params, faults, now, x, last, noise):
    told = [channel(fault, now.t, 0.1, noise[i], last[i]) for i, fault in enumerate(faults)]
    value = [read(c, jnp.sin(now.t)) for c in told]
    return x, value, sum(value)


# a campaign on disk

CAMPAIGN = r"""
import re, sys, time, jax
jax.config.update("jax_enable_x64", True)
import jaxatt
jaxatt.configure()
from experiments.campaigns import campaign
from jaxatt.campaign import run
some = campaign("observer_pd", 1, block=16384)._replace(ticks=10)
run(sys.argv[1], some, int(sys.argv[2]), progress=False)
peak = re.search(r"VmHWM:\s+(\d+)", open("/proc/self/status").read())  # getrusage tells of the parent too
print(time.process_time(), int(peak[1]) / 1024)
"""


def _disk(*sizes: int):
    for n in sizes:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "store.zarr"
            command = [sys.executable, "-c", CAMPAIGN, str(path), str(n)]
            out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            spent, peak = map(float, out.split())
            size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        yield row(f"campaign of {n} scenarios of 10 ticks, compiled and all", spent, "s CPU")
        yield row("  peak memory", peak, "MiB")
        yield row("  on disk", size / 2**20, "MiB")
