"""Control laws: from what on-board code believes to a torque."""

from __future__ import annotations

import jax.numpy as jnp

from jaxatt.vec import Vec3, norm, safe_sqrt


def pd(e_q: Vec3, e_w: Vec3, k_q, k_w) -> Vec3:
    """PD torque u = -k_q e_q - k_w e_w [N m], Yun & Kang (2020), eq. (10)."""
    return -(k_q * e_q) - k_w * e_w


def rate_gain_floor(e_q: Vec3, eps, lambda_max):
    """h(e_q) [N m s], below which the adaptive rate gain does not fall; Yun & Kang (2020), after eq. (16)."""
    return eps * lambda_max / 4 * (3 + 2 * norm(e_q) + 3 * e_q @ e_q) + 1.5


def adapted_rate_gain(k_w, e_q: Vec3, e_w: Vec3, eps, lambda_max, dt):
    """The rate gain k_w [N m s] after dt [s] of the adaptation law, Yun & Kang (2020), eq. (19).

    k_w' = -c^2 / (2 eps (k_w - h)) while k_w > h is singular at h: explicit steps overshoot it into negative
    damping (spec, 6). For constant c and h its exact solution is k_w - h = sqrt(s^2 - c^2 dt / eps), which
    lands on h for every dt.
    """
    h = rate_gain_floor(e_q, eps, lambda_max)
    c = eps * lambda_max * norm(e_w) + 1 + e_q @ e_q
    s = k_w - h
    return jnp.where(s > 0, h + safe_sqrt(jnp.maximum(s * s - c * c * dt / eps, 0)), k_w)


def saturated(u: Vec3, u_max) -> Vec3:
    """u with every axis limited to +-u_max."""
    return Vec3(*(jnp.clip(a, -u_max, u_max) for a in u))
