"""Worlds as data: a closed loop, the law of its days, its catalogue of faults, and how its days are drawn.

A day of number i has the same noise, motion and onset in every cell, so all comparisons are paired.

May import: leo4, leo4_days, microsat, microsat_days, microsat_rows, baselines, kinds, check, contract.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.contract import System
from jaxatt.yardstick import baselines, leo4, leo4_days, microsat, microsat_days, microsat_rows
from jaxatt.yardstick.kinds import effects


class World(NamedTuple):
    """A closed loop with the law of its days. It has two modes, even days the first, odd days the second."""

    name: str
    version: str
    system: System  # a tick is one packet; its log holds `telemetry`, with a ``mode`` 0 or 1, and `pointing` (n,) [rad]
    params: Any  # `system.init`'s
    sample: Callable  # (key, index, cell) -> Scenario; cell None: without a fault
    modes: tuple[str, str]  # two words: known on board
    units: dict[str, int]  # channels of each unit (), in the order of the blame
    warmup: float  # [s] without verdicts
    window: float  # [s] with
    onsets: Callable  # (scenario) -> onsets [s] of the channels of each unit, inf for a healthy one
    example: Callable  # () -> a packet of telemetry, NumPy
    odd: Callable  # (packets (packets, days, ...)) -> such as a fault may bring
    references: tuple  # `Detector`: those that are on every board
    sized: dict[str, tuple]  # (kind) -> sizes, eight from invisible to obvious; these make the macro
    plain: dict[str, tuple]  # (kind) -> one size, of kinds that have none
    pairs: dict[str, tuple]  # (kinds) -> pairs of sizes, of two faults at once
    held_out: dict[str, tuple]  # (kind) -> sizes, of kinds in no catalogue, never used to tune
    mismatch: dict[str, Callable]  # (name) -> `sample` of days that differ from those of the world

    @property
    def packets(self) -> int:
        """Of a run."""
        return round((self.warmup + self.window) / self.system.dt)

    @property
    def channels(self) -> int:
        """Of all units."""
        return sum(self.units.values())

    @property
    def catalogue(self) -> dict[str, tuple]:
        """Kind -> sizes."""
        return self.sized | self.plain | self.pairs


def _laws(draw: Callable, spreads: dict) -> dict[str, Callable]:
    """The laws of days of several names and spreads."""
    return {name: partial(draw, np.uint32(crc32(name.encode())), spread) for name, spread in spreads.items()}


def _world(name: str, loop: Any, days: Any, modes: tuple[str, str], references: tuple) -> World:
    """The world of a module of a loop and one of its days."""
    return World(
        name, "1", loop.system, loop.params, _laws(days.draw, {name: days.NOMINAL})[name], modes, days.UNITS, days.WARMUP,
        days.WINDOW, days.onsets, days.example, days.odd, references, days.SIZED, days.PLAIN, days.PAIRS, days.HELD_OUT,
        _laws(days.draw, days.MISMATCH),
    )  # fmt: skip


WORLDS = {
    "leo4": _world("leo4", leo4, leo4_days, ("hold", "slew"), baselines.REFERENCE),
    "microsat": _world("microsat", microsat, microsat_days, ("sunlit", "eclipse"), microsat_rows.REFERENCE),
}
CATALOGUE = {name: world.catalogue for name, world in WORLDS.items()}  # world -> {kind: sizes}


def refuse_foreign(world: World, cell) -> None:
    """Refuse, with ValueError, a cell of a kind that the world does not have, or that is none; numbers of effects pass."""
    effects(cell)
    if cell is None or not isinstance(cell[0], str):
        return
    known = {part for kind in (*world.catalogue, *world.held_out) for part in kind.split("+")}
    if not set(cell[0].split("+")) <= known:
        check.refuse("cell", f"be of a kind that {world.name} has, {', '.join(sorted(known))}", check.short(cell))


def days(world: World, key, numbers, cells) -> Any:
    """Scenarios of the days ``numbers``, float32 NumPy arrays with n in front.

    cells: one cell, or `effects` of shape (n,).
    """
    refuse_foreign(world, cells)
    numbers = np.asarray(numbers, np.int32)
    return drawn(world.sample, key, numbers, jax.tree.map(lambda a: np.broadcast_to(a, numbers.shape), effects(cells)))


def short(a) -> np.ndarray:
    """A number in float32, the type of all runs of the yardstick."""
    a = np.asarray(a)
    return a.astype(np.float32) if a.dtype.kind == "f" else a


def drawn(sample: Callable, key, numbers, cells) -> Any:
    """sample(key, number, cell) of all numbers, float32 NumPy arrays with n in front.

    sample: a function, or a partial whose arguments are numbers and may differ without a new program; cells: a tree of
    arrays with n in front.
    """
    numbers, full = np.asarray(numbers, np.int32), -(-len(numbers) // DRAWN) * DRAWN
    wide = lambda a: np.resize(np.asarray(a, np.float32), (full, *np.shape(a)[1:]))
    cells, places = jax.tree.map(wide, cells), np.resize(numbers, full)
    function, of_world = (sample.func, sample.args) if isinstance(sample, partial) else (sample, ())
    parts = [
        _many(function)(of_world, key, places[i : i + DRAWN], jax.tree.map(lambda a, i=i: a[i : i + DRAWN], cells))
        for i in range(0, full, DRAWN)
    ]
    return jax.tree.map(lambda *a: np.concatenate(a)[: len(numbers)], *parts)


DRAWN = 256  # days that are drawn at once: one program for all worlds, cells and numbers of days


@lru_cache
def _many(sample: Callable):
    """Days of a world, whose numbers are operands, compiled once."""

    def run(of_world, key, numbers, both):
        drawn = jax.vmap(partial(sample, *of_world), in_axes=(None, 0, 0))(key, numbers, both)
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (DRAWN, *a.shape[1:])).astype(jnp.float32), drawn)

    return jax.jit(run)


def true_channels(world: World, scenario):
    """Which channels are faulty, bool (channels,) behind the days."""
    return np.concatenate([np.isfinite(np.asarray(a)) for a in world.onsets(scenario)], axis=-1)


def onset_of(world: World, scenario):
    """Onset [s] in the window, (n,); inf without a fault."""
    return np.minimum.reduce([np.asarray(a).min(-1) for a in world.onsets(scenario)]) - world.warmup
