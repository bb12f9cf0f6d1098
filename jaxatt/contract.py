"""The contract: what a closed loop is made of. Every function sees one scenario; `jaxatt.sweep` runs many.

Time runs in ticks of ``dt``. A tick happens at an instant: sensors read, on-board code decides, a log is written.
Between ticks the continuous state flows.

May import: nothing of ours.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol


class Now(NamedTuple):
    """The present tick."""

    k: Any  # () [1] number of the tick, from 0
    t: Any  # () [s] k dt, the floating number next to it (`jaxatt.clock`): ``t >= 0.3`` holds from the tick of 0.3 s on
    dt: float  # [s] to the next tick


class Init(Protocol):
    """The state before tick 0: x moves between ticks, z is held."""

    def __call__(self, params: Any, scenario: Any, /) -> tuple[Any, Any]: ...


class Tick(Protocol):
    """One tick: the next x and z, of the same structure and shapes, and a log (any pytree of arrays)."""

    def __call__(self, params: Any, scenario: Any, now: Now, x: Any, z: Any, noise: Any, /) -> tuple[Any, Any, Any]: ...


class Flow(Protocol):
    """dx/dt at time t [s], a tree like x."""

    def __call__(self, params: Any, scenario: Any, t: Any, x: Any, z: Any, /) -> Any: ...


class Score(Protocol):
    """The tallies of one tick (`jaxatt.scores`); a sweep adds them up."""

    def __call__(self, params: Any, scenario: Any, now: Now, log: Any, /) -> Any: ...


class Check(Protocol):
    """Raises ValueError for params and a scenario that do not go together; see `System.check`."""

    def __call__(self, params: Any, scenario: Any, /) -> None: ...


def no_check(params, scenario) -> None:
    """The check of a loop that refuses nothing beyond what its fields say."""


class System(NamedTuple):
    """A closed loop: pure functions and plain numbers, hence hashable.

    x is the continuous state, moved by ``flow`` and, at jumps, by ``tick``; z is held between ticks. Both are pytrees
    (NamedTuples, as a rule). params: what the engineer ships; scenario: what the day brings.

    check: what no single field can say (`jaxatt.fields` has the rest). It gets NumPy arrays and is called before
    anything is compiled; a sweep hands it all scenarios at once, behind the axes that one scenario has, so write it
    with `jaxatt.check` or element by element. `check.last_tick` tells how long the run is, for tables that must reach.
    """

    init: Init
    tick: Tick
    flow: Flow
    dt: float  # [s] between ticks
    substeps: int = 1  # RK4 steps between ticks
    normals: int = 0  # standard normal numbers that a tick gets as ``noise``, shape (normals,)
    check: Check = no_check
