"""A closed loop as a function of standard normal numbers: what its runs draw, how they move and what they score.

A point is what a run draws: the numbers u of its scenario and its noise, all independent and standard normal. Points lie
side by side in the last axis, the chains. Two compiled programs do all of the work: `propose` moves the points, `value`
scores them, and both take every number as an argument. So a point need not be stored: `propose` draws it again, and
`value` scores it again, to the same bits.

May import: check, compiling, contract, engine, loss, noise, sweeping.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.compiling import compiled, traced
from jaxatt.contract import System
from jaxatt.engine import over_lanes, prepared, validated
from jaxatt.loss import Failures
from jaxatt.noise import CHUNK, block_key, chunk_noise, one_key
from jaxatt.sweeping import scores_of

STORED = 2**27  # bytes of a level's points, beyond which they are drawn again
STEP = (
    "hand over what it is a threshold of, such as scores.peak(log.xi) with the threshold for `above`; "
    "a yes or no is counted by `sweep` and `evaluation.interval`"
)  # what to use in place of a step


class Point(NamedTuple):
    """What runs draw, standard normal; the chains last."""

    u: Any  # (normals, chains) [1] numbers of the scenario
    noise: Any  # (ticks, system.normals, chains) [1] ticks filled up to whole chunks


class Event(NamedTuple):
    """The event score > above of one loop, and the size of a population."""

    system: System
    score: Callable
    draw: Callable | None  # u (normals,) -> scenario; None where there is one scenario
    params: Any
    scenario: Any  # () where it is drawn
    ticks: int
    normals: int  # numbers of a scenario
    above: float
    chains: int
    moves: int
    dtype: Any  # floating type of the run

    @property
    def n(self) -> int:
        """Runs of a population."""
        return self.chains * self.moves

    @property
    def shapes(self) -> Point:
        """Shapes of a point."""
        filled = -(-self.ticks // CHUNK) * CHUNK
        return Point((self.normals, self.chains), (filled, self.system.normals, self.chains))

    @property
    def words(self) -> str:
        """The event in words."""
        name = getattr(self.score, "__name__", "score").replace("_", " ").strip()
        name = "score" if "lambda" in name else name
        return f"{name} > {self.above:g} in {self.ticks * self.system.dt:g} s"

    def origin(self) -> Point:
        """Points at zero."""
        return Point(*(np.zeros(shape, self.dtype) for shape in self.shapes))

    @property
    def size(self) -> int:
        """Bytes that the points of all chains take."""
        return np.dtype(self.dtype).itemsize * sum(int(np.prod(shape)) for shape in self.shapes)

    @property
    def stored(self) -> bool:
        """Whether the points of all moves of a level are stored: no result depends on it."""
        return 2 * self.moves * self.size <= STORED

    @property
    def bytes(self) -> int:
        """What one population takes at most: start of a level, two points of a move, two ahead, those that go on, scores."""
        return self.size * (6 + 2 * self.moves * self.stored) + 64 * self.n


# the two programs


def propose(system: System, at: Point, ahead: Point, values, level, key, number, cos, sin):
    """Take the points ahead whose value exceeds the level, and propose cos x + sin xi from each.

    With cos^2 + sin^2 = 1 the proposal keeps the normal law (pCN: Cotter et al., 2013): accepted where the score exceeds
    the level, it keeps that law restricted to these scores. number: fixes xi. Returns the points and the proposals.
    """
    key = block_key(key, number)

    def one(system, part, c, a, b):
        a = jnp.where(values > level, b, a)
        xi = chunk_noise(system, block_key(key, part), c * len(a), len(a), values.shape, values.dtype)
        return a, cos * a + sin * xi

    numbers = one(system._replace(normals=len(at.u)), 0, jnp.int32(0), at.u[None], ahead.u[None])
    chunked = lambda a: a.reshape(-1, CHUNK, *a.shape[1:])
    given = jnp.arange(len(at.noise) // CHUNK, dtype=np.int32), chunked(at.noise), chunked(ahead.noise)
    # in pieces that stay in the processor's cache
    _, noise = jax.lax.scan(lambda none, given: (none, one(system, 1, *given)), None, given)
    before, after = (Point(u[0], a.reshape(at.noise.shape)) for u, a in zip(numbers, noise))
    return before, after


def chosen(at: Point, ahead: Point, values, level) -> Point:
    """The points ahead where their value exceeds the level, those of before elsewhere."""
    return jax.tree.map(partial(jnp.where, values > level), ahead, at)


def picked(at: Point, ahead: Point, values, level, index, here, kept: Point) -> Point:
    """kept with the points ``index`` (chains,) of those `chosen` in the places where ``here`` holds."""
    return jax.tree.map(lambda a, b: jnp.where(here, a[..., index], b), chosen(at, ahead, values, level), kept)


def value(system: System, score: Callable, draw: Callable | None, params, scenario, ticks, point: Point):
    """The score of every chain, (chains,); inf for NaN, and the lowest number for -inf, which every level is above."""
    found = scores_at(system, score, draw, params, scenario, ticks, point)
    found = jax.tree.leaves(found)[0].astype(point.noise.dtype)
    return jnp.where(jnp.isnan(found), jnp.inf, jnp.maximum(found, jnp.finfo(found.dtype).min)), jnp.isnan(found).any()


def scores_at(system: System, score: Callable, draw: Callable | None, params, scenario, ticks, point: Point):
    """The score's tree of values at points, chains last; ticks: a Python integer where it is differentiated."""
    n = point.noise.shape[-1]
    if draw is None:
        scenarios = jax.tree.map(lambda a: jnp.broadcast_to(jnp.asarray(a)[..., None], (*jnp.shape(a), n)), scenario)
    else:
        scenarios = over_lanes(lambda u: jax.tree.map(jnp.asarray, prepared(system, params, draw(u))[1]), n)(point.u)
    noise = lambda c: jax.lax.dynamic_slice_in_dim(point.noise, c * CHUNK, CHUNK)
    return scores_of(system, score, n, ticks, params, scenarios, noise)


