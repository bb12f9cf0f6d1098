"""The nearest failure by gradient, and importance sampling around it: a second method, for few and nearly flat boundaries.

A design point is the most likely draw at which a score reaches a number: the nearest to zero in standard normal space. It
falsifies a loop at the least cost. It need not be how the loop fails: where every tick and direction has a design point of
its own, the failures fill a shell, and sampling around a few points misses most of it without a sign. So `importance`
carries a flag unless its interval overlaps that of `rare.probability`.

May import: check, compiling, loss, noise, normal_space.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.compiling import compiled
from jaxatt.loss import Loss, log_t, said
from jaxatt.noise import BLOCK, block_key
from jaxatt.normal_space import Event, Point, event_of, kept_failures, proposed, scores_at, valued

BATCHES = 8  # of importance sampling, whose spread is the interval
DISTINCT = np.cos(np.radians(10))  # points within 10 deg of each other count as one


class Points(NamedTuple):
    """Design points, the nearest first; every field leads with them."""

    u: Any  # (points, normals) [1] numbers of the scenario
    noise: Any  # (points, ticks, system.normals) [1] for `simulate`
    beta: Any  # (points,) [1] distance from zero; negative where a run at zero fails
    form: Any  # (points,) [1] Phi(-beta), the probability beyond a flat boundary there
    score: Any  # (points,) [unit of the score]
    found_by: Any  # (points,) starts that ended there
    residual: Any  # (points,) [1] sine of the angle between point and gradient, 0 at a design point


def design_point(
    system, params, scenario, key, *, ticks: int, score: Callable, above: float, normals: int = 0, starts: int = 8,
    steps: int = 50,
) -> Points:  # fmt: skip
    """The most likely failures: the points nearest to zero at which the score reaches a number, by gradient.

    Zhang and Der Kiureghian's improved HLRF (1995) from random directions: a step goes to the nearest point of the
    linearised boundary, halved until the merit |x|^2 / 2 + c |above - score| falls.

    Args:
        system, params, scenario, ticks, score, above, normals: as of `rare.probability`.
        key: of the starts.
        starts: how many.
        steps: that each takes at most.

    Returns:
        `Points` more than 10 deg apart. ``simulate`` with ``noise[0]`` shows the first.

    Raises:
        ValueError, TypeError: as `rare.probability`; ValueError where no start comes to a design point.

    Warns:
        UserWarning if the gradient at the first point differs by more than 10 % from central differences.

    Example:
        >>> points = rare.design_point(
        ...     loop.system, loop.params, healthy, jax.random.key(0), ticks=300, score=peak, above=0.004
        ... )
    """
    starts, steps = check.whole("starts", starts), check.whole("steps", steps)
    side = -(-max(starts, 8) // 8) * 8
    event, key = event_of("design_point", system, params, scenario, key, ticks, score, above, normals, side, 5)
    slopes = _Slopes(event)
    generator = np.random.default_rng(key.tolist())
    x = generator.standard_normal((side, slopes.size))
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-30)
    s, g = slopes(np.zeros_like(x))
    sign = -1.0 if s[0] > event.above else 1.0
    s, g = slopes(x)
    half, taken, alive = np.ones(side), np.zeros(side, int), np.arange(side) < starts
    while alive.any():
        size = np.linalg.norm(g, axis=1)
        alive &= np.isfinite(s) & np.isfinite(size) & (size > 0)
        safe = np.where(alive, size, 1.0)
        ahead = np.where(alive[:, None], _nearest(event, x, s, g, safe), x)
        c = 2 * np.maximum(np.linalg.norm(x, axis=1), np.linalg.norm(ahead, axis=1)) / safe
        merit = lambda x, s, c=c: np.sum(x * x, axis=1) / 2 + c * np.abs(event.above - s)
        trial = x + half[:, None] * (ahead - x)
        there, slope = slopes(trial)
        fell = alive & (merit(trial, there) < merit(x, s))
        moved = np.linalg.norm(trial - x, axis=1) > 1e-5 * np.linalg.norm(x, axis=1)
        x, s, g = (np.where(fell[:, None], trial, x), np.where(fell, there, s), np.where(fell[:, None], slope, g))
        half, taken = np.where(fell, 1.0, half / 2), taken + fell
        alive &= (taken < steps) & (half > 1e-3) & (moved | ~fell)
    points = _distinct(event, slopes, x[:starts], s[:starts], g[:starts], sign)
    _check_gradient(slopes, np.concatenate([points.u, points.noise.reshape(len(points.u), -1)], axis=1)[0], generator)
    return points


def _nearest(event: Event, x, s, g, size):
    """The point of the linearised boundary nearest to zero."""
    return ((np.sum(g * x, axis=1) + event.above - s) / size**2)[:, None] * g


def _distinct(event: Event, slopes, x, s, g, sign: float) -> Points:
    size, length = np.linalg.norm(g, axis=1), np.linalg.norm(x, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.abs(s - event.above) / size  # how far from the boundary
        along = np.sum(x * g, axis=1) / (size * length)
    residual = np.sqrt(np.maximum(1 - along**2, 0))
    good = np.flatnonzero((off < 1e-3 * np.maximum(length, 1)) & (residual < 0.1))
    if not len(good):
        met = f"{np.nanmax(s):g} at best" if np.isfinite(s).any() else "NaN"
        check.refuse("score", f"rise to `above` = {event.above:g} along its gradient from one of the starts", met)
    kept: list[int] = []
    count: list[int] = []
    for i in good[np.argsort(length[good])]:
        near = [j for j, k in enumerate(kept) if x[i] @ x[k] > DISTINCT * length[i] * length[k]]
        if near:
            count[near[0]] += 1
        else:
            kept.append(i)
            count.append(1)
    from scipy.stats import norm

    point, beta = slopes.point(x[kept]), sign * length[kept]
    u, noise = point.u.T, np.moveaxis(point.noise, -1, 0)[:, : event.ticks]
    return Points(u, noise, beta, norm.sf(beta), s[kept], np.array(count), residual[kept])


def _check_gradient(slopes, x, generator) -> None:
    """Warn where the gradient at x differs from central differences along it and two random directions."""
    side = slopes.event.chains
    _, g = slopes(np.tile(x, (side, 1)))
    size = np.linalg.norm(g[0])
    along = np.stack([g[0], *(size * a / np.linalg.norm(a) + g[0] for a in generator.standard_normal((2, len(x))))])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    h = 0.01
    beside = np.concatenate([x + h * along, x - h * along])
    s, _ = slopes(np.concatenate([beside, np.tile(x, (side - 6, 1))]))
    off = np.max(np.abs((s[:3] - s[3:6]) / (2 * h) - along @ g[0])) / size
    if not off <= 0.1:
        check.warn(f"The gradient at the design point differs from central differences by {off:.0%}: see `score`.")


class _Slopes:
    """Scores and their gradients at points (starts, coordinates), float64."""

    def __init__(self, event: Event):
        self.event = event
        ticks = event.ticks
        self.size = event.normals + ticks * event.system.normals

    def point(self, x) -> Point:
        """The points of coordinates, chains last; ticks past the last one are zero."""
        event, n = self.event, len(x)
        noise = x[:, event.normals :].reshape(n, event.ticks, event.system.normals)
        filled = event.shapes.noise[0] - event.ticks
        noise = np.pad(np.moveaxis(noise, 0, -1), [(0, filled), (0, 0), (0, 0)])
        return Point(x[:, : event.normals].T.astype(event.dtype), noise.astype(event.dtype))

    def __call__(self, x):
        event = self.event
        given = event.system, event.score, event.draw, event.ticks, event.params, event.scenario
        with jax.debug_nans(False), jax.debug_infs(False):
            s, g = compiled(sloped, 4)(*given, self.point(x))
        u, noise = np.asarray(g.u, float).T, np.moveaxis(np.asarray(g.noise, float)[: event.ticks], -1, 0)
        return np.asarray(s, float), np.concatenate([u, noise.reshape(len(x), -1)], axis=1)


def sloped(system, score: Callable, draw: Callable | None, ticks: int, params, scenario, point: Point):
    """Scores (chains,) and their gradients, points like ``point``."""

    def total(point):
        s = jax.tree.leaves(scores_at(system, score, draw, params, scenario, ticks, point))[0]
        return jnp.sum(s), s

    gradient, s = jax.grad(total, has_aux=True)(point)
    return s, gradient


# importance sampling


def importance(
    system, params, scenario, key, points: Points, *, ticks: int, score: Callable, above: float, normals: int = 0,
    runs: int, against: Loss | None = None,
) -> Loss:  # fmt: skip
    """The probability that a score exceeds a number, by sampling around design points: for few, nearly flat boundaries.

    Draws come from unit normals at the points, all equally likely, and weigh by the balance heuristic
    1 / mean_k exp(u_k . x - |u_k|^2 / 2). What lies near none of the points is missed and does not show in the interval:
    the result carries a flag unless ``against`` confirms it.

    Args:
        system, params, scenario, key, ticks, score, above, normals: as of `rare.probability`.
        points: what `design_point` returned for the same loop.
        runs: how many, filled up to 8 batches of a multiple of 128.
        against: the result of `rare.probability` for the same event.

    Returns:
        A `Loss` whose repeats are the 8 batches; the root of a failure is the number of its nearest point, roots are the
        effective samples that fail, of all batches together.

    Raises:
        ValueError, TypeError: as `rare.probability`; ValueError for points of another loop.

    Warns:
        UserWarning with the flags, if there are any, and what they mean.

    Example:
        >>> second = rare.importance(
        ...     loop.system, loop.params, healthy, jax.random.key(1), points, ticks=300, score=peak, above=0.004,
        ...     runs=5000, against=loss,
        ... )
    """
    began = time.perf_counter()
    event, key = event_of("importance", system, params, scenario, key, ticks, score, above, normals, BLOCK, 5)
    check.kind("points", points, Points)
    if against is not None:
        check.kind("against", against, Loss)
    wanted = (len(points.beta), normals), (len(points.beta), event.ticks, system.normals)
    if (np.shape(points.u), np.shape(points.noise)) != wanted or not len(points.beta):
        check.refuse(
            "points", f"have u and noise of shapes {wanted}", f"{np.shape(points.u)}, {np.shape(points.noise)}"
        )
    blocks = -(-check.whole("runs", runs) // (BATCHES * BLOCK))
    filled = [(0, 0), (0, event.shapes.noise[0] - event.ticks), (0, 0)]
    centres = Point(np.asarray(points.u), np.pad(np.asarray(points.noise), filled))
    flat = _flat(Point(*(np.moveaxis(a, 0, -1) for a in centres)), event.ticks)
    found = [_batch(event, block_key(key, batch), centres, flat, blocks) for batch in range(BATCHES)]
    p, low, high, cv = (float(a) for a in log_t([one[0] for one in found]))
    weights = np.concatenate([one[1] for one in found])
    effective = float(weights.sum() ** 2 / np.sum(weights**2)) if len(weights) else 0.0
    low, high = (low, high) if p else (0.0, 1.0)
    flags = {
        "lost": any(one[0] == 0 for one in found),
        "few effective": effective < 10,
        "nan": any(one[2] for one in found),
        "unchecked": against is None,
        "contradicts": against is not None and not (low <= against.high and against.low <= high),
    }
    none, seconds = np.array([]), time.perf_counter() - began
    return Loss(
        p, low, high, cv, np.nan, np.array([one[0] for one in found]), none, none, none, None,
        BATCHES * blocks * BLOCK, said([flag for flag, up in flags.items() if up]),
        kept_failures(event, [one[3] for one in found]), seconds, None, effective, 1, event.words,
    )  # fmt: skip


def _flat(point: Point, ticks: int):
    """Coordinates (chains, coordinates) of points, in float64."""
    u, noise = np.asarray(point.u, float), np.asarray(point.noise, float)[:ticks]
    return np.concatenate([u, noise.reshape(-1, noise.shape[-1])]).T


def _batch(event: Event, key, centres: Point, flat, blocks: int):
    """Estimate of a batch, the weights of its failures, whether there was NaN, and up to 8 failures."""
    generator = np.random.default_rng(np.asarray(key).tolist())
    total, weights, nan, kept = 0.0, [], False, []
    for block in range(blocks):
        own = generator.integers(len(flat), size=BLOCK)
        at = Point(*(np.moveaxis(a[own], 0, -1).astype(event.dtype) for a in centres))
        _, point = proposed(event, at, at, np.zeros(BLOCK, event.dtype), 0.0, key, block, 1.0, 1.0)
        values, odd = valued(event, point)
        lost, x = np.asarray(values) > event.above, _flat(point, event.ticks)
        log_ratio = x @ flat.T - np.sum(flat**2, axis=1) / 2
        most = log_ratio.max(axis=1)
        weight = np.exp(-most) / np.exp(log_ratio - most[:, None]).mean(axis=1)
        total, nan = total + weight[lost].sum(), nan or bool(odd)
        weights.extend(weight[lost])
        u, noise = (np.moveaxis(np.asarray(a), -1, 0) for a in point)
        kept += [
            (weight[i], u[i], noise[i, : event.ticks], np.asarray(values)[i], log_ratio[i].argmax())
            for i in np.flatnonzero(lost)
        ]
        kept = sorted(kept, key=lambda one: -one[0])[:BATCHES]
    share = np.array([one[0] for one in kept]) / max(sum(one[0] for one in kept), 1e-300)
    if kept:
        u, noise, value, root = (np.stack(a) for a in list(zip(*kept))[1:])
    else:
        u, noise = (
            np.zeros((0, event.normals), event.dtype),
            np.zeros((0, event.ticks, event.system.normals), event.dtype),
        )
        value, root = np.zeros(0, event.dtype), np.zeros(0, int)
    return total / (blocks * BLOCK), np.array(weights), nan, (u, noise, value, root, share)
