"""Plants: how spacecraft really move.

May import: check, vec, attitude, faults, mounting, scores.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxatt.check import door
from jaxatt.mounting import Triads
from jaxatt.vec import Mat3, Vec3, cross, diagonal, inverse, once


@door
def body_acceleration(w: Vec3, u: Vec3, J: Mat3, J_inv: Mat3, sign=-1) -> Vec3:
    """dw/dt [rad/s^2] of a rigid body under torque u [N m]: J w' = -w x J w + u.

    sign: -1 is Euler's equation; +1 the dynamics as Yun & Kang (2020), eq. (4), print them, which do not
    conserve momentum (docs/loops/observer_pd.md, erratum 1).
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


@door
def wheel_acceleration(wheel: Wheel, y, u):
    """dy/dt [deg/s^2] of a wheel at speed y under the command u (docs/loops/wheel_mrac.md, choice 7).

    y' = -a y + b u - F exp(-(y / y_s)^2) tanh(y / eps), where u has passed the bound, the dead zone and the gate.
    Continuous in y and u, so that gradients exist; the gate rises over a tenth of its width.
    """
    fade = jnp.exp(-jnp.square(y / wheel.slow))
    u = gated(beyond(jnp.clip(u, -wheel.u_max, wheel.u_max), wheel.dead_zone), wheel.gate)
    driven = (1 - wheel.weakness * fade) * (wheel.b * u - wheel.a * y)
    return beyond(driven - wheel.friction * fade * jnp.tanh(y / wheel.creep), wheel.stiction * fade)


@door
def beyond(u, width):
    """What of u lies beyond the dead zone [-width, width]; for no width u itself, its gradient included."""
    return jnp.where(jnp.abs(u) >= width, u - jnp.sign(u) * width, 0)


@door
def gated(u, gate):
    """u, or nothing where |u| < gate: a gate whose edge, a smooth step, is a tenth of it wide."""
    shut = gate > 0
    s = jnp.clip(10 * jnp.abs(u) / jnp.where(shut, gate, 1) - 9.5, 0, 1)
    return jnp.where(shut, s * s * (3 - 2 * s) * u, u)


# rigid body with reaction wheels


@door
def wheeled_acceleration(w: Vec3, H: Vec3, T: Vec3, J: Mat3, J_inv: Mat3) -> Vec3:
    """dw/dt [rad/s^2] of a body whose wheels hold the momentum H and gain it at the rate T, both in body axes.

    J w' = -T - w x (J w + H), Park (2005), eq. (3): the torque on the body is -T. Any consistent units.
    """
    return J_inv @ (-T - cross(w, J @ w + H))


@door
def wheel_rate(u, h, torque_max, momentum_max):
    """What the wheels make of the commanded momentum rate u: limited, and none outward past momentum_max.

    u, h: (n, *lanes) commanded rate and momentum; torque_max, momentum_max: limits of shape (*lanes), inf for none.
    """
    limited = jnp.clip(u, -torque_max, torque_max)
    full = jnp.abs(h) >= momentum_max
    return jnp.where(full & (limited * h > 0), 0, limited)


# control-moment-gyro cluster


class ModuleInertia(NamedTuple):
    """Moments of inertia of one module, the same for all of a cluster; shape (*lanes)."""

    I_cr: Any  # [kg m^2] of the whole module about its gimbal axis r
    I_cs: Any  # [kg m^2] of the whole module about its spin axis s
    I_ct: Any  # [kg m^2] of the whole module about its torque axis t
    I_ws: Any  # [kg m^2] of the wheel about its spin axis


class CmgMotion(NamedTuple):
    """Rates of change of a spacecraft with a cluster."""

    w: Vec3  # (*lanes) [rad/s^2]
    rate: Any  # (n, *lanes) [rad/s^2] of the gimbal rates
    spin: Any  # (n, *lanes) [rad/s^2] of the wheel speeds


