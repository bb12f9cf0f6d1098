"""Singularities of a control-moment-gyro cluster: where its modules cannot turn the spacecraft about some axis.

T = [t_1 ... t_n] holds the torque directions (`cmg.Triads.t`); the cluster is singular where rank T < 3. Off line: grid
points and directions lie in an axis behind that of the modules. Momenta are in units of one module's h_w, angles in rad.
``axes`` are the `cmg.GimbalAxes` of the n modules that work; `cmg.modules` picks them. Every function raises TypeError for
what are no axes and ValueError for axes that are no unit vectors at right angles; those of rank and condition refuse fewer
than three modules and parallel ones too. Source: Jin & Leeghim (2021), section 3; docs/loops/cmg_loss.md.

May import: check, fields, vec, torque_matrix, cmg.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check, fields
from jaxatt.cmg import GimbalAxes, check_cluster, cmg_triads
from jaxatt.torque_matrix import condition, minors, squared_singular_values
from jaxatt.vec import Vec3, columns, cross, norm, safe_sqrt


def _modules(axes: GimbalAxes) -> int:
    """The number of modules; refuses what are no axes."""
    check.kind("axes", axes, GimbalAxes)
    fields.validate("axes", axes)
    return np.shape(axes.r.x)[0]


def _three_modules(axes: GimbalAxes) -> None:
    """Refuses axes of more or fewer than three modules."""
    if (n := _modules(axes)) != 3:
        check.refuse("axes", "be of three modules", f"of {n}")
    check_cluster("axes", axes)


def _checked(name: str, value, *shape: int) -> np.ndarray:
    """Finite numbers of one shape as an array; refuses others."""
    check.finite(name, value)
    if np.shape(value) != shape:
        check.refuse(name, f"have shape {shape}", f"of shape {np.shape(value)}")
    return np.asarray(value, float)


def _directions(name: str, u: Vec3) -> Vec3:
    """Unit vectors (m,) as arrays; refuses others."""
    check.kind(name, u, Vec3)
    check.unit(name, u)
    shapes = {np.shape(c) for c in u}
    if len(shapes) > 1 or np.ndim(u.x) != 1:
        check.refuse(name, "have components of one shape (m,)", f"of {' and '.join(map(str, shapes))}")
    return Vec3(*(jnp.asarray(c, float) for c in u))


# grids


def ill_conditioned(axes: GimbalAxes, points: int, threshold: Any = 100.0) -> tuple[Any, int]:
    """How many of the points^n gimbal-angle combinations have condition >= threshold, and points^n (Table 3).

    points: of a grid from 0 to 360 deg without its end. threshold: one, or several, which are counted at once, (k,). The grid runs by blocks and is never held. An angle and its
    opposite give the same condition number, t(gamma + 180 deg) = -t(gamma), so an even number of points needs 1/2^n of
    the grid. The grid says how often T is ill conditioned, not how large the singular set is: see `singular_area`.

    Raises ValueError for points < 1 and for threshold <= 1.
    """
    points = check.whole("points", points)
    check.above("threshold", threshold, 1, "the smallest condition number")
    n = _modules(axes)
    check_cluster("axes", axes)
    fold = 2 if points % 2 == 0 else 1
    counts = _count(axes, points // fold, points, np.ravel(np.asarray(threshold, float))).tolist()
    counts = [count * fold**n for count in counts]
    return (np.array(counts) if np.ndim(threshold) else counts[0]), points**n


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
        l1, _, l3 = squared_singular_values([*(Vec3(*(a[i] for a in c)) for c, i in zip(rest, angles)), row, line])
        above = l1 >= (threshold * threshold)[:, None, None] * l3
        return count + above.sum(1, dtype=jnp.int32)

    threshold = threshold.astype(dtype)
    count = jax.lax.fori_loop(0, kept ** (n - 2), block, jnp.zeros((len(threshold), kept), jnp.int32))
    return count.sum(1, dtype=jnp.result_type(int))


# singular momenta


def singular_momentum(axes: GimbalAxes, u: Vec3, signs):
    """Momentum and gimbal angles of the singular state in directions u, (m,): h `Vec3` (m,), gamma (n, m) [rad].

    Every module's momentum is as far along u, or against it, as it can be: s_i = e_i (u - (u.r_i) r_i) /
    sqrt(1 - (u.r_i)^2), so that no torque has a component along u. u: unit vectors; signs: e_i = +-1, (n,). All equal
    signs give the external surface, mixed ones internal surfaces. The directions u = +-r_i are holes of the map, where
    the result is NaN: see `rims`.
    """
    signs = _checked("signs", signs, _modules(axes))
    check.one_of("signs", signs, (-1, 1))
    return _singular(axes, _directions("u", u), signs)


def _singular(axes: GimbalAxes, u: Vec3, signs):
    at, e = _over_points(axes), jnp.asarray(signs)[:, None]
    s = u - (at.r @ u) * at.r
    length = norm(s)
    s = jnp.where(length > 1e-12, e / jnp.where(length > 1e-12, length, 1), jnp.nan) * s
    h = Vec3(*(a.sum(0) for a in s))
    return h, jnp.arctan2(s @ cross(at.r, at.s0), s @ at.s0)


def sign_patterns(n: int) -> np.ndarray:
    """The 2^(n-1) patterns of signs, shape (patterns, n), first sign +: the others are these with u and e reversed.

    Raises ValueError for n < 1 and n > 20, a million patterns.
    """
    if check.whole("n", n) > 20:
        check.refuse("n", "not exceed 20 modules", n)
    return np.array([(1, *rest) for rest in product((1, -1), repeat=n - 1)])


class Rim(NamedTuple):
    """The singular momenta in a direction u along a gimbal axis: the modules with that axis are free.

    One free module gives a circle of radius 1 round the centre, k of them a disc of radius k.
    """

    centre: np.ndarray  # (3,)
    normal: np.ndarray  # (3,) u
    modules: int  # number of free modules
    external: bool  # all other signs equal


def rims(axes: GimbalAxes) -> list[Rim]:
    """The rims of all holes u = r_i, for all signs of the other modules; u = -r_i gives the same set."""
    _modules(axes)
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


def clearance(axes: GimbalAxes, h) -> float:
    """Distance of the momentum h, shape (3,), from the nearest singular momentum: 0 on the singular surfaces.

    For h = 0 the radius of the ball round zero momentum that is free of singularities.
    """
    n, h = _modules(axes), _checked("h", h, 3)
    near = lambda signs: _least(lambda u: _distance(axes, u, signs, Vec3(*h)), sphere(4000))[1]
    distances = [near(signs) for signs in sign_patterns(n)]
    for rim in rims(axes):
        away = h - rim.centre
        up = away @ rim.normal
        out = np.linalg.norm(away - up * rim.normal)
        gap = abs(out - 1) if rim.modules == 1 else max(out - rim.modules, 0.0)
        distances.append(float(np.hypot(up, gap)))
    return float(min(distances))


@jax.jit
def _distance(axes: GimbalAxes, u: Vec3, signs, h: Vec3):
    return jnp.nan_to_num(norm(_singular(axes, u, signs)[0] - h), nan=jnp.inf)


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


def support(axes: GimbalAxes, u: Vec3):
    """Largest u.h of the cluster, shape (m,): the support of the envelope's convex hull, for unit vectors u."""
    _modules(axes)
    along = _over_points(axes).r @ _directions("u", u)
    return safe_sqrt(jnp.maximum(1 - along * along, 0)).sum(0)


