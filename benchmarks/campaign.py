"""Campaigns under stress: killed at random moments, memory over the number of scenarios, cost over a bare sweep."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks import tiny_campaign as tiny
from experiments.campaigns import campaign
from jaxatt import sweep
from jaxatt.campaign import run, scenarios

KILLS, BLOCKS = 50, 40


def rows(quick: bool):
    """Counts of the kills, peak memory of 10 000 and 100 000 scenarios, time per block over that of a sweep."""
    with tempfile.TemporaryDirectory() as folder:
        yield from kills(Path(folder), 5 if quick else KILLS)
        yield from memory(Path(folder), *((2000, 20_000) if quick else (10_000, 100_000)))
        yield from overhead(Path(folder), 3 if quick else 5)


def kills(folder: Path, count: int, seed: int = 0):
    """Kill -9 a campaign at random moments, resume it, and compare all files with those of an uninterrupted one."""
    context, rng, n = tiny.processes(), np.random.default_rng(seed), BLOCKS * 128
    started = time.perf_counter()
    tiny.killed(context, folder / "x.zarr", BLOCKS, BLOCKS, 0.0)
    whole = time.perf_counter() - started
    run(folder / "whole.zarr", tiny.campaign(), n, progress=False)
    expected, deaths, identical = tiny.files(folder / "whole.zarr"), [], 0
    for k in range(count):
        after = int(rng.integers(1, BLOCKS)) if k % 10 else 0  # one in ten dies at any moment of all
        path, moment = folder / f"{k}.zarr", rng.uniform(0, 0.03 if after else whole)
        deaths.append(tiny.killed(context, path, BLOCKS, after, moment))
        run(path, tiny.campaign(), n, progress=False)
        identical += tiny.files(path) == expected
    partial = sum(0 < death.blocks < BLOCKS for death in deaths)
    yield dict(name=f"killed at {count} random moments and resumed: all files the same", value=identical, unit="times")
    yield dict(name=f"  left between 1 and {BLOCKS - 1} of {BLOCKS} blocks", value=partial, unit="times")
    yield dict(name="  inside a write", value=sum(death.inside for death in deaths), unit="times")


PEAK = """
import resource, sys, jax
jax.config.update("jax_enable_x64", True)
from experiments.campaigns import campaign
from jaxatt.campaign import run
from jaxatt.campaign.summary import describe
some = campaign("observer_pd", 1)._replace(ticks=20)
describe(run(sys.argv[1], some, int(sys.argv[2]), progress=False))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def memory(folder: Path, few: int, many: int):
    """Peak resident memory of a process that runs and sums up a campaign of few and of many scenarios."""
    peaks = {}
    for n in (few, many):
        command = [sys.executable, "-c", PEAK, str(folder / f"memory{n}.zarr"), str(n)]
        peaks[n] = float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        yield dict(name=f"peak memory, {n} scenarios of observer_pd", value=peaks[n], unit="MiB")
    yield dict(name="  the many over the few", value=peaks[many] / peaks[few], unit="1")


def overhead(folder: Path, repeats: int, blocks: int = 4, size: int = 8192):
    """CPU time of campaigns over that of the bare sweep of the same scenarios, in blocks of at least a second."""
    base = campaign("observer_pd", 1)
    base, n = base._replace(block=size), blocks * size
    many = scenarios(base, 0, n)

    def bare():
        sweep(base.system, base.params, many, base.key, ticks=base.ticks, score=base.score, progress=False)

    def whole(count):
        path = folder / f"overhead{len(list(folder.iterdir()))}.zarr"
        run(path, base, count * size, progress=False)

    def seconds(work):
        cpu, wall = time.process_time(), time.perf_counter()
        work()
        return time.process_time() - cpu, time.perf_counter() - wall

    whole(1)
    bare()
    times = np.array(
        [[seconds(bare), seconds(lambda: whole(blocks)), seconds(lambda: whole(1))] for _ in range(repeats)]
    )
    (sweep_cpu, sweep_wall), (cpu, _), (one, _) = times.min(0)
    yield dict(name=f"block of {size} scenarios, bare sweep", value=sweep_wall / blocks, unit="s")
    each = (cpu - one) / (blocks - 1)
    yield dict(name="  CPU time of a further block over that of the sweep", value=each / (sweep_cpu / blocks), unit="1")
    yield dict(name="  CPU time beside the blocks (names, tracing, opening)", value=one - each, unit="s")
