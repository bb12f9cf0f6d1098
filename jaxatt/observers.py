"""Estimators that keep no covariance: nonlinear observer, recursive least squares. Kalman filters: `filters`.

May import: check, vec, attitude, compiling.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp

from jaxatt.attitude import mrp_rate, mrp_rate_transposed
from jaxatt.compiling import shared
from jaxatt.vec import Mat3, Vec3, cross, inverse, safe_sqrt


class AttitudeRate(NamedTuple):
    """An attitude and a body rate: truth, reading, estimate or residual; each a `Vec3`, or a `Reading` of one."""

    q: Annotated[Any, "1"]  # MRP
    w: Annotated[Any, "rad/s"]  # body rate


def mrp_observer(estimate: AttitudeRate, y: AttitudeRate, u: Vec3, J: Mat3, alpha, beta) -> AttitudeRate:
    """Rate of change of the nonlinear observer's estimate (qh, wh), Yun & Kang (2020), eq. (7).

    qh' = G(y_q) wh + alpha xi_q, J wh' = u - wh x J y_w + beta xi_w + G(y_q)' xi_q, with xi = y - (qh, wh). y: readings;
    u: torque [N m]; J: inertia [kg m^2]; alpha [1/s], beta [N m s]: gains. Eq. (6) prints another form, which fails:
    docs/loops/observer_pd.md, errata 1 and 2.
    """
    xi_q, xi_w = y.q - estimate.q, y.w - estimate.w

    def torque(xi_q, xi_w, u):
        return u - cross(estimate.w, J @ y.w) + beta * xi_w + mrp_rate_transposed(y.q, xi_q)

    return AttitudeRate(q=mrp_rate(y.q, estimate.w) + alpha * xi_q, w=inverse(J) @ shared(torque, xi_q, xi_w, u))


def residual_norm(y: AttitudeRate, estimate: AttitudeRate):
    """|xi|, xi = y - estimate; MRP and rad/s are added without weights, as in Yun & Kang (2020)."""
    xi_q, xi_w = y.q - estimate.q, y.w - estimate.w
    return safe_sqrt(xi_q @ xi_q + xi_w @ xi_w)


class LeastSquares(NamedTuple):
    """An estimate of a in y = W a and its gain."""

    a: Any  # [y / W] estimate of the parameter
    P: Any  # [1/(W^2 s)] gain


def least_squares(estimate: LeastSquares, W, y, dt, forget=0.0) -> LeastSquares:
    """The estimate after dt [s] in which the regressor W and the output y were constant.

    Eun et al. (2016), eqs. (9), (10): a' = -P W (W a - y), P' = -P W^2 P, here in the rational form that is their
    exact solution, stable for every dt and never P < 0; forward Euler makes P negative where P W^2 dt > 1
    (docs/loops/wheel_mrac.md, choice 4). forget [1/s]: rate at which old data lose weight; without excitation P then
    grows without bound, and the caller limits it.
    """
    P = estimate.P / (jnp.exp(-forget * dt) + estimate.P * W * W * dt)
    return LeastSquares(a=estimate.a - P * W * (W * estimate.a - y) * dt, P=P)
