"""Studies: what one does with a closed loop, in memory: sweep many scenarios, rerun one.

May import: check, engine.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable
from functools import lru_cache
from math import prod

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from jaxatt import check
from jaxatt.engine import (
    BLOCK,
    System,
    admit,
    block_log,
    block_scores,
    compiled,
    fit_alone,
    one_key,
    traced,
    tree_bytes,
)


def sweep(system: System, params, scenarios, key, *, ticks: int, score: Callable, progress: bool | None = None):
    """Score many scenarios: the tree of ``score``, with values of shape (..., n).

    scenarios: every leaf carries the n scenarios in its last axis; params none. Scenario i meets the noise
    ``noise_of(system, key, i, ticks)``; its result does not depend on n, bit for bit, nor on the number of
    devices. Blocks run one after the other on every local device, so memory does not grow with ticks and only
    with the scores in n. progress: show a bar; None shows it on terminals and in notebooks, after two seconds.

    Under jit, grad or vmap the same numbers come from one traced loop over the blocks.

    Raises ValueError for leaves without scenarios, by name, and for what the system's check refuses; TypeError
    for what is no number or no key.
    """
    ticks, n = check.whole("ticks", ticks), check.lanes(scenarios)
    check.function("score", score)
    params, scenarios = _admitted(system, params, scenarios, n)
    key = one_key(key)
    blocks = -(-n // BLOCK)
    if traced(params, scenarios, key):
        return _traced(system, score, ticks, params, scenarios, key, n, blocks)
    with _bar(progress, n, " scenarios") as bar:
        return scored(system, params, scenarios, key, ticks, score, advance=bar.update)


def _admitted(system, params, scenarios, n):
    """`admit` for n scenarios of which each must fit the params alone: params with lanes are `varied`'s."""
    params, scenarios = admit(system, params, scenarios, (n,))
    if any(np.shape(leaf)[-1:] == (n,) for leaf in jax.tree.leaves(params)):
        fit_alone(system, params, scenarios, (n,))
    return params, scenarios


def scored(system, params, scenarios, key, ticks, score, first: int = 0, advance: Callable = lambda n: None):
    """What `sweep` gives, of admitted input: the blocks first, first + 1, ... on every local device, one host loop.

    advance(n) is called when n more scenarios are done.
    """
    n = check.lanes(scenarios)
    blocks = -(-n // BLOCK)
    rows, layout = _packed(scenarios)
    run = compiled(_packed_scores, 4)
    devices = jax.local_devices()
    at = [jax.device_put((params, key), device) for device in devices]
    under_way: deque = deque()
    done: list = []
    for block in range(blocks + 2 * len(devices)):
        if block < blocks:
            params, key = at[block % len(devices)]  # they decide where it runs
            number = np.int32(first + block)
            under_way.append(run(system, score, ticks, layout, params, key, _lanes_of(rows, block), number))
        if under_way and block >= 2 * len(devices) - 1:
            done.append(jax.tree.map(np.asarray, under_way.popleft()))
            advance(min(BLOCK, n - (len(done) - 1) * BLOCK))
    return jax.tree.map(lambda *parts: np.concatenate(parts, axis=-1)[..., :n], *done)


def score_shapes(system, params, scenarios, key, ticks, score):
    """Shapes and types of a block's scores, of admitted input, from the trace that `scored` runs next."""
    rows, layout = _packed(scenarios)
    operands = params, key, _lanes_of(rows, 0), np.int32(0)
    return compiled(_packed_scores, 4).eval_shape(system, score, ticks, layout, *operands)


def _bar(progress: bool | None, total: int, unit: str, done: int = 0):
    """A progress bar of total units, some done before; progress None: on a terminal or in a notebook, after 2 s."""
    seen = sys.stderr.isatty() or "ipykernel" in sys.modules
    hidden = progress is False or (progress is None and not seen)
    return tqdm(total=total, unit=unit, initial=done, disable=hidden, delay=0 if progress else 2, leave=False)


def _packed_scores(system, score, ticks, layout, params, key, rows, block):
    return block_scores(system, score, ticks, params, _unpacked(rows, layout), key, block)


def _packed(scenarios):
    """The leaves of a sweep as one array of shape (rows, n) for each dtype, and how to get them back.

    A block then costs one transfer instead of a hundred small ones, which took as long as the loop itself.
    """
    leaves, structure = jax.tree.flatten(scenarios)
    kinds = sorted({str(leaf.dtype) for leaf in leaves})
    flat = [np.asarray(leaf).reshape(-1, leaf.shape[-1]) for leaf in leaves]
    rows = [np.concatenate([a for a in flat if str(a.dtype) == kind]) for kind in kinds]
    return rows, (structure, tuple((kinds.index(str(a.dtype)), a.shape[:-1]) for a in leaves))


def _unpacked(rows, layout):
    structure, shapes = layout
    at = [0] * len(rows)
    leaves = []
    for kind, shape in shapes:
        size = prod(shape)
        leaves.append(rows[kind][at[kind] : at[kind] + size].reshape(*shape, -1))
        at[kind] += size
    return jax.tree.unflatten(structure, leaves)


def _lanes_of(scenarios, block: int):
    """The scenarios of one block, the last one repeated where the block is not full."""

    def take(leaf):
        here = leaf[..., block * BLOCK : (block + 1) * BLOCK]
        return np.concatenate([here] + [here[..., -1:]] * (BLOCK - here.shape[-1]), axis=-1)

    return jax.tree.map(take, scenarios)


def _traced(system, score, ticks, params, scenarios, key, n, blocks):
    def split(leaf):
        leaf = jnp.concatenate([leaf, jnp.repeat(leaf[..., -1:], blocks * BLOCK - n, axis=-1)], axis=-1)
        return jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], blocks, BLOCK), -2, 0)

    def one(block_and_scenarios):
        block, scenarios = block_and_scenarios
        return block_scores(system, score, ticks, params, scenarios, key, block)

    out = jax.lax.map(one, (jnp.arange(blocks), jax.tree.map(split, scenarios)))
    return jax.tree.map(lambda a: jnp.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1)[..., :n], out)


