"""What the fields of a NamedTuple are, stated once, for readers and machines: unit, domain and shape.

    class Params(NamedTuple):
        k_q: Annotated[Any, "N m", positive] = 330.0  # attitude gain, eq. (10)
        h: Annotated[Any, "N m s", finite, (4,)] = np.zeros(4)  # wheel momenta

The first string is the unit, "1" for a pure number; a tuple is the shape of one scenario's value, () if there is none,
several for alternatives, a name in it, ("n",), for a length that fields share; functions of (name, value), most of them
of `jaxatt.check`, refuse what lies outside the domain; `jaxatt.check.instant` marks a time at which something starts or
ends. The comment holds the meaning. What no single field can say, a method ``check(name)`` of the NamedTuple refuses.

From it come the refusals of `simulate` and `sweep`, the units of stores, tables and figures, and the lists of fields in
the documentation. A field without such an annotation is not checked.

May import: check.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import jax
import numpy as np

from jaxatt import check


class Field(NamedTuple):
    """What is known of one field."""

    kind: Any  # `type`: its class where it is a NamedTuple, else None
    unit: str | None  # None where it is not annotated
    shapes: tuple[tuple, ...]  # allowed shapes of one scenario's value, where they are stated
    domain: tuple[Callable, ...]  # functions (name, value) that refuse
    instant: bool = False  # whether it is a time at which something starts or ends, `check.instant` in its domain


@lru_cache
def of(cls: type) -> dict[str, Field]:
    """The fields of a NamedTuple by name."""
    try:
        hints = get_type_hints(cls, include_extras=True)
    except NameError:  # a class made in a function, of names that are found there only
        hints = {}
    return {name: _field(hints.get(name, Any)) for name in cls._fields}  # pyright: ignore[reportAttributeAccessIssue]


def _field(hint) -> Field:
    base, *notes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    kind = base if isinstance(base, type) and hasattr(base, "_fields") else None
    units = [note for note in notes if isinstance(note, str)]
    shapes = tuple(note for note in notes if isinstance(note, tuple))
    domain = tuple(note for note in notes if callable(note))
    return Field(kind, units[0] if units else None, shapes, domain, check.instant in domain)


def units(cls_or_tree) -> dict[str, str]:
    """Units of the numbers of a NamedTuple by path: ``{"w.x": "rad/s", "k_q": "N m"}``; without those not annotated.

    cls_or_tree: a class, or an instance, whose nested values are followed too.
    """
    cls = cls_or_tree if isinstance(cls_or_tree, type) else type(cls_or_tree)
    found = {}
    for name, field in of(cls).items():
        value = None if cls is cls_or_tree else getattr(cls_or_tree, name)
        inner = value if hasattr(value, "_fields") else field.kind
        if inner is None:
            leaves = jax.tree_util.tree_leaves_with_path(value) if isinstance(value, (tuple, dict)) else [((), value)]
            if field.unit is not None:
                found |= {name + _dotted(path): field.unit for path, _ in leaves}
            continue
        within = units(inner)
        if field.unit is not None:
            paths = jax.tree_util.tree_leaves_with_path(inner) if not isinstance(inner, type) else []
            names = [_dotted(path)[1:] for path, _ in paths] or list(_names(inner))
            within = {path: field.unit for path in names} | within
        found |= {f"{name}.{path}": unit for path, unit in within.items()}
    return found


def _names(cls) -> list[str]:
    return [n for name, f in of(cls).items() for n in ([f"{name}.{m}" for m in _names(f.kind)] if f.kind else [name])]


def _dotted(path) -> str:
    text = jax.tree_util.keystr(path, simple=True, separator=".")
    return f".{text}" if text else ""


def named(tree, alone: str) -> dict:
    """The leaves of a tree by name: ``delay``, ``main.delay``, ``spans.0``; alone: the name of a single leaf."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator=".") or alone: leaf for path, leaf in leaves}


def units_within(tree) -> dict[str, str]:
    """The units that the NamedTuples of any tree state, by the names of `named`."""
    parts = jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda node: hasattr(node, "_fields"))
    found = {}
    for path, part in parts:
        at = jax.tree_util.keystr(path, simple=True, separator=".")
        if hasattr(part, "_fields"):
            found |= {f"{at}.{name}" if at else name: unit for name, unit in units(part).items()}
    return found


def instants(tree, put: Callable):
    """The tree with put(a) in place of every leaf a of the fields that are instants."""
    if not hasattr(tree, "_fields"):
        part = lambda node: hasattr(node, "_fields")
        return jax.tree.map(lambda node: instants(node, put) if part(node) else node, tree, is_leaf=part)
    parts = [
        jax.tree.map(put, value) if known.instant else instants(value, put)
        for known, value in zip(of(type(tree)).values(), tree)
    ]
    return tree._make(parts)


def validate(name: str, tree, n: int | None = None) -> None:
    """Refuse what the fields of a NamedTuple do not allow, by the name of the first: type, shape, domain.

    tree: of any depth; parts that are no NamedTuple are passed over. n: number of scenarios, in the last axis of every
    leaf; None for a single one. None is refused where it is not the default. Raises TypeError for another type,
    ValueError for the rest.
    """
    _validate(name, tree, () if n is None else (n,), {})


def _validate(name: str, tree, batch: tuple, lengths: dict, shapes: tuple | None = None) -> None:
    if not hasattr(tree, "_fields"):
        if isinstance(tree, tuple):
            for i, part in enumerate(tree):
                _validate(f"{name}[{i}]", part, batch, lengths, shapes)
        elif shapes is not None and tree is not None:
            if not check.is_number(tree):
                raise TypeError(f"`{name}` must be a number or an array, but it is {check.short(tree)}.")
            _shaped(name, tree, batch, lengths, shapes)
        return
    for (field, known), value in zip(of(type(tree)).items(), tree):
        here = f"{name}.{field}"
        stated = known.unit is not None or known.domain
        wanted = known.shapes or shapes or (((),) if stated else None)
        if value is None and type(tree)._field_defaults.get(field, 0) is None:
            continue
        if known.kind is not None:
            check.kind(here, value, known.kind)
        if value is None and wanted is not None:
            raise TypeError(f"`{here}` must be a number or an array, but it is None.")
        _validate(here, value, batch, lengths, wanted)
        for rule in known.domain:
            rule(here, value)
    if hasattr(tree, "check"):
        tree.check(name)


def _shaped(name: str, leaf, batch: tuple, lengths: dict, shapes: tuple) -> None:
    found = np.shape(leaf)
    own = found[: len(found) - len(batch)] if batch and found[-1:] == batch else (found if not batch else None)
    for shape in shapes:
        if own is not None and len(own) == len(shape):
            bound = dict(lengths)
            if all((bound.setdefault(a, b) if isinstance(a, str) else a) == b for a, b in zip(shape, own)):
                lengths |= bound
                return
    wanted = " or ".join(
        "(" + ", ".join(str(lengths.get(a, a)) for a in shape) + ("," * (len(shape) == 1)) + ")" for shape in shapes
    )
    told = f"{wanted} in each scenario" if batch else wanted
    shown = (found[-1:] + found[:-1]) if batch else found
    shared = "the same in all scenarios; `jaxatt.varied` takes others"
    many = shared if name.startswith("params") else "one scenario; `jaxatt.sweep` takes many"
    way_out = "" if batch or len(found) <= max(map(len, shapes)) else f": {many}"
    check.refuse(name, f"have shape {told}{way_out}", f"of shape {shown}")
