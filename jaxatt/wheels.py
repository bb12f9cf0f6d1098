"""Reaction wheels: where they point, how one turns, its friction and limits, and how several share a torque.

Two wheels: `Wheel` is told a speed and lives inside the flow, in steps of Runge-Kutta (the test bed of Eun et al., 2016);
`TorqueWheel` is told a torque that is held over a tick. Each has the friction that its integration needs.

May import: check, vec, attitude, faults, scores, torque_matrix.
"""

from __future__ import annotations

from itertools import combinations
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.check import finite, limit, not_negative, positive, share
from jaxatt.torque_matrix import min_norm_solve
from jaxatt.vec import Vec3, columns, cross, project, resultant

# a wheel that is told a speed, in the flow


class Wheel(NamedTuple):
    """A wheel's drive y' + a y = b u and what spoils it; the defaults spoil nothing.

    y: wheel speed [deg/s]; u: command [deg/s]. Any unit of angle will do, if it is the same in all. With stiction the
    wheel comes to rest and stays until the drive asks for more; without, it creeps under any torque, as in Eun et al.
    """

    a: Annotated[Any, "1/s", finite] = 10.0  # pole a_p, Eun et al. (2016), eq. (3)
    b: Annotated[Any, "1/s", finite] = 20.0  # gain b_p, eq. (3)
    u_max: Annotated[Any, "deg/s", limit] = jnp.inf  # bound on the command
    dead_zone: Annotated[Any, "deg/s", finite, not_negative] = 0.0  # the command counts only beyond it
    gate: Annotated[Any, "deg/s", finite, not_negative] = 0.0  # smaller commands do nothing, larger ones count in full
    weakness: Annotated[Any, "1", share] = 0.0  # share of the drive's acceleration that is missing at rest
    dead_drive: Annotated[Any, "deg/s^2", finite, not_negative] = 0.0  # at rest the drive counts only beyond it
    slow: Annotated[Any, "deg/s", limit] = 1500.0  # speed y_s beyond which weakness, dead_drive and friction fade
    friction: Annotated[Any, "deg/s^2", finite, not_negative] = 0.0  # deceleration F; Coulomb's with slow = inf
    creep: Annotated[Any, "deg/s", limit] = 100.0  # speed eps over which friction without stiction turns round
    stiction: Annotated[Any, "deg/s^2", finite, not_negative] = 0.0  # the least that breaks a wheel away from rest
    stribeck: Annotated[Any, "deg/s", limit] = 10.0  # speed over which stiction falls to friction once it turns
    settle: Annotated[Any, "s", finite, positive] = 0.01  # time in which stiction brings rest; at least 0.4 of a step
    viscous: Annotated[Any, "1/s", finite, not_negative] = 0.0  # friction that grows with speed, over speed

    def check(self, name: str) -> None:
        """Refuse, with ValueError, a wheel that no command can turn."""
        if check.concrete(self.b):
            b = np.asarray(self.b)
            check.each(f"{name}.b", "not be zero (no command could turn the wheel)", b, b != 0)


def wheel_acceleration(wheel: Wheel, y, u):
    """dy/dt [deg/s^2] of a wheel at speed y under the command u: the drive, and `wheel_friction`.

    y' = -a y + b u - F exp(-(y / y_s)^2) tanh(y / eps), where u has passed the bound, the dead zone and the gate
    (docs/loops/wheel_mrac.md, choice 7). The gate rises over a tenth of its width, so that gradients exist.
    """
    fade = jnp.exp(-jnp.square(y / wheel.slow))
    u = gated(beyond(jnp.clip(u, -wheel.u_max, wheel.u_max), wheel.dead_zone), wheel.gate)
    driven = beyond((1 - wheel.weakness * fade) * (wheel.b * u - wheel.a * y), wheel.dead_drive * fade)
    return driven + wheel_friction(wheel, y, driven)


