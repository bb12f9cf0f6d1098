"""Faults as data: what goes wrong with one channel, from when to when.

A `Fault` is numbers in the scenario, so every kind, size and onset can differ from scenario to scenario and nothing
recompiles. A faulty channel stays affine in the truth, reading = gain * truth + offset (`Channel`), which serves sensors
that are sampled and those that are read continuously between ticks.

May import: check, vec.
"""

from __future__ import annotations

from functools import reduce, wraps
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.check import a_number, flag, instant, not_negative, positive
from jaxatt.vec import Vec3, safe_sqrt


class Fault(NamedTuple):
    """One channel's fault; what is not set does nothing, and kinds combine.

    ``Fault()`` is a healthy channel. A fault whose kind is given but not its onset is there from the start:
    ``Fault(bias=0.1)`` is ``Fault(onset=0.0, bias=0.1)``. Fields of shape () for one channel, or (n,) for n.
    """

    onset: Annotated[Any, "s", instant] = jnp.inf  # first instant of the fault
    end: Annotated[Any, "s", instant] = jnp.inf  # first instant after it
    bias: Annotated[Any, a_number] = 0.0  # [unit of the channel] constant offset
    drift: Annotated[Any, a_number] = 0.0  # [unit of the channel] incipient offset: drift (1 - exp(-(t - onset) / tau))
    tau: Annotated[Any, "s", positive] = 1.0  # time constant of the drift
    random: Annotated[Any, not_negative] = 0.0  # [unit of the channel] std of a Gaussian signal, held between ticks
    scale: Annotated[Any, "1", a_number] = 1.0  # factor on the true signal: scale-factor error, loss of effectiveness
    growth: Annotated[Any, "1", not_negative] = 1.0  # factor on the channel's own noise
    stuck: Annotated[Any, "1", flag] = 0.0  # 1: the reading stays at the last one before the onset
    missing: Annotated[Any, "1", flag] = 0.0  # 1: there is no reading; its value, not valid, stays at the last one

    def check(self, name: str) -> None:
        """Refuse, with ValueError, a fault that ends before its onset."""
        check.pair(f"{name}.end", "not lie before the onset", self.end, self.onset, np.greater_equal)


_tuple_made = Fault.__new__


@wraps(_tuple_made)
def _made(cls, *fields, **kinds):
    if not fields and "onset" not in kinds:
        kinds["onset"] = 0.0 if kinds else jnp.inf
    return _tuple_made(cls, *fields, **kinds)


Fault.__new__ = _made  # a NamedTuple takes no __new__ of its own in its body


class Channel(NamedTuple):
    """How a channel reads until the next tick: gain * truth + offset."""

    gain: Any  # [1]
    offset: Any  # [unit of the channel]


class Reading(NamedTuple):
    """A measurement that may be missing: a dead gyro and a channel that was not sampled are the same thing."""

    value: Any  # [unit of the channel]
    valid: Any  # bool: what is not valid is not used, whatever its value


def present(reading: Reading):
    """Whether a reading is there: valid, and finite in all that one flag stands for, such as a `Vec3`; as its flag."""
    return jax.tree.map(
        lambda valid, value: valid & jnp.isfinite(sum(jax.tree.leaves(value))), reading.valid, reading.value
    )


def known(reading: Reading, otherwise):
    """The reading where it is `present`, else ``otherwise``, what is believed without it; no NaN enters a gradient."""
    return jax.tree.map(
        lambda there, value, other: jax.tree.map(lambda a, b: jnp.where(there, a, b), value, other),
        present(reading), reading.value, otherwise,
    )  # fmt: skip


def dead(onset: Any = 0.0, end: Any = jnp.inf) -> Fault:
    """A channel that reads exactly zero from onset to end [s]."""
    return Fault(onset, end, scale=0.0, growth=0.0)


def dead_where(mask, onset: Any = 0.0) -> Fault:
    """Those of several units, gyros or wheels, that are dead from onset [s] on: where mask, (n,) of bool, is true."""
    mask = jnp.asarray(mask, bool)
    return jax.tree.map(lambda a: jnp.broadcast_to(a, mask.shape), dead(jnp.where(mask, onset, jnp.inf)))


def on_axes(fault: Fault) -> Vec3:
    """The same fault on the three channels of a triad."""
    return Vec3(fault, fault, fault)


def healthy() -> Channel:
    """A channel that reads the truth."""
    return Channel(1.0, 0.0)


def faults_of(tree) -> list[Fault]:
    """Every `Fault` in a tree, such as a scenario, a `Vec3` of faults or one fault."""
    leaves = jax.tree.leaves(tree, is_leaf=lambda node: isinstance(node, Fault))
    return [leaf for leaf in leaves if isinstance(leaf, Fault)]


def active(fault: Fault, t):
    """Whether the fault is on at t [s]: onset <= t < end."""
    return (t >= fault.onset) & (t < fault.end)


def heard(fault: Fault, t):
    """Whether the channel gives a reading at t [s]."""
    return jnp.logical_not(active(fault, t) & (fault.missing > 0))


def any_active(faults, t):
    """Whether any of the faults, any tree that holds some, is on at t [s]."""
    return reduce(jnp.logical_or, [active(f, t) for f in faults_of(faults)])


def first_onset(faults):
    """The earliest onset [s] of the faults, any tree that holds some; inf where there is none."""
    return reduce(jnp.minimum, [f.onset for f in faults_of(faults)])


def channel(fault: Fault, t, std, normal, last) -> Channel:
    """The channel as it reads from tick time t [s] on.

    std: standard deviation of its noise [unit of the channel]; normal: a standard normal number, which serves the noise
    and ``fault.random`` together, for the sum of two Gaussian signals is one; last: the previous reading, which a stuck
    channel repeats, and a missing one: whether it is valid tells `heard`.
    """
    on = active(fault, t)
    held = on & ((fault.stuck > 0) | (fault.missing > 0))
    since = jnp.where(on, t - fault.onset, 0)
    grown = fault.growth * std
    spread = safe_sqrt(grown * grown + fault.random * fault.random)
    faulty = fault.bias + fault.drift * (1 - jnp.exp(-since / fault.tau)) + spread * normal
    return Channel(
        gain=jnp.where(held, 0, jnp.where(on, fault.scale, 1)),
        offset=jnp.where(held, last, jnp.where(on, faulty, std * normal)),
    )


def read(c: Channel, truth):
    """The reading of a channel whose true signal is truth [unit of the channel]."""
    return c.gain * truth + c.offset
