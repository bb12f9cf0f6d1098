"""Estimators that keep no covariance: nonlinear observer, recursive least squares. Kalman filters: `kalman`.

May import: check, vec, attitude, faults, mounting, scores.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxatt.attitude import mrp_rate, mrp_rate_transposed
from jaxatt.check import door
from jaxatt.vec import Mat3, Vec3, cross, once, safe_sqrt


class AttitudeRate(NamedTuple):
    """An attitude and a body rate: truth, reading, estimate or residual."""

    q: Any  # Vec3 [1] MRP
    w: Any  # Vec3 [rad/s]


@door
def mrp_observer(
    estimate: AttitudeRate, y: AttitudeRate, u: Vec3, J: Mat3, J_inv: Mat3, alpha, beta, sign=-1
) -> AttitudeRate:
    """Rate of change of the nonlinear MRP observer's estimate, Yun & Kang (2020), eq. (7).

    y: readings; u: torque [N m]; J: inertia [kg m^2]; alpha [1/s], beta [N m s]: gains; sign: -1 for Euler's
    equation, +1 for the dynamics as printed. Eq. (6) prints S(w) J wh in place of S(wh) J w, for which the Lyapunov
    identity fails. Errata 1 and 2 of docs/loops/observer_pd.md.
    """
    xi_q, xi_w = y.q - estimate.q, y.w - estimate.w

    def torque(xi_q, xi_w, u):
        return sign * cross(estimate.w, J @ y.w) + beta * xi_w + mrp_rate_transposed(y.q, xi_q) + u

    return AttitudeRate(q=mrp_rate(y.q, estimate.w) + alpha * xi_q, w=J_inv @ once(torque, xi_q, xi_w, u))


@door
def residual_norm(y: AttitudeRate, estimate: AttitudeRate):
    """|xi|: norm of reading minus estimate, MRP and rad/s added without weights as in the paper."""
    xi_q, xi_w = y.q - estimate.q, y.w - estimate.w
    return safe_sqrt(xi_q @ xi_q + xi_w @ xi_w)


class LeastSquares(NamedTuple):
    """An estimate of a in y = W a and its gain. Shapes (*lanes)."""

    a: Any  # [y / W] estimate of the parameter
    P: Any  # [1/(W^2 s)] gain


@door
def least_squares(estimate: LeastSquares, W, y, dt, forget=0.0) -> LeastSquares:
    """The estimate after dt [s] in which the regressor W and the output y were constant.

    Eun et al. (2016), eqs. (9), (10): a' = -P W (W a - y), P' = -P W^2 P, here in the rational form that is their
    exact solution, stable for every dt and never P < 0; forward Euler makes P negative once P W^2 dt > 1
    (docs/loops/wheel_mrac.md, choice 4). forget [1/s]: rate at which old data lose weight; without excitation P then
    grows without bound, and the caller limits it.
    """
    P = estimate.P / (jnp.exp(-forget * dt) + estimate.P * W * W * dt)
    return LeastSquares(a=estimate.a - P * W * (W * estimate.a - y) * dt, P=P)
