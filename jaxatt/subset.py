"""Subset simulation: chains in standard normal space that climb from level to level of a score.

Where points are large, none between two moves is stored: a level keeps where its chains start, their scores and how they
moved, and draws again the few points that go on (`normal_space`).

May import: normal_space.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxatt.normal_space import Event, Point, picked, proposed, untraced, valued

SHARE = (
    0.44  # of moves accepted that the pilot aims at: near the best for one coordinate and for many (Papaioannou, 2015)
)
MOST = 40  # levels of a pilot
KEPT = 8  # failures of a population


# one level


class Level(NamedTuple):
    """The moves of a population at one level: enough to draw any of its points again."""

    number: int  # of the level, from 0
    level: float  # that every state exceeds
    start: Point
    before: Any  # (chains,) scores at the start
    ahead: Any  # (moves, chains) scores of the proposals
    states: Any  # (moves, chains) scores of the states
    angles: Any  # (moves,) [rad] of the moves: rho is the cosine
    roots: Any  # (moves, chains) the states of level 0 that they descend from
    nan: bool  # whether a score was NaN
    points: list  # of every move, with its proposals, where they are few enough to be stored; else empty

    @property
    def acceptance(self) -> float:
        """Share of the moves accepted."""
        return float(np.mean(self.ahead > self.level))


def first_level(event: Event, key) -> Level:
    """Independent runs."""
    lowest = np.zeros(event.chains, event.dtype)
    roots = np.arange(event.n).reshape(event.moves, event.chains)
    return _moved(event, key, 0, -np.inf, event.origin(), lowest, np.pi / 2, roots, False)


def next_level(event: Event, key, last: Level, level: float, angle: float, adapt: bool = False) -> Level:
    """The level after ``last``, from seeds among its states above ``level``; adapt: the angle, to the acceptance."""
    survivors = np.flatnonzero(last.states.ravel() > level)
    seeds = survivors[systematic(_generator(key, last.number), len(survivors), event.chains)]
    start, before = drawn_again(event, key, last, seeds), last.states.ravel()[seeds]
    roots = np.broadcast_to(last.roots.ravel()[seeds], (event.moves, event.chains))
    return _moved(event, key, last.number + 1, level, start, before, angle, roots, adapt)


def _moved(event: Event, key, number, level, start, before, angle, roots, adapt) -> Level:
    at, ahead, values, found, angles, nan, points = start, start, before, [], [], [], []
    for move in range(event.moves):
        angles.append(angle)
        at, ahead = proposed(event, at, ahead, values, level, key, number * event.moves + move, *_turn(angle))
        points += [(at, ahead)] if event.stored else []
        values, odd = valued(event, ahead)
        found.append(values)
        nan.append(odd)
        if adapt:
            share = np.mean(np.asarray(values) > level)
            angle = float(np.clip(angle * np.exp((share - SHARE) / np.sqrt(move + 1)), 0.01, np.pi / 2))
    proposals, states = np.stack([np.asarray(a) for a in found]), []
    for row in proposals:
        before_it = states[-1] if states else before
        states.append(np.where(row > level, row, before_it))
    return Level(
        number, level, start, before, proposals, np.stack(states), np.array(angles), roots, any(map(bool, nan)), points
    )


def _turn(angle: float) -> tuple[float, float]:
    return (0.0, 1.0) if angle == np.pi / 2 else (np.cos(angle), np.sin(angle))


def _generator(key, number: int):
    return np.random.default_rng([*np.asarray(key).tolist(), number])


def systematic(generator, m: int, k: int):
    """k of m survivors by systematic resampling: each has k/m offspring in the mean, and within one of it; shuffled."""
    at = ((generator.random() + np.arange(k)) * m / k).astype(int)
    return generator.permutation(m)[np.minimum(at, m - 1)]


def drawn_again(event: Event, key, level: Level, states) -> Point:
    """The points of states of a level, at most as many as chains, numbered along chains, then moves."""
    index = np.zeros(event.chains, int)
    index[: len(states)] = states
    real = event.dtype.type
    kept, at, ahead, values = event.origin(), level.start, level.start, level.before
    for move in range(event.moves):
        number = level.number * event.moves + move
        if level.points:
            at, ahead = level.points[move]
        else:
            at, ahead = proposed(event, at, ahead, values, level.level, key, number, *_turn(level.angles[move]))
        values, here = level.ahead[move], index // event.chains == move
        if here.any():
            kept = untraced(picked, 0)(at, ahead, values, real(level.level), index % event.chains, here, kept)
    return kept


# populations


class Pilot(NamedTuple):
    """What an adaptive population found: the levels and angles that the others keep to."""

    levels: Any  # (levels,) [unit of the score] ascending, all below ``above``
    angles: Any  # (levels,) [rad] rho is the cosine
    grid: Any  # (points,) [unit of the score] where the others take the exceedance curve
    distinct: int  # different values of the score among the independent runs
    reached: bool  # whether ``above`` was
    nan: bool
    runs: int


class Population(NamedTuple):
    """One estimate at fixed levels."""

    p: float  # [1] probability: the product of the shares
    shares: Any  # (levels + 1,) [1] above the next level; NaN once all are lost
    acceptance: Any  # (levels,) [1] of moves
    cv: float  # [1] coefficient of variation by Au and Beck (2001); NaN where all are lost
    curve: Any  # (points,) [1] probability of exceeding the grid
    roots: int  # independent runs that the failures descend from
    nan: bool
    u: Any  # (kept, normals) of the failures kept
    noise: Any  # (kept, ticks, system.normals)
    score: Any  # (kept,)
    root: Any  # (kept,) the independent run that each descends from
    weight: Any  # (kept,) [1] share of all failures that each stands for


def piloted(event: Event, key, tell: Callable) -> Pilot:
    """The adaptive population; tell(level, p, acceptance) after every level."""
    last = first_level(event, key)
    angle, p, levels, angles, grid = float(np.arccos(0.8)), 1.0, [], [], []
    distinct = len(np.unique(last.states[np.isfinite(last.states)]))
    nan = last.nan
    while True:
        tell(len(levels), p, last.acceptance)
        values = last.states.ravel()
        reached = bool(np.sum(values > event.above) >= event.chains)
        level = None if reached else _level_above(event, values, levels[-1] if levels else -np.inf)
        share = np.mean(values > (event.above if level is None else level))
        highest = np.sort(values)[::-1]
        shares = np.geomspace(0.9 if not levels else 0.99, max(share, 1.5 / len(values)), 12)[:-1]
        grid.extend(highest[np.minimum((shares * len(values)).astype(int), len(values) - 1)])
        if level is None or len(levels) == MOST:
            break
        grid.append(level)
        p *= share
        last = next_level(event, key, last, level, angle, adapt=True)
        angle, nan = float(last.angles[-1]), nan or last.nan
        levels.append(level)
        angles.append(angle)
    grid = np.unique([b for b in grid if np.isfinite(b) and b < event.above])
    runs = (len(levels) + 1) * event.n
    return Pilot(np.array(levels), np.array(angles), np.append(grid, event.above), distinct, reached, nan, runs)


def _level_above(event: Event, values, last: float) -> float | None:
    """The value with as many states above it as there are chains, or where values tie nearly so; None if there is none."""
    at, count = np.unique(values, return_counts=True)
    above = len(values) - np.cumsum(count)
    use = (above > 0) & (at > last) & (at < event.above)
    if not use.any():
        return None
    return float(at[use][np.argmin(np.abs(np.log(above[use] / event.chains)))])


def populated(event: Event, key, pilot: Pilot, tell: Callable) -> Population:
    """An independent population at the pilot's levels and angles: p is unbiased, however well its chains mix."""
    p, shares, acceptance, spread, nan = 1.0, [], [], 0.0, False
    curve, last = np.zeros(len(pilot.grid)), first_level(event, key)
    bounds = [-np.inf, *pilot.levels, np.inf]
    for number, level in enumerate([*pilot.levels, event.above]):
        nan = nan or last.nan
        if number:
            acceptance.append(last.acceptance)
        here = (pilot.grid >= bounds[number]) & (pilot.grid < bounds[number + 1])
        values = np.sort(last.states.ravel())
        curve[here] = p * (1 - np.searchsorted(values, pilot.grid[here], side="right") / event.n)
        share = float(np.mean(last.states > level))
        spread += au_beck(last.states > level, number)
        shares.append(share)
        p *= share
        tell(number, p, last.acceptance)
        if share == 0 or number == len(pilot.levels):
            break
        last = next_level(event, key, last, level, pilot.angles[number])
    missing = len(pilot.levels) - len(acceptance)
    acceptance = np.array([*acceptance, *[np.nan] * missing])
    shares = np.array([*shares, *[np.nan] * (len(pilot.levels) + 1 - len(shares))])
    failed = np.flatnonzero(last.states.ravel() > event.above) if p else np.array([], int)
    roots, counts = np.unique(last.roots.ravel()[failed], return_counts=True)
    keep, weight = _spread(_generator(key, MOST + 1), last.roots.ravel()[failed], roots, counts)
    keep = failed[keep]
    point = jax.tree.map(np.asarray, drawn_again(event, key, last, keep)) if len(keep) else event.origin()
    u, noise = (np.ascontiguousarray(np.moveaxis(a, -1, 0)[: len(keep)]) for a in point)
    return Population(
        p, shares, acceptance, float(np.sqrt(spread)) if p else np.nan, curve, len(roots), nan, u,
        noise[:, : event.ticks], last.states.ravel()[keep], last.roots.ravel()[keep], weight,
    )  # fmt: skip


