"""On-board code of any loop as a module of Basilisk: it moves the spacecraft and its sensors, our computer steers and detects.

    computer = basilisk.computer(loop.decide, loop.params, start, dt=0.1, read=read, write=write)
    sim.AddModelToTask("task", computer, priority)  # below spacecraft and sensors, above actuators

The task's period is the tick. At each tick ``read()`` makes readings of Basilisk's messages, ``decide`` runs, compiled, and
``write`` tells which messages the module shall send; what reads them acts from this tick to the next. Needs Basilisk:
pip install 'jaxatt[bench]'.

May import: check, compiling, clock, stepping.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.clock import meant
from jaxatt.compiling import compiled
from jaxatt.stepping import on_board, timing_of


def computer(
    decide: Callable,
    params,
    start,
    *,
    dt: float,
    read: Callable[[], Any],
    write: Callable[[Any, Any], Iterable] | None = None,
    flow: Callable | None = None,
    substeps: int = 1,
):
    """On-board code as a Python module of Basilisk, a ``SysModel``.

    Args:
        decide: (params, now, computer, readings) -> computer, log, as in a closed loop.
        params: what the engineer ships.
        start: what the computer knows before the first tick.
        dt: [s] of a tick, the period of the module's task; the tick of time zero is the first.
        read: () -> readings, what ``decide`` takes; called at each tick, to read messages.
        write: (computer, log) -> pairs (message, payload) to send, of NumPy numbers after ``decide``; None: nothing is sent.
        flow: of the computer between ticks, as of `jaxatt.replay.replay`; it sees the readings held.
        substeps: RK4 steps of ``flow`` in a tick.

    Returns:
        The module. ``module.computer`` is what it knows, ``module.record()`` gives times, computers and logs of all
        ticks, time first, as `jaxatt.simulate` does. `InitializeSimulation` brings it back to the start.

    Raises:
        ValueError: dt that is not positive or no whole number of nanoseconds, substeps < 1; in a run, a task of another
            period (Basilisk prints it and raises RuntimeError, as for all that fails in a run).
        TypeError: what is no number or no function.
        ImportError: without Basilisk.

    Example:
        >>> torque = messaging.CmdTorqueBodyMsg()
        >>> payload = lambda u: messaging.CmdTorqueBodyMsgPayload(torqueRequestBody=np.array(u).tolist())
        >>> sent = lambda computer, log: [(torque, payload(log.u))]
        >>> module = basilisk.computer(decide, params, start, dt=0.1, read=read, write=sent)
    """
    dt, substeps = timing_of(decide, flow, dt, substeps)
    check.function("read", read)
    if write is not None:
        check.function("write", write)
    nanos = meant(dt) * 10**9
    if nanos.denominator != 1:
        check.refuse("dt", "be a whole number of nanoseconds", f"{dt:.17g}")
    params, start = check.converted(params, check.numbers("start", start))
    return _module()(decide, flow, dt, int(nanos), substeps, params, start, read, write or (lambda computer, log: ()))


@cache
def _module() -> type:
    """The class, made when it is first asked for: Basilisk is imported here and nowhere else."""
    try:
        from Basilisk.architecture import sysModel  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(f"jaxatt.basilisk needs Basilisk: pip install 'jaxatt[bench]' ({error}).") from None

    class Computer(sysModel.SysModel):
        """One computer on board."""

        def __init__(self, decide, flow, dt, nanos, substeps, params, start, read, write):
            super().__init__()
            self.ModelTag = "computer"
            self.static = decide, flow, dt, substeps
            self.nanos, self.params, self.start, self.read, self.write = nanos, params, start, read, write
            self.dtype = check.float_type((params, start))
            self.Reset(0)

        def Reset(self, CurrentSimNanos):
            self.computer, self.told = self.start, []

        def UpdateState(self, CurrentSimNanos):
            k = len(self.told)
            if CurrentSimNanos != k * self.nanos:
                must = f"be the period of the task, so that tick {k} comes at {k * self.nanos} ns"
                check.refuse("dt", must, f"at {CurrentSimNanos} ns")
            readings = jax.tree.map(self.typed, check.numbers("readings", self.read()))
            operands = self.params, np.int32(k), self.computer, readings
            self.computer, *told = compiled(on_board, 4, operands)(*self.static, *operands)
            self.told.append(told := jax.tree.map(lambda a: np.asarray(a)[()], told))
            for message, payload in self.write(*told):
                message.write(payload, CurrentSimNanos, self.moduleID)

        def typed(self, leaf):
            """A reading in the floating type of the params; flags and integers stay what they are."""
            kind = getattr(leaf, "dtype", bool if isinstance(leaf, bool) else self.dtype)
            return np.asarray(leaf, self.dtype if jnp.issubdtype(kind, jnp.floating) else kind)

        def record(self):
            """Times [s], computers after ``decide`` and logs, time first."""
            t = self.nanos * 1e-9 * np.arange(len(self.told))
            return t, *jax.tree.map(lambda *a: np.stack(a), *self.told)

    return Computer
