"""The torque matrix of n actuators, T = [t_1 ... t_n]: rank, singular values, and T x = a solved for x.

T is a `Vec3` whose components are its rows, shape (n,): the spin axes of n wheels, or the torque directions of n control
moment gyros. All algebra is element-wise, without LAPACK, so that it is fast in a batch; axes behind the actuators' are
grid points.

May import: check, vec, compiling.
"""

from __future__ import annotations

from functools import reduce
from itertools import combinations
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxatt.compiling import shared
from jaxatt.vec import Mat3, Vec3, columns, cross, diagonal, inverse, largest_eigenvalue, safe_sqrt

SWEEPS = 6  # of Jacobi's rotations: quadratic in the end, round-off after four or five for any 3 x n matrix


def times(v: Vec3, x) -> Vec3:
    """sum x_i v_i, that is T x for x of shape (n,); T' a for a vector a is t @ a."""
    return Vec3(*(_sum(row * x) for row in v))


def dyads(v: Vec3, weight) -> Mat3:
    """sum weight_i v_i v_i', a symmetric matrix; weight: () or (n,)."""
    return _symmetric(lambda a, b: _sum(weight * a * b), v)


def _sum(a):
    """Sum over the modules, written out: over the array's axis it compiles to code several times slower."""
    return reduce(add, a)


def _symmetric(entry, v: Vec3) -> Mat3:
    xy, xz, yz = entry(v.x, v.y), entry(v.x, v.z), entry(v.y, v.z)
    return Mat3(Vec3(entry(v.x, v.x), xy, xz), Vec3(xy, entry(v.y, v.y), yz), Vec3(xz, yz, entry(v.z, v.z)))


def gram(t: Vec3) -> Mat3:
    """T T'."""
    return dyads(t, 1)


def minors(t: list[Vec3]) -> dict[tuple[int, int, int], Any]:
    """det [t_i t_j t_k] of the columns i < j < k."""
    return {(i, j, k): t[i] @ cross(t[j], t[k]) for i, j, k in combinations(range(len(t)), 3)}


class OrderedMinors(NamedTuple):
    """Minors of T of order two and three, twice and six times over."""

    pairs: Vec3  # (n, n) t_j x t_k
    triples: Any  # (n, n, n) det [t_i t_j t_k]


def ordered_minors(t: Vec3) -> OrderedMinors:
    """All products of two columns and determinants of three of T, by their order."""
    pairs = cross(Vec3(*(c[:, None] for c in t)), t)
    return OrderedMinors(pairs, Vec3(*(c[:, None, None] for c in t)) @ pairs)


def gram_determinant(t: Vec3):
    """det(T T') = (sigma_1 sigma_2 sigma_3)^2 as the sum of the squared minors (Cauchy-Binet): never cancels."""
    triples = ordered_minors(t).triples
    return jnp.sum(triples * triples, axis=(0, 1, 2)) / 6


def squared_singular_values(t: list[Vec3], once=lambda f, *operands: f(*operands)):
    """sigma_1^2 >= sigma_2^2 >= sigma_3^2 >= 0 of the columns t; once: `shared`, where a loop needs several of them.

    The eigenvalues of T T', but none by a subtraction: the small ones come from their sum and product (Vieta), those
    from the squared minors of T of order two and three (docs/loops/cmg_loss.md, choice 3).
    """
    A, areas, volumes = once(_invariants, t)
    return _roots(once(largest_eigenvalue, A), areas, volumes)


def _invariants(t: list[Vec3]):
    """T T', and the sums of the squared minors of T of order two and three: l1 l2 + l1 l3 + l2 l3 and l1 l2 l3."""
    A = _symmetric(lambda a, b: sum(x * y for x, y in zip(a, b)), Vec3(*zip(*t)))
    areas = sum(c @ c for c in (cross(a, b) for a, b in combinations(t, 2)))
    return A, areas, sum(d * d for d in minors(t).values())


def _roots(l1, areas, volumes):
    """Eigenvalues l1 >= l2 >= l3 of T T' from the largest and the sums of the squared minors of order two and three."""
    by = 1 / _not_zero(l1)
    product = volumes * by  # l2 l3
    both = jnp.maximum(areas - product, 0) * by  # l2 + l3
    divisor = both + safe_sqrt(jnp.maximum(both * both - 4 * product, 0))
    l3 = jnp.minimum(2 * product / _not_zero(divisor), both / 2)
    return l1, both - l3, l3


def singular_values(t: Vec3) -> Vec3:
    """Singular values of T, largest first: small ones as exact as T, two that coincide to the root of rounding."""
    return Vec3(*(safe_sqrt(a) for a in squared_singular_values(columns(t), shared)))


