"""Delays: a line of the latest samples, and the sample of a given age in it; sensors that read now and then.

The line is held between ticks, an array (k,) with the newest sample first, or a tree of such arrays; its length bounds
the age.

May import: check.
"""

from __future__ import annotations

from functools import reduce

import jax
import jax.numpy as jnp

from jaxatt import check


def pushed(line, newest):
    """The line (k,) one tick later: ``newest`` comes first, the oldest sample drops out.

    Both may be trees of one structure, such as a `jaxatt.faults.Reading` with its flag.
    """
    return jax.tree.map(lambda a, new: jnp.concatenate([jnp.asarray(new, a.dtype)[None], a[:-1]]), line, newest)


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


# readings that come late or seldom


def empty_line(reading, k: int):
    """A line of k readings like this reading, any tree of numbers and flags: zeros, and no flag is up."""
    return jax.tree.map(lambda a: jnp.zeros((k, *jnp.shape(a)), jnp.asarray(a).dtype), reading)


def aged(line, age):
    """The reading that is ``age`` [ticks] old, to the nearest tick; an age outside the line gives its newest or oldest.

    Flags and quaternions, which `delayed` could not blend, come as they were.
    """
    i = jnp.clip(jnp.round(age), 0, jax.tree.leaves(line)[0].shape[0] - 1)
    picked = lambda a: reduce(lambda found, j: jnp.where(i == j, a[j], found), range(1, len(a)), a[0])
    return jax.tree.map(picked, line)  # by selections: in a batch of ages they cost less than a gather


def due(k, p: int, q: int):
    """Whether a sensor that reads p times in q ticks reads at tick k; as even as ticks allow, the first at tick 0.

    4 Hz in ticks of 10 Hz: p, q = 2, 5 gives ticks 0, 3, 5, 8, 10, ... Raises ValueError for p < 1 or p > q.
    """
    p = check.whole("p", p)
    q = check.whole("q", q, p)
    return (p * (k % q)) % q < p
