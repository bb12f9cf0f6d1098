"""Checks of what a user hands in, before anything is compiled.

One grammar for every refusal: "`name` must be such, but it is value." Checks read concrete numbers; under a
transformation (jit, grad, vmap) there are none and they pass. Of many numbers the message names the first one that is
refused. name: what the message calls the argument; value: what was handed in; must and reason: words of the message.

May import: nothing of ours.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.dtypes import prng_key


def refuse(name: str, must: str, value) -> NoReturn:
    """Raise the ValueError "`name` must ..., but it is value."."""
    raise ValueError(" ".join(f"`{name}` must {must}, but it is {value}.".splitlines()))


def short(value) -> str:
    """A value in one short line."""
    if hasattr(value, "dtype") and hasattr(value, "shape") and value.shape:
        return f"an array of shape {value.shape} and type {value.dtype}"
    words = " ".join(repr(value).split())
    return words if len(words) <= 80 else f"{words[:77]}..."


def concrete(tree) -> bool:
    """Whether a tree holds numbers and no tracers."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


_run: ContextVar[tuple] = ContextVar(
    "of what is checked: number of scenarios, whether params are shared, time of the last tick [s]",
    default=(None, False, 0.0),
)


@contextmanager
def scenarios(n: int | None, params: Any = (), end: float = 0.0):
    """Within it, the last axis of length n of what is checked holds the scenarios; None: there is just one.

    params: what is named so and shared by the scenarios; () where there is nothing. end: see `last_tick`.
    """
    token = _run.set((n, bool(jax.tree.leaves(params)), end))
    try:
        yield
    finally:
        _run.reset(token)


def last_tick() -> float:
    """Time of the last tick [s] of the run that a loop's ``check`` is called for; 0 where no run is meant."""
    return _run.get()[2]


def each(name: str, must: str, value, good) -> None:
    """Refuse the first of the concrete numbers ``value`` for which ``good`` is False."""
    value, good = np.broadcast_arrays(np.asarray(value), np.asarray(good))
    if not good.all():
        bad = tuple(int(i) for i in np.argwhere(~good)[0])
        at, where = _place_of(name, bad, value.shape)
        raise ValueError(f"`{name}{at}` must {must}, but it is {float(value[bad]):g}{where}.")


def pair(name: str, must: str, value, other, holds) -> None:
    """Refuse the first number of ``value`` of which holds(value, other) is False; tracers pass."""
    if concrete((value, other)):
        each(name, must, value, holds(np.asarray(value), np.asarray(other)))


def _place_of(name: str, index: tuple, shape: tuple) -> tuple[str, str]:
    """Where in an array an index lies: the words behind the name, and those that tell the scenario."""
    (n, shared, _), where = _run.get(), ""
    if n is not None and shape[-1:] == (n,) and not (shared and name.lstrip("|").startswith("params")):
        index, where = index[:-1], f" in scenario {index[-1]}"
    return (f"[{', '.join(map(str, index))}]" if index else ""), where


def is_key(value) -> bool:
    """Whether the value is a typed key of JAX's random numbers, which is an array and holds no numbers."""
    return hasattr(value, "dtype") and jnp.issubdtype(value.dtype, prng_key)


def real(name: str, value) -> np.ndarray:
    """The value as an array; refuses, with TypeError, what holds no real numbers."""
    try:
        a = np.asarray(value)
    except (TypeError, ValueError):
        a = np.asarray(None)
    if a.dtype.kind not in "biuf":
        raise TypeError(f"`{name}` must hold real numbers, but it is {short(value)}.")
    return a


def number(name: str, value) -> float:
    """Refuse what is not one real number; return it as float."""
    a = real(name, value)
    if a.shape != ():
        refuse(name, "be one number", short(value))
    return float(a)


def fits(name: str, value, other: str, against) -> None:
    """Refuse a value that does not broadcast with ``against``, the value of ``other``."""
    shape, there = np.shape(value), np.shape(against)
    if any(1 != m != n != 1 for m, n in zip(shape[::-1], there[::-1])):
        refuse(name, f"have a shape that fits that of `{other}`, {there}", f"of shape {shape}")


