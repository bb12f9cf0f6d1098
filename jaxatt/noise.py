"""Noise: standard normal numbers that depend on the key, the scenario's number and the tick alone.

The scenarios of a block lie side by side in the last axis, the lanes.

May import: check, compiling, contract, vec.
"""

from __future__ import annotations

from math import prod

import jax
import jax.numpy as jnp
from jax.extend.random import threefry_2x32

from jaxatt import check
from jaxatt.compiling import compiled, shared
from jaxatt.contract import System
from jaxatt.vec import polynomial

BLOCK = 128  # scenarios that run side by side; with the key it fixes a scenario's noise, so it is no option
CHUNK = 10  # ticks whose noise is drawn together, and between which reverse mode keeps the state

VERSION = 2  # of the numbers below: another one gives other bits for the same key, so campaigns keep it

# Normal quantile as x P(w) / Q(w) with x = 1 - 2p and w = -log(4p(1 - p)): one formula from the centre to the tails,
# within 8e-8 relative of the exact quantile for w in [0, 33.9]. Three times as fast as erf_inv on JAX 0.10. Fitted by
# iteratively reweighted least squares; tests/test_noise.py holds it against SciPy.
_P = (1.2533142363811407, 0.45470743694962035, 0.09303821761104376, 0.012839939543093811, 0.0011706156328512372,
      5.519034129735792e-05, 1.6778843158076054e-07)  # fmt: skip
_Q = (1.0, 0.10100637305813538, 0.03475255721389443, 0.0024721041012158483, 0.00024069435245768195,
      3.3687149579721435e-06)  # fmt: skip


def _normal(word, partner):
    """Standard normal numbers of random 32-bit words, float32, by the inverse distribution, exact to 7.87.

    The top bit of a word is the sign, the others are the magnitude m; the low 16 bits v of its partner refine m, so that
    the tail has steps as fine as the centre. Two partners share 16 bits, yet each is exactly normal: v moves a number by
    about 1 / (m |number|), so by more than 1e-3 once in 1e7 draws, and moves the partner by 2^-16 in probability. Given
    m = 0, 1 or 10 the correlation of a number, its size and its square with those of the partner is below 4.2e-4, the
    scatter of 4e6 draws.
    """
    m = (word & 0x7FFFFFFF).astype(jnp.int32)  # signed, for the CPU has no fast conversion of unsigned integers
    fine = ((partner & 0xFFFF).astype(jnp.int32).astype(jnp.float32) + 0.5) * 2.0**-16
    p = (m.astype(jnp.float32) + fine) * 2.0**-32  # probability of a tail beyond, in (0, 1/2)
    x = ((0x7FFFFFFF - m).astype(jnp.float32) + (1 - fine)) * 2.0**-31  # 1 - 2p without cancellation
    w = -jnp.log(4 * p * (1 - p))
    size = x * polynomial(_P, w) / polynomial(_Q, w)
    return jnp.where(word.astype(jnp.int32) < 0, -size, size)


def _words(key, n: int):
    """n random 32-bit words of a raw key in pairs, shape (2, n / 2): the two words of a threefry block are partners.

    Both are used, twice as fast as random.bits. n: even.
    """
    return threefry_2x32(key, jnp.arange(n, dtype=jnp.uint32)).reshape(2, n // 2)


def chunk_noise(system: System, key, k0, ticks: int, lanes: tuple, dtype):
    """Noise of the ticks k0 .. k0 + ticks - 1 from a raw key, shape (ticks, normals, *lanes)."""
    shape = (system.normals, *lanes)
    if system.normals == 0:
        return jnp.zeros((ticks, *shape), dtype)
    n = prod(shape)
    keys = jax.vmap(lambda k: jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), k)))
    words = shared(
        lambda k0: jax.vmap(lambda key: _words(key, n + n % 2))(
            keys(k0 + jnp.arange(ticks, dtype=jnp.result_type(k0)))
        ),
        k0,
    )
    numbers = shared(lambda words: _normal(words, words[:, ::-1]), words)
    # cast outside: within, float64 would halve the width of all of it
    return numbers.reshape(ticks, n + n % 2)[:, :n].reshape(ticks, *shape).astype(dtype)


def one_key(key):
    """The two raw words of a single key, typed or raw; TypeError for what is no key, ValueError for several."""
    if check.is_key(key):
        if str(jax.random.key_impl(key)) != "threefry2x32":
            raise TypeError(
                f"`key` must be a threefry key, jax.random.key(seed), but it is one of {jax.random.key_impl(key)}."
            )
        key = jax.random.key_data(key)
    if not hasattr(key, "dtype") or key.dtype != jnp.uint32 or key.shape[-1:] != (2,):
        raise TypeError(f"`key` must be a key of jax.random.key(seed), but it is {check.short(key)}.")
    if key.ndim != 1:
        check.refuse("key", "be one key", f"of shape {key.shape[:-1]}")
    return key


def block_key(key, block):
    """The raw key of a block of scenarios, from the raw key of the sweep."""
    return jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), block))


def noise_of(system: System, key, index: int, ticks: int):
    """The noise of one scenario of a sweep.

    Args:
        system: the loop, which says how many normals a tick takes.
        key: the sweep's key.
        index: number of the scenario, from 0.
        ticks: how many.

    Returns:
        Array (ticks, normals), float32: ``simulate`` with it repeats the scenario.

    Raises:
        ValueError: ticks < 1, index < 0, several keys, or more noise than the free memory holds.
        TypeError: what is no key.

    Example:
        >>> noise = noise_of(system, jax.random.key(1), 17, ticks=600)
    """
    ticks, index = check.whole("ticks", ticks), check.whole("index", index, 0)
    key = one_key(key)
    check.fits_memory(f"`ticks` = {ticks}", 4 * BLOCK * ticks * system.normals, "ask for fewer")
    return compiled(_noise_of, 2, key)(system, ticks, key, index // BLOCK, index % BLOCK)


def _noise_of(system, ticks, key, block, lane):
    return chunk_noise(system, block_key(key, block), jnp.asarray(0), ticks, (BLOCK,), jnp.float32)[..., lane]
