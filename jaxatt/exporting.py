"""On-board code of any loop as one file that runs without jaxatt.

    exporting.write("computer.zip", loop.decide, loop.params, computer, readings, dt=loop.DT)

The file is a ZIP archive: ``decide.bin``, the function as `jax.export` serializes it; ``about.json``, the period and unit,
shape and type of every number by name; ``numbers.npz``, params and computer before the first tick; ``onboard.py``, which
loads it (`jaxatt.onboard`). What is exported is the program that `jaxatt.replay` runs at each tick. Writing and loading
need flatbuffers, as `jax.export` itself: the extra ``export``. JAX reads files that are up to six months old.

May import: check, fields, stepping, onboard.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check, fields, onboard
from jaxatt.stepping import on_board, timing_of


def write(
    path,
    decide: Callable,
    params,
    computer,
    readings,
    *,
    dt: float,
    flow: Callable | None = None,
    substeps: int = 1,
    platforms: tuple[str, ...] = ("cpu",),
) -> Path:
    """Write on-board code to one file.

    The code is (k, params, computer, readings) to the computer of tick k + 1 and the log of ``decide`` at tick k: each a
    dict of arrays by name, ``belief.q.w``. In closed loop on board, the flow between two ticks sees the readings held.

    Args:
        path: of the file.
        decide: (params, now, computer, readings) -> computer, log, as in a closed loop.
        params: what the engineer ships; the file holds them, and the code takes others.
        computer: what the computer knows before the first tick.
        readings: of any one tick: only shapes and types matter.
        dt: [s] between ticks.
        flow: of the computer between ticks, as of `jaxatt.replay.replay`.
        substeps: RK4 steps of ``flow`` between ticks.
        platforms: on which the code shall run, of "cpu", "cuda", "rocm", "tpu".

    Returns:
        The path.

    Raises:
        ValueError: dt <= 0, substeps < 1, another platform, names that are not one a number, a
            folder that is not there.
        TypeError: what is no number or no path; ``decide`` or ``flow`` that return another structure, type or shape.
        ImportError: without flatbuffers.

    Example:
        >>> computer = loop.computer_of(*loop.init(loop.params, loop.scenario))
        >>> exporting.write("computer.zip", loop.decide, loop.params, computer, readings, dt=loop.DT)
        >>> code = onboard.load("computer.zip")
        >>> computer, log = code.decide(0, code.params, code.computer, {"gyro.value.x": 0.1, ...})
    """
    dt, substeps = timing_of(decide, flow, dt, substeps)
    if not isinstance(platforms, (tuple, list)) or not platforms or not set(platforms) <= set(PLATFORMS):
        check.refuse("platforms", f"be some of {', '.join(PLATFORMS)}", check.short(platforms))
    try:
        import flatbuffers  # noqa: F401  # pyright: ignore[reportMissingImports, reportMissingModuleSource]
    except ImportError as error:
        raise ImportError(f"jaxatt.exporting needs flatbuffers: pip install 'jaxatt[export]' ({error}).") from None
    for name, tree in (("computer", computer), ("readings", readings)):
        check.numbers(name, tree)
    params, (computer, readings) = check.converted(params, (computer, readings))
    given = {"params": params, "computer": computer, "readings": readings}
    flat = {kind: _named(kind, tree) for kind, tree in given.items()}
    path = check.new_file("path", path)
    of_log = {}

    def code(k, *by_name):
        trees = [jax.tree.unflatten(jax.tree.structure(tree), [numbers[name] for name in flat[kind]])
                 for (kind, tree), numbers in zip(given.items(), by_name)]  # fmt: skip
        ahead, _, log = on_board(decide, flow, dt, substeps, trees[0], k, *trees[1:])
        of_log.update(_about(_named("log", log), log))
        return _named("computer", ahead), _named("log", log)

    k = jnp.asarray(0)
    exported = jax.export.export(jax.jit(code), platforms=tuple(platforms))(k, *flat.values())
    about = {
        "written by": f"jaxatt.exporting with jax {jax.__version__}",
        "dt": dt,
        "platforms": list(platforms),
        "float": str(check.float_type((params, computer, readings))),
        "k": str(k.dtype),
        **{kind: _about(flat[kind], tree) for kind, tree in given.items()},
        "log": of_log,
    }
    numbers = io.BytesIO()
    kept = {f"{kind}/{name}": a for kind in ("params", "computer") for name, a in flat[kind].items()}
    np.savez(numbers, **kept)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("about.json", json.dumps(about, indent=1) + "\n")
        file.writestr("decide.bin", bytes(exported.serialize()))
        file.writestr("numbers.npz", numbers.getvalue())
        file.write(onboard.__file__, "onboard.py")
    return path


PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def _named(kind: str, tree) -> dict:
    """The leaves of a tree by name, of which there must be one for each; a single leaf bears the name of its kind."""
    found = fields.named(tree, kind)
    if len(found) < len(jax.tree.leaves(tree)):
        check.refuse(kind, "name every number once", f"with names such as {check.short(list(found))} twice")
    return found


def _about(numbers: dict, tree) -> dict:
    units = fields.units_within(tree)
    return {
        name: {"unit": units.get(name), "shape": list(np.shape(a)), "type": str(jnp.result_type(a))}
        for name, a in numbers.items()
    }
