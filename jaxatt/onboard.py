"""Run on-board code from a file that `jaxatt.exporting.write` has written. Needs jax and flatbuffers, and no jaxatt.

A copy lies in each file, which Python imports from there: ``sys.path.append("computer.zip"); from onboard import load``.

May import: nothing of ours.
"""

import io
import json
import zipfile
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jax import export


class OnBoard(NamedTuple):
    """Code, numbers by name, and what both mean."""

    decide: Callable  # (k, params, computer, readings) of tick k -> computer of tick k + 1, log: dicts by name
    params: dict  # as they were shipped
    computer: dict  # before tick 0
    about: dict  # `dt` [s], and unit, shape and type of each number


def load(path) -> OnBoard:
    """The on-board code in a file; ValueError for a file of float64 where jax runs in float32, and for wrong names."""
    with zipfile.ZipFile(path) as file:
        about = json.loads(file.read("about.json"))
        code = export.deserialize(bytearray(file.read("decide.bin")))
        with np.load(io.BytesIO(file.read("numbers.npz"))) as numbers:
            params, computer = ({n: numbers[f"{kind}/{n}"] for n in about[kind]} for kind in ("params", "computer"))
    if about["float"] == "float64" and not jax.config.read("jax_enable_x64"):
        raise ValueError(
            "`path` must hold float32, but it is float64: first jax.config.update('jax_enable_x64', True)."
        )
    call = jax.jit(code.call)

    def decide(k, params, computer, readings):
        given = {"params": params, "computer": computer, "readings": readings}
        for kind, tree in given.items():
            if odd := set(tree) ^ set(about[kind]):
                raise ValueError(
                    f"`{kind}` must hold the names of about[{kind!r}], but it is not so for {sorted(odd)}."
                )
            given[kind] = {n: np.asarray(tree[n], a["type"]) for n, a in about[kind].items()}
        return call(np.asarray(k, about["k"]), *given.values())

    return OnBoard(decide, params, computer, about)
