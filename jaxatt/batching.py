"""A kernel with the scenarios in the last axis, called for one scenario.

Of a state with a large covariance `jax.vmap` makes slow loops: it batches component by component, wherever the batch
axis happens to lie. `lanes_last` batches the kernel of a part as a whole: a function written once for arrays that have
zero or more trailing axes, the lanes. Only the part knows of it; whoever calls the part sees one scenario.

May import: nothing of ours.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax.core import eval_jaxpr
from jax.custom_batching import custom_vmap


def lanes_last(kernel: Callable, f: Callable, example, *operands, smooth: Callable | None = None):
    """kernel(f, *operands) for one scenario; under `jax.vmap` the batch is the last axis of all that kernel sees.

    Args:
        kernel: a function of f and of arrays with trailing lanes that returns a tree of arrays with the same lanes.
        f: a function of one array of one scenario, ``example``. It may close over anything, tracers too; the kernel
            gets it as a function of an array with lanes.
        operands: arrays of one scenario, or trees of them.
        smooth: the kernel that is differentiated in place of ``kernel``, which may then use loops of traced length.
    """
    g, closure = hoisted(f, example)

    def run(g, closure, *operands):
        of = lambda kernel: lambda closure, *operands: kernel(partial(g, closure), *operands)
        if smooth is None:
            return of(kernel)(closure, *operands)
        fast = jax.custom_jvp(of(kernel))
        fast.defjvp(lambda primals, tangents: jax.jvp(of(smooth), primals, tangents))
        return fast(closure, *operands)

    @custom_vmap
    def one(closure, *operands):
        return run(g, closure, *operands)

    @one.def_vmap
    def many(n, batched, closure, *operands):
        if not any(jax.tree.leaves(batched)):  # as jvp without vmap asks for
            out = run(g, closure, *operands)
            return out, jax.tree.map(lambda _: False, out)
        on_closure, *on = batched

        def last(has, a):
            return jnp.moveaxis(a, 0, -1) if has else jnp.broadcast_to(jnp.asarray(a)[..., None], (*jnp.shape(a), n))

        axes = [-1 if has else None for has in on_closure]
        closure = [jnp.moveaxis(a, 0, -1) if has else a for has, a in zip(on_closure, closure)]
        over = jax.vmap(g, in_axes=(axes, -1), out_axes=-1, axis_size=n)
        out = run(over, closure, *jax.tree.map(last, tuple(on), operands))
        return jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), out), jax.tree.map(lambda _: True, out)

    return one(closure, *operands)


def in_lanes(kernel: Callable, *operands):
    """kernel(*operands) for one scenario, of trees of arrays; under `jax.vmap` the batch is the last axis of each."""
    return lanes_last(lambda _, *operands: kernel(*operands), lambda x: x, 0.0, *operands)


# Small matrices in a kernel: arrays (m, n, ...) whose trailing axes are the lanes.


def column(v, like):
    """The components of v as an array, each of the shape of ``like``."""
    return jnp.stack([jnp.broadcast_to(a, jnp.shape(like)) for a in v])


def matrix(m, like):
    """The matrix m, rows of components such as a `Mat3`, as an array whose entries have the shape of ``like``."""
    return jnp.stack([column(row, like) for row in m])


def times(m, rows) -> list:
    """m @ rows, a list of rows, of m by rows of k components, such as a `Mat3`, and ``rows`` (k, n, ...)."""
    return [sum(a * row for a, row in zip(by, rows)) for by in m]


def transposed(M):
    """The transpose."""
    return jnp.swapaxes(M, 0, 1)


def mask(pattern, like):
    """The ``pattern`` of bool, for as many lanes as an entry ``like`` has."""
    return jnp.asarray(pattern).reshape(*pattern.shape, *(1,) * jnp.ndim(like))


# closures


def hoisted(f: Callable, example) -> tuple[Callable, list]:
    """f without its closure: g and operands with g(operands, x) = f(x), for batching rules take no closures.

    `jax.closure_convert` does the same, but for floating numbers only.
    """
    program, shape = jax.make_jaxpr(f, return_shape=True)(example)
    tree, jaxpr = jax.tree.structure(shape), program.jaxpr  # g holds no consts, which are tracers

    def g(closure, x):
        return jax.tree.unflatten(tree, eval_jaxpr(jaxpr, closure, x))

    return g, list(program.consts)