def positive(name: str, value) -> None:
    """Refuse numbers that are not finite and > 0."""
    if concrete(value):
        value = real(name, value)
        each(name, "be a positive number", value, (value > 0) & np.isfinite(value))


def not_negative(name: str, value) -> None:
    """Refuse numbers that are not >= 0; inf passes."""
    if concrete(value):
        value = real(name, value)
        each(name, "not be negative", value, value >= 0)


def above(name: str, value, least: float, reason: str) -> None:
    """Refuse numbers that are not > least; inf passes."""
    if concrete(value):
        value = real(name, value)
        each(name, f"be greater than {least:g} ({reason})", value, value > least)


def between(name: str, value, low: float, high, reason: str) -> None:
    """Refuse numbers outside the open interval (low, high); reason says what bounds it."""
    if concrete((value, high)):
        value, high = real(name, value), np.asarray(high)
        inside = (value > low) & (value < high)
        met = np.broadcast_to(high, inside.shape)[~inside][:1]  # by the first that is refused
        each(name, f"lie in ({low:g}, {met.sum():g}), {reason}", value, inside)


def acute(name: str, value) -> None:
    """Refuse angles [rad] outside 0 to 90 deg."""
    between(name, value, 0, np.pi / 2, "0 to 90 deg in rad")


def one_of(name: str, value, allowed: tuple) -> None:
    """Refuse numbers that are none of the allowed ones."""
    if concrete(value):
        value = real(name, value)
        each(name, f"be one of {allowed}", value, np.isin(value, allowed))


def finite(name: str, tree) -> None:
    """Refuse NaN and infinities anywhere in a tree, by the path of the leaf."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if concrete(leaf):
            leaf = real(name + jax.tree_util.keystr(path), leaf)
            each(name + jax.tree_util.keystr(path), "be finite", leaf, np.isfinite(leaf))


def a_number(name: str, tree) -> None:
    """Refuse NaN anywhere in a tree, by the path of the leaf; infinities pass."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if concrete(leaf):
            leaf = real(name + jax.tree_util.keystr(path), leaf)
            each(name + jax.tree_util.keystr(path), "be a number", leaf, ~np.isnan(leaf))


def instant(name: str, value) -> None:
    """Refuse NaN, infinities pass; marks the field as an instant, which the engine takes as the tick's that it means."""
    a_number(name, value)


def moments(name: str, matrix) -> np.ndarray | None:
    """Principal moments, ascending, shape (3,) of an inertia given as three rows, first axis; None for tracers.

    Refuses a matrix that is not symmetric or not positive definite, and moments that no body has: each is at most the
    sum of the other two (a plate reaches it).
    """
    if not concrete(matrix):
        return None
    finite(name, matrix)
    entries = np.stack(np.broadcast_arrays(*(np.asarray(a, float) for row in matrix for a in row)))
    m = np.moveaxis(entries.reshape(3, 3, *entries.shape[1:]), (0, 1), (-2, -1))
    size = np.abs(m).max((-1, -2))
    skew = np.abs(m - np.swapaxes(m, -1, -2)).max((-1, -2))
    each(name, "be symmetric (largest difference to its transpose 0)", skew, skew <= 1e-6 * size)
    principal = np.moveaxis(np.linalg.eigvalsh(m), -1, 0)
    each(name, "be positive definite (smallest principal moment > 0)", principal[0], principal[0] > 0)
    excess = principal[2] - principal[0] - principal[1]
    must = "have no principal moment above the sum of the other two (no body is thinner than a plate; excess 0)"
    each(name, must, excess, excess <= 1e-5 * size)
    return principal


def inertia(name: str, matrix) -> None:
    """Refuse a matrix that is the inertia of no body: see `moments`.

    Products of inertia are the tensor's own entries, J_xy = -sum(m x y); a mass-properties tool may list them without the
    minus sign.
    """
    moments(name, matrix)


def limit(name: str, value) -> None:
    """Refuse a limit that is not > 0; inf stands for no limit."""
    above(name, value, 0, "inf for no limit")


def flag(name: str, value) -> None:
    """Refuse numbers other than 0 and 1."""
    one_of(name, value, (0, 1))