def programs(event: Event, key):
    """Both programs, lowered for an event: what makes its numbers."""
    at, number, real = event.origin(), np.int32(0), event.dtype.type
    values = np.zeros(event.chains, event.dtype)
    yield compiled(propose, 1).lower(event.system, at, at, values, real(0), key, number, real(0), real(0))
    yield compiled(value, 3).lower(*_of(event), at)


def proposed(event: Event, at: Point, ahead: Point, values, level, key, number: int, cos: float, sin: float):
    """`propose`, compiled."""
    real = event.dtype.type
    numbers = real(level), key, np.int32(number), real(cos), real(sin)
    return untraced(propose, 1)(event.system, at, ahead, values, *numbers)


def valued(event: Event, point: Point):
    """`value`, compiled: the scores, and whether there was NaN."""
    return untraced(value, 3)(*_of(event), point)


@cache
def untraced(f: Callable, static: int):
    """f compiled, for callers that are not traced: `compiled` looks at every call, which takes longer than a toy's move."""
    return compiled(f, static)


def _of(event: Event):
    return event.system, event.score, event.draw, event.params, event.scenario, np.int32(event.ticks)


def drawn(system: System, draw: Callable, params, u):
    """The scenarios of the numbers u (n, normals), the batch first."""
    return jax.vmap(lambda u: jax.tree.map(jnp.asarray, prepared(system, params, draw(u))[1]))(u)


def kept_failures(event: Event, by_repeat) -> Failures:
    """The failures of all repeats, one after the other; by_repeat: u, noise, score, root and weight of each."""
    u, noise, score, root, weight = (np.concatenate(parts) for parts in zip(*by_repeat))
    if event.draw is None:
        scenario = jax.tree.map(lambda a: np.broadcast_to(np.asarray(a), (len(u), *np.shape(a))), event.scenario)
    else:
        padded = np.pad(u, [(0, -len(u) % 64), (0, 0)])  # few shapes to compile for
        found = compiled(drawn, 2)(event.system, event.draw, event.params, padded)
        scenario = jax.tree.map(lambda a: np.asarray(a)[: len(u)], found)
    repeat = np.repeat(np.arange(len(by_repeat)), [len(part[2]) for part in by_repeat])
    return Failures(scenario, noise, u, score, repeat, root, weight)


# the door


def event_of(
    verb: str, system, params, scenario, key, ticks, score, above, normals, chains, moves
) -> tuple[Event, Any]:
    """The arguments of a verb as an `Event` and a raw key, checked; see `rare.probability` for what is refused."""
    if traced(params, scenario, key, above):
        raise TypeError(
            f"`{verb}` must be called outside jit, grad and vmap, for it counts runs and has no gradient: compare "
            f"results at the same key, or tune the score itself."
        )
    check.kind("system", system, System)
    ticks, normals = check.whole("ticks", ticks), check.whole("normals", normals, 0)
    check.function("score", score)
    above = check.number("above", above)
    check.finite("above", above)
    if check.whole("chains", chains, 8) % 8:
        check.refuse("chains", "be a multiple of 8", chains)
    moves, key = check.whole("moves", moves, 5), np.asarray(one_key(key))
    draw = scenario if callable(scenario) else None
    if draw is None:
        if normals:
            check.refuse("normals", "be 0 where `scenario` is no function of them", normals)
        params, scenario = validated(system, params, scenario)
        dtype = check.float_type((params, scenario))
    else:
        check.whole("normals", normals)
        u = np.random.default_rng(0).standard_normal((128, normals)).astype(check.float_type(params))
        some = compiled(drawn, 2)(system, draw, params, u)
        params, some = validated(system, params, some, 128)
        dtype, scenario = check.float_type((params, some)), ()
    event = Event(system, score, draw, params, scenario, ticks, normals, above, chains, moves, np.dtype(dtype))
    _one_number(event)
    return event._replace(above=float(event.dtype.type(above))), key


def _one_number(event: Event) -> None:
    """Refuse a score that is not one continuous number."""
    given = event.system, event.score, event.draw, event.params, event.scenario
    at = Point(*(jax.ShapeDtypeStruct(shape, event.dtype) for shape in event.shapes))
    found = jax.eval_shape(lambda ticks, at: scores_at(*given, ticks, at), np.int32(event.ticks), at)
    leaves = jax.tree.leaves(found)
    if len(leaves) != 1 or leaves[0].shape != (event.chains,):
        shapes = ", ".join(str(a.shape[:-1]) for a in leaves)
        check.refuse("score", "give one tally of one number", f"{len(leaves)} of shapes {shapes}")
    if not jnp.issubdtype(leaves[0].dtype, jnp.floating):
        raise TypeError(f"`score` must be continuous: {STEP}, but it is {leaves[0].dtype}.")