def reach(axes: GimbalAxes, d: Vec3):
    """Largest |h| that the cluster holds along the unit vectors d, shape (m,).

    Less than the hull's support allows where the envelope has dimples. By projected gradient ascent of d.h over
    the gimbal angles, h kept on the line, from 24 fixed starts; one that ends off the line does not count. Good to
    1e-4 on flat faces, to 1e-8 elsewhere.
    """
    _modules(axes)
    return _reach(axes, _directions("d", d))


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


def envelope(axes: GimbalAxes, m: int = 1500) -> Envelope:
    """The momentum envelope over m nearly even directions, its least and largest radius refined."""
    d = sphere(m)
    far = np.asarray(reach(axes, d))
    inscribed = _least(lambda u: reach(axes, u), d, keep=3, rounds=12)[1]
    largest = -_least(lambda u: -reach(axes, u), d, keep=3, rounds=12)[1]
    return Envelope(d, far, inscribed, float(np.mean(far**3) ** (1 / 3)), largest)


# the singular set in gimbal space


def singular_area(axes: GimbalAxes, m: int = 500) -> float:
    """Area of the set det T = 0 of three modules in the space of their gimbal angles, in units of (2 pi)^2.

    The set's unit normal is n = grad det / |grad det|, and |n_k| dA is the area seen along angle k; so the area is
    the sum over k of the integral of |n_k| over the plane of the other two, both roots counted: det T is
    c cos gamma_k - s sin gamma_k. By m points per turn, those of two angles never opposite, where sheets meet.
    """
    _three_modules(axes)
    return float(_area(axes, check.whole("m", m)))


