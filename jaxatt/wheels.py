"""Reaction wheels: where they point, how a wheel and its drive move, limits, allocation of a torque.

May import: check, vec, attitude, faults, scores.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.check import finite, limit, not_negative, share
from jaxatt.vec import Mat3, Vec3, diagonal, inverse

# one reaction wheel and its drive


class Wheel(NamedTuple):
    """A wheel's drive y' + a y = b u and what spoils it; the defaults spoil nothing.

    y: wheel speed [deg/s]; u: command [deg/s]. Any unit of angle will do, if it is the same in all.
    """

    a: Annotated[Any, "1/s", finite] = 10.0  # pole a_p, Eun et al. (2016), eq. (3)
    b: Annotated[Any, "1/s", finite] = 20.0  # gain b_p, eq. (3)
    u_max: Annotated[Any, "deg/s", limit] = jnp.inf  # bound on the command
    dead_zone: Annotated[Any, "deg/s", finite, not_negative] = 0.0  # the command counts only beyond it
    gate: Annotated[Any, "deg/s", finite, not_negative] = 0.0  # smaller commands do nothing, larger ones count in full
    weakness: Annotated[Any, "1", share] = 0.0  # share of the acceleration that is missing at rest
    friction: Annotated[Any, "deg/s^2", finite, not_negative] = 0.0  # deceleration F; Coulomb's with slow = inf
    stiction: Annotated[Any, "deg/s^2", finite, not_negative] = 0.0  # acceleration counts only beyond it, at rest
    slow: Annotated[Any, "deg/s", limit] = 1500.0  # speed y_s beyond which weakness, friction and stiction fade
    creep: Annotated[Any, "deg/s", limit] = 100.0  # speed eps over which friction turns round

    def check(self, name: str) -> None:
        """Refuse, with ValueError, a wheel that no command can turn."""
        if check.concrete(self.b):
            b = np.asarray(self.b)
            check.each(f"{name}.b", "not be zero (no command could turn the wheel)", b, b != 0)


def wheel_acceleration(wheel: Wheel, y, u):
    """dy/dt [deg/s^2] of a wheel at speed y under the command u (docs/loops/wheel_mrac.md, choice 7).

    y' = -a y + b u - F exp(-(y / y_s)^2) tanh(y / eps), where u has passed the bound, the dead zone and the gate.
    Continuous in y and u, so that gradients exist; the gate rises over a tenth of its width.
    """
    fade = jnp.exp(-jnp.square(y / wheel.slow))
    u = gated(beyond(jnp.clip(u, -wheel.u_max, wheel.u_max), wheel.dead_zone), wheel.gate)
    driven = (1 - wheel.weakness * fade) * (wheel.b * u - wheel.a * y)
    return beyond(driven - wheel.friction * fade * jnp.tanh(y / wheel.creep), wheel.stiction * fade)


def beyond(u, width):
    """What of u lies beyond the dead zone [-width, width]; for no width u itself, its gradient included."""
    return jnp.where(jnp.abs(u) >= width, u - jnp.sign(u) * width, 0)


def gated(u, gate):
    """u, or nothing where |u| < gate: a gate whose edge, a smooth step, is a tenth of it wide."""
    shut = gate > 0
    s = jnp.clip(10 * jnp.abs(u) / jnp.where(shut, gate, 1) - 9.5, 0, 1)
    return jnp.where(shut, s * s * (3 - 2 * s) * u, u)


def wheel_rate(u, h, torque_max, momentum_max):
    """Momentum rates (n,) that n wheels give of the commanded ones: limited, and none outward past momentum_max.

    u, h: (n,) commanded rates and momenta; torque_max, momentum_max: limits, inf for none. Any consistent units.
    """
    limited = jnp.clip(u, -torque_max, torque_max)
    full = jnp.abs(h) >= momentum_max
    return jnp.where(full & (limited * h > 0), 0, limited)


def wheel_pyramid(gamma) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Spin axes of four reaction wheels about z; Park (2005), eq. (2): the columns of W. gamma [rad]."""
    s, c = jnp.sin(gamma), jnp.cos(gamma)
    return Vec3(s * s, s * c, c), Vec3(-s * s, s * c, c), Vec3(-s * s, -s * c, c), Vec3(s * s, -s * c, c)


def allocation(T: Vec3, axes, up):
    """Least momentum rates u (n,) of the wheels that are up whose resultant is T, a momentum rate in body axes.

    u = m W' (W m W' + 1e-6 I)^-1 T: the pseudo-inverse to a part in 1e6, and finite with any number of wheels.

    axes: n `Vec3`, the columns of W; up: (n,), 1 for a wheel in use and 0 for one that is not. Any consistent units.
    """
    gram = diagonal(Vec3(1e-6, 1e-6, 1e-6))
    for axis, m in zip(axes, up):
        gram = gram + Mat3(axis.x * m * axis, axis.y * m * axis, axis.z * m * axis)
    along = inverse(gram) @ T
    return jnp.stack([m * (axis @ along) for axis, m in zip(axes, up)])
