"""Speed of the grid count of Table 3 against plain C, and of the closed loop after the loss of a module."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

from benchmarks.measure import c_library, cpu_ns, seconds
from jaxatt import simulate, sweep
from jaxatt import singularity as sg
from jaxatt.cmg import cmg_triads, modules
from jaxatt.loops import cmg_loss as cmg

COUNTS = {"pyramid": (cmg.PYRAMID, 8808256), "box-90": (cmg.BOX, 16346560)}  # mounting of four, count of three, 0.5 deg


def rows(quick: bool) -> Iterator[dict]:
    """Grid at 0.5 deg, float64, exact counts in both programs; loop at N = 1024, float64."""
    yield from grid()
    yield from loop(quick)


def grid() -> Iterator[dict]:
    library = c_library(Path(__file__).with_suffix(".c"), "double")
    library.ill_conditioned.restype = ctypes.c_long
    whole = 0.0
    for name, (four, exact) in COUNTS.items():
        axes = modules(four, [0, 1, 2])
        at = jax.tree.map(lambda a: a[:, None], axes)
        table = np.stack([np.asarray(c) for c in cmg_triads(at, np.radians(0.5) * np.arange(360)).t], axis=1)
        table = np.ascontiguousarray(table)  # (module, xyz, angle)
        pointer = table.ctypes.data_as(ctypes.c_void_p)
        found = {}

        def in_c(pointer=pointer, found=found):
            found["C"] = 8 * library.ill_conditioned(pointer, ctypes.c_int(360), ctypes.c_double(100.0))

        def ours(axes=axes, found=found):
            found["jaxatt"], _ = sg.ill_conditioned(axes, 720)

        evaluated = 360**3
        c, j = cpu_ns(in_c, evaluated), cpu_ns(ours, evaluated)
        for program, count in found.items():
            if count != exact:
                raise RuntimeError(f"`{program}` must count {exact} for the {name}, but it is {count}.")
        whole += seconds(ours)
        yield {"name": f"grid 0.5 deg, {name}: C", "value": c, "unit": "ns per evaluated point"}
        yield {"name": f"grid 0.5 deg, {name}: jaxatt", "value": j, "unit": "ns per evaluated point"}
        yield {"name": f"grid 0.5 deg, {name}: rate of jaxatt / rate of C", "value": c / j, "unit": ""}
    yield {"name": "grid 0.5 deg, 2 x 373 248 000 points: wall time", "value": whole, "unit": "s"}


def loop(quick: bool) -> Iterator[dict]:
    ticks = 100 if quick else 400
    batch = jax.tree.map(lambda a: np.broadcast_to(np.asarray(a, float), (1024, *np.shape(a))), cmg.scenario)
    key = jax.random.key(0)
    for substeps, step in ((10, "1 ms"), (1, "10 ms")):
        system = cmg.system._replace(substeps=substeps)

        def swept(system=system):
            return sweep(system, cmg.params, batch, key, ticks=ticks, score=cmg.score, progress=False)

        ns = cpu_ns(swept, 1024 * ticks * substeps, 3)
        yield {"name": f"loop, N = 1024, float64, plant step {step}", "value": ns, "unit": "ns per scenario-step"}

    def cost(params):
        log = jax.vmap(lambda s: simulate(system, params, s, key, ticks=100))(batch_128)
        return (log.w @ log.w).sum()

    batch_128 = jax.tree.map(lambda a: a[:128], batch)
    forward, gradient = jax.jit(cost), jax.jit(jax.grad(cost))
    f, g = cpu_ns(lambda: forward(cmg.params), 128 * 100, 3), cpu_ns(lambda: gradient(cmg.params), 128 * 100, 3)
    yield {"name": "gradient in all params / run, N = 128, plant step 10 ms", "value": g / f, "unit": ""}
