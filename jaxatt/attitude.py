"""Attitude algebra: modified Rodrigues parameters (MRP), quaternions, matrices, rotation vectors and Euler angles.

An attitude is the rotation of the body frame against a reference frame. Every matrix here takes body components to
reference components. MRP: q = tan(angle/4) axis, with the shadow -q/|q|^2 for the same attitude. Quaternions: scalar
first, Hamilton product, so that the matrix of p * q is the product of the matrices. Rotation vector: angle times axis.

Conversions from a quaternion (`quat_matrix`, `mrp_from_quat`, `vector_from_quat`, `euler_from_quat`, `angles_from_quat`,
`quat_angle`) take any length but zero, which gives NaN: a quaternion of telemetry has three digits. Everything else
takes unit quaternions, which `quat_normalised` makes. Matrices are taken as the nearest rotation.

May import: check, vec.
"""

from __future__ import annotations

from math import inf, pi
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.vec import Mat3, Quat, Vec3, cross, det, diagonal, largest_eigenvector, norm, safe_sqrt, where

# angles

TURNS = {"rad": 2 * pi, "mrad": 2e3 * pi, "deg": 360.0, "arcmin": 21600.0, "arcsec": 1296000.0, "rev": 1.0}


def full_turn(unit: str) -> float:
    """One turn in a unit of angle: 2 pi for "rad", 360 for "deg"; inf for a unit that is none. See `TURNS`."""
    return TURNS.get(unit, inf)


def wrapped(a, turn: Any = 2 * pi):
    """The angle a less its whole turns, within half a turn of zero: the residual of two angles.

    turn: one turn in the unit of a (`full_turn`); inf where a is no angle and stays what it is.
    """
    return nearest_angle(a, 0, turn)


def nearest_angle(a, b, turn: Any = 2 * pi):
    """The angle a less whole turns, within half a turn of b: what a sensor that starts anew at a turn means.

    turn: as of `wrapped`.
    """
    apart = jnp.asarray(a - b)
    kind = apart.dtype if jnp.issubdtype(apart.dtype, jnp.floating) else float
    turn = jnp.asarray(turn, kind)  # lest float32 become float64
    is_angle = jnp.isfinite(turn)
    turns = jnp.round(apart / jnp.where(is_angle, turn, 1))
    return a - jnp.where(is_angle, turn, 0) * turns


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


def mrp_from_matrix(m: Mat3) -> Vec3:
    """MRP, |q| <= 1, of the rotation nearest to m; raises what `nearest_rotation` raises."""
    return mrp_from_quat(quat_from_matrix(m))


def mrp_matrix(q: Vec3) -> Mat3:
    """Rotation matrix of MRP q, body to reference."""
    return quat_matrix(quat_from_mrp(q))


def mrp_from_quat(p: Quat) -> Vec3:
    """MRP, |q| <= 1, of a quaternion."""
    return jnp.where(p.w < 0, -1, 1) / (norm(p) + jnp.abs(p.w)) * p.v


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
    """Rotation matrix of a quaternion, body to reference."""
    w, x, y, z = p
    s = 2 / jnp.asarray(p @ p)  # a Python zero would raise
    return Mat3(
        Vec3(1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
        Vec3(s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)),
        Vec3(s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)),
    )


def quat_from_matrix(m: Mat3) -> Quat:
    """Unit quaternion, w >= 0, of the rotation nearest to m; raises what `nearest_rotation` raises."""
    return quat_from_rotation(nearest_rotation(m))


def quat_from_rotation(m: Mat3) -> Quat:
    """Unit quaternion, w >= 0, of a matrix that is a rotation to rounding, such as one of axes; nothing is checked.

    4 q q' has the elements of the matrix; its longest row keeps all digits at every angle (Shepperd, 1978; Markley,
    2008).
    """
    a, b, c = m
    w, x, y, z = c.y - b.z, a.z - c.x, b.x - a.y, 1 + a.x + b.y + c.z
    xy, xz, yz = a.y + b.x, a.z + c.x, b.z + c.y
    rows = (
        Quat(z, w, x, y),
        Quat(w, 1 + a.x - b.y - c.z, xy, xz),
        Quat(x, xy, 1 + b.y - c.z - a.x, yz),
        Quat(y, xz, yz, 1 + c.z - a.x - b.y),
    )
    longest, size = rows[0], rows[0].w
    for i in (1, 2, 3):
        longer = rows[i][i] > size
        longest, size = where(longer, rows[i], longest), jnp.where(longer, rows[i][i], size)
    return quat_normalised(longest) * jnp.where(longest.w < 0, -1, 1)


