"""Clusters of control moment gyros that tests share, and their torque matrices at many gimbal angles."""

import jax
import numpy as np

from jaxatt.cmg import cmg_axes, cmg_triads, modules

SKEWS = {"pyramid": 54.7, "box": 90.0}
FOUR = {name: cmg_axes(np.radians(skew), np.radians([0.0, 90.0, 180.0, 270.0])) for name, skew in SKEWS.items()}
THREE = {name: modules(axes, [0, 1, 2]) for name, axes in FOUR.items()}


def over(axes):
    """Axes with room for grid points behind the modules."""
    return jax.tree.map(lambda a: np.asarray(a)[:, None], axes)


def torque(axes, gamma):
    """Torque matrices at gimbal angles (n, m), components (n, m)."""
    return cmg_triads(over(axes), gamma).t


def matrices(t):
    """T of shape (m, 3, n)."""
    return np.moveaxis(np.stack([np.asarray(c) for c in t]), -1, 0)


def angles(n, m, seed=0):
    """Gimbal angles (n, m) [rad], drawn."""
    return np.random.default_rng(seed).uniform(0, 2 * np.pi, (n, m))
