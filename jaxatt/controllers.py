"""Control laws: from what on-board code believes to a torque.

May import: check, vec, attitude, faults, mounting, scores, singularity.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxatt.check import door
from jaxatt.mounting import GimbalAxes, cmg_triads
from jaxatt.singularity import gram_determinant, min_norm_solve, robust_solve, times
from jaxatt.vec import Mat3, Quat, Vec3, cross, diagonal, inverse, norm, safe_sqrt


@door
def pd(e_q: Vec3, e_w: Vec3, k_q, k_w) -> Vec3:
    """PD torque u = -k_q e_q - k_w e_w [N m], Yun & Kang (2020), eq. (10)."""
    return -(k_q * e_q) - k_w * e_w


@door
def rate_gain_floor(e_q: Vec3, eps, lambda_max):
    """h(e_q) [N m s], below which the adaptive rate gain does not fall; Yun & Kang (2020), after eq. (16).

    eps [1/s] of the Lyapunov function; lambda_max: largest principal moment of inertia [kg m^2].
    """
    return eps * lambda_max / 4 * (3 + 2 * norm(e_q) + 3 * e_q @ e_q) + 1.5


@door
def adapted_rate_gain(k_w, e_q: Vec3, e_w: Vec3, eps, lambda_max, dt):
    """The rate gain k_w [N m s] after dt [s] of the adaptation law, Yun & Kang (2020), eq. (19).

    k_w' = -c^2 / (2 eps (k_w - h)) while k_w > h is singular at h: explicit steps overshoot it into negative
    damping. For constant c and h its exact solution is k_w - h = sqrt(s^2 - c^2 dt / eps), which lands on h for every
    dt (docs/loops/observer_pd.md, choice 5). eps [1/s]; lambda_max: largest principal moment of inertia [kg m^2].
    """
    h = rate_gain_floor(e_q, eps, lambda_max)
    c = eps * lambda_max * norm(e_w) + 1 + e_q @ e_q
    s = k_w - h
    return jnp.where(s > 0, h + safe_sqrt(jnp.maximum(s * s - c * c * dt / eps, 0)), k_w)


@door
def saturated(u: Vec3, u_max) -> Vec3:
    """u with every axis limited to +-u_max."""
    return Vec3(*(jnp.clip(a, -u_max, u_max) for a in u))


# model-reference adaptive control of a first-order plant


class Adaptation(NamedTuple):
    """Numbers of the adaptation law (6) of Eun et al. (2016); the defaults leave it as it is. Shapes (*lanes).

    Speeds are in deg/s. A gain given for rad/s is (pi / 180)^2 times as large here: docs/loops/wheel_mrac.md, choice 1.
    """

    gamma: Any = 1e-6  # [s/deg^2] adaptation gain
    sign: Any = 1.0  # [1] sgn(b_p) as the computer believes it
    normalise: Any = 0.0  # [s^2/deg^2] c: gamma is divided by 1 + c (r^2 + y^2)
    leak: Any = 0.0  # [1/s] sigma modification: the parameters decay at this rate
    limit: Any = jnp.inf  # [1] projection: |a_r| and |a_y| do not grow beyond


class Mrac(NamedTuple):
    """State of the controller. Shapes (*lanes)."""

    y_m: Any  # [deg/s] output of the reference model
    a_r: Any  # [1] parameter on the reference input
    a_y: Any  # [1] parameter on the plant's output


@door
def mrac_input(mrac: Mrac, r, y):
    """u = a_r r + a_y y [deg/s], Eun et al. (2016), eq. (5); r: reference input, y: plant output [deg/s]."""
    return mrac.a_r * r + mrac.a_y * y


@door
def mrac_flow(mrac: Mrac, law: Adaptation, r, y, a_m, b_m) -> Mrac:
    """Rate of change of the controller's state, Eun et al. (2016), eqs. (2), (4), (6).

    r: reference input, y: plant output [deg/s]; a_m, b_m: reference model [1/s].
    """
    e = y - mrac.y_m  # eq. (4)
    g = law.sign * law.gamma / (1 + law.normalise * (r * r + y * y))
    return Mrac(
        y_m=b_m * r - a_m * mrac.y_m,  # eq. (2)
        a_r=_projected(mrac.a_r, -g * e * r - law.leak * mrac.a_r, law.limit),  # eq. (6)
        a_y=_projected(mrac.a_y, -g * e * y - law.leak * mrac.a_y, law.limit),
    )


@door
def mrac_step(mrac: Mrac, law: Adaptation, r, y, dt) -> Mrac:
    """The parameters after one forward-Euler step of the adaptation (6) over dt [s]; y_m is left alone.

    r: reference input, y: plant output [deg/s]. This is how a computer samples the law; it is stable only within
    `mrac_sampled_bound`.
    """
    rate = mrac_flow(mrac, law, r, y, 0.0, 0.0)
    a_r, a_y = mrac.a_r + dt * rate.a_r, mrac.a_y + dt * rate.a_y
    return mrac._replace(a_r=jnp.clip(a_r, -law.limit, law.limit), a_y=jnp.clip(a_y, -law.limit, law.limit))


@door
def mrac_sampled_bound(law: Adaptation, dt, a_p, b_p, a_y=0.0):
    """The largest r^2 + y^2 [deg^2/s^2] at which `mrac_step` with a held command is stable.

    Near the matching line the sampled loop is stable if r^2 + y^2 < (a_p / b_p - a_y) / (gamma dt); normalisation
    makes gamma smaller by 1 + c (r^2 + y^2), and no bound remains once c is large enough
    (docs/loops/wheel_mrac.md, choice 5).
    """
    room = (a_p / jnp.abs(b_p) - law.sign * a_y) / dt
    slack = law.gamma - room * law.normalise
    return jnp.where(slack > 0, room / jnp.where(slack > 0, slack, 1), jnp.inf)


def _projected(a, rate, limit):
    return jnp.where((jnp.abs(a) >= limit) & (a * rate > 0), 0, rate)


# PID, and its allocation to wheels


@door
def pid(angle: Vec3, integral: Vec3, w: Vec3, k_f: Vec3, k_p: Vec3, k_i: Vec3, k_d: Vec3) -> Vec3:
    """T = K_F (K_P angle + K_I integral + K_D w) per axis, Park (2005), eq. (5): a momentum rate of the wheels.

    angle [rad], integral [rad s], w [rad/s]; with degrees the published gains are unstable (docs/loops/gyro_ekf.md,
    choice 1).
    """
    law = lambda f, p, i, d, a, s, r: f * (p * a + i * s + d * r)
    return Vec3(*map(law, k_f, k_p, k_i, k_d, angle, integral, w))


@door
def allocation(T: Vec3, axes, up):
    """Least momentum rates u, shape (n, *lanes), of the wheels that are up, whose sum along their axes is T.

    u = m W' (W m W' + 1e-6 I)^-1 T: the pseudo-inverse to a part in 1e6, and finite with any number of wheels.
    """
    o = jnp.zeros_like(T.x)
    gram = diagonal(Vec3(o, o, o) + Vec3(1e-6, 1e-6, 1e-6))
    for axis, m in zip(axes, up):
        gram = gram + Mat3(axis.x * m * axis, axis.y * m * axis, axis.z * m * axis)
    along = inverse(gram) @ T
    return jnp.stack([m * (axis @ along) for axis, m in zip(axes, up)])


# steering of control-moment-gyro clusters


class Steering(NamedTuple):
    """A steering law as numbers: T rate = torque / h_w solved for gimbal rates. Every field has shape (*lanes)."""

    rcond: Any = 1e-15  # [1] singular values below rcond sigma_1 count as zero; used while lam0 is 0
    lam0: Any = 0.0  # [1] singularity-robust inverse T'(T T' + lam E)^-1, lam = lam0 exp(-mu det T T'); 0: pinv
    mu: Any = 10.0  # [1] how fast lam falls away from singularity
    dither: Any = 0.0  # [1] off-diagonal size of E in the generalised singularity-robust inverse
    dither_rate: Any = jnp.pi / 2  # [rad/s] of the dither
    null: Any = 0.0  # [1/s] gain of null motion up the gradient of det T T'; no effect with three modules


@door
def rate_pi(e: Vec3, integral: Vec3, J_T: Mat3, k_p, k_i) -> Vec3:
    """PI torque demand J_T (k_p e + k_i integral) [N m] of the rate error e [rad/s], eq. (7)."""
    return J_T @ (k_p * e + k_i * integral)


@door
def steer(law: Steering, a: Vec3, axes: GimbalAxes, gamma, healthy, t):
    """Gimbal rates [rad/s], shape (n, *lanes), with T rate = a as nearly as the law allows.

    a: wanted change of the cluster's momentum over h_w [1/s]; gamma: gimbal angles [rad], shape (n, *lanes);
    healthy: 1 or 0, shape (n, *lanes): the columns of T that count; t: time [s], of the dither.
    """

    def torque(gamma):
        return healthy * cmg_triads(axes, gamma).t

    T = torque(gamma)
    up = law.null * jax.grad(lambda gamma: jnp.sum(gram_determinant(torque(gamma))))(gamma)
    to_do = a - times(T, up)  # so that up moves the gimbals, but not the momentum
    return up + jnp.where(law.lam0 > 0, robust_solve(T, to_do, damping(law, T, t)), min_norm_solve(T, to_do, law.rcond))


@door
def damping(law: Steering, T: Vec3, t) -> Mat3:
    """lam E of the (generalised) singularity-robust inverse at time t [s]; E = 1 without dither."""
    lam = law.lam0 * jnp.exp(-law.mu * gram_determinant(T))
    x, y, z = (law.dither * lam * jnp.sin(law.dither_rate * t + phase) for phase in (0, jnp.pi / 2, jnp.pi))
    return Mat3(Vec3(lam, z, y), Vec3(z, lam, x), Vec3(y, x, lam))


# quaternion PD


@door
def quaternion_pd(e: Quat, e_w: Vec3, w: Vec3, J: Mat3, bandwidth, damping) -> Vec3:
    """Torque [N m] u = -J (2 wn^2 sign(e_0) e_v + 2 zeta wn e_w) + w x J w: a linear second-order closed loop.

    e: error quaternion; e_w: rate error [rad/s]; w: body rate [rad/s]; J [kg m^2]; bandwidth wn [rad/s]; damping
    zeta [1]. The sign takes the shorter way round.
    """
    shorter = jnp.where(e.w < 0, -1, 1)
    return cross(w, J @ w) - J @ ((2 * bandwidth**2 * shorter) * e.v + (2 * damping * bandwidth) * e_w)