def nearest_rotation(m: Mat3) -> Mat3:
    """The rotation nearest to m: the orthogonal factor of its polar decomposition, by the Newton-Schulz iteration.

    m <- m (3 I - m'm) / 2 from a multiple of m whose singular values are below sqrt(3), where it converges; the error is
    squared in each step. Where det(m) is not positive, or m nearly singular (least singular value below a fiftieth of
    the others), there is no such rotation and it is NaN.

    Raises:
        ValueError: concrete numbers with det(m) <= 0: a reflection, such as axes of a left-handed frame, or no matrix
            of axes at all.
    """
    size = det(m)
    if check.concrete(size):
        check.each("det(m)", "be 1 (a reflection is no rotation)", size, ~(np.asarray(size) <= 0))
    kind = jnp.result_type(float, *jax.tree.leaves(m))
    entries = jnp.broadcast_arrays(*(jnp.asarray(a, kind) for row in m for a in row))
    m = Mat3.of([entries[:3], entries[3:6], entries[6:]])
    m = m * jnp.sqrt(3 / (m.x @ m.x + m.y @ m.y + m.z @ m.z))
    m = jax.lax.fori_loop(0, 14, _newton_schulz, m)
    return where(det(m) > 0.999, m, jax.tree.map(lambda a: jnp.full_like(a, jnp.nan), m))


def _newton_schulz(_, m: Mat3) -> Mat3:
    """M (3 I - M' M) / 2; a function of the module, so that calls without jit compile the loop once."""
    return (m @ (diagonal([jnp.full_like(m.x.x, 3)] * 3) - m.T @ m)) * 0.5


def quat_from_vector(r: Vec3) -> Quat:
    """Unit quaternion of the rotation vector r [rad]; smooth at zero."""
    half = 0.5 * norm(r)
    small = half < 1e-4  # sin(h)/h by its series: exact to rounding there, and differentiable at zero
    sinc = jnp.where(small, 1 - half * half / 6, jnp.sin(half) / jnp.where(small, 1, half))
    return Quat(jnp.cos(half), *(0.5 * sinc * r))


def vector_from_quat(p: Quat) -> Vec3:
    """Rotation vector [rad] of a quaternion, |r| <= pi, smooth at zero; of half a turn the one along p's vector part.

    2 atan2(|v|, |w|) v / |v|, for acos(w) loses half of the digits near zero.
    """
    vv, w = p.v @ p.v, jnp.abs(p.w)
    small = vv < 1e-8 * w * w
    w_safe, v = jnp.where(small, w, 1), norm(p.v)
    v_safe = jnp.where(small, 1, v)
    series = (2 - 2 / 3 * vv / (w_safe * w_safe)) / w_safe  # 2 atan(x) / x of x = |v| / w: exact to rounding there
    return jnp.where(p.w < 0, -1, 1) * jnp.where(small, series, 2 * jnp.arctan2(v_safe, w) / v_safe) * p.v


def quat_angle(p: Quat):
    """Rotation angle of a quaternion [rad], in [0, pi]."""
    return 2 * jnp.arctan2(norm(p.v), jnp.abs(p.w))


def quat_from_scalar_last(a) -> Quat:
    """The quaternion of an array-like with the four rows x, y, z, w; TypeError for a `Quat`, whose scalar is first."""
    if isinstance(a, Quat):
        raise TypeError("`a` must be an array with the rows x, y, z, w, but it is a Quat, whose scalar is first.")
    x, y, z, w = a
    return Quat(w, x, y, z)


def scalar_last_from_quat(p: Quat) -> jax.Array:
    """Array (4,) of x, y, z, w."""
    return jnp.stack(jnp.broadcast_arrays(p.x, p.y, p.z, p.w))


def quat_mean(p: Quat, weights: Any = 1.0) -> Quat:
    """Mean attitude of n quaternions, components (n,), w >= 0: the rotation nearest to all in least squares.

    The eigenvector of the largest eigenvalue of sum w q q' (Markley et al., 2007), which takes q and -q as the one
    attitude that they are. NaN where no single attitude is nearest.

    weights: (n,) >= 0, such as 1 / variance.
    """
    p = Quat(*jnp.broadcast_arrays(*quat_normalised(p)))
    return largest_eigenvector(tuple(Quat(*(jnp.sum(weights * a * b, axis=0) for b in p)) for a in p))[1]


# rotation vectors and how they add: exp(r) is the rotation of the rotation vector r


def left_jacobian(r: Vec3) -> Mat3:
    """J with exp(r + d) = exp(J d) exp(r) to first order in d [rad]; its transpose is that of exp(r + d) = exp(r) exp(J' d).

    The second is the one of small turns in body axes. J = I + (1 - cos t)/t^2 [r x] + (t - sin t)/t^3 [r x]^2, t = |r|.
    """
    tt = r @ r
    small, t = _small(tt)
    sinc = jnp.where(small, 1 - tt / 24 + tt * tt / 1920, jnp.sin(t / 2) / (t / 2))
    b = jnp.where(small, 1 / 6 - tt / 120 + tt * tt / 5040, (t - jnp.sin(t)) / (t * t * t))
    return _about(r, sinc * sinc / 2, b)


def left_jacobian_inverse(r: Vec3) -> Mat3:
    """The inverse of `left_jacobian`, I - [r x]/2 + (1 - (t/2) cot(t/2))/t^2 [r x]^2; singular where t = |r| is 2 pi."""
    tt = r @ r
    small, t = _small(tt)
    b = jnp.where(small, 1 / 12 + tt / 720 + tt * tt / 30240, (1 - t / 2 / jnp.tan(t / 2)) / (t * t))
    return _about(r, -0.5, b)


