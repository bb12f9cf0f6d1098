"""Delays: a line of the latest samples, and the sample of a given age in it.

The line is held between ticks, an array (k,) with the newest sample first; its length bounds the age.

May import: nothing of ours.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def pushed(line, newest):
    """The line (k,) one tick later: ``newest`` comes first, the oldest sample drops out."""
    return jnp.concatenate([jnp.asarray(newest, line.dtype)[None], line[:-1]])


def delayed(line, age):
    """The sample that is ``age`` [ticks] old, between two samples linearly interpolated; differentiable in both.

    An age outside [0, k - 1] gives the newest or the oldest sample. An age that a few roundings part from a
    whole tick is that tick; its derivative is the one towards the older sample. NaN counts only where it is asked for.
    """
    last = line.shape[0] - 1
    age = jnp.clip(jnp.asarray(age, line.dtype), 0, last)
    held = jax.lax.stop_gradient(age)
    tick = jnp.round(held)
    age = age + jnp.where(jnp.abs(held - tick) <= 8 * jnp.finfo(line.dtype).eps * tick, tick - held, 0)
    held = jax.lax.stop_gradient(age)
    first = jnp.floor(held)
    number = jnp.arange(last + 1, dtype=line.dtype)
    newer, older = (jnp.sum(jnp.where(number == at, line, 0)) for at in (first, jnp.minimum(first + 1, last)))
    older = jnp.where((held > first) | jnp.isfinite(older), older, newer)
    return (1 - (age - first)) * newer + (age - first) * older