def condition(t: Vec3):
    """Condition number sigma_1 / sigma_3 of T, eq. (3); inf where rank T < 3."""
    return condition_and_rank(t)[0]


def condition_and_rank(t: Vec3):
    """`condition`, and whether sigma_2 < 1e-6 sigma_1: T of rank one, from which no gimbal motion helps at first."""
    sigma = singular_values(t)
    singular = sigma.z <= 0
    return jnp.where(singular, jnp.inf, sigma.x / jnp.where(singular, 1, sigma.z)), sigma.y < 1e-6 * sigma.x


# solving T x = a


def min_norm_solve(t: Vec3, a: Vec3, rcond):
    """The pseudo-inverse of T times a, (n,): of all least-squares solutions the shortest.

    Singular values below rcond sigma_1, or below rounding, n eps sigma_1, count as zero; at rank 0 the solution is 0.
    """
    return pseudo_inverse(t, rcond) @ a


@jax.custom_jvp
def pseudo_inverse(t: Vec3, rcond) -> Vec3:
    """The Moore-Penrose inverse P (n, 3) of T for every rank, its columns as a `Vec3`: P a is ``pseudo_inverse(t, rcond) @ a``.

    Hestenes' one-sided Jacobi rotations make the rows of T orthogonal, U T = B, so that T's own digits are kept, where
    (T T')^-1 would square the condition: P = sum b_k u_k' / |b_k|^2 over the rows |b_k| > rcond |b_1|. The derivative is
    that of Golub & Pereyra (1973) at constant rank, finite everywhere.
    """
    size = reduce(jnp.maximum, [jnp.max(jnp.abs(row), axis=0) for row in t])
    size = _not_zero(size)  # so that no square underflows in float32
    one, zero = jnp.ones_like(size), jnp.zeros_like(size)
    rows = tuple(row / size for row in t)
    turns = tuple(Vec3(*(one if i == k else zero for k in range(3))) for i in range(3))
    rows, turns = jax.lax.fori_loop(0, SWEEPS, _sweep, (rows, turns))
    squares = [_sum(row * row) for row in rows]
    eps = len(t.x) * jnp.finfo(size.dtype).eps
    least = jnp.square(jnp.maximum(rcond, eps)) * reduce(jnp.maximum, squares)
    kept = [square > least for square in squares]
    weights = [jnp.where(keep, 1 / jnp.where(keep, square, 1), 0) / size for keep, square in zip(kept, squares)]
    return reduce(add, [Vec3(*(u * w * row for u in turn)) for row, turn, w in zip(rows, turns, weights)])


@pseudo_inverse.defjvp
def _pseudo_inverse_jvp(primals, tangents):
    """dP = -P dT P + P P' dT' (1 - T P) + (1 - P T) dT' P' P."""
    (t, rcond), (dt, _) = primals, tangents
    p = pseudo_inverse(t, rcond)
    one = diagonal((1.0, 1.0, 1.0))
    outside = _combined(dt, one - _products(t, p))
    inside = _combined(dt, _products(p, p))
    change = _products(p, outside) - _products(dt, p) - _products(t, inside)
    return p, _combined(p, change) + inside


def _products(a: Vec3, b: Vec3) -> Mat3:
    """A B of A by rows and B by columns, all of shape (n,)."""
    return Mat3(*(Vec3(*(_sum(row * column) for column in b)) for row in a))


def _combined(columns: Vec3, m: Mat3) -> Vec3:
    """C m of the columns of C, shape (n,): the columns of the product."""
    return Vec3(*(columns.x * c.x + columns.y * c.y + columns.z * c.z for c in m.T))


def _sweep(_, state):
    """One rotation of each pair of rows that makes them orthogonal, and of U."""
    rows, turns = map(list, state)
    for i, j in combinations(range(3), 2):
        across, apart = 2 * _sum(rows[i] * rows[j]), _sum(rows[j] * rows[j]) - _sum(rows[i] * rows[i])
        divisor = jnp.abs(apart) + jnp.sqrt(apart * apart + across * across)
        tan = jnp.where(apart >= 0, across, -across) / _not_zero(divisor)
        cos = 1 / jnp.sqrt(1 + tan * tan)
        sin = tan * cos
        rows[i], rows[j] = cos * rows[i] - sin * rows[j], sin * rows[i] + cos * rows[j]
        turns[i], turns[j] = cos * turns[i] - sin * turns[j], sin * turns[i] + cos * turns[j]
    return tuple(rows), tuple(turns)


def robust_solve(t: Vec3, a: Vec3, E: Mat3):
    """T' (T T' + E)^-1 a, (n,): the singularity-robust inverse with damping E."""
    return t @ (inverse(gram(t) + E) @ a)


def _not_zero(a):
    return jnp.where(a > 0, a, 1)