def wheel_friction(wheel: Wheel, y, driven):
    """Acceleration [deg/s^2] by friction at speed y of a wheel that its drive accelerates by ``driven``.

    Where the drive turns the wheel on, or at rest, friction holds against it, up to the stiction S; where the drive
    brakes, friction adds to it. So it never gives power to the wheel, and a wheel that comes to rest stays there. At
    speed it is F exp(-(y / y_s)^2) + (S - F) exp(-(|y| / stribeck)^2) + viscous |y|. It turns round over the speed
    width = settle S, which makes rest an equilibrium with the time constant ``settle``, stable for Runge-Kutta steps up
    to 2.7 ``settle``. The gradient of a wheel at rest is zero.
    """
    sticks = wheel.stiction > 0
    static = jnp.where(sticks, jnp.maximum(wheel.stiction, wheel.friction), 0)
    width = jnp.where(sticks, jnp.maximum(wheel.settle * static, 1e-9), wheel.creep)  # so that gradients stay finite
    turned = jnp.tanh(y / width)
    kinetic = wheel.friction * jnp.exp(-jnp.square(y / wheel.slow))
    risen = jnp.maximum(static - wheel.friction, 0)
    level = kinetic + risen * jnp.exp(-jnp.square(jnp.maximum(jnp.abs(y) - width, 0) / wheel.stribeck))
    held = jnp.where(jnp.sign(y) * driven >= 0, jnp.clip(driven, -static, static), 0)
    return -turned * level - (1 - jnp.abs(turned)) * held - wheel.viscous * y


def beyond(u, width):
    """What of u lies beyond the dead zone [-width, width]; for no width u itself, its gradient included."""
    return jnp.where(jnp.abs(u) >= width, u - jnp.sign(u) * width, 0)


def gated(u, gate):
    """u, or nothing where |u| < gate: a gate whose edge, a smooth step, is a tenth of it wide."""
    shut = gate > 0
    s = jnp.clip(10 * jnp.abs(u) / jnp.where(shut, gate, 1) - 9.5, 0, 1)
    return jnp.where(shut, s * s * (3 - 2 * s) * u, u)


# wheels that are told a torque, held over a tick


class Friction(NamedTuple):
    """A bearing's friction: c(W) = coulomb + (stiction - coulomb) exp(-(W / stribeck)^2), and viscous W."""

    coulomb: Annotated[Any, "N m", finite, not_negative] = 0.0
    stiction: Annotated[Any, "N m", finite, not_negative] = 0.0  # at rest, not below coulomb
    stribeck: Annotated[Any, "rad/s", limit] = 3.0  # speed over which stiction falls to coulomb
    viscous: Annotated[Any, "N m s", finite, not_negative] = 0.0

    def check(self, name: str) -> None:
        """Refuse, with ValueError, stiction below Coulomb friction."""
        must = f"not be below {name}.coulomb"
        check.pair(f"{name}.stiction", must, self.stiction, self.coulomb, np.greater_equal)


class TorqueWheel(NamedTuple):
    """A reaction wheel with its motor, or n of them: every field a number or (n,)."""

    J: Annotated[Any, "kg m^2", positive]  # about its axis
    torque_max: Annotated[Any, "N m", limit] = jnp.inf
    speed_max: Annotated[Any, "rad/s", limit] = jnp.inf  # no torque outward from here on: the limit of the momentum
    knee: Annotated[Any, "rad/s", finite, not_negative] = 0.0  # from here on the outward torque falls; below speed_max
    friction: Friction = Friction()

    def check(self, name: str) -> None:
        """Refuse, with ValueError, a knee that is not below the largest speed."""
        check.pair(f"{name}.knee", f"be below {name}.speed_max", self.knee, self.speed_max, np.less)


def relative_speed(J, h, axes, w: Vec3):
    """Speeds W (n,) [rad/s] of n wheels on a body that turns at w: W_i = h_i / J - a_i w.

    h: (n,) [N m s] the wheels' whole axial momenta, the body's share included; J: of the wheels [kg m^2]. The body's
    inertia is then that without the wheels about their axes, J_b w' = T - sum a_i n_i - w x (J_b w + W h) and h_i' = n_i
    with the axial torques n_i of `wheel_torque`: see `body_acceleration`.
    """
    return h / J - project(axes, w)


def motor_torque(wheel: TorqueWheel, demand, speed):
    """Torque of the motor [N m]: the demand within torque_max, which braking has at any speed, and outward below the knee.

    Outward it falls from the knee on, in proportion, to none at speed_max.
    """
    outward = jnp.sign(demand) * speed
    span = jnp.where(jnp.isfinite(wheel.speed_max), wheel.speed_max - wheel.knee, 1)
    room = jnp.clip((wheel.speed_max - outward) / span, 0, 1)
    return jnp.clip(demand, -wheel.torque_max * room, wheel.torque_max * room)


