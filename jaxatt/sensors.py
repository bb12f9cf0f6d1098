"""Sensors: how star sensors and gyros read, faults included, and where gyros point.

May import: check, vec, attitude, faults, scores.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt.faults import Reading, channel, heard, present, read
from jaxatt.vec import Vec3, array, columns, cross, resultant


def triad(faults: Vec3, t, std, normals, last: Vec3) -> Vec3:
    """The three channels of a star sensor or rate gyro from tick time t [s] on, a `Vec3` of `Channel`.

    faults: `Vec3` of `Fault`; std: standard deviation of each channel's noise; normals: three standard normal numbers;
    last: the previous reading.
    """
    return Vec3(*(channel(f, t, std, n, v) for f, n, v in zip(faults, normals, last)))


def read_triad(channels: Vec3, truth: Vec3) -> Vec3:
    """The reading of a triad whose true signals are ``truth``."""
    return Vec3(*map(read, channels, truth))


def heard_triad(faults: Vec3, t):
    """Whether a triad gives a reading at t [s]: it counts as a whole, and is missing where one of its channels is."""
    x, y, z = (heard(f, t) for f in faults)
    return x & y & z


def quantised(y, step):
    """y rounded to whole multiples of step, 0 for no rounding; gradients pass the rounding over."""
    coarse = step > 0
    safe = jnp.where(coarse, step, 1)
    return y + jax.lax.stop_gradient(jnp.where(coarse, safe * jnp.round(y / safe) - y, 0))


# where gyros point


def gyro_pyramid(alpha, beta) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Input axes of the gyros A, B, C about -z and of the spare D along z; Park (2005), eq. (1).

    alpha: [rad] between A, B, C and -z; 54.7356 deg with beta = 60 deg makes the three an orthogonal triad;
    beta: [rad] azimuth of B and C from y.
    """
    sa, ca, sb, cb = jnp.sin(alpha), jnp.cos(alpha), jnp.sin(beta), jnp.cos(beta)
    return Vec3(0.0, -sa, -ca), Vec3(sb * sa, cb * sa, -ca), Vec3(-sb * sa, cb * sa, -ca), Vec3(0.0, 0.0, 1.0)


def parity_vector(axes):
    """Unit v, shape (4,), with v' G = 0 for four axes that span space; its first number is not negative.

    A gyro whose number is 0, for the other three lie in a plane, is not watched; NaN where all four lie in one.

    v' y of four gyros is free of the body rate: it holds errors only, but one number cannot tell whose.
    """
    a, b, c, d = columns(axes)
    v = jnp.stack([cross(b, c) @ d, -(cross(a, c) @ d), cross(a, b) @ d, -(cross(a, b) @ c)])
    return v * (jnp.where(v[0] < 0, -1, 1) / jnp.sqrt(jnp.sum(v * v)))


def rate_maps(axes):
    """Pseudo-inverses, (2^n, 3, n), of n gyro axes for every subset in use; gyro i counts 2^i in its number."""
    rows = jnp.stack([array(axis) for axis in columns(axes)])
    n = len(rows)
    in_use = np.arange(2**n)[:, None] >> np.arange(n) & 1  # (2^n, n)
    return jnp.linalg.pinv(rows * in_use[..., None])


def rate_from(maps, gyro: Reading) -> Vec3:
    """The body rate [rad/s] that explains the valid, finite ones of n gyro readings (n,) best; maps: of `rate_maps`."""
    there = present(gyro)
    subset = sum(valid << i for i, valid in enumerate(there.astype(int)))
    return resultant(maps[subset], jnp.where(there, gyro.value, 0))
