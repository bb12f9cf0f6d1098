"""Delays: a line of the latest samples, and the sample of a given age in it.

The line is held between ticks, an array (k,) with the newest sample first; its length bounds the age.

May import: nothing of ours.
"""

from __future__ import annotations

import jax.numpy as jnp


def pushed(line, newest):
    """The line (k,) one tick later: ``newest`` comes first, the oldest sample drops out."""
    return jnp.concatenate([jnp.asarray(newest, line.dtype)[None], line[:-1]])


def delayed(line, age):
    """The sample that is ``age`` [ticks] old, between two samples linearly interpolated; differentiable in both.

    An age outside [0, k - 1] gives the newest or the oldest sample. NaN counts only where it is asked for.
    """
    last = line.shape[0] - 1
    weight = jnp.maximum(
        1 - jnp.abs(jnp.arange(last + 1, dtype=line.dtype) - jnp.clip(jnp.asarray(age, line.dtype), 0, last)), 0
    )
    return jnp.sum(weight * jnp.where(weight > 0, line, 0))
