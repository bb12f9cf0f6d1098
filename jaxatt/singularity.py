"""Singularities of a control-moment-gyro cluster: where its modules cannot turn the spacecraft about some axis.

T = [t_1 ... t_n] holds the torque directions (`mounting.Triads.t`); the cluster is singular where rank T < 3.
Everything about T is closed-form 3 x n algebra on `Vec3` of shape (n, *lanes): no decomposition, any lanes. A
module that does not count has its column set to zero. Momenta are in units of one module's h_w, angles in rad.
Source: Jin & Leeghim (2021), section 3; docs/loops/cmg_loss.md.

May import: check, vec, attitude, faults, mounting, scores.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import combinations, product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.check import door
from jaxatt.mounting import GimbalAxes, check_gimbal_axes, cmg_triads
from jaxatt.vec import Mat3, Vec3, cross, diagonal, norm, safe_sqrt

# the torque matrix


@door
def columns(t: Vec3) -> list[Vec3]:
    """The columns of T, components of shape (*lanes)."""
    return [Vec3(*column) for column in zip(*t)]


@door
def minors(t: list[Vec3]) -> dict[tuple[int, int, int], Any]:
    """det [t_i t_j t_k] of the columns i < j < k, shape (*lanes)."""
    return {(i, j, k): t[i] @ cross(t[j], t[k]) for i, j, k in combinations(range(len(t)), 3)}


@door
def gram_determinant(t: Vec3):
    """det(T T') = (sigma_1 sigma_2 sigma_3)^2 as the sum of the squared minors (Cauchy-Binet): never cancels."""
    return sum(d * d for d in minors(columns(t)).values())


@door
def singular_values(t: Vec3) -> Vec3:
    """Singular values of T, largest first, shape (*lanes); the smallest to rounding of T, not of T T'."""
    l1, l2, l3 = _squares(columns(t))
    return Vec3(safe_sqrt(l1), safe_sqrt(l2), safe_sqrt(l3))


@door
def condition(t: Vec3):
    """Condition number sigma_1 / sigma_3 of T, eq. (3), shape (*lanes); inf where rank T < 3."""
    return condition_and_rank(t)[0]


@door
def condition_and_rank(t: Vec3):
    """`condition`, and whether sigma_2 < 1e-6 sigma_1: T of rank one, from which no gimbal motion helps at first."""
    sigma = singular_values(t)
    singular = sigma.z <= 0
    return jnp.where(singular, jnp.inf, sigma.x / jnp.where(singular, 1, sigma.z)), sigma.y < 1e-6 * sigma.x


# The largest root of a cubic with three real roots is q + 2 p cos(acos(r) / 3). With z = sqrt((1 + r) / 2) the
# cosine is cos(2/3 acos z), analytic up to z = -1, so a polynomial of degree 20 gives it to rounding on [0, 1].
_NODES = np.cos(np.pi * (np.arange(21) + 0.5) / 21)  # Chebyshev's
_THIRD = np.polynomial.chebyshev.cheb2poly(
    np.polynomial.chebyshev.chebfit(_NODES, np.cos(2 / 3 * np.arccos((_NODES + 1) / 2)), 20)
)


def _cos_third(r):
    """cos(acos(r) / 3) for r in [-1, 1]."""
    x = 2 * safe_sqrt((1 + r) / 2) - 1
    value = float(_THIRD[-1])
    for c in _THIRD[-2::-1]:
        value = value * x + float(c)
    return value


def _squares(t: list[Vec3]):
    """sigma_1^2 >= sigma_2^2 >= sigma_3^2 >= 0 of the columns t, the eigenvalues of T T'.

    The small root comes from the product of the roots (Vieta), never from a subtraction, and the product from
    the minors, never from T T' (docs/loops/cmg_loss.md, choice 3).
    """
    xx, yy, zz = (sum(a * a for a in row) for row in zip(*t))
    trace = xx + yy + zz
    q = trace / 3
    xx, yy, zz = xx - q, yy - q, zz - q
    xy, xz, yz = sum(c.x * c.y for c in t), sum(c.x * c.z for c in t), sum(c.y * c.z for c in t)
    p = safe_sqrt((xx * xx + yy * yy + zz * zz + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    by = 1 / jnp.where(p > 0, p, 1)
    xx, yy, zz, xy, xz, yz = (a * by for a in (xx, yy, zz, xy, xz, yz))  # p^3 would underflow in float32
    r = (xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)) / 2
    l1 = q + 2 * p * _cos_third(jnp.clip(r, -1, 1))
    both = jnp.maximum(trace - l1, 0)  # l2 + l3
    f = sum(d * d for d in minors(t).values()) / jnp.where(l1 > 0, l1, 1)  # l2 l3
    divisor = both + safe_sqrt(jnp.maximum(both * both - 4 * f, 0))
    l3 = jnp.minimum(2 * f / jnp.where(divisor > 0, divisor, 1), both / 2)
    return l1, both - l3, l3


# solving T x = a


@door
def times(t: Vec3, x) -> Vec3:
    """T x for x of shape (n, *lanes); T' a for a `Vec3` a is t @ a."""
    return Vec3(*(jnp.sum(row * x, axis=0) for row in t))


@door
def gram(t: Vec3) -> Mat3:
    """T T', components of shape (*lanes)."""
    return Mat3(*(times(t, row) for row in t))


@door
def min_norm_solve(t: Vec3, a: Vec3, rcond):
    """The pseudo-inverse of T times a, shape (n, *lanes): of all least-squares solutions the shortest.

    Singular values below rcond sigma_1 count as zero. At full rank it is the mean of the solutions of all triples
    of columns weighted by their squared minors: as exact as T itself, where (T T')^-1 would square the condition.
    At rank two the direction of sigma_3 is projected out; at rank one sigma_2 counts as exactly zero.
    """
    c, A = columns(t), gram(t)
    l1, l2, l3 = _squares(c)
    total, full = 0.0, [0.0] * len(c)
    for (i, j, k), d in minors(c).items():
        total = total + d * d
        for own, second, third in ((i, j, k), (j, k, i), (k, i, j)):
            full[own] = full[own] + d * (cross(c[second], c[third]) @ a)
    full = jnp.stack(full) / jnp.where(total > 0, total, 1)

    u = _kernel(A - diagonal((l3, l3, l3)))
    two = t @ (_inverse(A + Mat3(u.x * u, u.y * u, u.z * u)) @ (a - (u @ a) * u))
    one = t @ a / jnp.where(l1 > 0, l1, 1)
    least = rcond * rcond * l1
    return jnp.where(l3 > least, full, jnp.where(l2 > least, two, one))


@door
def robust_solve(t: Vec3, a: Vec3, E: Mat3):
    """T' (T T' + E)^-1 a, shape (n, *lanes): the singularity-robust inverse with damping E."""
    return t @ (_inverse(gram(t) + E) @ a)


def _inverse(m: Mat3) -> Mat3:
    # adjugate over determinant of a symmetric matrix; finite for a singular one too, which nobody uses then
    adjugate = Mat3(cross(m.y, m.z), cross(m.z, m.x), cross(m.x, m.y))
    d = m.x @ adjugate.x
    return adjugate * (1 / jnp.where(d != 0, d, 1))


def _kernel(m: Mat3) -> Vec3:
    # the unit vector that a symmetric matrix of rank two takes to zero: the longest column of its adjugate
    x, y, z = cross(m.y, m.z), cross(m.z, m.x), cross(m.x, m.y)
    xx, yy, zz = x @ x, y @ y, z @ z
    first, second = (xx >= yy) & (xx >= zz), yy >= zz
    u = Vec3(*(jnp.where(first, a, jnp.where(second, b, c)) for a, b, c in zip(x, y, z)))
    length = norm(u)
    return u * (1 / jnp.where(length > 0, length, 1))


# grids


@door
def ill_conditioned(axes: GimbalAxes, points: int, threshold=100.0) -> tuple[int, int]:
    """How many of the points^n gimbal-angle combinations have condition >= threshold, and points^n (Table 3).

    axes: of the n >= 3 modules that work, shape (n,) (`mounting.modules` picks them); points: of a grid from 0 to
    360 deg without its end. The grid runs by blocks and is never held. An angle and its opposite give the same
    condition number, t(gamma + 180 deg) = -t(gamma), so an even number of points needs 1/2^n of the grid. The
    grid says how often T is ill conditioned, not how large the singular set is: see `singular_area`.

    Raises ValueError for axes that are none, for points < 1 and for threshold <= 1.
    """
    points = check.whole("points", points)
    check.above("threshold", threshold, 1, "the smallest condition number")
    check_gimbal_axes("axes", axes)
    n = axes.r.x.shape[0]
    fold = 2 if points % 2 == 0 else 1
    return int(_count(axes, points // fold, points, threshold)) * fold**n, points**n


@partial(jax.jit, static_argnums=(1, 2))
def _count(axes: GimbalAxes, kept: int, points: int, threshold):
    dtype = jnp.result_type(*jax.tree.leaves(axes))
    n = axes.r.x.shape[0]
    at = jax.tree.map(lambda a: a[:, None].astype(dtype), axes)
    table = cmg_triads(at, (2 * np.pi / points * np.arange(kept)).astype(dtype)).t
    *rest, row, line = columns(table)
    row = Vec3(*(a[:, None] for a in row))

    def block(index, count):
        angles = jnp.unravel_index(index, (kept,) * (n - 2))
        l1, _, l3 = _squares([*(Vec3(*(a[i] for a in c)) for c, i in zip(rest, angles)), row, line])
        return count + (l1 >= threshold * threshold * l3).sum(0, dtype=jnp.int32)

    count = jax.lax.fori_loop(0, kept ** (n - 2), block, jnp.zeros(kept, jnp.int32))
    return count.sum(dtype=jnp.result_type(int))


# singular momenta


@door
def singular_momentum(axes: GimbalAxes, u: Vec3, signs):
    """Momentum and gimbal angles of the singular state in direction u: h `Vec3` (m,), gamma (n, m) [rad].

    Every module's momentum is as far along u, or against it, as it can be: s_i = e_i (u - (u.r_i) r_i) /
    sqrt(1 - (u.r_i)^2), so that no torque has a component along u. axes: (n,); u: unit vectors of shape (m,);
    signs: e_i = +-1, shape (n,). All equal signs give the external surface, mixed ones internal surfaces. The
    directions u = +-r_i are holes of the map, where the result is NaN: see `rims`.
    """
    at, e = _with_lanes(axes), jnp.asarray(signs)[:, None]
    u = Vec3(*(jnp.asarray(a) for a in u))
    s = u - (at.r @ u) * at.r
    length = norm(s)
    s = jnp.where(length > 1e-12, e / jnp.where(length > 1e-12, length, 1), jnp.nan) * s
    h = Vec3(*(a.sum(0) for a in s))
    return h, jnp.arctan2(s @ cross(at.r, at.s0), s @ at.s0)


@door
def sign_patterns(n: int) -> np.ndarray:
    """The 2^(n-1) patterns of signs, shape (patterns, n), first sign +: the others are these with u and e reversed.

    Raises ValueError for n < 1 and n > 20, a million patterns.
    """
    if check.whole("n", n) > 20:
        check.refuse("n", "not exceed 20 modules", n)
    return np.array([(1, *rest) for rest in product((1, -1), repeat=n - 1)])


class Rim(NamedTuple):
    """The singular momenta in a direction u along a gimbal axis: the modules with that axis are free.

    One free module gives a circle of radius 1, k of them a disc of radius k; h = centre + (in the plane) .
    """

    centre: np.ndarray  # (3,)
    normal: np.ndarray  # (3,) u
    modules: int  # number of free modules
    external: bool  # all other signs equal


@door
def rims(axes: GimbalAxes) -> list[Rim]:
    """The rims of all holes u = r_i, for all signs of the other modules; u = -r_i gives the same set."""
    r = np.stack([np.asarray(c, float) for c in axes.r], axis=-1)
    found: list[Rim] = []
    for i, u in enumerate(r):
        along = r @ u
        free = np.abs(along) > 1 - 1e-12
        if free[:i].any():
            continue  # met before
        others = np.flatnonzero(~free)
        s = (u - along[others, None] * r[others]) / np.sqrt(1 - along[others, None] ** 2)
        for signs in product((1, -1), repeat=len(others)):
            found.append(Rim(np.array(signs) @ s, u, int(free.sum()), abs(sum(signs)) == len(signs)))
    return found


@door
def clearance(axes: GimbalAxes, h) -> float:
    """Distance of the momentum h, shape (3,), from the nearest singular momentum: 0 on the singular surfaces.

    For h = 0 the radius of the ball round zero momentum that is free of singularities.
    """
    h = np.asarray(h, float)
    distances: list[float] = [
        _least(lambda u, signs=signs: _distance(axes, u, signs, Vec3(*h)), sphere(4000))[1]
        for signs in sign_patterns(axes.r.x.shape[0])
    ]
    for rim in rims(axes):
        away = h - rim.centre
        up = away @ rim.normal
        out = np.linalg.norm(away - up * rim.normal)
        gap = abs(out - 1) if rim.modules == 1 else max(out - rim.modules, 0.0)
        distances.append(float(np.hypot(up, gap)))
    return float(min(distances))


@jax.jit
def _distance(axes: GimbalAxes, u: Vec3, signs, h: Vec3):
    return jnp.nan_to_num(norm(singular_momentum(axes, u, signs)[0] - h), nan=jnp.inf)


@door
def sphere(m: int) -> Vec3:
    """m nearly even unit vectors (Fibonacci's spiral), shape (m,).

    Raises ValueError for m < 1, and where the free memory does not hold them.
    """
    check.fits_memory(f"`m` = {check.whole('m', m)}", 64 * m, "ask for fewer")
    z = 1 - (2 * np.arange(m) + 1) / m
    turn = np.pi * (1 + 5**0.5) * np.arange(m)
    rho = np.sqrt(1 - z * z)
    return Vec3(rho * np.cos(turn), rho * np.sin(turn), z)


def _least(f: Callable, u: Vec3, keep: int = 8, rounds: int = 40) -> tuple[np.ndarray, float]:
    """Where on the sphere f is least, shape (3,), and its value there: u is a grid, refined by shrinking cones."""
    points = np.stack(u, axis=-1)
    fan = np.stack(sphere(32), axis=-1)
    cone = 4 / np.sqrt(len(points))
    values = np.asarray(f(u))
    order = np.argsort(values)[:keep]
    best, values = points[order], values[order]
    for _ in range(rounds):
        around = np.concatenate([best[:, None], best[:, None] + cone * fan], axis=1)
        around /= np.linalg.norm(around, axis=-1, keepdims=True)
        tried = np.asarray(f(Vec3(*around.reshape(-1, 3).T))).reshape(keep, -1)
        choice = tried.argmin(1)
        best, values = around[np.arange(keep), choice], tried[np.arange(keep), choice]
        cone *= 0.6
    return best[values.argmin()], float(values.min())


# the momentum envelope


@door
def support(axes: GimbalAxes, u: Vec3):
    """Largest u.h of the cluster, shape (m,): the support of the envelope's convex hull, for unit vectors u."""
    along = _with_lanes(axes).r @ u
    return safe_sqrt(jnp.maximum(1 - along * along, 0)).sum(0)


@door
def reach(axes: GimbalAxes, d: Vec3):
    """Largest |h| that the cluster holds along the unit vectors d, shape (m,).

    Less than the hull's support allows where the envelope has dimples. By projected gradient ascent of d.h over
    the gimbal angles, h kept on the line, from 24 fixed starts; one that ends off the line does not count. Good to
    1e-4 on flat faces, to 1e-8 elsewhere.
    """
    return _reach(axes, Vec3(*(jnp.asarray(a, float) for a in d)))


@jax.jit
def _reach(axes: GimbalAxes, d: Vec3):
    n, m = axes.r.x.shape[0], d.x.shape[0]
    at = jax.tree.map(lambda a: jnp.asarray(a)[:, None, None], axes)
    d = Vec3(*(a[None] for a in d))
    least_x = jnp.abs(d.x) < 0.6  # two unit vectors at right angles to d
    e = cross(d, Vec3(*(jnp.where(least_x, a, b) for a, b in ((1.0, 0.0), (0.0, 1.0), (0.0, 0.0)))))
    e = e / norm(e)
    f = cross(d, e)
    start = jax.random.uniform(jax.random.key(0), (n, 24, m), d.x.dtype, 0, 2 * jnp.pi)

    def off_line(gamma):
        triads = cmg_triads(at, gamma)
        h = Vec3(*(a.sum(0) for a in triads.s))
        return triads.t, h, h @ e, h @ f

    def back(tx, ty, x, y):  # the least change of the angles that changes h.e by x and h.f by y
        xx, xy, yy = (tx * tx).sum(0) + 1e-9, (tx * ty).sum(0), (ty * ty).sum(0) + 1e-9
        return ((yy * x - xy * y) * tx + (xx * y - xy * x) * ty) / (xx * yy - xy * xy)

    def climb(_, gamma):
        t, _, x, y = off_line(gamma)
        up, tx, ty = t @ d, t @ e, t @ f  # gradients of h.d, h.e and h.f
        along = up - back(tx, ty, (up * tx).sum(0), (up * ty).sum(0))
        return gamma + 0.5 * along - back(tx, ty, x, y).clip(-0.3, 0.3)

    def restore(_, gamma):
        t, _, x, y = off_line(gamma)
        return gamma - back(t @ e, t @ f, x, y)

    gamma = jax.lax.fori_loop(0, 8, restore, jax.lax.fori_loop(0, 150, climb, start))
    _, h, x, y = off_line(gamma)
    return jnp.where(x * x + y * y < 1e-16, h @ d, 0).max(0)


class Envelope(NamedTuple):
    """What a cluster can hold, [h_w]."""

    directions: Vec3  # (m,) unit vectors
    reach: np.ndarray  # (m,)
    inscribed: float  # radius of the largest ball round zero
    volume: float  # radius of the ball of the same volume
    largest: float  # |h|


@door
def envelope(axes: GimbalAxes, m: int = 1500) -> Envelope:
    """The momentum envelope over m nearly even directions, its least and largest radius refined."""
    d = sphere(m)
    far = np.asarray(reach(axes, d))
    inscribed = _least(lambda u: reach(axes, u), d, keep=3, rounds=12)[1]
    largest = -_least(lambda u: -reach(axes, u), d, keep=3, rounds=12)[1]
    return Envelope(d, far, inscribed, float(np.mean(far**3) ** (1 / 3)), largest)


# the singular set in gimbal space


@door
def singular_area(axes: GimbalAxes, m: int = 500) -> float:
    """Area of the set det T = 0 of three modules in the space of their gimbal angles, in units of (2 pi)^2.

    The set's unit normal is n = grad det / |grad det|, and |n_k| dA is the area seen along angle k; so the area is
    the sum over k of the integral of |n_k| over the plane of the other two, both roots counted: det T is
    c cos gamma_k - s sin gamma_k. By m points per turn, those of two angles never opposite, where sheets meet.
    """
    check_gimbal_axes("axes", axes)
    if axes.r.x.shape[0] != 3:
        check.refuse("axes", "be of three modules", f"of {axes.r.x.shape[0]}")
    return float(_area(axes, m))


@partial(jax.jit, static_argnums=1)
def _area(axes: GimbalAxes, m: int):
    midpoints = 2 * jnp.pi * (jnp.arange(m) + 0.5) / m
    r, s0 = ([Vec3(*(jnp.asarray(c) for c in v)) for v in columns(part)] for part in axes)

    def at(i, gamma):
        t0 = cross(r[i], s0[i])
        return jnp.cos(gamma) * s0[i] + jnp.sin(gamma) * t0, jnp.cos(gamma) * t0 - jnp.sin(gamma) * s0[i]

    total = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        (s_i, t_i), (s_j, t_j) = at(i, midpoints[:, None]), at(j, midpoints[None] + np.pi / (2 * m))
        across = cross(t_i, t_j)
        root = jnp.arctan2(across @ cross(r[k], s0[k]), across @ s0[k])
        s_k, t_k = at(k, root)  # half a turn on, where the other root is, both change their sign
        slope = jnp.abs(across @ s_k)  # dt/dgamma = -s
        gradient = safe_sqrt(slope**2 + (t_k @ cross(s_i, t_j)) ** 2 + (t_k @ cross(t_i, s_j)) ** 2)
        total += 2 * jnp.mean(slope / jnp.where(gradient > 0, gradient, 1))
    return total


@door
def passability(axes: GimbalAxes, gamma) -> np.ndarray:
    """Eigenvalues, ascending, shape (n - 2, *lanes), of N' diag(u.s_i) N at singular angles gamma (n, *lanes).

    N spans the null space of T, u is the singular direction; at rank T = 2. Eigenvalues of one sign: no null motion
    leaves the singular state, it is impassable. Of both signs: perhaps passable. With three modules there is one
    eigenvalue, no null motion, and nothing to pass.
    """
    gamma = np.asarray(gamma, float)
    lanes = gamma.ndim - 1
    at = cmg_triads(jax.tree.map(lambda a: np.reshape(a, (-1,) + (1,) * lanes), axes), gamma)
    s, t = (np.moveaxis(np.stack([np.asarray(c) for c in v]), (0, 1), (-2, -1)) for v in (at.s, at.t))
    left, _, right = np.linalg.svd(t)
    null = right[..., 2:, :]  # rows: the null vectors
    along = np.einsum("...i,...in->...n", left[..., 2], s)
    return np.moveaxis(np.linalg.eigvalsh(np.einsum("...an,...n,...bn->...ab", null, along, null)), -1, 0)


# rearrangement


class Rearrangement(NamedTuple):
    """Gimbal angles that were found, best first."""

    gamma: np.ndarray  # (k, n) [rad]
    condition: np.ndarray  # (k,)


@door
def rearrange(axes: GimbalAxes, gamma, step=np.pi / 36, rank: Callable | None = None) -> Rearrangement:
    """All gimbal angles of least condition among gamma and its neighbours by -step, 0, +step [rad] in each module.

    axes: (n,) of the modules that work; gamma: (n,). Ties are common, for the clusters are symmetric, and they are
    not equally good (docs/loops/cmg_loss.md, erratum 9): rank(gamma of shape (k, n)) -> (k,) orders them, least
    first, for instance by simulation. Ties within 1e-9.
    """
    gamma = np.asarray(gamma, float)
    options = gamma + step * np.array(list(product((-1, 0, 1), repeat=len(gamma))))
    kappa = np.asarray(condition(cmg_triads(_with_lanes(axes), options.T).t))
    tied = np.flatnonzero(kappa <= kappa.min() * (1 + 1e-9))
    if rank is not None:
        tied = tied[np.argsort(np.asarray(rank(options[tied])), kind="stable")]
    return Rearrangement(options[tied], kappa[tied])


@door
def rearrange_by_gradient(axes: GimbalAxes, gamma, limit=np.pi / 36) -> Rearrangement:
    """The gimbal angles of three modules within +-limit [rad] of gamma with the largest and the smallest det T.

    At a singular start the gradients of det(T T') and of the condition number are zero and infinite, that of det T
    is neither; its two signs lead to the two classes of ties. Sorted by condition.
    """
    gamma = jnp.asarray(gamma, float)
    if gamma.shape != (3,):
        check.refuse("gamma", "hold the angles of three modules", f"of shape {gamma.shape}")
    nudged = 1e-3 * limit * jnp.ones(3)  # off the saddle where two sheets of the singular set cross
    ends = jnp.stack([_climb(axes, gamma, nudged, limit, sign) for sign in (1.0, -1.0)])
    kappa = np.asarray(condition(cmg_triads(_with_lanes(axes), ends.T).t))
    order = np.argsort(kappa)
    return Rearrangement(np.asarray(ends)[order], kappa[order])


@jax.jit
def _climb(axes: GimbalAxes, gamma, start, limit, sign):
    def height(change):
        (d,) = minors(columns(cmg_triads(axes, gamma + change).t)).values()
        return sign * d

    def step(_, change):
        return jnp.clip(change + 0.02 * jax.grad(height)(change), -limit, limit)

    return gamma + jax.lax.fori_loop(0, 1000, step, start)


def _with_lanes(axes: GimbalAxes) -> GimbalAxes:
    return jax.tree.map(lambda a: jnp.asarray(a)[:, None], axes)