def rerun(system: System, params, scenarios, key, index: int, *, ticks: int):
    """The log, time first, of scenario ``index`` of a sweep with the same arguments: the same run, bit for bit.

    Raises what `sweep` raises, and ValueError for an index that is not one of the scenarios.
    """
    ticks, n = check.whole("ticks", ticks), check.lanes(scenarios)
    index = check.whole("index", index, 0)
    if index >= n:
        check.refuse("index", f"be less than the {n} scenarios", index)
    params, scenarios = _admitted(system, params, scenarios, n)
    here = _lanes_of(jax.tree.map(np.asarray, scenarios), index // BLOCK)
    return logged(system, params, here, one_key(key), index, ticks)


def logged(system, params, here, key, index: int, ticks: int):
    """What `rerun` gives, of admitted input: here are the `BLOCK` scenarios of the block that holds ``index``."""
    block, lane = divmod(index, BLOCK)
    operands = params, here, key, np.int32(block), np.int32(lane)
    run = compiled(block_log, 2)
    check.fits_memory(f"`ticks` = {ticks}", tree_bytes(run.eval_shape(system, ticks, *operands)), "ask for fewer")
    return run(system, ticks, *operands)


@lru_cache
def varied(system: System) -> System:
    """The same loop with its params as part of the scenario: a design study as a sweep.

    Its params are ``()`` and its scenarios pairs (params, scenario), so every number of both may differ from
    scenario to scenario.
    """

    def unpacked(f):
        return lambda _, pair, *rest: f(*pair, *rest)

    return system._replace(**{name: unpacked(getattr(system, name)) for name in ("init", "tick", "flow", "check")})


def batch(tree, n: int):
    """One scenario, a tree, n times: every leaf, of shape (...), gets the n scenarios as its last axis, (..., n)."""
    n = check.whole("n", n)

    def repeated(leaf):
        if not check.is_number(leaf):
            raise TypeError(f"`tree` must hold numbers, but it holds {check.short(leaf)}.")
        return np.broadcast_to(np.asarray(leaf)[..., None], (*np.shape(leaf), n))

    return jax.tree.map(repeated, tree)
