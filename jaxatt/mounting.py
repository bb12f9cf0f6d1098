"""Where things point on the spacecraft: axes and triads in body components.

May import: check, vec.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.check import door
from jaxatt.vec import Vec3, cross, once

# gyros and wheels


@door
def gyro_pyramid(alpha, beta) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Input axes of the gyros A, B, C about -z and of the spare D along z; Park (2005), eq. (1).

    alpha: [rad] between A, B, C and -z; 54.7356 deg with beta = 60 deg makes the three an orthogonal triad;
    beta: [rad] azimuth of B and C from y.
    """
    sa, ca, sb, cb = jnp.sin(alpha), jnp.cos(alpha), jnp.sin(beta), jnp.cos(beta)
    o = jnp.zeros_like(sa)
    return Vec3(o, -sa, -ca), Vec3(sb * sa, cb * sa, -ca), Vec3(-sb * sa, cb * sa, -ca), Vec3(o, o, jnp.ones_like(sa))


@door
def wheel_pyramid(gamma) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Spin axes of four reaction wheels about z; Park (2005), eq. (2): the columns of W. gamma [rad]."""
    s, c = jnp.sin(gamma), jnp.cos(gamma)
    return Vec3(s * s, s * c, c), Vec3(-s * s, s * c, c), Vec3(-s * s, -s * c, c), Vec3(s * s, -s * c, c)


@door
def along(axes, v: Vec3):
    """Components of v along the axes, shape (n, *lanes): G w for gyros, W' v for wheels."""
    return jnp.stack([a @ v for a in axes])


@door
def total(axes, s) -> Vec3:
    """Sum of s[i] along the axes, s of shape (n, *lanes): W h for wheels."""
    x, y, z = (sum(a[j] * s[i] for i, a in enumerate(axes)) for j in range(3))
    return Vec3(x, y, z)


@door
def parity_vector(axes):
    """Unit v, shape (4, *lanes), with v' G = 0 for four axes no three of which lie in a plane; first v positive.

    v' y of four gyros is free of the body rate: it holds errors only, but one number cannot tell whose.
    """
    a, b, c, d = axes
    v = jnp.stack([cross(b, c) @ d, -(cross(a, c) @ d), cross(a, b) @ d, -(cross(a, b) @ c)])
    return v * (jnp.sign(v[0]) / jnp.sqrt(jnp.sum(v * v, axis=0)))


# control moment gyros


class GimbalAxes(NamedTuple):
    """A cluster of n single-gimbal control moment gyros; every component has shape (n, *lanes)."""

    r: Vec3  # [1] gimbal axis
    s0: Vec3  # [1] spin axis at gimbal angle zero, at right angles to r


class Triads(NamedTuple):
    """Where the modules of a cluster point; every component has shape (n, *lanes)."""

    r: Vec3  # [1] gimbal axis
    s: Vec3  # [1] spin axis
    t: Vec3  # [1] r x s = ds/dgamma; the output torque is -h gamma' t


@door
def cmg_axes(skew, azimuth) -> GimbalAxes:
    """Axes of modules round the z axis, Jin & Leeghim (2021), eqs. (8)-(10).

    skew: angle of the gimbal axis to the z axis [rad], shape (*lanes) or (n, *lanes): 54.7 deg makes the
    paper's pyramid, 90 deg its box-90; azimuth: of the gimbal axis in the x-y plane [rad], shape (n, *lanes).
    The spin axis at gimbal angle zero lies in the x-y plane. NumPy arrays unless an argument is of JAX.
    """
    m = jnp if any(isinstance(a, jax.Array) for a in (skew, azimuth)) else np  # at import nothing runs on JAX
    skew, azimuth = m.broadcast_arrays(m.asarray(skew, float), m.asarray(azimuth, float))
    sin_b, cos_b, sin_a, cos_a = m.sin(skew), m.cos(skew), m.sin(azimuth), m.cos(azimuth)
    return GimbalAxes(Vec3(sin_b * cos_a, sin_b * sin_a, cos_b), Vec3(-sin_a, cos_a, m.zeros_like(cos_a)))


@door
def cmg_triads(axes: GimbalAxes, gamma) -> Triads:
    """The triads at gimbal angles gamma [rad], shape (n, *lanes)."""
    sin, cos = once(lambda gamma: (jnp.sin(gamma), jnp.cos(gamma)), gamma)
    t0 = cross(axes.r, axes.s0)
    return Triads(axes.r, cos * axes.s0 + sin * t0, cos * t0 - sin * axes.s0)


def _fit(shapes) -> bool:
    try:
        np.broadcast_shapes(*shapes)
    except ValueError:
        return False
    return True


@door
def modules(axes: GimbalAxes, which) -> GimbalAxes:
    """The cluster of the modules ``which`` alone, a list of indices."""
    which = np.asarray(which)
    return GimbalAxes(*(Vec3(*(c[which] for c in v)) for v in axes))


def check_gimbal_axes(name: str, axes: GimbalAxes, used: Any = True) -> None:
    """Refuse, with ValueError, axes that are no unit vectors at right angles, fewer than three modules, and
    parallel gimbal axes, whose torques lie in one plane at all gimbal angles.

    used: bool, shape (n, *lanes): the modules that count for the last two.
    """
    if not check.concrete((axes, used)):
        return
    check.kind(name, axes, GimbalAxes)
    for field, v in zip(GimbalAxes._fields, axes):
        check.kind(f"{name}.{field}", v, Vec3)
        for axis, component in zip(Vec3._fields, v):
            check.real(f"{name}.{field}.{axis}", component)
    check.real("used", used)
    shapes = [np.shape(c) for v in check.numbers(name, axes) for c in v] + [np.shape(used)]
    if not _fit(shapes):
        check.refuse(name, "have components of one shape, that of `used` too", " and ".join(map(str, set(shapes))))
    r, s0 = (np.stack(np.broadcast_arrays(*(np.asarray(c, float) for c in v))) for v in axes)
    if r.ndim < 2:
        check.refuse(f"{name}.r", "have shape (n, *lanes) with the modules first", f"of shape {r.shape[1:]}")
    if np.broadcast_shapes(np.shape(used), r.shape[1:]) != r.shape[1:]:
        check.refuse("used", f"have the shape of the axes, {r.shape[1:]}", np.shape(used))
    single = np.finfo(np.float32).eps  # axes may have been float32
    for field, v in (("r", r), ("s0", s0)):
        length = np.sqrt((v * v).sum(0))
        each_length = f"{name}.{field}"
        check.each(f"|{each_length}|", "be 1 (unit vectors)", length, np.abs(length - 1) < 8 * single)
    slant = (r * s0).sum(0)
    check.each(f"{name}.r . {name}.s0", "be 0 (right angles)", slant, np.abs(slant) < 8 * single)
    used = np.broadcast_to(np.asarray(used, bool), r.shape[1:])
    count = used.sum(0)
    check.each(f"number of healthy modules of {name}", "be at least 3", count, count >= 3)
    spread = np.einsum("in...,jn...->...ij", r * used, r * used)
    second = np.linalg.eigvalsh(spread)[..., 1]
    check.each(f"{name}.r", "not all be parallel (spread of the healthy modules' axes > 0)", second, second > 1e-9)
