"""Control laws: from what on-board code believes to a torque on the body, or to a command of a drive.

May import: check, vec.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.check import finite, not_negative
from jaxatt.check import limit as positive_or_inf
from jaxatt.vec import Mat3, Quat, Vec3, cross, norm, safe_sqrt, zeros


def pd(e_q: Vec3, e_w: Vec3, k_q, k_w) -> Vec3:
    """PD torque u = -k_q e_q - k_w e_w [N m], Yun & Kang (2020), eq. (10)."""
    return -(k_q * e_q) - k_w * e_w


def rate_gain_floor(e_q: Vec3, eps, lambda_max):
    """h(e_q) [N m s], below which the adaptive rate gain does not fall; Yun & Kang (2020), after eq. (16).

    eps [1/s] of the Lyapunov function; lambda_max: largest principal moment of inertia [kg m^2].
    """
    return eps * lambda_max / 4 * (3 + 2 * norm(e_q) + 3 * (e_q @ e_q)) + 1.5


def adapted_rate_gain(k_w, e_q: Vec3, e_w: Vec3, eps, lambda_max, dt):
    """The rate gain k_w [N m s] after dt [s] of the adaptation law, Yun & Kang (2020), eq. (19).

    k_w' = -c^2 / (2 eps (k_w - h)) while k_w > h, here in its exact solution for constant c and h: with s = k_w - h
    before, sqrt(s^2 - c^2 dt / eps) after. It ends at h for every dt; explicit steps pass h, where the law is singular,
    into negative damping (docs/loops/observer_pd.md, choice 5). eps [1/s]; lambda_max: largest principal moment of
    inertia [kg m^2].
    """
    h = rate_gain_floor(e_q, eps, lambda_max)
    c = eps * lambda_max * norm(e_w) + 1 + e_q @ e_q
    s = k_w - h
    return jnp.where(s > 0, h + safe_sqrt(jnp.maximum(s * s - c * c * dt / eps, 0)), k_w)


class PdMargins(NamedTuple):
    """Margins of the proof of stability of the adaptive PD law, which holds where all are positive."""

    k_q: Any  # [N m] above the least attitude gain, Yun & Kang (2020), eq. (18)
    eps: Any  # [1/s] below the largest epsilon with Q > 0, after eq. (12)
    T: Any  # [N m/s] of T_I > 0, eq. (16), for constant gains


def pd_margins(k_q, k_w, eps, lambda_max, e_q=0.0, e_w=0.0) -> PdMargins:
    """The margins at tracking errors of norms e_q [1] and e_w [rad/s], for gains k_q [N m] and k_w [N m s].

    eps [1/s] of the Lyapunov function; lambda_max: largest principal moment of inertia [kg m^2]. A penalty on them keeps
    a search of gains where the proof holds. The adaptation (19) leaves that region in time whatever the gains are
    (docs/loops/observer_pd.md, erratum 7).
    """
    c = eps * lambda_max * e_w + 1 + e_q * e_q
    room = k_w - rate_gain_floor(Vec3(e_q, 0.0, 0.0), eps, lambda_max)
    positive = room > 0
    held = eps * k_q - 0.5 * eps * eps - 1 - c * c / jnp.where(positive, room, 1)
    return PdMargins(
        k_q=k_q - eps / 2 - 1 / eps,
        eps=2 / jnp.sqrt(lambda_max) - eps,
        T=jnp.where(positive, held, room - 1),
    )


def saturated(u: Vec3, u_max) -> Vec3:
    """u with every component limited to +-u_max."""
    return Vec3(*(jnp.clip(a, -u_max, u_max) for a in u))


# model-reference adaptive control of a first-order plant


class Adaptation(NamedTuple):
    """Numbers of the adaptation law (6) of Eun et al. (2016); the defaults leave it as it is.

    Speeds are in deg/s. A gain given for rad/s is (pi / 180)^2 times as large here: docs/loops/wheel_mrac.md, choice 1.
    """

    gamma: Annotated[Any, "s/deg^2", finite, not_negative] = 1e-6  # adaptation gain
    sign: Annotated[Any, "1"] = 1.0  # sgn(b_p) as the computer believes it
    normalise: Annotated[Any, "s^2/deg^2", finite, not_negative] = 0.0  # c: gamma is divided by 1 + c (r^2 + y^2)
    leak: Annotated[Any, "1/s", finite, not_negative] = 0.0  # sigma modification: the parameters decay at this rate
    limit: Annotated[Any, "1", positive_or_inf] = jnp.inf  # projection: |a_r| and |a_y| do not grow beyond

    def check(self, name: str) -> None:
        """Refuse, with ValueError, a sign that is none."""
        check.one_of(f"{name}.sign", self.sign, (-1, 1))


class Mrac(NamedTuple):
    """State of the controller."""

    y_m: Any  # [deg/s] output of the reference model
    a_r: Any  # [1] parameter on the reference input
    a_y: Any  # [1] parameter on the plant's output


def mrac_input(mrac: Mrac, r, y):
    """u = a_r r + a_y y [deg/s], Eun et al. (2016), eq. (5); r: reference input, y: plant output [deg/s]."""
    return mrac.a_r * r + mrac.a_y * y


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


def mrac_step(mrac: Mrac, law: Adaptation, r, y, dt) -> Mrac:
    """The parameters after one forward-Euler step of the adaptation (6) over dt [s]; y_m is left alone.

    r: reference input, y: plant output [deg/s]. This is how a computer samples the law; it is stable only within
    `mrac_sampled_bound`.
    """
    rate = mrac_flow(mrac, law, r, y, 0.0, 0.0)
    a_r, a_y = mrac.a_r + dt * rate.a_r, mrac.a_y + dt * rate.a_y
    return mrac._replace(a_r=jnp.clip(a_r, -law.limit, law.limit), a_y=jnp.clip(a_y, -law.limit, law.limit))


def mrac_sampled_bound(law: Adaptation, dt, a_p, b_p, a_y=0.0):
    """The largest r^2 + y^2 [deg^2/s^2] at which `mrac_step` with a held command is stable.

    Near the matching line the sampled loop is stable if r^2 + y^2 < (a_p / b_p - a_y) / (gamma dt); normalisation
    makes gamma smaller by 1 + c (r^2 + y^2), and no bound remains once c is large enough
    (docs/loops/wheel_mrac.md, choice 5).
    """
    return _largest(law, (a_p / abs(b_p) - law.sign * a_y) / dt)


def mrac_flow_bound(law: Adaptation, dt, b_p):
    """The largest r^2 + y^2 [deg^2/s^2] at which `mrac_flow` can be integrated by RK4 in steps of dt [s].

    The adaptation turns at sqrt(b_p gamma (r^2 + y^2)), and RK4 bears 2.8 rad a step, of which 2 are taken.
    """
    return _largest(law, (2 / dt) ** 2 / abs(b_p))


def _largest(law: Adaptation, most):
    """The r^2 + y^2 at which its product with the normalised gain reaches ``most`` [1/s]; inf where it never does."""
    slack = law.gamma - most * law.normalise
    where = np.where if check.concrete((slack, most)) else jnp.where  # a check compiles nothing
    return where(slack > 0, most / where(slack > 0, slack, 1), np.inf)


def _projected(a, rate, limit):
    return jnp.where((jnp.abs(a) >= limit) & (a * rate > 0), 0, rate)


# PID


def pid(angle: Vec3, integral: Vec3, w: Vec3, k_f: Vec3, k_p: Vec3, k_i: Vec3, k_d: Vec3) -> Vec3:
    """Torque on the body -K_F (K_P angle + K_I integral + K_D w) per axis, Park (2005), eq. (5).

    The paper's T is its negative, the momentum rate of the wheels. angle [rad], integral [rad s], w [rad/s]; with
    degrees the published gains are unstable (docs/loops/gyro_ekf.md, choice 1).
    """
    law = lambda k_f, k_p, k_i, k_d, a, s, r: -k_f * (k_p * a + k_i * s + k_d * r)
    return Vec3(*map(law, k_f, k_p, k_i, k_d, angle, integral, w))


# quaternion PD


def quaternion_pd(
    e: Quat, e_w: Vec3, w: Vec3, J: Mat3, bandwidth, damping, acceleration: Vec3 | None = None, h: Vec3 | None = None
) -> Vec3:
    """Torque on the body [N m] that makes the error obey a linear second-order equation.

    u = J (a - 2 wn^2 sign(e_0) e_v - 2 zeta wn e_w) + w x (J w + h); the sign takes the shorter way round. e: error
    quaternion; e_w: rate error [rad/s]; w: body rate [rad/s]; J: inertia [kg m^2]; bandwidth wn [rad/s]; damping zeta
    [1]; acceleration a of the target [rad/s^2] and momentum h stored in wheels [N m s], both in body axes, None for 0.
    """
    a = zeros() if acceleration is None else acceleration
    stored = zeros() if h is None else h
    shorter = jnp.where(e.w < 0, -1, 1)
    wanted = a - (2 * bandwidth**2 * shorter) * e.v - (2 * damping * bandwidth) * e_w
    return J @ wanted + cross(w, J @ w + stored)


# magnetic torquers: the dipole moment m gives the torque m x B


def bdot(field: Vec3, last: Vec3, hold, gain, moment_max) -> Vec3:
    """Dipole moment [A m^2] that takes rate out of a tumbling body: -k (B - B_last) / hold / |B|^2, each axis limited.

    It damps towards the turning of the field, about twice the orbit's rate; the rate about B is not damped. The sample
    time must be short against the tumbling, rate * hold << 1.

    field, last: the field in body axes at this reading and the one before [T]; hold [s] between them; gain [N m s]:
    `bdot_gain`; moment_max [A m^2].
    """
    change = (field - last) / hold
    return saturated(-_per_square(gain, field) * change, moment_max)


def bdot_gain(orbit_rate, inclination, least_moment):
    """The gain 2 n (1 + sin xi) J_min [N m s] of Avanzini & Giulietti (2012); a higher one is not faster.

    orbit_rate n [rad/s]; inclination xi of the orbit to the geomagnetic equator [rad]; least_moment J_min: of the three
    principal moments of inertia [kg m^2].
    """
    return 2 * orbit_rate * (1 + jnp.sin(inclination)) * least_moment


def unloading(momentum: Vec3, field: Vec3, gain, moment_max) -> Vec3:
    """Dipole moment [A m^2] that takes momentum out of wheels: k (h x B) / |B|^2, each axis limited.

    Its torque is -k times the part of h across B: the gain k [1/s] is the rate at which that part decays while the wheels
    hold the body. momentum h: of all wheels in body axes [N m s]; field B in body axes [T]; moment_max [A m^2].
    """
    return saturated(_per_square(gain, field) * cross(momentum, field), moment_max)


def _per_square(gain, field: Vec3):
    """gain / |B|^2, and 0 without a field: before the first reading torquers stay off."""
    square = field @ field
    return jnp.where(square > 0, gain / jnp.where(square > 0, square, 1), 0)
