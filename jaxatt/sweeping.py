"""Many runs of a closed loop in memory: sweep scenarios, rerun one of them, vary params too.

Scenarios lead at the public face: every leaf has shape (n, ...). Inside they run in blocks of `BLOCK` lanes.

May import: check, fields, contract, compiling, noise, engine, scores.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, overload

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxatt import check, scores
from jaxatt.compiling import compiled, in_threads, shared, traced
from jaxatt.contract import Score, System
from jaxatt.engine import over_lanes, run, start, step, times, tree_bytes, validated
from jaxatt.noise import BLOCK, CHUNK, block_key, chunk_noise, one_key


def sweep(system: System, params, scenarios, key, *, ticks: int, score: Callable, progress: bool | None = None):
    """Score many scenarios of a closed loop.

    Scenario i meets the noise ``noise_of(system, key, i, ticks)``; its result does not depend on n, bit for bit, nor on
    the number of devices. Blocks of 128 run one after the other on every local device, so memory does not grow with
    ticks, and with n only by the scores. Another n, params, key or ticks compiles nothing. Under jit, grad or vmap the
    same numbers come from one traced loop over the blocks, to rounding.

    Args:
        system: the loop.
        params: what the engineer ships, the same for all scenarios (`varied` for others).
        scenarios: what n days bring: the tree of a scenario, every leaf of shape (n, ...), as
            ``jax.vmap(draw)(jax.random.split(key, n))`` makes it.
        key: fixes the noise.
        ticks: how many ticks each runs.
        score: (params, scenario, now, log) -> tree of `jaxatt.scores` tallies, for one scenario and one tick.
        progress: show a bar; None shows it on terminals and in notebooks, after two seconds.

    Returns:
        The tree of ``score``, every value of shape (n, ...), as NumPy arrays.

    Raises:
        ValueError: leaves that do not lead with the same n, numbers outside their domain.
        TypeError: what is no number or no key, a score that holds something else than tallies, a function of the loop
            that returns the wrong structure or shape.

    Example:
        >>> draw = lambda key: loop.scenario._replace(std_w=1e-3 * jax.random.uniform(key))
        >>> scenarios = jax.vmap(draw)(jax.random.split(jax.random.key(0), 1000))
        >>> found = jaxatt.sweep(loop.system, loop.params, scenarios, jax.random.key(1), ticks=600, score=loop.score)
    """
    check.kind("system", system, System)
    ticks, n = check.whole("ticks", ticks), check.batch_size("scenarios", scenarios)
    check.function("score", score)
    params, scenarios = validated(system, params, scenarios, n, ticks)
    key = one_key(key)
    if traced(params, scenarios, key):
        return _traced(system, score, ticks, params, scenarios, key, n)
    with progress_bar(progress, n, " scenarios") as bar:
        return scored(system, params, scenarios, key, ticks, score, advance=bar.update)


def rerun(system: System, params, scenarios, key, index: int, *, ticks: int):
    """The log of one scenario of a sweep, bit for bit what was scored.

    Args:
        system, params, scenarios, key, ticks: as handed to `sweep`.
        index: number of the scenario, from 0.

    Returns:
        The log, time first, as of `simulate`.

    Raises:
        ValueError, TypeError: as `sweep`; ValueError for an index that is none of the scenarios.

    Example:
        >>> worst = int(np.argmax(found.peak_q))
        >>> log = jaxatt.rerun(loop.system, loop.params, scenarios, jax.random.key(1), worst, ticks=600)
    """
    check.kind("system", system, System)
    ticks, n = check.whole("ticks", ticks), check.batch_size("scenarios", scenarios)
    index = check.whole("index", index, 0)
    if index >= n:
        check.refuse("index", f"be less than the {n} scenarios", index)
    params, scenarios = validated(system, params, scenarios, n, ticks)
    here = block_of(jax.tree.map(np.asarray, scenarios), index // BLOCK)
    return logged(system, params, here, one_key(key), index, ticks)


@overload
def varied(loop: System) -> System: ...
@overload
def varied(loop: Score) -> Score: ...
def varied(loop: System | Score) -> System | Score:
    """A loop, or a score, with its params as part of the scenario: a design study as a sweep.

    Args:
        loop: a `System`, or a score function.

    Returns:
        The same with ``()`` for params and pairs (params, scenario) for scenarios, so that every number of both may
        differ from scenario to scenario. Equal arguments give the same object, which compiles once.

    Example:
        >>> gains = jnp.linspace(200.0, 400.0, 1000)
        >>> pair = lambda gain: (loop.params._replace(k_q=gain), loop.scenario)
        >>> found = jaxatt.sweep(
        ...     varied(loop.system), (), jax.vmap(pair)(gains), key, ticks=600, score=varied(loop.score)
        ... )
    """
    if not isinstance(loop, System):
        check.function("loop", loop)
    return _varied(loop)


@lru_cache
def _varied(loop: Any) -> Any:
    if not isinstance(loop, System):
        return partial(_of_pair, loop)
    names = ("init", "tick", "flow", "check")
    return loop._replace(**{name: partial(_of_pair, getattr(loop, name)) for name in names})


def _of_pair(f, params, pair, *rest):
    if jax.tree.leaves(params):
        check.refuse(
            "params", "be () for a varied loop, whose scenarios are pairs (params, scenario)", check.short(params)
        )
    return f(*pair, *rest)


# blocks


def block_scores(system: System, score: Callable, ticks, params, scenarios, key, block):
    """Scores of one block of `BLOCK` scenarios, lanes last: a tree of values of shape (..., BLOCK). Pure.

    ticks: a Python integer, or a traced one where nothing is differentiated; key: raw key of the sweep; block: number
    of the block, which with the key fixes its noise.
    """
    dtype = check.float_type((params, scenarios))
    noise = partial(_block_noise, system, block_key(key, block), dtype)
    return scores_of(system, score, BLOCK, ticks, params, scenarios, noise)


def scores_of(system: System, score: Callable, n: int, ticks, params, scenarios, noise: Callable):
    """Scores of n scenarios side by side under the noise given, lanes last. Pure.

    ticks: as of `block_scores`; noise(c): that of chunk c, shape (CHUNK, normals, n).
    """

    def tallied(now, log):
        one = lambda scenario, log: jax.tree.map(jnp.asarray, score(params, scenario, now, log))
        return over_lanes(one, n)(scenarios, log)

    @partial(jax.jit, inline=True)  # traced once for its shapes and its values
    def ahead(state, at, noise):
        now, state, log = step(system, params, scenarios, n, at, state, noise, one_way=not isinstance(ticks, int))
        return state, tallied(now, log)

    state = start(system, params, scenarios, n)
    instants = lambda c: times(system, params, scenarios, c * CHUNK + jnp.arange(CHUNK, dtype=np.int32))
    taken = lambda tree, i: jax.tree.map(lambda a: a[i], tree)
    shapes = jax.eval_shape(ahead, state, *taken((instants(0), noise(0)), 0))[1]
    nothing = jax.tree.map(scores.empty, shapes, is_leaf=scores.is_tally)
    add = over_lanes(scores.add, n)

    if isinstance(ticks, int):
        fold = lambda tally, now, log: (add(tally, tallied(now, log)), None)
        tally, _ = run(system, params, scenarios, n, ticks, CHUNK, noise, fold, nothing)
    else:

        def chunk(c, carry):
            here = instants(c), noise(c)

            def one(i, carry):
                state, more = ahead(carry[0], *taken(here, i))
                return state, add(carry[1], more)

            return jax.lax.fori_loop(0, jnp.minimum(CHUNK, ticks - c * CHUNK), one, carry)

        _, tally = jax.lax.fori_loop(0, -(-ticks // CHUNK), chunk, (state, nothing))
    return over_lanes(scores.values, n)(tally)


def _block_noise(system, key, dtype, c):
    return chunk_noise(system, key, c * CHUNK, CHUNK, (BLOCK,), dtype)


def block_log(system: System, ticks: int, params, scenarios, key, block, lane):
    """The log, time first, of one lane of a block: the same computation as `block_scores`."""
    noise = partial(_block_noise, system, block_key(key, block), check.float_type((params, scenarios)))

    def fold(none, now, log):
        # behind a boundary, lest the compiler works the log out for this lane alone, with other roundings
        return none, shared(lambda log: jax.tree.map(lambda a: a[..., lane], log), log)

    _, logs = run(system, params, scenarios, BLOCK, ticks, CHUNK, noise, fold, None, one_way=True)
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:ticks], logs)


def block_records(system: System, record: Callable, ticks: int, every: int, params, scenarios, key, block):
    """record(log) of the ticks 0, every, 2 every, ... of a block: a tree of shape (records, ..., BLOCK)."""
    noise = partial(_block_noise, system, block_key(key, block), check.float_type((params, scenarios)))

    def fold(none, now, log):
        return none, over_lanes(lambda log: jax.tree.map(jnp.asarray, record(log)), BLOCK)(log)

    _, logs = run(system, params, scenarios, BLOCK, ticks, CHUNK, noise, fold, None, one_way=True)
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:ticks:every], logs)


# all blocks


def scored(system, params, scenarios, key, ticks, score, first: int = 0, advance: Callable = lambda n: None, jobs=None):
    """What `sweep` gives, of validated input: the blocks first, first + 1, ... in one host loop.

    advance(n) is called when n more scenarios are done; jobs: how many blocks at once, as of `by_block`.
    """

    def call(params, here, key, block):
        return compiled(block_scores, 2)(system, score, np.int32(ticks), params, here, key, block)

    found = by_block(call, params, scenarios, key, first, advance, jobs)
    return jax.tree.map(lambda a: np.moveaxis(a, -1, 0), found)


def recorded(system, record, ticks: int, every: int, params, scenarios, key, first: int = 0, jobs=None):
    """`block_records` of the blocks first, first + 1, ..., as NumPy arrays of shape (records, ..., n)."""

    def call(params, here, key, block):
        return compiled(block_records, 4)(system, record, ticks, every, params, here, key, block)

    return by_block(call, params, scenarios, key, first, jobs=jobs)


def by_block(call: Callable, params, scenarios, key, first: int, advance: Callable = lambda n: None, jobs=None):
    """call(params, here, key, block) of all blocks, joined along the lanes, which come last, as NumPy arrays.

    Several blocks run at once: on every local device, and on every core of a single CPU device, each in a thread, for
    a device takes up one program at a time from each thread. jobs: how many; None for `programs_at_once`.
    """
    scenarios = jax.tree.map(np.asarray, scenarios)
    n = len(jax.tree.leaves(scenarios)[0])
    devices = jax.local_devices()
    at = [jax.device_put((params, key), device) for device in devices]  # they decide where a block runs

    def start(block: int):
        params, key = at[block % len(devices)]
        with jax.debug_nans(False), jax.debug_infs(False):  # a NaN is the answer where a window was empty
            return call(params, block_of(scenarios, block), key, np.int32(first + block))

    done = [start(0)]  # in this thread, lest two compile it
    for out in in_threads(lambda block: jax.tree.map(np.asarray, start(block)), range(1, -(-n // BLOCK)), jobs):
        advance(BLOCK)
        done.append(out)
    done[0] = jax.tree.map(np.asarray, done[0])
    advance(n - BLOCK * (len(done) - 1))
    return jax.tree.map(lambda *parts: np.concatenate(parts, axis=-1)[..., :n], *done)


def score_shapes(system, params, scenarios, key, ticks, score):
    """Shapes and types of a block's scores, lanes last, of validated input, from the trace that `scored` runs next."""
    operands = np.int32(ticks), params, block_of(scenarios, 0), key, np.int32(0)
    return compiled(block_scores, 2).eval_shape(system, score, *operands)


