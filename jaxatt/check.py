"""The door: what a user hands in is converted and checked here, before anything is compiled.

One grammar for every refusal: "`name` must be such, but it is value." Checks read concrete numbers; under a
transformation (jit, grad, vmap) there are none and they pass. Lanes trail: the message names the first
offending lane. name: what the message calls the argument; value: what was handed in; must and reason: words of the
message.

May import: nothing of ours.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from functools import wraps
from inspect import signature
from pathlib import Path
from traceback import walk_tb
from typing import Any, NoReturn, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def refuse(name: str, must: str, value, lane: int | None = None) -> NoReturn:
    """Raise the ValueError "`name` must ..., but it is value (in scenario lane)"."""
    where = "" if lane is None else f" in scenario {lane}"
    raise ValueError(f"`{name}` must {must}, but it is {value}{where}.")


def short(value) -> str:
    """A value in one short line."""
    if hasattr(value, "dtype") and hasattr(value, "shape") and value.shape:
        return f"an array of shape {value.shape} and type {value.dtype}"
    words = " ".join(repr(value).split())
    return words if len(words) <= 80 else f"{words[:77]}..."


def concrete(tree) -> bool:
    """Whether a tree holds numbers and no tracers."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def each(name: str, must: str, value, good) -> None:
    """Refuse the first of the concrete numbers ``value`` for which ``good`` is False."""
    value, good = np.broadcast_arrays(np.asarray(value), np.asarray(good))
    if not good.all():
        bad = tuple(int(i) for i in np.argwhere(~good)[0])
        refuse(name, must, f"{float(value[bad]):g}", bad[-1] if bad else None)


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
        each(name, f"lie in ({low:g}, {np.min(high):g}), {reason},", value, inside)


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
    kinds = {leaf.dtype for leaf in jax.tree.leaves(trees) if hasattr(leaf, "dtype")}
    return jnp.result_type(1.0, *(kind for kind in kinds if jnp.issubdtype(kind, jnp.floating)))


def precise(said: str, trees) -> None:
    """Warn of a run in float32, in which what ``said`` says goes wrong; Python shows it once per line of the caller.

    trees: the params and the scenario of the run.
    """
    if float_type(trees) == np.float32:
        way_out = "Run in float64: jax.config.update('jax_enable_x64', True)."
        warnings.warn(f"{said}. {way_out}", stacklevel=5)  # of simulate and sweep


def converted(params, scenario) -> tuple[Any, Any]:
    """params and scenario with every leaf an array of strong type and all floats of one type.

    Python numbers become floats; integer and bool arrays stay what they are. Raises TypeError for a leaf that
    is no number, or one of another size than 32 or 64 bits.
    """
    dtype = float_type((numbers("params", params), numbers("scenario", scenario)))

    def convert(leaf):
        kind = getattr(leaf, "dtype", bool if isinstance(leaf, bool) else dtype)
        wanted = dtype if jnp.issubdtype(kind, jnp.floating) else kind
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
    if type(value) is not wanted:
        raise TypeError(f"`{name}` must be a {wanted.__name__}, but it is {short(value)}.")


def shapes(params, scenario, params_like, scenario_like) -> tuple:
    """The lanes of a scenario: `lanes_of` both, where params carry none or, in a design study, the scenario's.

    params_like, scenario_like: examples of both.
    """
    lanes, its = lanes_of("scenario", scenario, scenario_like), lanes_of("params", params, params_like)
    if its not in ((), lanes):
        refuse("params", f"carry no lanes, or the scenario's, {lanes}", its)
    return lanes


def lanes_of(name: str, tree, example) -> tuple:
    """The lanes that the leaves of a tree carry behind the shapes of the example's: the same for all of them.

    Refuses another structure and integers in place of floats, with TypeError, and other shapes, with ValueError, by
    the name of the leaf. A part for which the example has None is passed over.
    """
    found = _lanes_found(name, tree, example)
    (first, lanes), *others = found
    for other, its in others:
        if its != lanes:
            refuse(other, f"carry the same lanes as `{first}`, {lanes}", its)
    return lanes