def share(name: str, value) -> None:
    """Refuse numbers outside [0, 1]."""
    if concrete(value):
        value = real(name, value)
        each(name, "lie in [0, 1]", value, (value >= 0) & (value <= 1))


def unit(name: str, v, tolerance: float = 1e-5) -> None:
    """Refuse a vector or quaternion v, given by components, whose length is not 1 within the tolerance."""
    if concrete(v):
        length = _length(name, v)
        each(f"|{name}|", "be 1", length, np.abs(length - 1) <= tolerance)


def mrp(name: str, q) -> None:
    """Refuse modified Rodrigues parameters that are not finite or longer than 10, which are degrees by mistake.

    |q| = tan(angle / 4) <= 1 describes every attitude; beyond it lies the shadow set.
    """
    if concrete(q):
        length = _length(name, q)
        each(f"|{name}|", "be at most 10 (an MRP is tan(angle/4), 1 for half a turn)", length, length <= 10)


def _length(name: str, v) -> np.ndarray:
    finite(name, v)
    return np.sqrt(sum(np.square(np.asarray(a, float)) for a in v))


def whole(name: str, value, least: int = 1) -> int:
    """Refuse what is not a whole number >= least, or more than 32 bits can count; return it as int."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        refuse(name, f"be a whole number of at least {least}", short(value))
    if value >= 2**31:
        refuse(name, "be less than 2147483648", short(value))
    return int(value)


def wholes(name: str, values, least: int = 1) -> list[int]:
    """Refuse values that are not whole numbers >= least, at least one of them; return them as a list."""
    values = list(values) if np.iterable(values) else []
    if not values:
        refuse(name, "hold at least one whole number", short(values))
    return [whole(f"{name}[{i}]", value, least) for i, value in enumerate(values)]


def place(name: str, value) -> Path:
    """Refuse, with TypeError, what names no file or folder; return it as a path."""
    if not isinstance(value, (str, Path)) or "\0" in str(value):
        raise TypeError(f"`{name}` must be a path, but it is {short(value)}.")
    return Path(value)


def new_file(name: str, value) -> Path:
    """Refuse what names no file in a folder that is there; return it as a path."""
    path = place(name, value)
    if path.is_dir() or not path.parent.is_dir():
        refuse(name, "name a file in a folder that is there", repr(str(path)))
    return path


def mapping(name: str, value) -> None:
    """Refuse, with TypeError, what is not a mapping."""
    if not isinstance(value, Mapping):
        raise TypeError(f"`{name}` must be a mapping, such as a dict, but it is {short(value)}.")


def function(name: str, value) -> None:
    """Refuse, with TypeError, what cannot be called."""
    if not callable(value):
        raise TypeError(f"`{name}` must be a function, but it is {short(value)}.")


def fits_memory(name: str, takes: int, way_out: str) -> None:
    """Refuse a result that takes more bytes than are free; name: of what it holds, way_out: what to do instead."""
    free = free_memory()
    if takes > free:
        raise ValueError(f"{name} takes {takes / 1e9:.3g} GB, but {free / 1e9:.3g} GB of memory are free: {way_out}.")


def free_memory() -> float:
    """Bytes of memory that are free on the device of a run; inf where nobody can tell."""
    if jax.default_backend() != "cpu":
        stats = jax.local_devices()[0].memory_stats() or {}
        return stats.get("bytes_limit", np.inf) - stats.get("bytes_in_use", 0)
    try:
        with open("/proc/meminfo") as file:
            lines = dict(line.split(":") for line in file)
        return 1024.0 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return np.inf


def float_type(trees):
    """The floating type of a run: what the floating leaves promote to; Python numbers follow the others."""
    kinds = {jax.dtypes.canonicalize_dtype(leaf.dtype) for leaf in jax.tree.leaves(trees) if hasattr(leaf, "dtype")}
    return jnp.result_type(1.0, *(kind for kind in kinds if jnp.issubdtype(kind, jnp.floating)))


def precise(said: str, trees) -> None:
    """Warn of a run in float32, in which what ``said`` says goes wrong; Python shows it once per line of the caller.

    trees: the params and the scenario of the run.
    """
    if float_type(trees) == np.float32:
        warn(f"{said}. Run in float64: jax.config.update('jax_enable_x64', True).")


def warn(message: str) -> None:
    """Warn of what is allowed and likely wrong, at the line that called jaxatt from outside."""
    here, frame, level = str(Path(__file__).parent), sys._getframe(), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith(here):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)


def converted(params, scenario) -> tuple[Any, Any]:
    """params and scenario with every leaf an array of strong type and all floats of one type.

    Python numbers become floats; integer and bool arrays stay what they are. Raises TypeError for a leaf that
    is no number, or one of another size than 32 or 64 bits.
    """
    dtype = float_type((numbers("params", params), numbers("scenario", scenario)))

    def convert(leaf):
        kind = getattr(leaf, "dtype", bool if isinstance(leaf, bool) else dtype)
        wanted = dtype if jnp.issubdtype(kind, jnp.floating) else kind
        if isinstance(leaf, jax.Array) and leaf.dtype == wanted and not leaf.weak_type:
            return leaf
        # NumPy where it will do: a hundred transfers to the device would take longer than a short sweep
        return jnp.asarray(leaf, wanted) if isinstance(leaf, jax.Array) else np.asarray(leaf, wanted)

    return jax.tree.map(convert, params), jax.tree.map(convert, scenario)


def numbers(name: str, tree):
    """The tree, if all of its leaves are numbers, floats of 32 or 64 bits; TypeError, by the leaf's path, if not."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if not is_number(leaf):
            raise TypeError(
                f"`{name}{jax.tree_util.keystr(path)}` must be a number or an array, but it is {short(leaf)}."
            )
        if hasattr(leaf, "dtype") and leaf.dtype.kind not in "biu" and leaf.dtype not in (np.float32, np.float64):
            raise TypeError(f"`{name}{jax.tree_util.keystr(path)}` must be float32 or float64, but it is {leaf.dtype}.")
    return tree


