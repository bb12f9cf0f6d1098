"""Time: the instant of each tick, and the tick that a written instant means.

Tick k comes at t = k dt, the floating number next to the product, where ``dt`` means the simple fraction that it was
written as, 0.1 a tenth and 1 / 3 a third. So an instant as it is written, 0.3 or 86400.1, is the same number as the time
of its tick, in float32 and float64, and ``now.t >= 0.3`` holds from that tick on. Instants that were worked out, 0.1 + 0.2,
or drawn, are off by their rounding; fields that are marked as instants (`jaxatt.check.instant`) are put right by `at_tick`
before the run. Float32 tells the ticks of 2^23 = 8.4 million apart, float64 all that 31 bits count.

May import: check.
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from math import frexp, ldexp

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check

WRITTEN = 10**6  # largest denominator of a dt that is taken as a fraction
NEAR = 2.0**-22  # relative distance within which an instant is that of a tick: two roundings of float32


def time_of(k, dt: float, dtype):
    """Time [s] of tick k, an array of integers from 0 to 2^31 - 1: k dt, rounded once to dtype, float32 or float64.

    Products of short pieces of k and dt are exact; what their sum rounds off is added to it last. A compiler may fuse
    products with sums and changes nothing.
    """
    first, second, third = (np.asarray(piece, dtype) for piece in _pieces(float(dt), dtype == np.float32))
    low, middle = k % 2**12, k % 2**24
    total = rest = np.zeros((), dtype)
    small = rest
    for part in (k - middle, middle - low, low):
        part = part.astype(dtype)
        product = part * first
        ahead = total + product
        rest = rest + (product - (ahead - total))
        small = small + part * third
        total, rest = ahead, rest + part * second
    return total + (rest + small)


@lru_cache
def _pieces(dt: float, short: bool) -> tuple[float, float, float]:
    """Three numbers of few bits that add up to dt, the largest first; short: for products in float32."""
    rest, pieces = meant(dt), []
    for _ in range(3):
        size, exponent = frexp(float(rest))
        bits = 12 if short else 22
        pieces.append(ldexp(round(ldexp(size, bits)), exponent - bits))
        rest -= Fraction(pieces[-1])
    return tuple(pieces)  # pyright: ignore[reportReturnType]


def meant(dt: float) -> Fraction:
    """The fraction that a period [s] was written as: 0.1 is 1/10. Where there is no simple one, the number itself."""
    simple = Fraction(dt).limit_denominator(WRITTEN)
    return simple if abs(float(simple) - dt) <= 4 * np.spacing(dt) else Fraction(dt)


def at_tick(instant, dt: float):
    """The instant [s], or the time of the tick from which rounding alone parts it.

    Rounding: `NEAR` of the instant, in float64 a hundredth of dt at most. An instant between two ticks stays what it is:
    from it on is from the next tick on. The gradient is 1.

    Args:
        instant: array of any shape, floating; others, and infinities, stay as they are.
        dt: [s] between ticks.

    Returns:
        Array like instant.
    """
    if not jnp.issubdtype(instant.dtype, jnp.floating):
        return instant
    xp = np if check.concrete(instant) else jnp
    instant, dtype = xp.asarray(instant), instant.dtype  # within jit even a concrete array of JAX would be traced
    here = jax.lax.stop_gradient(instant) if xp is jnp else instant
    countable = (here > -dt) & (here < 2.147e9 * dt)
    here = xp.where(countable, here, xp.zeros((), dtype))
    k = xp.maximum(xp.round(here / dt), 0).astype(np.int32)
    k = xp.maximum(k + xp.round((here - time_of(k, dt, dtype)) / dt).astype(np.int32), 0)
    t = time_of(k, dt, dtype)
    rounding = NEAR * here if dtype == np.float32 else xp.minimum(NEAR * here, 0.01 * dt)
    near = countable & (abs(here - t) <= rounding + 1e-9 * dt)
    if xp is np:
        return np.where(near, t, instant).astype(dtype)
    return jnp.where(near, instant + (t - here), instant)
