"""Plants: how spacecraft really move."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxatt.vec import Mat3, Vec3, cross, once


def body_acceleration(w: Vec3, u: Vec3, J: Mat3, J_inv: Mat3, sign=-1) -> Vec3:
    """dw/dt [rad/s^2] of a rigid body under torque u [N m]: J w' = -w x J w + u.

    sign: -1 is Euler's equation; +1 the dynamics as Yun & Kang (2020), eq. (4), print them, which do not
    conserve momentum (spec, 5.1).
    """
    return J_inv @ once(lambda w, u: sign * cross(w, J @ w) + u, w, u)


# one reaction wheel and its drive


class Wheel(NamedTuple):
    """A wheel's drive y' + a y = b u and what spoils it; the defaults spoil nothing. Every field has shape (*lanes).

    y: wheel speed [deg/s]; u: command [deg/s]. Any unit of angle will do, if it is the same in all.
    """

    a: Any = 10.0  # [1/s] pole a_p, Eun et al. (2016), eq. (3)
    b: Any = 20.0  # [1/s] gain b_p, eq. (3)
    u_max: Any = jnp.inf  # [deg/s] bound on the command
    dead_zone: Any = 0.0  # [deg/s] the command counts only beyond it
    gate: Any = 0.0  # [deg/s] a smaller command does nothing, a larger one counts in full
    weakness: Any = 0.0  # [1] share of the acceleration that is missing at rest
    friction: Any = 0.0  # [deg/s^2] deceleration F; Coulomb's friction with slow = inf
    stiction: Any = 0.0  # [deg/s^2] acceleration counts only beyond it, at rest
    slow: Any = 1500.0  # [deg/s] speed y_s beyond which weakness, friction and stiction fade
    creep: Any = 100.0  # [deg/s] speed eps over which friction turns round


def wheel_acceleration(wheel: Wheel, y, u):
    """dy/dt [deg/s^2] of a wheel at speed y under the command u (spec, 4).

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


# rigid body with reaction wheels


def wheeled_acceleration(w: Vec3, H: Vec3, T: Vec3, J: Mat3, J_inv: Mat3) -> Vec3:
    """dw/dt [rad/s^2] of a body whose wheels hold the momentum H and gain it at the rate T, both in body axes.

    J w' = -T - w x (J w + H), Park (2005), eq. (3): the torque on the body is -T. Any consistent units.
    """
    return J_inv @ (-T - cross(w, J @ w + H))


def wheel_rate(u, h, torque_max, momentum_max):
    """What the wheels make of the commanded momentum rate u: limited, and none outward past momentum_max.

    u, h: (n, *lanes) commanded rate and momentum; limits of shape (*lanes), inf for none.
    """
    limited = jnp.clip(u, -torque_max, torque_max)
    full = jnp.abs(h) >= momentum_max
    return jnp.where(full & (limited * h > 0), 0, limited)
