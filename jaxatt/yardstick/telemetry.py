"""What a detector is, and the seven residuals of a packet of telemetry that half of the baselines use.

Everything is written for one scenario with plain arrays, (3,), (5, 4).

May import: leo4, steady, vec, sensors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt.vec import Vec3, array, cross
from jaxatt.yardstick import leo4
from jaxatt.yardstick.leo4 import Telemetry
from jaxatt.yardstick.steady import steady


class Verdict(NamedTuple):
    """What a detector says of a packet."""

    score: Any  # () larger is more suspicious; NaN alarms
    blame: Any  # (channels,) >= 0, unit by unit, in leo4 (11,): gyros 0-3, star tracker about x y z, wheels 0-3; ones where it cannot tell


class Detector(NamedTuple):
    """A passive detector: init(params) -> z; step(params, z, telemetry) -> z, Verdict, one packet."""

    name: str
    init: Callable[[Any], Any]
    step: Callable[[Any, Any, Any], tuple[Any, Verdict]]  # of the world's telemetry
    params: Any = ()  # `init` and `step` get it first; any tree of arrays
    tuned: int = 0  # how many numbers were fitted


def blame(gyro: Any = 0.0, star: Any = 0.0, wheel: Any = 0.0):
    """Blame (11,) spread evenly over the channels of each unit."""
    kind = jnp.result_type(gyro, star, wheel)
    parts = [jnp.full(n, a, kind) for a, n in ((gyro, 4), (star, 3), (wheel, 4))]
    return jnp.concatenate(parts)


# residuals

MEMORY = 600.0  # [packets] of the parity's baseline
Q_RATE, Q_ACCELERATION = 1e-14, 4.3e-7**2 * leo4.DT  # [(rad/s)^2, (rad/s^2)^2] a tick, of the rate observer
_RATE = steady([[1, leo4.DT], [0, 1]], np.diag([Q_RATE, Q_ACCELERATION]), np.eye(1, 2), [[leo4.STD_AXIS**2]])
KD = tuple(float(k) for k in _RATE.gain[:, 0])  # (1, 1/s) of the rate observer
STD_DYNAMICS = float(np.sqrt(leo4.TICKS * _RATE.innovation[0, 0]))  # [rad/s] of five innovations, were they white
STD_PARITY = leo4.STD_GYRO / np.sqrt(leo4.TICKS)  # [rad/s]
STD = (leo4.STD_INNOVATION,) * 3 + (float(STD_PARITY),) + (STD_DYNAMICS,) * 3  # of the seven, by theory


class Residuals(NamedTuple):
    """What the residuals remember."""

    baseline: Any  # [rad/s] of the parity
    seen: Any  # [packets]
    w: Vec3  # [rad/s] of the rate observer
    a: Vec3  # [rad/s^2] acceleration that the model does not explain


def residuals_init(params: Any = None) -> Residuals:
    """Before the first packet."""
    zero = jnp.zeros(())
    three = Vec3(zero, zero, zero)
    return Residuals(zero, zero, three, three)


def residuals_step(state: Residuals, telemetry: Telemetry) -> tuple[Residuals, Any]:
    """The residuals (7,) of a packet: innovation (3) [rad], parity [rad/s], dynamics (3) [rad/s].

    Parity: mean of V y over the packet less its causal baseline, B += r max(1 / (k + 1), 1 / 600). Dynamics: a steady
    observer of rate and unexplained acceleration meets G+ y - b each tick; its five innovations are added.
    """
    seen = state.seen
    p = sum(v * jnp.sum(telemetry.gyro[:, i]) for i, v in enumerate(leo4.PARITY)) / leo4.TICKS
    hp = p - state.baseline
    baseline = state.baseline + hp * jnp.maximum(1 / (seen + 1), 1 / MEMORY)
    nu = Vec3.of(telemetry.innovation)
    bias = Vec3.of(telemetry.bias) + leo4.params.k_bias * nu
    y = Vec3(*(a - b for a, b in zip(leo4.rate_of(telemetry.gyro.T), bias)))  # components (5,)
    u = leo4.summed(telemetry.torque.T)
    w = Vec3(*(jnp.where(seen > 0, old, new[0]) for old, new in zip(state.w, y)))

    def one(told, now):
        (w, a, dyn), (y, u) = told, now
        e = y - w
        w, a = w + KD[0] * e, a + KD[1] * e
        return (w + leo4.DT * (leo4.INVERSE @ (u - cross(w, leo4.INERTIA @ w)) + a), a, dyn + e), None

    (w, a, dyn), _ = jax.lax.scan(one, (w, state.a, Vec3(*(0 * v for v in w))), (y, u))
    r = jnp.concatenate([telemetry.innovation, hp[None], array(dyn)])
    return Residuals(baseline, jnp.minimum(seen + 1, 1e6), w, a), r


@dataclass(frozen=True)  # JAX refers to functions weakly, and no tuple can be
class OnResiduals:
    """A detector's step that sees the residuals of the packet too; several in one sweep share them.

    Its state is (that of the residuals, z), as `with_residuals` starts it.
    """

    step: Callable[[Any, Any, Any, Any], tuple[Any, Verdict]]  # (params, z, residuals, telemetry)
    residuals: Callable[[Any, Any], tuple[Any, Any]] = residuals_step  # (state, telemetry) -> state, residuals

    def __call__(self, params, z, telemetry):
        residuals, r = self.residuals(z[0], telemetry)
        after, verdict = self.step(params, z[1], r, telemetry)
        return (residuals, after), verdict


@cache
def with_residuals(init: Callable[[Any], Any], start: Callable[[], Any] = residuals_init) -> Callable[[Any], Any]:
    """The init of a detector whose step is `OnResiduals`: the same function for the same arguments."""
    return lambda params: (start(), init(params))
