"""Bounds as a change of variables: numbers that an optimizer may move at will, and never leave their range.

May import: check, gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import zip_longest
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.tuning.gradient import floats


class Bounds(NamedTuple):
    """Two functions, inverse to each other, on trees of numbers."""

    free: Callable  # numbers within the bounds -> numbers without bounds, which an optimizer may move at will
    within: Callable  # back


def bounded(low, high) -> Bounds:
    """Bounds as a change of variables: any step of an optimizer on ``free(theta)`` stays in (low, high).

    A positive number is ``bounded(0, inf)``: the logarithm. Between two positive bounds a number moves in ratios,
    between others in differences; in both cases 0 is the middle.

    Args:
        low: a tree like theta, or one number for all of it; -inf leaves the side open, for all numbers of a leaf.
        high: likewise, with inf.

    Returns:
        The two functions ``free`` and ``within``.

    Raises:
        ValueError: both functions, where low is not below high; ``free``, for concrete numbers that lie outside.

    Example:
        >>> gains = bounded(1e-3, 1e3)
        >>> best, _ = tune(lambda free, key: cost(gains.within(free), key), gains.free(start), optimizer, steps, key)
        >>> gains.within(best)
    """

    def over(f, theta):
        leaves, structure, ends, paths = ends_of(theta, low, high)
        return jax.tree.unflatten(structure, [f(*end, leaf, path) for end, leaf, path in zip(ends, leaves, paths)])

    return Bounds(lambda theta: over(_free, theta), lambda free: over(_within, free))


def ends_of(theta, low, high):
    """The leaves of the tree theta, their structure, the bounds low and high of each, checked, and their paths."""
    leaves, structure = jax.tree.flatten(floats("theta", theta))
    spread = lambda b: jax.tree.leaves(b) if jax.tree.structure(b) == structure else [b] * len(leaves)
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(theta)]
    ends = list(zip(spread(low), spread(high)))
    for path, leaf, (a, b) in zip(paths, leaves, ends):
        for name, end in (("low", a), ("high", b)):
            shape = check.real(name + path, end).shape
            if not all(a in (1, b) for a, b in zip_longest(shape[::-1], leaf.shape[::-1], fillvalue=1)):
                check.refuse(name + path, f"broadcast to the shape {leaf.shape} of theta", shape)
        check.each(f"low{path}", f"be less than high, {check.short(b)}", a, np.asarray(a) < b)
    return leaves, structure, ends, paths


def _free(low, high, a, path):
    if check.concrete(a):
        check.each(
            f"theta{path}",
            f"lie in ({check.short(low)}, {check.short(high)})",
            a,
            (np.asarray(a) > low) & (np.asarray(a) < high),
        )
    no_low, no_high = _absent("low", low, path), _absent("high", high, path)
    if no_high:
        return jnp.asarray(a) if no_low else jnp.log(a - low)
    if no_low:
        return -jnp.log(high - a)
    if np.all(np.asarray(low) > 0):
        low, high, a = np.log(low), np.log(high), jnp.log(a)
    return jnp.log((a - low) / (high - a))


def _within(low, high, a, path):
    no_low, no_high = _absent("low", low, path), _absent("high", high, path)
    if no_high:
        return jnp.asarray(a) if no_low else low + jnp.exp(a)
    if no_low:
        return high - jnp.exp(-a)
    share = jax.nn.sigmoid(a)
    if np.all(np.asarray(low) > 0):
        return jnp.exp(np.log(low) + (np.log(high) - np.log(low)) * share)
    return low + (high - low) * share


def _absent(name: str, bound, path: str) -> bool:
    """Whether a leaf's bound is infinite: all of its numbers or none."""
    infinite = np.isinf(bound)
    if infinite.any() and not infinite.all():
        check.refuse(f"{name}{path}", "be finite or infinite throughout", bound)
    return bool(infinite.all())
