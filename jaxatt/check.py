"""The door: what a user hands in is converted and checked here, before anything is compiled.

One grammar for every refusal: "`name` must be such, but it is value." Checks read concrete numbers; under a
transformation (jit, grad, vmap) there are none and they pass. Lanes trail: the message names the first
offending lane. name: what the message calls the argument; value: what was handed in; must and reason: words of the
message. Imports nothing of jaxatt.
"""

from __future__ import annotations

from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def refuse(name: str, must: str, value, lane: int | None = None) -> NoReturn:
    """Raise the ValueError "`name` must ..., but it is value (in scenario lane)"."""
    where = "" if lane is None else f" in scenario {lane}"
    raise ValueError(f"`{name}` must {must}, but it is {value}{where}.")


def concrete(tree) -> bool:
    """Whether a tree holds numbers and no tracers."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def each(name: str, must: str, value, good) -> None:
    """Refuse the first of the concrete numbers ``value`` for which ``good`` is False."""
    value, good = np.broadcast_arrays(np.asarray(value), np.asarray(good))
    if not good.all():
        bad = tuple(int(i) for i in np.argwhere(~good)[0])
        refuse(name, must, f"{value[bad]:g}", bad[-1] if bad else None)


def positive(name: str, value) -> None:
    """Refuse numbers that are not finite and > 0."""
    if concrete(value):
        value = np.asarray(value)
        each(name, "be a positive number", value, (value > 0) & np.isfinite(value))


def not_negative(name: str, value) -> None:
    """Refuse numbers that are not >= 0; inf passes."""
    if concrete(value):
        value = np.asarray(value)
        each(name, "not be negative", value, value >= 0)


def above(name: str, value, least: float, reason: str) -> None:
    """Refuse numbers that are not > least; inf passes."""
    if concrete(value):
        value = np.asarray(value)
        each(name, f"be greater than {least:g} ({reason})", value, value > least)


def between(name: str, value, low: float, high, reason: str) -> None:
    """Refuse numbers outside the open interval (low, high); reason says what bounds it."""
    if concrete((value, high)):
        value, high = np.asarray(value), np.asarray(high)
        inside = (value > low) & (value < high)
        each(name, f"lie in ({low:g}, {np.min(high):g}), {reason},", value, inside)


def one_of(name: str, value, allowed: tuple) -> None:
    """Refuse numbers that are none of the allowed ones."""
    if concrete(value):
        value = np.asarray(value)
        each(name, f"be one of {allowed}", value, np.isin(value, allowed))


def finite(name: str, tree) -> None:
    """Refuse NaN and infinities anywhere in a tree, by the path of the leaf."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if concrete(leaf):
            leaf = np.asarray(leaf)
            each(name + jax.tree_util.keystr(path), "be finite", leaf, np.isfinite(leaf))


def a_number(name: str, tree) -> None:
    """Refuse NaN anywhere in a tree, by the path of the leaf; infinities pass."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if concrete(leaf):
            leaf = np.asarray(leaf)
            each(name + jax.tree_util.keystr(path), "be a number", leaf, ~np.isnan(leaf))


def moments(name: str, matrix) -> np.ndarray | None:
    """Principal moments, ascending, shape (3, *lanes), of an inertia given as three rows [kg m^2].

    Refuses a matrix that is not symmetric or not positive definite. None under a transformation.
    """
    if not concrete(matrix):
        return None
    rows = [np.broadcast_arrays(*(np.asarray(a, float) for row in matrix for a in row))]
    m = np.moveaxis(np.stack(rows[0]).reshape(3, 3, *rows[0][0].shape), (0, 1), (-2, -1))
    finite(name, matrix)
    skew = np.abs(m - np.swapaxes(m, -1, -2)).max((-1, -2))
    size = np.abs(m).max((-1, -2))
    each(f"{name} - {name}'", "be zero (a symmetric matrix)", skew, skew <= 1e-6 * size)
    principal = np.linalg.eigvalsh(m)
    least = principal[..., 0]
    if not (least > 0).all():
        bad = tuple(int(i) for i in np.argwhere(~(least > 0))[0])
        where = f" in scenario {bad[-1]}" if bad else ""
        raise ValueError(
            f"`{name}` must be positive definite, but its smallest principal moment is {least[bad]:g} kg m^2{where}."
        )
    return np.moveaxis(principal, -1, 0)


def whole(name: str, value, least: int = 1) -> int:
    """Refuse what is not a whole number >= least; return it as int."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        refuse(name, f"be a whole number of at least {least}", repr(value))
    return int(value)


def float_type(trees):
    """The floating type of a run: what the floating leaves promote to; Python numbers follow the others."""
    kinds = {leaf.dtype for leaf in jax.tree.leaves(trees) if hasattr(leaf, "dtype")}
    return jnp.result_type(1.0, *(kind for kind in kinds if jnp.issubdtype(kind, jnp.floating)))


def converted(params, scenario) -> tuple[Any, Any]:
    """params and scenario with every leaf an array of strong type and all floats of one type.

    Python numbers become floats; integer and bool arrays stay what they are. Raises TypeError for a leaf that
    is no number.
    """
    dtype = float_type((_numbers("params", params), _numbers("scenario", scenario)))

    def convert(leaf):
        kind = getattr(leaf, "dtype", bool if isinstance(leaf, bool) else dtype)
        wanted = dtype if jnp.issubdtype(kind, jnp.floating) else kind
        # NumPy where it will do: a hundred transfers to the device would take longer than a short sweep
        return jnp.asarray(leaf, wanted) if isinstance(leaf, jax.Array) else np.asarray(leaf, wanted)

    return jax.tree.map(convert, params), jax.tree.map(convert, scenario)


def _numbers(name: str, tree):
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if not isinstance(leaf, (bool, int, float, np.ndarray, np.generic, jax.Array)) or (
            isinstance(leaf, (np.ndarray, np.generic)) and leaf.dtype.kind not in "biuf"
        ):
            raise TypeError(f"`{name}{jax.tree_util.keystr(path)}` must be a number or an array, but it is {leaf!r}.")
    return tree


def lanes(scenarios) -> int:
    """Number of scenarios of a sweep: the last axis, which every leaf must carry."""
    leaves = jax.tree_util.tree_leaves_with_path(scenarios)
    if not leaves:
        raise ValueError("`scenarios` must hold at least one array, but it is empty.")
    shapes = {jax.tree_util.keystr(path): np.shape(leaf) for path, leaf in leaves}
    for path, shape in shapes.items():
        if not shape:
            raise ValueError(f"`scenarios{path}` must carry the scenarios in its last axis, but it is a single number.")
    n = max(shape[-1] for shape in shapes.values())
    for path, shape in shapes.items():
        if shape[-1] != n:
            raise ValueError(f"`scenarios{path}` must hold {n} scenarios in its last axis, but its shape is {shape}.")
    if n == 0:
        raise ValueError("`scenarios` must hold at least one scenario, but its last axis is empty.")
    return n