def is_number(leaf) -> bool:
    """Whether a leaf is a real number or an array of them that a float can hold."""
    if isinstance(leaf, (np.ndarray, np.generic)):
        return leaf.dtype.kind in "biuf"
    if isinstance(leaf, jax.Array):
        return any(jnp.issubdtype(leaf.dtype, kind) for kind in (jnp.bool_, jnp.integer, jnp.floating))
    return isinstance(leaf, (bool, float)) or (isinstance(leaf, int) and abs(leaf) < 2**63)


def kind(name: str, value, wanted: type) -> None:
    """Refuse, with TypeError, what is not of the wanted type."""
    was = type(value)
    if was is not wanted:
        anew = (was.__module__, was.__qualname__) == (wanted.__module__, wanted.__qualname__)
        said = (
            f"of a {wanted.__name__} that has been defined anew: make it again after a reload" if anew else short(value)
        )
        raise TypeError(f"`{name}` must be a {wanted.__name__}, but it is {said}.")


def kinds(params, Params: type, scenario, Scenario: type) -> None:
    """Refuse, with TypeError, params and scenarios of another loop."""
    if type(scenario) is tuple and [type(part) for part in scenario] == [Params, Scenario]:
        raise TypeError(
            "`scenario` must be a Scenario, but it is a pair (params, scenario): `jaxatt.varied` takes pairs."
        )
    kind("params", params, Params)
    kind("scenario", scenario, Scenario)


def batch_size(name: str, scenarios) -> int:
    """Number n of scenarios of a sweep, with which every leaf must lead; ValueError, by the leaf's path, if not."""
    leaves = jax.tree_util.tree_leaves_with_path(scenarios)
    if not leaves:
        raise ValueError(f"`{name}` must hold at least one array, but it is empty.")
    shapes = {jax.tree_util.keystr(path): np.shape(leaf) for path, leaf in leaves}
    for path, shape in shapes.items():
        if not shape:
            refuse(
                name + path, "lead with the scenarios, shape (n, ...)", "a single number: see `jax.vmap(draw)(keys)`"
            )
    n = max(shape[0] for shape in shapes.values())
    for path, shape in shapes.items():
        if shape[0] != n:
            refuse(name + path, f"lead with the same {n} scenarios as the other leaves", f"of shape {shape}")
    if n == 0:
        refuse(name, "hold at least one scenario", "empty")
    return n
