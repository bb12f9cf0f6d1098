"""Where things point: the axes of gyros and wheels, as tuples of unit `Vec3` in body axes."""

from __future__ import annotations

import jax.numpy as jnp

from jaxatt.vec import Vec3, cross


def gyro_pyramid(alpha, beta) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Input axes of the gyros A, B, C about -z and of the spare D along z; Park (2005), eq. (1).

    alpha: [rad] between A, B, C and -z; 54.7356 deg with beta = 60 deg makes the three an orthogonal triad;
    beta: [rad] azimuth of B and C from y.
    """
    sa, ca, sb, cb = jnp.sin(alpha), jnp.cos(alpha), jnp.sin(beta), jnp.cos(beta)
    o = jnp.zeros_like(sa)
    return Vec3(o, -sa, -ca), Vec3(sb * sa, cb * sa, -ca), Vec3(-sb * sa, cb * sa, -ca), Vec3(o, o, o + 1)


def wheel_pyramid(gamma) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Spin axes of four reaction wheels about z; Park (2005), eq. (2): the columns of W. gamma [rad]."""
    s, c = jnp.sin(gamma), jnp.cos(gamma)
    return Vec3(s * s, s * c, c), Vec3(-s * s, s * c, c), Vec3(-s * s, -s * c, c), Vec3(s * s, -s * c, c)


def along(axes, v: Vec3):
    """Components of v along the axes, shape (n, *lanes): G w for gyros, W' v for wheels."""
    return jnp.stack([a @ v for a in axes])


def total(axes, s) -> Vec3:
    """Sum of s[i] along the axes, s of shape (n, *lanes): W h for wheels."""
    x, y, z = (sum(a[j] * s[i] for i, a in enumerate(axes)) for j in range(3))
    return Vec3(x, y, z)


def parity_vector(axes):
    """Unit v, shape (4, *lanes), with v' G = 0 for four axes no three of which lie in a plane; first v positive.

    v' y of four gyros is free of the body rate: it holds errors only, but one number cannot tell whose.
    """
    a, b, c, d = axes
    v = jnp.stack([cross(b, c) @ d, -(cross(a, c) @ d), cross(a, b) @ d, -(cross(a, b) @ c)])
    return v * (jnp.sign(v[0]) / jnp.sqrt(jnp.sum(v * v, axis=0)))
