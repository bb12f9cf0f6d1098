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

# Normal quantile as x P(w) / Q(w) with x = 2u - 1 and w = -log(4u(1 - u)): one formula from the centre to the
# tails, within 1e-8 relative of the exact quantile over all 2^23 values of u. Three times as fast as erf_inv on
# JAX 0.10. Fitted by iteratively reweighted least squares; tests/test_noise.py holds it against SciPy.
_P = (1.2533141498490095, 0.4325156793724996, 0.08401840867205965, 0.01094915946460716, 9.086772553634041e-4,
      3.491005456299212e-05)  # fmt: skip
_Q = (1.0, 0.08329848156363834, 0.03219616729462598, 0.001858744245195428, 1.809863938681891e-4,
      1.3188746002534835e-06)  # fmt: skip


def _normal(bits):
    """Standard normal numbers of random 32-bit words, float32, by the inverse distribution."""
    u = ((bits >> 9).astype(jnp.float32) + 0.5) * 2.0**-23  # symmetric, never 0 or 1
    w = -jnp.log(4 * u * (1 - u))
    return (2 * u - 1) * polynomial(_P, w) / polynomial(_Q, w)


def _words(key, shape):
    """Random 32-bit words of a raw key: both words of each threefry block are used, twice as fast as random.bits."""
    return threefry_2x32(key, jnp.arange(prod(shape), dtype=jnp.uint32)).reshape(shape)


def chunk_noise(system: System, key, k0, ticks: int, lanes: tuple, dtype):
    """Noise of the ticks k0 .. k0 + ticks - 1 from a raw key, shape (ticks, normals, *lanes)."""
    shape = (system.normals, *lanes)
    if system.normals == 0:
        return jnp.zeros((ticks, *shape), dtype)
    keys = jax.vmap(lambda k: jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), k)))
    bits = shared(
        lambda k0: jax.vmap(lambda key: _words(key, shape))(keys(k0 + jnp.arange(ticks, dtype=jnp.result_type(k0)))), k0
    )
    return shared(_normal, bits).astype(dtype)  # cast outside: within, float64 would halve the width of all of it


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