def au_beck(above, level: int) -> float:
    """Squared coefficient of variation of a level's share, from the indicators ``above`` (moves, chains) of its states.

    Au and Beck (2001), eq. (28) and (29): correlation along the chains counts, that between levels and seeds does not.
    """
    moves, share = len(above), above.mean()
    if share in (0, 1):
        return 0.0
    lags = range(1, moves if level else 1)
    rho = [(np.mean(above[:-k] & above[k:]) - share**2) / (share * (1 - share)) for k in lags]
    gamma = 2 * sum((1 - k / moves) * r for k, r in zip(lags, rho))
    return (1 - share) / (share * above.size) * max(1 + gamma, 0)


def _spread(generator, owner, roots, counts):
    """Up to `KEPT` of the failures, spread over their roots, and the share of all that each stands for."""
    order = generator.permutation(len(roots))
    waiting = {root: list(generator.permutation(np.flatnonzero(owner == root))) for root in roots[order][:KEPT]}
    keep: list[int] = []
    while len(keep) < min(KEPT, len(owner)) and any(waiting.values()):
        for root in waiting:
            if waiting[root] and len(keep) < KEPT:
                keep.append(waiting[root].pop())
    kept = np.array(keep, int)
    size = dict(zip(roots.tolist(), counts.tolist()))
    each = np.array([size[root] / np.sum(owner[kept] == root) for root in owner[kept]])
    return kept, each / each.sum() if len(kept) else each
