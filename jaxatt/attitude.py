"""Attitude algebra: modified Rodrigues parameters (MRP), quaternions and 3-2-1 Euler angles.

An attitude is the rotation of the body frame against a reference frame. Every matrix here takes body components to
reference components. MRP: q = tan(angle/4) axis, with the shadow -q/|q|^2 for the same attitude. Quaternions: scalar
first, Hamilton product, so that the matrix of p * q is the product of the matrices.

May import: check, vec.
"""

from __future__ import annotations

import jax.numpy as jnp

from jaxatt.vec import Mat3, Quat, Vec3, cross, norm, safe_sqrt

# MRP


def mrp_rate(q: Vec3, w: Vec3) -> Vec3:
    """dq/dt = G(q) w [1/s] of MRP q for the body rate w [rad/s]; G = ((1 - q.q) I + 2 S(q) + 2 q q') / 4."""
    return (0.25 - 0.25 * (q @ q)) * w + 0.5 * (cross(q, w) + (q @ w) * q)


def mrp_rate_transposed(q: Vec3, v: Vec3) -> Vec3:
    """G(q)' v, the transpose of the map of `mrp_rate`."""
    return (0.25 - 0.25 * (q @ q)) * v + 0.5 * ((q @ v) * q - cross(q, v))


def mrp_product(p: Vec3, q: Vec3) -> Vec3:
    """MRP of the matrix product A(p) A(q), the representative with |.| <= 1; no singularity.

    n / d is one representative, n / (d - c) its shadow; the first is the inner one where d >= c / 2. Since c >= 1 the
    chosen denominator is never zero, whereas n / d alone is 0/0 where q is the shadow of -p.
    """
    pp, qq = p @ p, q @ q
    n = (1 - qq) * p + (1 - pp) * q + 2 * cross(p, q)
    c, d = (1 + pp) * (1 + qq), 1 + pp * qq - 2 * (p @ q)
    return n / jnp.where(d >= c / 2, d, d - c)


def mrp_error(q: Vec3, q_d: Vec3) -> Vec3:
    """MRP of A(q_d)' A(q), the attitude q as seen from the target q_d, |.| <= 1; de/dt = G(e) w for a target at rest."""
    return mrp_product(-q_d, q)


def mrp_inner(q: Vec3) -> Vec3:
    """The representative with |q| <= 1: the shadow -q/|q|^2 where |q| > 1."""
    qq = q @ q
    return q / jnp.where(qq > 1, -qq, 1)


def mrp_nearest(q: Vec3, p: Vec3) -> Vec3:
    """The representative of q, itself or its shadow, that lies nearest to p."""
    qq = q @ q
    keep = qq - 1 <= 2 * (q @ p)  # |q - p| <= |-q/|q|^2 - p| without a division: the shadow of zero is at infinity
    return q / jnp.where(keep, 1, -qq)


def mrp_matrix(q: Vec3) -> Mat3:
    """Rotation matrix of MRP q, body to reference."""
    return quat_matrix(quat_from_mrp(q))


def mrp_from_quat(p: Quat) -> Vec3:
    """MRP, |q| <= 1, of a unit quaternion."""
    return jnp.where(p.w < 0, -1, 1) / (1 + jnp.abs(p.w)) * p.v


def quat_from_mrp(q: Vec3) -> Quat:
    """Unit quaternion of MRP q."""
    qq = q @ q
    return Quat((1 - qq) / (1 + qq), *(2 / (1 + qq) * q))


# quaternions


def quat_conjugate(p: Quat) -> Quat:
    """The inverse of a unit quaternion."""
    return Quat(p.w, -p.x, -p.y, -p.z)


def quat_normalised(p: Quat) -> Quat:
    """p / |p|."""
    return p / jnp.sqrt(p @ p)


def quat_error(p: Quat, p_d: Quat) -> Quat:
    """Attitude p as seen from the target p_d."""
    return quat_conjugate(p_d) * p


def quat_rate(p: Quat, w: Vec3) -> Quat:
    """dp/dt = p (0, w) / 2 [1/s] for the body rate w [rad/s]."""
    return 0.5 * (p * Quat(0.0, *w))


def quat_rotate(p: Quat, v: Vec3) -> Vec3:
    """v from body to reference components: p v conj(p)."""
    t = 2 * cross(p.v, v)
    return v + p.w * t + cross(p.v, t)


def quat_to_body(p: Quat, v: Vec3) -> Vec3:
    """v from reference to body components, A(p) v: conj(p) v p."""
    return quat_rotate(quat_conjugate(p), v)


def quat_matrix(p: Quat) -> Mat3:
    """Rotation matrix of a unit quaternion, body to reference."""
    w, x, y, z = p
    return Mat3(
        Vec3(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        Vec3(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        Vec3(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def quat_from_vector(r: Vec3) -> Quat:
    """Unit quaternion of the rotation vector r [rad]; smooth at zero."""
    half = 0.5 * norm(r)
    small = half < 1e-4  # sin(h)/h by its series: exact to rounding there, and differentiable at zero
    sinc = jnp.where(small, 1 - half * half / 6, jnp.sin(half) / jnp.where(small, 1, half))
    return Quat(jnp.cos(half), *(0.5 * sinc * r))


def quat_angle(p: Quat):
    """Rotation angle of a unit quaternion [rad], in [0, pi]."""
    return 2 * jnp.arctan2(norm(p.v), jnp.abs(p.w))


# Euler angles 3-2-1: about z, then the new y, then the new x. As Vec3 (about x, about y, about z) [rad].


def euler_rate(a: Vec3, w: Vec3) -> Vec3:
    """d(angles)/dt [rad/s] for the body rate w [rad/s]; singular where the angle about y is +-90 deg."""
    s, c = jnp.sin(a.x), jnp.cos(a.x)
    q = w.y * s + w.z * c
    return Vec3(w.x + jnp.tan(a.y) * q, w.y * c - w.z * s, q / jnp.cos(a.y))


def euler_body_rate(a: Vec3, rate: Vec3) -> Vec3:
    """Body rate [rad/s] of the angle rates: the inverse of `euler_rate`, regular everywhere."""
    s, c = jnp.sin(a.x), jnp.cos(a.x)
    q = rate.z * jnp.cos(a.y)
    return Vec3(rate.x - rate.z * jnp.sin(a.y), rate.y * c + q * s, q * c - rate.y * s)


def quat_from_euler(a: Vec3) -> Quat:
    """Unit quaternion of 3-2-1 Euler angles [rad]."""
    half = 0.5 * a
    about_x = Quat(jnp.cos(half.x), jnp.sin(half.x), 0.0, 0.0)
    about_y = Quat(jnp.cos(half.y), 0.0, jnp.sin(half.y), 0.0)
    about_z = Quat(jnp.cos(half.z), 0.0, 0.0, jnp.sin(half.z))
    return about_z * about_y * about_x


def euler_from_quat(p: Quat) -> Vec3:
    """3-2-1 Euler angles [rad] of a unit quaternion, the angle about y in [-90, 90] deg."""
    m = quat_matrix(p)
    cos_y = safe_sqrt(m.x.x * m.x.x + m.y.x * m.y.x)
    return Vec3(jnp.arctan2(m.z.y, m.z.z), jnp.arctan2(-m.z.x, cos_y), jnp.arctan2(m.y.x, m.x.x))
