"""A function with many results over the lanes as one loop of the CPU.

XLA's compiler for CPUs makes a loop over the lanes for every result, and each of them reads and works out again what
several results share. One operation of XLA has any number of results and a body of our own: a reduction over windows of
one element. Its body here is the function, written out in scalars: one loop, on vectors, that works nothing out twice. It
has no derivative; programs that are differentiated do without.

May import: compiling.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial, reduce
from math import prod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.extend.core import Literal

from jaxatt.compiling import OVERLAP_CHECKS

MOST = 4000  # operations of a body, whose compilation takes longer than in proportion to them
WIDEST = 64  # operands: the loop runs on vectors where no result overlaps an operand, which is checked pair by pair

_ALIKE = """
abs add and atan atan2 ceil clamp convert_element_type cos cosh div eq exp expm1 floor ge gt integer_pow is_finite le log
log1p logistic lt max min mul ne neg not or pow rem round rsqrt select_n sign sin sinh sqrt square sub tan tanh xor
""".split()  # noqa: SIM905
_MOVING = "broadcast_in_dim concatenate expand_dims reshape rev slice squeeze stack transpose unstack".split()  # noqa: SIM905
_FOLDING = {"reduce_sum": lax.add, "reduce_max": lax.max, "reduce_min": lax.min}
_CALLS = {"jit": "jaxpr", "custom_jvp_call": "call_jaxpr"}
_SAME = ("copy", "optimization_barrier", "stop_gradient")


class _NotScalar(Exception):
    """An operation that is not written out in scalars."""


class _Small(NamedTuple):
    """A small array as its entries."""

    shape: tuple
    entries: list  # scalars, row by row

    @classmethod
    def of(cls, array):
        return cls(np.shape(array), list(np.asarray(array).reshape(-1)))


def available() -> bool:
    """Whether this process compiles such loops to vectors: on a CPU, with the flags of `jaxatt.configure`."""
    running = not jax.config.jax_disable_jit and jax.default_backend() == "cpu"  # pyright: ignore[reportAttributeAccessIssue]
    return running and OVERLAP_CHECKS in os.environ.get("XLA_FLAGS", "")


def advanced(f: Callable, n: int, shared, held, x, times):
    """x after x = f(shared, held, x, t) for each t of times, over n lanes; None where f cannot be one loop.

    f: a function of one scenario, of element-wise arithmetic on small arrays. shared: a tree of arrays that all lanes
    share, or of numbers; held, x: trees of arrays (..., n); times: (steps,) numbers.
    """
    inside = lambda a: jax.ShapeDtypeStruct(np.shape(a)[:-1], a.dtype)
    shared = jax.tree.map(lambda a: jnp.asarray(a, times.dtype if isinstance(a, float) else None), shared)
    told = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), shared)
    moved = jax.tree.leaves(x)
    if not moved or any(a.size == 0 for a in moved):
        return None
    try:
        with jax.disable_jit():  # loops of fixed length are written out, and nothing is set apart
            program = jax.make_jaxpr(f)(told, *jax.tree.map(inside, (held, x)), jax.ShapeDtypeStruct((), times.dtype))
    except Exception:  # the other way to run f says what is wrong with it
        return None
    common = [a for leaf in jax.tree.leaves(shared) for a in jnp.reshape(leaf, -1)]
    rows = [a for leaf in jax.tree.leaves(held) if np.size(leaf) for a in jnp.reshape(leaf, (-1, n))]
    moving = [a for leaf in moved for a in jnp.reshape(leaf, (-1, n))]
    scalars = [jax.ShapeDtypeStruct((), a.dtype) for a in (*common, *rows, *moving, times)]
    try:
        body = jax.make_jaxpr(partial(_written_out, program))(*scalars).jaxpr
    except _NotScalar:
        return None
    equations, used = _needed(body)
    first, last = len(common), len(common) + len(rows)
    operands, loads = _packed(rows, [first + i for i in range(len(rows)) if used[first + i]], first)
    numbers = [i for i in (*range(first), len(scalars) - 1) if used[i]]
    operands, places = _placed([*moving, *operands], [scalars[i].dtype for i in numbers])
    if len(equations) > MOST or len(operands) > WIDEST:
        return None
    held_operands, k = operands[len(moving) :], len(moving)
    types = [a.dtype for a in held_operands]

    def step(moving, t):
        all_operands = (*moving, *held_operands)
        starts = [jnp.zeros((), a.dtype) for a in all_operands]
        for i, place in zip(numbers, places):
            starts[place] = t if i == len(scalars) - 1 else common[i]

        def entry(start, here):
            env = dict(zip(body.invars[last:], here[:k]))
            for load, word in zip(loads, here[k:]):
                env |= zip((body.invars[i] for i in load), _unpacked(word) if len(load) == 2 else [word])
            env |= zip((body.invars[i] for i in numbers), (start[place] for place in places))
            read = lambda v: np.asarray(v.val) if isinstance(v, Literal) else env[v]
            for e in equations:
                env[e.outvars[0]] = e.primitive.bind(*map(read, e.invars), **e.params)
            return (*map(read, body.outvars), *(jnp.zeros((), dtype) for dtype in types))

        return list(lax.reduce_window(all_operands, tuple(starts), entry, (1,), (1,), "VALID")[:k])

    moving, _ = lax.scan(lambda moving, t: (step(moving, t), None), moving, times)
    entries = iter(moving)
    joined = [jnp.stack([next(entries) for _ in range(prod(a.shape[:-1]))]).reshape(a.shape) for a in moved]
    return jax.tree.unflatten(jax.tree.structure(x), joined)


def _packed(rows: list, used: list[int], first: int) -> tuple[list, list]:
    """Operands for the rows that are used, and the numbers that each holds: of float32 two in a word of 64 bits."""
    short = [i for i in used if rows[i - first].dtype == jnp.float32]
    pairs = list(zip(short[::2], short[1::2])) if jax.dtypes.canonicalize_dtype(np.uint64) == np.uint64 else []
    alone = [i for i in used if not any(i in pair for pair in pairs)]
    bits = lambda i: lax.bitcast_convert_type(rows[i - first], jnp.uint32).astype(jnp.uint64)
    words = [bits(low) | (bits(high) << np.uint64(32)) for low, high in pairs]
    return [*words, *(rows[i - first] for i in alone)], [*pairs, *((i,) for i in alone)]


def _unpacked(word) -> list:
    """The two numbers of float32 in a word of 64 bits."""
    part = lambda bits: lax.bitcast_convert_type(bits.astype(jnp.uint32), jnp.float32)
    return [part(word), part(word >> np.uint64(32))]


def _placed(operands: list, types: list) -> tuple[list, list[int]]:
    """Operands, more where they do not suffice, and for each number that all lanes share one whose start it can be."""
    free, places = dict(enumerate(operands)), []
    for dtype in types:
        place = next((i for i, a in free.items() if a.dtype == dtype), len(operands))
        if place == len(operands):
            operands = [*operands, jnp.zeros(operands[0].shape, dtype)]
        free.pop(place, None)
        places.append(place)
    return operands, places


def _needed(body) -> tuple[list, list[bool]]:
    """The equations that the results of a program of scalars need, and which of its inputs."""
    needed, equations = {v for v in body.outvars if not isinstance(v, Literal)}, []
    for e in reversed(body.eqns):
        if e.outvars[0] in needed:
            equations.append(e)
            needed |= {v for v in e.invars if not isinstance(v, Literal)}
    return equations[::-1], [v in needed for v in body.invars]


# a program written out in scalars


def _written_out(program, *scalars) -> list:
    """The entries of the results of a program, of those of its inputs."""
    entries = iter(scalars)
    given = [_Small(v.aval.shape, [next(entries) for _ in range(prod(v.aval.shape))]) for v in program.jaxpr.invars]
    return [a for result in _evaluated(program, given) for a in result.entries]


def _evaluated(program, given: list[_Small]) -> list[_Small]:
    if any(isinstance(a, Tracer) for a in program.consts):
        raise _NotScalar  # of a program around this one
    env: dict[Any, _Small] = dict(zip(program.jaxpr.invars, given))
    env |= zip(program.jaxpr.constvars, map(_Small.of, program.consts))
    read = lambda v: _Small.of(v.val) if isinstance(v, Literal) else env[v]
    for e in program.jaxpr.eqns:
        env |= zip(e.outvars, _results(e, [read(v) for v in e.invars]))
    return [read(v) for v in program.jaxpr.outvars]


def _results(e, given: list[_Small]) -> list[_Small]:
    """Results of one equation, in scalars. Raises `_NotScalar` for an operation that is not written so."""
    name, shape = e.primitive.name, e.outvars[0].aval.shape
    if name in _ALIKE:
        spread = [a.entries * prod(shape) if a.shape == () else a.entries for a in given]
        return [_Small(shape, [e.primitive.bind(*each, **e.params) for each in zip(*spread)])]
    if name in _MOVING:  # where each entry comes from: the same operation on their numbers
        ends = np.cumsum([0, *(len(a.entries) for a in given)])
        with jax.ensure_compile_time_eval():
            numbers = [jnp.arange(at, at + len(a.entries)).reshape(a.shape) for at, a in zip(ends, given)]
            out = e.primitive.bind(*numbers, **e.params)
        sources = [np.asarray(a).reshape(-1) for a in (out if e.primitive.multiple_results else [out])]
        entries = [a for part in given for a in part.entries]
        return [_Small(v.aval.shape, [entries[i] for i in at]) for v, at in zip(e.outvars, sources)]
    if name in _FOLDING:
        numbers = np.arange(prod(given[0].shape)).reshape(given[0].shape)
        axes = e.params["axes"]
        groups = np.moveaxis(numbers, axes, range(len(axes))).reshape(-1, prod(shape)).T
        return [_Small(shape, [reduce(_FOLDING[name], [given[0].entries[i] for i in group]) for group in groups])]
    if name in _CALLS:
        return _evaluated(e.params[_CALLS[name]], given)
    if name in _SAME:
        return given
    raise _NotScalar(name)
