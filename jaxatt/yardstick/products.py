"""Products with constant matrices that stay part of one compiled loop when a sweep runs many days at once.

A product that the CPU compiler hands to its library breaks the loop of a sweep into hundreds of separate calls, which
cost more than the product; sums over the columns do not.

May import: batching.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from jaxatt.batching import in_lanes


@custom_vmap
def product(M, x):
    """M x of a constant matrix or a stack of them (..., m, k) and as many vectors (..., k)."""
    return jnp.einsum("...ij,...j->...i", M, x)


@product.def_vmap
def _(n, batched, M, x):
    if batched[0] or not batched[1]:
        M = M if batched[0] else jnp.broadcast_to(M, (n, *M.shape))
        x = x if batched[1] else jnp.broadcast_to(x, (n, *x.shape))
        return jnp.einsum("...ij,...j->...i", M, x), True
    columns, x = jnp.moveaxis(jnp.asarray(M), -1, 0), jnp.moveaxis(x, (0, -1), (-1, 0))  # (k, ..., m) and (k, ..., n)
    nothing = jnp.zeros((*M.shape[:-1], n), x.dtype)
    found = jax.lax.fori_loop(0, len(columns), lambda k, a: a + columns[k][..., None] * x[k][..., None, :], nothing)
    return jnp.moveaxis(found, -1, 0), True


def pushed(line, new):
    """The line (N, ...), oldest first, without its oldest and with ``new`` (...)."""
    return in_lanes(lambda line, new: jnp.concatenate([line[1:], new[None]]), line, new)


@custom_vmap
def correlations(filters, line):
    """Sums over the last l of the rows of a line against filters (l, types, channels), (types, axes) for each of them.

    line: (N, channels, axes), oldest first; filters: a tuple of several lengths l <= N.
    """
    return [jnp.einsum("ltc,lca->ta", f, line[len(line) - len(f) :]) for f in filters]


@correlations.def_vmap
def _(n, batched, filters, line):
    if any(jax.tree.leaves(batched[0])) or not batched[1]:
        f, x = (0 if has else None for has in (any(jax.tree.leaves(batched[0])), batched[1]))
        out = jax.vmap(lambda *a: correlations.fun(*a), in_axes=(f, x))(filters, line)
        return out, [True] * len(filters)
    line, found = jnp.moveaxis(line, 0, -1), []
    filters = [jnp.asarray(f) for f in filters]
    for f in filters:
        span, types, channels = f.shape
        start = len(line) - span

        def row(j, a, f=f, start=start, channels=channels):
            here, by = line[start + j], f[j]
            return a + sum(by[:, c, None, None] * here[c] for c in range(channels))

        found.append(jax.lax.fori_loop(0, span, row, jnp.zeros((types, *line.shape[2:]), line.dtype)))
    return [jnp.moveaxis(a, -1, 0) for a in found], [True] * len(filters)