def held_torque(wheel: TorqueWheel, motor, speed, dt):
    """Torque of motor and friction together [N m] on a wheel, held over dt [s]: n = J (W+ - W) / dt.

    Implicit in the sign of the speed (Moreau): free speed f = W + dt motor / J, then
    W+ = sign(f) max(|f| - dt c(W) / J, 0) / (1 + dt viscous / J). The wheel rests exactly where |f| <= dt c / J, friction
    never gives power, and nothing chatters at any dt. The gradient at rest is zero: a resting wheel does not follow.
    """
    friction = wheel.friction
    level = friction.coulomb + (friction.stiction - friction.coulomb) * jnp.exp(-jnp.square(speed / friction.stribeck))
    free = speed + dt * motor / wheel.J
    after = beyond(free, dt * level / wheel.J) / (1 + dt * friction.viscous / wheel.J)
    return wheel.J * (after - speed) / dt


def wheel_torque(wheel: TorqueWheel, demand, speed, dt, drive: Any = 1.0, wear: Any = 1.0, seized: Any = False):
    """Torque on the wheel [N m] for a demand, held over dt: `motor_torque` and `held_torque`, with the faults of this tick.

    drive: share of the demand that the motor gives, 0 for a dead one, which keeps its friction; wear: factor on friction;
    seized: whether the wheel is stuck to the body, so that its momentum stays. Such as `Fault.scale` of a `Channel`.
    """
    worn = wheel.friction._replace(
        coulomb=wear * wheel.friction.coulomb,
        stiction=wear * wheel.friction.stiction,
        viscous=wear * wheel.friction.viscous,
    )
    torque = held_torque(wheel._replace(friction=worn), motor_torque(wheel, drive * demand, speed), speed, dt)
    return jnp.where(seized, 0, torque)


def wheel_rate(u, h, torque_max, momentum_max):
    """Momentum rates (n,) that n wheels give of the commanded ones: limited, and none outward past momentum_max.

    u, h: (n,) commanded rates and momenta; torque_max, momentum_max: limits, inf for none. Any consistent units.
    """
    limited = jnp.clip(u, -torque_max, torque_max)
    full = jnp.abs(h) >= momentum_max
    return jnp.where(full & (limited * h > 0), 0, limited)


# where wheels point


def pyramid(skew, azimuth=np.pi / 4) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Spin axes of four wheels in a pyramid about z.

    skew: [rad] between the axes and z; atan(sqrt 2), 54.74 deg, treats all directions alike, W W' = 4/3 I. The
    elevation over the x-y plane is 90 deg less it. azimuth: [rad] of the first axis in the x-y plane, from x to y; the
    others follow by 90 deg.
    """
    m = jnp if any(isinstance(a, jax.Array) for a in (skew, azimuth)) else np  # at import nothing runs on JAX
    s, c = m.sin(skew), m.cos(skew)
    x, y = s * m.cos(azimuth), s * m.sin(azimuth)
    return Vec3(x, y, c), Vec3(-y, x, c), Vec3(-x, -y, c), Vec3(y, -x, c)


def park_pyramid(gamma) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Spin axes of the four wheels of Park (2005), eq. (2), the columns of W: `pyramid(gamma)` at 45 deg alone.

    gamma: [rad] between the axes and z, and between y and the vertical planes of the axes, so that these are not at
    right angles to each other unless gamma is 45 deg.
    """
    s, c = jnp.sin(gamma), jnp.cos(gamma)
    return Vec3(s * s, s * c, c), Vec3(-s * s, s * c, c), Vec3(-s * s, -s * c, c), Vec3(s * s, -s * c, c)


# sharing a torque


def _in_use(axes, up) -> Vec3:
    """W, (n,) a row, its columns zero for wheels that are down; refuses an ``up`` of another length."""
    vectors = columns(axes)
    if jnp.shape(up) != (len(vectors),):
        must = f"hold a number for each of the {len(vectors)} axes, shape ({len(vectors)},)"
        check.refuse("up", must, f"of shape {jnp.shape(up)}")
    up = 1.0 * jnp.asarray(up)
    return Vec3(*(jnp.stack(jnp.broadcast_arrays(*row)) * up for row in zip(*vectors)))