def _lanes_found(name: str, tree, example) -> list[tuple[str, tuple]]:
    if example is None:
        return []
    if hasattr(example, "_fields"):
        kind(name, tree, type(example))
        return [
            found
            for field, part, its_example in zip(example._fields, tree, example)
            for found in _lanes_found(f"{name}.{field}", part, its_example)
        ]
    if not is_number(tree):
        raise TypeError(f"`{name}` must be a number or an array, but it is {short(tree)}.")
    if hasattr(tree, "dtype") and not jnp.issubdtype(tree.dtype, jnp.floating):
        raise TypeError(f"`{name}` must be floating-point, but it is {short(tree)}.")
    shape, components = np.shape(tree), np.shape(example)
    if shape[: len(components)] != components:
        refuse(name, f"have shape ({''.join(f'{n}, ' for n in components)}*lanes)", shape)
    return [(name, shape[len(components) :])]


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


# the door of a function of numbers


F = TypeVar("F", bound=Callable)


def door(f: F) -> F:
    """f, but what it cannot work with is refused in one line that names the argument.

    Nothing is checked where f works, so that it costs nothing. What goes wrong in a function that a caller hands in
    is seen whole. An argument annotated with a NamedTuple must be one.
    """
    wanted = {
        name: ("" if p.annotation is p.empty else str(p.annotation)) + (" | None" if p.default is None else "")
        for name, p in signature(f).parameters.items()
    }

    @wraps(f)
    def at_the_door(*args, **kwargs):
        try:
            return f(*args, **kwargs)
        except (TypeError, ValueError, AttributeError, LookupError, ArithmeticError, NotImplementedError) as error:
            if isinstance(error, (jax.errors.JAXTypeError, jax.errors.JAXIndexError)):
                raise  # a tracer where a number is needed: no fault of the input
            if _from_outside(error, (*args, *kwargs.values())):
                raise
            said = " ".join(str(error).split())
            try:
                given = signature(f).bind(*args, **kwargs).arguments
            except TypeError as wrong:
                raise TypeError(f"`{f.__name__}` must be called as {f.__name__}{signature(f)}: {wrong}.") from None
            ours = isinstance(error, (TypeError, ValueError)) and said.startswith("`")
            if ours and {_subject(said), _subject(said) + "s"} & set(given):  # one of the labels is a label
                raise type(error)(said) from None
            _blame(f.__name__, given, wanted, said)

    return at_the_door  # pyright: ignore[reportReturnType]


def _from_outside(error: Exception, given) -> bool:
    """Whether the error arose in one of the functions given."""
    codes = {getattr(getattr(f, "func", f), "__code__", None) for f in given} - {None}
    return any(frame.f_code in codes for frame, _ in walk_tb(error.__traceback__))


def _subject(said: str) -> str:
    """The argument that a refusal names: what its first word begins with."""
    word = said[1:].split("`")[0]
    return "".join(c if c.isidentifier() or c.isdigit() else " " for c in word).split(" ")[0]


def _blame(called: str, given: dict, wanted: dict, said: str) -> NoReturn:
    for name, value in given.items():
        note = wanted[name]
        if value is None and "None" in note:
            continue
        kind = note.split("[")[0].split(" ")[0]
        a_tuple = kind.isidentifier() and kind[0].isupper() and kind not in ("Any", "Axes", "Sequence")
        its_type = (lambda a, k=kind: type(a).__name__ == k, f"a {kind}") if a_tuple else (lambda _: True, "")
        fits, what = KINDS.get(kind, its_type)
        if not fits(value):
            raise TypeError(f"`{name}` must be {what}, but it is {short(value)}.") from None
        if kind in ("Callable", "Axes") or "str" in note:
            continue
        for leaf in _leaves(value):
            a_key = name == "key" and jnp.issubdtype(getattr(leaf, "dtype", bool), jax.dtypes.prng_key)
            if not (is_number(leaf) or a_key or hasattr(leaf, "keys") or hasattr(leaf, "plot")):  # a table, axes
                raise TypeError(f"`{name}` must hold real numbers, but it holds {short(leaf)}.") from None
    shapes = ", ".join(f"`{name}` has {_shapes(value)}" for name, value in given.items())
    raise ValueError(f"`{called}` must get arguments that fit, but {shapes}: {said[:120]}") from None


KINDS = {
    "Callable": (callable, "a function"),
    "Mapping": (lambda a: isinstance(a, Mapping), "a mapping"),
    "str": (lambda a: isinstance(a, str), "a string"),
}  # what an annotation asks for, beside NamedTuples and numbers


def _shapes(value) -> str:
    shapes = sorted({str(np.shape(leaf)) for leaf in _leaves(value) if is_number(leaf)})
    return f"shape {' and '.join(shapes[:3])}" if shapes else short(value)


def _leaves(value) -> list:
    try:
        return jax.tree.leaves(value, is_leaf=lambda a: a is None)
    except ValueError:  # a dict whose keys have no order
        return [value]