@partial(jax.jit, static_argnums=1)
def _area(axes: GimbalAxes, m: int):
    midpoints = 2 * jnp.pi * (jnp.arange(m) + 0.5) / m
    r, s0 = (columns(v) for v in axes)

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


def passability(axes: GimbalAxes, gamma) -> np.ndarray:
    """Eigenvalues, ascending, (n - 2, ...), of N' diag(u.s_i) N at singular angles gamma (n, ...), rank T = 2.

    N spans the null space of T, u is the singular direction. Eigenvalues of one sign: no null motion leaves the
    singular state, it is impassable. Of both signs: perhaps passable. Three modules have no null motion.
    """
    gamma = _checked("gamma", gamma, _modules(axes), *np.shape(gamma)[1:])
    check_cluster("axes", axes)
    at = cmg_triads(jax.tree.map(lambda a: np.reshape(a, (-1,) + (1,) * (gamma.ndim - 1)), axes), gamma)
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


def rearrange(axes: GimbalAxes, gamma, step=np.pi / 36, rank: Callable | None = None) -> Rearrangement:
    """All gimbal angles of least condition among gamma and its neighbours by -step, 0, +step [rad] in each module.

    gamma: (n,). Ties, within 1e-9, are common, for the clusters are symmetric, and they are not equally good
    (docs/loops/cmg_loss.md, erratum 9): rank(gamma (k, n)) -> (k,) orders them, least first, say by simulation.
    """
    gamma = _checked("gamma", gamma, _modules(axes))
    check_cluster("axes", axes)
    check.positive("step", step)
    if rank is not None:
        check.function("rank", rank)
    options = gamma + step * np.array(list(product((-1, 0, 1), repeat=len(gamma))))
    kappa = np.asarray(condition(cmg_triads(_over_points(axes), options.T).t))
    tied = np.flatnonzero(kappa <= kappa.min() * (1 + 1e-9))
    if rank is not None:
        tied = tied[np.argsort(np.asarray(rank(options[tied])), kind="stable")]
    return Rearrangement(options[tied], kappa[tied])


def rearrange_by_gradient(axes: GimbalAxes, gamma, limit=np.pi / 36) -> Rearrangement:
    """The gimbal angles of three modules within +-limit [rad] of gamma with the largest and the smallest det T.

    At a singular start the gradients of det(T T') and of the condition number are zero and infinite, that of det T
    is neither; its two signs lead to the two classes of ties. Sorted by condition.
    """
    _three_modules(axes)
    gamma = jnp.asarray(_checked("gamma", gamma, 3))
    check.positive("limit", limit)
    nudged = 1e-3 * limit * jnp.ones(3)  # off the saddle where two sheets of the singular set cross
    ends = jnp.stack([_climb(axes, gamma, nudged, limit, sign) for sign in (1.0, -1.0)])
    kappa = np.asarray(condition(cmg_triads(_over_points(axes), ends.T).t))
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


def _over_points(axes: GimbalAxes) -> GimbalAxes:
    return jax.tree.map(lambda a: jnp.asarray(a)[:, None], axes)
