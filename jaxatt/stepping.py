"""One tick of on-board code outside of its closed loop: for recorded readings, for files of code, for other simulators.

May import: check, clock, contract, engine.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxatt import check
from jaxatt.clock import time_of
from jaxatt.contract import Now
from jaxatt.engine import alone, match_state, rk4


def timing_of(decide, flow, dt, substeps) -> tuple[float, int]:
    """dt and substeps of on-board code, as of `on_board`; refuses what is no function, dt <= 0 and substeps < 1."""
    check.function("decide", decide)
    if flow is not None:
        check.function("flow", flow)
    dt = check.number("dt", dt)
    check.positive("dt", dt)
    return float(dt), check.whole("substeps", substeps)


def on_board(
    decide: Callable, flow: Callable | None, dt: float, substeps: int, params, k, computer, readings, stages=None
):
    """What the computer knows before tick k + 1, what it knew after ``decide`` at tick k, and the log of that.

    decide, flow, params, computer, readings: as of `jaxatt.replay.replay`, of one tick. dt: [s]. substeps: of RK4 in a tick.
    stages: readings that flow sees, leaves of shape (substeps, 4, ...); None: those of the tick, held. Raises TypeError
    where decide or flow return another structure, type or shape.
    """
    dtype = check.float_type((params, computer, readings))
    now = Now(k, time_of(k, dt, dtype), dt)

    def one(computer, readings):
        out = decide(params, now, computer, readings)
        if not isinstance(out, tuple) or len(out) != 2:
            raise TypeError(f"`decide` must return computer, log, but it is {check.short(out)}.")
        return match_state(out[0], computer, "decide"), jax.tree.map(jnp.asarray, out[1])

    after, log = alone(one, computer, readings)
    if flow is None:
        return after, after, log
    rates = jax.eval_shape(flow, params, after, readings)
    if not isinstance(rates, dict) or not set(rates) <= set(getattr(after, "_fields", ())):
        raise TypeError(f"`flow` must return a dict by fields of the computer, but it is {check.short(rates)}.")
    h = dt / substeps

    def ahead(x, step):
        at, seen = step

        def rate(t, x, now=readings):
            return match_state(flow(params, after._replace(**x), now), x, "flow")

        return rk4(rate, at, x, h, seen), None

    moving = {name: getattr(after, name) for name in rates}
    times = now.t + h * jnp.arange(substeps, dtype=dtype)
    return after._replace(**jax.lax.scan(ahead, moving, (times, stages))[0]), after, log