def _small(tt):
    """Whether |r| is so small that a series is exact to rounding, and |r| where it is not."""
    small = tt < 1e-4
    return small, jnp.sqrt(jnp.where(small, 1e-4, tt))  # a root of 1 would be wrong where tt is worked out twice


def _about(r: Vec3, a, b) -> Mat3:
    """I + a [r x] + b [r x]^2."""
    d, (x, y, z), s = 1 - b * (r @ r), a * r, b * r
    return Mat3(
        Vec3(d + s.x * r.x, s.x * r.y - z, s.x * r.z + y),
        Vec3(s.y * r.x + z, d + s.y * r.y, s.y * r.z - x),
        Vec3(s.z * r.x - y, s.z * r.y + x, d + s.z * r.z),
    )


# Euler angles of all twelve sequences, in the order of the name


def quat_from_angles(a: Vec3, sequence: str) -> Quat:
    """Unit quaternion of Euler angles [rad] of any sequence: '321' turns about z, then the new y, then the new x.

    a: in the order of the sequence. `quat_from_euler` takes those of '321' by axis instead. SciPy writes '321' as 'ZYX'.

    Raises:
        ValueError: a sequence that is none of the twelve.
    """
    axes = _axes(sequence)
    half = 0.5 * a
    turns = []
    for axis, angle in zip(axes, half):
        v: list[Any] = [0.0, 0.0, 0.0]
        v[axis] = jnp.sin(angle)
        turns.append(Quat(jnp.cos(angle), *v))
    return turns[0] * turns[1] * turns[2]


def angles_from_quat(p: Quat, sequence: str) -> Vec3:
    """Euler angles [rad] of a quaternion for any sequence, in its order: the inverse of `quat_from_angles`.

    The first and third lie in (-pi, pi], the second in [-90, 90] deg for three different axes, in [0, 180] deg where
    the first is the third. At the end of these intervals (gimbal lock) only the sum or the difference of the first and
    the third is known: there the third is 0 and the first takes all. The attitude is kept to rounding everywhere, though
    near lock the two angles by themselves lose digits. After Bernardes & Viollet (2022).

    Raises:
        ValueError: a sequence that is none of the twelve.
    """
    i, j, k = _axes(sequence)
    proper, parity = k == i, 1 if (j - i) % 3 == 1 else -1
    p = quat_normalised(p)
    v = p.v
    w, a, b, c = p.w, v[i], v[j], parity * v[3 - i - j]
    if not proper:  # less a quarter turn about the second axis, which brings the third axis to the first
        w, a, b, c = w + parity * b, a + parity * c, b - parity * w, c - parity * a
    sign = 1 if proper else -parity
    up, down = safe_sqrt(w * w + a * a), safe_sqrt(b * b + c * c)
    least = 2 * jnp.finfo(jnp.result_type(float, up)).eps
    at_zero, at_half = down < least * up, up < least * down
    angle = lambda y, x, locked: jnp.arctan2(jnp.where(locked, 0, y), jnp.where(locked, 1, x))
    half_sum, half_difference = angle(a, w, at_half), angle(sign * c, sign * b, at_zero)
    first = jnp.where(at_zero, 2 * half_sum, jnp.where(at_half, 2 * half_difference, half_sum + half_difference))
    third = jnp.where(at_zero | at_half, 0, half_sum - half_difference)
    second = sign * 2 * jnp.arctan2(down, up) + (0 if proper else parity * pi / 2)
    return Vec3(_half_open(first), second, _half_open(third))


def _axes(sequence: str) -> tuple[int, int, int]:
    """Indices of the axes of a sequence."""
    if not isinstance(sequence, str) or len(sequence) != 3 or not set(sequence) <= set("123"):
        check.refuse("sequence", "be three of 1, 2, 3, such as '321'", check.short(sequence))
    i, j, k = (int(axis) - 1 for axis in sequence)
    if j in (i, k):
        check.refuse("sequence", "have neighbours that differ, such as '321'", check.short(sequence))
    return i, j, k


def _half_open(a):
    """An angle of (-2 pi, 2 pi] in (-pi, pi]."""
    return jnp.where(a > pi, a - 2 * pi, jnp.where(a <= -pi, a + 2 * pi, a))


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
    return quat_from_angles(Vec3(a.z, a.y, a.x), "321")


def euler_from_quat(p: Quat) -> Vec3:
    """3-2-1 Euler angles [rad] of a quaternion, the angle about y in [-90, 90] deg; at +-90 deg the one about x is 0.

    The attitude is kept to rounding everywhere, see `angles_from_quat`.
    """
    a = angles_from_quat(p, "321")
    return Vec3(a.z, a.y, a.x)


def euler_from_matrix(m: Mat3) -> Vec3:
    """3-2-1 Euler angles [rad] of the rotation nearest to m; raises what `nearest_rotation` raises."""
    return euler_from_quat(quat_from_matrix(m))