def refuse_flat(name: str, axes, up: Any = 1.0) -> None:
    """Refuse, with ValueError, wheels that cannot turn the body about every axis: fewer than three, parallel, in one plane.

    For the check of a loop that needs all three; `allocation` gives what such wheels can.

    name: what the message calls the axes; axes: as of `allocation`, scenarios last; up: (n,), 1 for a wheel in use, or 1
    for all. Tracers pass.
    """
    if check.concrete((axes, up)):
        W = (
            np.stack([np.stack(np.broadcast_arrays(*axis)) for axis in columns(axes)]).T
            * np.atleast_1d(up).T[..., None, :]
        )
        W = np.concatenate(
            [W, np.zeros((*W.shape[:-1], 2))], axis=-1
        )  # so that one wheel, too, has three singular values
        least = np.linalg.svd(W, compute_uv=False)[..., 2]
        check.each(name, "span space (least singular value above 1e-6)", least, least > 1e-6)


def allocation(T: Vec3, axes, up):
    """Least momentum rates u (n,) of the wheels that are up whose resultant is T, a momentum rate in body axes.

    u = W^+ T with the exact pseudo-inverse of the wheels in use (`torque_matrix.pseudo_inverse`): where they do not
    span space, the resultant is the part of T that they can give; with none, u = 0.

    axes: n `Vec3`, the columns of W, or an array (3, n); up: (n,), 1 for a wheel in use and 0 for one that is not. Any
    consistent units. Raises ValueError or TypeError for axes of another form and where up has another length.
    """
    return min_norm_solve(_in_use(axes, up), T, 0.0)


def minimax(T: Vec3, axes, up):
    """Momentum rates u (n,) of the wheels that are up with the resultant T whose largest |u_i| is least.

    Markley, Reynolds, Liu & Lebsock (2010): for each pair of axes c = w_i x w_j and t = T c / sum |w_k c|; of the pair with
    the largest |t| all others give t sign(w_k c), the pair the rest. It gets the most out of limited wheels; continuous,
    not smooth. With three axes in use in one plane the solution need not be the least, and where the wheels do not
    span space it is that of `allocation`. Arguments and errors as there.
    """
    W = _in_use(axes, up)
    w = columns(W)
    best, u = jnp.zeros_like(W.x[0]) - 1, jnp.zeros_like(W.x)
    spanned = jnp.zeros_like(best)
    for i, j in combinations(range(len(w)), 2):
        c = cross(w[i], w[j])
        across = W @ c
        span, area = jnp.sum(jnp.abs(across), axis=0), c @ c
        good = (area > 0) & (span > 0)
        t = (T @ c) / jnp.where(good, span, 1)
        others = jnp.array([k not in (i, j) for k in range(len(w))])
        x = jnp.where(others, t * jnp.sign(across), 0)
        rest = T - resultant(W, x)
        by = jnp.where(good, 1 / jnp.where(good, area, 1), 0)
        x = x.at[i].set(cross(rest, w[j]) @ c * by).at[j].set(cross(w[i], rest) @ c * by)
        better = good & (jnp.abs(t) > best)
        best, u, spanned = jnp.where(better, jnp.abs(t), best), jnp.where(better, x, u), jnp.maximum(spanned, span)
    eps = 10 * len(w) * jnp.finfo(W.x.dtype).eps
    return jnp.where(spanned > eps, u, min_norm_solve(W, T, 0.0))


def null_part(u, axes, up):
    """The part of u (n,) of the wheels that are up which has no resultant, (1 - W^+ W) u: it moves momentum among them.

    -k null_part(h - h_0, axes, up), added to a command, brings the wheels to the momenta h_0, away from zero speed say,
    as far as the body does not feel it. axes, up and errors: as of `allocation`.
    """
    W = _in_use(axes, up)
    return jnp.asarray(up) * u - min_norm_solve(W, resultant(W, u), 0.0)


def coasting(change, axes, up):
    """Momentum (n,) by which the wheels that are up must change to undo the ``change`` (n,) of those that are down.

    A wheel out of use runs down and its friction turns the body: -W_up^+ W_down change. axes, up, errors: `allocation`.
    """
    W = _in_use(axes, up)
    return min_norm_solve(W, -resultant(axes, (1.0 - jnp.asarray(up)) * jnp.asarray(change)), 0.0)


def wheel_drive(reference, demand, tacho, dt, gain, windup):
    """The drive of a wheel on board: its new momentum reference [N m s], and the torque to ask of the motor [N m].

    The reference integrates the demand, no further than ``windup`` from the tachometer's momentum ``tacho`` [N m s];
    the torque is demand + gain (reference - tacho), so that friction needs no model to be overcome. gain: [1/s].
    """
    reference = jnp.clip(reference + dt * demand, tacho - windup, tacho + windup)
    return reference, demand + gain * (reference - tacho)