@door
def cluster_inertia(J: Mat3, at: Triads, m: ModuleInertia) -> Mat3:
    """J_T of eq. (11) [kg m^2]: J_S + sum I_cr r r' + I_cs s s' + I_ct t t', using r r' + s s' + t t' = 1."""
    r, s = each_module(at.r), each_module(at.s)
    o = len(r) * m.I_ct + jnp.zeros_like(J.x.x)
    return sum((dyad(a, m.I_cr - m.I_ct) + dyad(b, m.I_cs - m.I_ct) for a, b in zip(r, s)), J + diagonal((o, o, o)))


@door
def cluster_momentum(w: Vec3, rate, spin, at: Triads, J_T: Mat3, m: ModuleInertia) -> Vec3:
    """h_T of eq. (11) [N m s] at gimbal rates ``rate`` and wheel speeds ``spin`` of shape (n, *lanes) [rad/s]."""
    h = J_T @ w
    for r, s, a, b in zip(each_module(at.r), each_module(at.s), rate, spin):
        h += m.I_cr * a * r + m.I_ws * b * s
    return h


@door
def cmg_motion(w: Vec3, rate, spin, at: Triads, J: Mat3, m: ModuleInertia, servo, brake, free, friction) -> CmgMotion:
    """How a spacecraft with a cluster moves without outer torque, Jin & Leeghim (2021), eqs. (11)-(12), any n.

    w: body rate [rad/s]; rate, spin: gimbal rates and wheel speeds relative to their mounting [rad/s]; J: of the
    spacecraft without modules [kg m^2]. Module by module, of shape (n, *lanes): servo: gimbal acceleration that
    the gimbal's drive enforces [rad/s^2]; brake: b_r of the wheel [N m s], 0 where its motor holds the speed;
    free: 1 where no drive holds the gimbal and it swings against friction [N m s], servo ignored, otherwise 0.

    A free gimbal obeys the balance of momentum about its own axis, in which r.w' couples back to the body; the
    wheel law leaves out the s.w' part of the wheel's acceleration, as the paper does.
    """
    J_T = cluster_inertia(J, at, m)
    torque = -cross(w, cluster_momentum(w, rate, spin, at, J_T, m))
    J_w = J_T
    change, spin_change = [], []
    for i, (r, s, t) in enumerate(zip(*map(each_module, at))):
        s_w, t_w = s @ w, t @ w
        swing = ((m.I_cs - m.I_ct) * s_w * t_w + m.I_ws * spin[i] * t_w - friction[i] * rate[i]) / m.I_cr  # less r.w'
        change.append(jnp.where(free[i] > 0, swing, servo[i]))
        spin_change.append(-brake[i] * spin[i] / m.I_ws)
        torque -= m.I_ws * spin[i] * rate[i] * t  # gyroscopic, eq. (5)
        torque -= m.I_cr * change[i] * r
        torque -= (m.I_cs - m.I_ct) * rate[i] * (s_w * t + t_w * s)  # J_T' w
        torque -= m.I_ws * spin_change[i] * s  # reaction of the brake, in eq. (12) tau_br s_4
        J_w -= dyad(r, m.I_cr * free[i])
    w_change = inverse(J_w) @ torque
    change = [a - free[i] * (r @ w_change) for i, (a, r) in enumerate(zip(change, each_module(at.r)))]
    return CmgMotion(w_change, jnp.stack(change), jnp.stack(spin_change))


@door
def each_module(v: Vec3) -> list[Vec3]:
    """The vectors, components of shape (*lanes), of a `Vec3` of shape (n, *lanes).

    Sums over modules are written out: over the array's axis they compile to code several times slower.
    """
    return [Vec3(*components) for components in zip(*v)]


@door
def dyad(v: Vec3, weight) -> Mat3:
    """weight v v'."""
    by = weight * v
    return Mat3(v.x * by, v.y * by, v.z * by)


# rigid body on a circular orbit


@door
def gravity_gradient(down: Vec3, J: Mat3, orbit_rate) -> Vec3:
    """Gravity-gradient torque 3 wo^2 z x J z [N m]; down: nadir z in body axes, a unit vector; orbit_rate [rad/s]."""
    return 3 * orbit_rate * orbit_rate * cross(down, J @ down)
