"""The attitude from vectors measured at one instant: TRIAD of two, Davenport's q method of two or more.

b: unit vectors in body axes as measured; r: the same in reference axes; b = A' r, A body to reference.

May import: check, vec, attitude, faults.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxatt.attitude import quat_from_rotation, quat_matrix
from jaxatt.faults import Reading
from jaxatt.vec import (
    Mat3,
    Quat,
    Vec3,
    cross,
    inverse,
    largest_eigenvalue,
    largest_eigenvector,
    norm,
    outer,
    scaled_identity,
    where,
)

PARALLEL = 0.0871557  # sin(5 deg): vectors nearer to each other or to opposites give no attitude


def triad_attitude(b1: Vec3, b2: Vec3, r1: Vec3, r2: Vec3) -> Reading:
    """The attitude that takes b1 to r1 exactly, and b2 into the half plane of r1 and r2 (Black, 1964).

    A = F_r F_b' with the columns u, u x v / |u x v| and the vector product of these two. Valid, with a `Quat` for value,
    where the vectors of either pair lie more than 5 deg apart and from being opposite.
    """
    apart = (norm(cross(b1, b2)) > PARALLEL * norm(b1) * norm(b2)) & (
        norm(cross(r1, r2)) > PARALLEL * norm(r1) * norm(r2)
    )
    body, reference = _frame(b1, b2, apart), _frame(r1, r2, apart)
    return Reading(quat_from_rotation(reference.T @ body), apart)


def _frame(u: Vec3, v: Vec3, apart) -> Mat3:
    """Rows: u, its normal in the plane's direction and the third; any frame where u and v are not apart."""
    u = where(apart, u, Vec3(1.0, 0.0, 0.0))
    v = where(apart, v, Vec3(0.0, 1.0, 0.0))
    u, n = u / norm(u), cross(u, v)
    n = n / norm(n)
    return Mat3(u, n, cross(u, n))


def triad_covariance(b1: Vec3, b2: Vec3, std1, std2) -> Mat3:
    """Covariance of the small turn, in body axes [rad^2], of `triad_attitude`; Shuster & Oh (1981).

    s1^2 I + ((s2^2 - s1^2) b1 b1' + s1^2 (b1.b2) (b1 b2' + b2 b1')) / |b1 x b2|^2; std1, std2: of each vector across its
    direction [rad]; unit vectors. Not finite where they are parallel.
    """
    n = cross(b1, b2)
    s1, s2 = std1 * std1, std2 * std2
    both = outer(b1, b2)
    spread = (s2 - s1) * outer(b1, b1) + (s1 * (b1 @ b2)) * (both + both.T)
    return scaled_identity(s1) + spread / (n @ n)


class Fit(NamedTuple):
    """An attitude from many vectors."""

    q: Quat  # w >= 0; NaN where no attitude is nearest
    loss: Any  # () [1] half the weighted mean square of what is left, 1 - lambda
    gap: Any  # () [1] from the largest to the second eigenvalue; 0: the vectors do not tell the attitude


def davenport(b: tuple[Vec3, ...], r: tuple[Vec3, ...], weights) -> Fit:
    """The attitude of the least sum of w_i |b_i - A' r_i|^2 (Wahba, 1965), by Davenport's matrix.

    With B = sum w r b', z = sum w b x r and K = ((tr B, z'), (z, B + B' - tr B I)) it is the eigenvector of the largest
    eigenvalue lambda of K. No Rodrigues vector, hence nothing is singular at 180 deg.

    b, r: two or more unit vectors each; weights: a number >= 0 for each, such as 1 / std^2, of which only the ratios
    count; 0 leaves a vector out.
    """
    total = sum(weights)
    w = [a / jnp.where(total > 0, total, 1) for a in weights]
    B = Mat3(*(sum((a * r_i[k] * b_i for a, b_i, r_i in zip(w, b, r)), Vec3(0.0, 0.0, 0.0)) for k in range(3)))
    z = sum((a * cross(b_i, r_i) for a, b_i, r_i in zip(w, b, r)), Vec3(0.0, 0.0, 0.0))
    trace = B.x.x + B.y.y + B.z.z
    S = B + B.T - scaled_identity(trace)
    K = Quat(trace, *z), Quat(z.x, *S.x), Quat(z.y, *S.y), Quat(z.z, *S.z)
    _, q = largest_eigenvector(K)
    seen = B @ quat_matrix(q).T  # as B with the body vectors turned to reference axes, where the attitude is none:
    largest = seen.x.x + seen.y.y + seen.z.z  # there K is this number and, beside it, the matrix M of the others
    M = seen + seen.T - scaled_identity(largest)
    gap = largest - largest_eigenvalue(M)
    return Fit(q, 1 - largest, jnp.where(q.w >= 0, gap, 0))  # q is NaN where two are exactly the largest


def davenport_covariance(b: tuple[Vec3, ...], stds) -> Mat3:
    """Covariance of the small turn, in body axes [rad^2], of `davenport` with weights 1 / std^2: (sum (I - b b') / s^2)^-1.

    stds: of each vector across its direction [rad]; Shuster & Oh (1981).
    """
    terms = [(scaled_identity() - outer(v, v)) / (s * s) for v, s in zip(b, stds)]
    return inverse(sum(terms[1:], terms[0]))
