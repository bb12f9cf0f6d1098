"""Sampling designs: which point of the unit cube, or which combination, scenario ``index`` gets.

All are pure functions of the index, so that a campaign can compute any block anywhere and never holds a table.
Points lie strictly inside (0, 1), ready for an inverse distribution function. Whether a design may be extended:
iid and Sobol points do not know how many there will be, so it may; a Latin hypercube and a full factorial are
balanced only as a whole, and have a ``size``.

May import: check.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations
from math import comb, prod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check


class Design(NamedTuple):
    """Points by index. ``size`` belongs into the campaign that uses it."""

    point: Callable  # (key, index) -> (dims,) in (0, 1)
    size: int | None  # points that it has; None: as many as wanted


def _unit(words):
    """Random 32-bit words as numbers in (0, 1), in the default float type."""
    if jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        return (words.astype(jnp.float64) + 0.5) * 2.0**-32
    return ((words >> 9).astype(jnp.float32) + 0.5) * 2.0**-23


def iid(dims: int) -> Design:
    """Independent uniform points."""
    return Design(partial(_iid, check.whole("dims", dims)), None)


def _iid(dims, key, index):
    return _unit(jax.random.bits(jax.random.fold_in(key, index), (dims,), jnp.uint32))


def latin(n: int, dims: int) -> Design:
    """A Latin hypercube of n points: along every axis, one in each of n equal intervals.

    The whole of it is balanced, not a part: take all n scenarios, and do not extend. In float32 a point may fall
    beside its interval by rounding. Beyond n the points repeat.
    """
    n = check.whole("n", n)
    return Design(partial(_latin, n, check.whole("dims", dims)), n)


def _latin(n, dims, key, index):
    keys = jax.random.split(jax.random.fold_in(key, 2**32 - 1), dims)  # one permutation an axis
    within = _iid(dims, key, index)
    where = jax.vmap(lambda key: _permuted(n, key, index))(keys)
    u = (where.astype(within.dtype) + within) / n
    return jnp.clip(u, jnp.finfo(u.dtype).tiny, 1 - jnp.finfo(u.dtype).epsneg)


@partial(jax.jit, static_argnums=0)  # called by hand, the loops would be compiled at every call
def _permuted(n, key, index):
    """Where a random permutation of range(n) sends the index: a Feistel network, walked until it lands inside."""
    half = max(1, (max(n - 1, 1).bit_length() + 1) // 2)  # bits; the network permutes range(4^half)
    mask = jnp.uint32(2**half - 1)
    rounds = jax.random.bits(key, (6,), jnp.uint32)

    def mixed(x, salt):  # the finaliser of MurmurHash3
        x = (x ^ salt) * jnp.uint32(0x9E3779B1) + salt
        x = (x ^ (x >> 16)) * jnp.uint32(0x85EBCA6B)
        x = (x ^ (x >> 13)) * jnp.uint32(0xC2B2AE35)
        return x ^ (x >> 16)

    def once(x):
        step = lambda salt, pair: (pair[1], pair[0] ^ (mixed(pair[1], salt) & mask))
        left, right = jax.lax.fori_loop(0, 6, lambda i, pair: step(rounds[i], pair), (x >> half, x & mask))
        return (left << half) | right

    start = once((jnp.asarray(index) % n).astype(jnp.uint32))  # beyond 4^half the walk would not end
    return jax.lax.while_loop(lambda x: x >= n, once, start)


SOBOL_BITS = 22  # a Sobol design has 2^22 points: building its numbers takes as long as drawing them once


def sobol(dims: int) -> Design:
    """Sobol points (Joe and Kuo's direction numbers, by SciPy), with a random digital shift from the key.

    Any first 2^m of them are balanced, so n is best a power of two; extend by doubling.
    """
    return Design(partial(_sobol, _directions(check.whole("dims", dims))), 2**SOBOL_BITS)


def _directions(dims: int) -> np.ndarray:
    """Direction numbers (bits, dims) as 32-bit words, read off the sequence: point i is their sum over Gray(i)."""
    from scipy.stats import qmc

    if dims > qmc.Sobol.MAXDIM:
        check.refuse("dims", f"be at most {qmc.Sobol.MAXDIM}", dims)
    sequence = qmc.Sobol(dims, scramble=False, bits=32)
    rows, at = [], 0
    for bit in range(SOBOL_BITS):
        sequence.fast_forward(2**bit - at)
        word = (sequence.random(1)[0] * 2.0**32).astype(np.uint32)  # Gray(2^bit) = 2^bit + 2^(bit - 1)
        rows.append(word ^ rows[-1] if rows else word)
        at = 2**bit + 1
    return np.stack(rows)


def _sobol(directions, key, index):
    gray = index ^ (index >> 1)
    bits = (gray >> jnp.arange(len(directions))) & 1
    words = jnp.where(bits[:, None] == 1, directions, jnp.uint32(0))
    words = jax.lax.reduce(words, jnp.uint32(0), jax.lax.bitwise_xor, (0,))
    return _unit(words ^ jax.random.bits(key, words.shape, jnp.uint32))


# combinations


def factorial(index, counts: Sequence[int]) -> tuple[Any, ...]:
    """The level of every factor in combination ``index`` of a full factorial; the last factor changes fastest.

    counts: levels of each factor; the whole has their product, after which it repeats, so an index beyond it
    gives a replicate. index: integers of any shape, which is that of every level.
    """
    counts = check.wholes("counts", counts)
    index, levels = jnp.asarray(index) % prod(counts), []
    for count in reversed(counts):
        levels.append(index % count)
        index = index // count
    return tuple(reversed(levels))


def subsets(channels: int, most: int | None = None) -> np.ndarray:
    """All sets of at most ``most`` of the channels, (sets, channels) bool, the empty one first: which are faulty.

    ``jnp.asarray(subsets(4))[index % 16]`` gives every combination of four faults in turn.
    """
    channels = check.whole("channels", channels)
    most = channels if most is None else check.whole("most", most, 0)
    sizes, sets = range(min(most, channels) + 1), 0
    for size in sizes:
        sets += comb(channels, size)
        check.fits_memory(f"`channels` = {channels} with `most` = {most}", (sets + 40) * channels, "take fewer")
    chosen = np.zeros((sets, channels), bool)
    for row, who in zip(chosen, (who for size in sizes for who in combinations(range(channels), size))):
        row[list(who)] = True
    return chosen