def block_of(scenarios, block: int):
    """The scenarios of one block of a batch, lanes last; the last one is repeated where the block is not full."""

    def take(leaf):
        here = leaf[block * BLOCK : (block + 1) * BLOCK]
        if len(here) < BLOCK:
            here = np.concatenate([here, np.repeat(here[-1:], BLOCK - len(here), axis=0)])
        return here if here.ndim == 1 else np.moveaxis(here, 0, -1)  # to turn one takes longer than to copy it

    return jax.tree.map(take, scenarios)


def progress_bar(progress: bool | None, total: int, unit: str, done: int = 0):
    """A progress bar of total units, some done before; progress None: on a terminal or in a notebook, after 2 s."""
    seen = sys.stderr.isatty() or "ipykernel" in sys.modules
    hidden = progress is False or (progress is None and not seen)
    return tqdm(total=total, unit=unit, initial=done, disable=hidden, delay=0 if progress else 2, leave=False)


def logged(system, params, here, key, index: int, ticks: int):
    """What `rerun` gives, of validated input: here is the block, lanes last, that holds scenario ``index``."""
    block, lane = divmod(index, BLOCK)
    operands = params, here, key, np.int32(block), np.int32(lane)
    call = compiled(block_log, 2)
    check.fits_memory(f"`ticks` = {ticks}", tree_bytes(call.eval_shape(system, ticks, *operands)), "ask for fewer")
    return call(system, ticks, *operands)


def _traced(system, score, ticks, params, scenarios, key, n):
    blocks = -(-n // BLOCK)

    def split(leaf):
        leaf = jnp.concatenate([leaf, jnp.repeat(leaf[-1:], blocks * BLOCK - n, axis=0)])
        return jnp.moveaxis(leaf.reshape(blocks, BLOCK, *leaf.shape[1:]), 1, -1)

    def one(block_and_scenarios):
        block, scenarios = block_and_scenarios
        return block_scores(system, score, ticks, params, scenarios, key, block)

    out = jax.lax.map(one, (jnp.arange(blocks), jax.tree.map(split, scenarios)))
    out = jax.tree.map(lambda a: jnp.moveaxis(a, -1, 1).reshape(-1, *a.shape[1:-1])[:n], out)
    name = lambda path: jax.tree_util.keystr(path, simple=True, separator=".")
    scores.tell("score", {name(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(out)})
    return out
