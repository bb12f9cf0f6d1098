"""Faults as data: what goes wrong with one channel, from when to when.

A `Fault` is numbers in the scenario, so every kind, size and onset is a batch axis and nothing recompiles.
A faulty channel stays affine in the truth, reading = gain * truth + offset (`Channel`), which serves sampled
sensors and those read continuously between ticks alike.

May import: check, vec.
"""

from __future__ import annotations

from functools import reduce
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.check import door
from jaxatt.vec import Vec3, safe_sqrt


class Fault(NamedTuple):
    """One channel's fault; what is not set does nothing. Kinds combine. Every field has shape (*lanes)."""

    onset: Any = jnp.inf  # [s] first instant of the fault
    end: Any = jnp.inf  # [s] first instant after it
    bias: Any = 0.0  # [channel unit] constant offset
    drift: Any = 0.0  # [channel unit] incipient offset: drift (1 - exp(-(t - onset) / tau))
    tau: Any = 1.0  # [s] time constant of the drift
    random: Any = 0.0  # [channel unit] standard deviation of a Gaussian signal, held from tick to tick
    scale: Any = 1.0  # [1] factor on the true signal: scale-factor error, loss of effectiveness
    growth: Any = 1.0  # [1] factor on the channel's own noise
    stuck: Any = 0.0  # [1] 1: the reading stays at the last one before the onset


class Channel(NamedTuple):
    """How a channel reads until the next tick: gain * truth + offset. Fields of shape (*lanes)."""

    gain: Any  # [1]
    offset: Any  # [channel unit]


class Reading(NamedTuple):
    """A measurement that may be missing: a dead gyro and an unsampled or masked channel are the same thing."""

    value: Any  # [channel unit]
    valid: Any  # [bool] what is not valid is not used, whatever its value


def dead(onset=0.0, end=jnp.inf) -> Fault:
    """A channel that reads exactly zero from onset to end [s]."""
    return Fault(onset, end, scale=0.0, growth=0.0)


def on_axes(fault: Fault) -> Vec3:
    """The same fault on the three channels of a triad."""
    return Vec3(fault, fault, fault)


@door
def active(fault: Fault, t):
    """Whether the fault is on at t [s]: onset <= t < end."""
    return (t >= fault.onset) & (t < fault.end)


@door
def any_active(faults, t):
    """Whether any of the faults, a sequence of `Fault`, is on at t [s]."""
    return reduce(jnp.logical_or, [active(f, t) for f in faults])


@door
def first_onset(faults):
    """The earliest onset [s] of faults, a sequence of `Fault`; inf where there is none."""
    return reduce(jnp.minimum, [f.onset for f in faults])


@door
def channel(fault: Fault, t, std, normal, last) -> Channel:
    """The channel as it reads from tick time t [s] on.

    std: standard deviation of its noise [channel unit]; normal: a standard normal number, which serves the noise
    and ``fault.random`` together, for the sum of two Gaussian signals is one; last: the previous reading, which
    a stuck channel repeats. All of shape (*lanes).
    """
    on = active(fault, t)
    stuck = on & (fault.stuck > 0)
    since = jnp.where(on, t - fault.onset, 0)
    grown = fault.growth * std
    spread = safe_sqrt(grown * grown + fault.random * fault.random)
    faulty = fault.bias + fault.drift * (1 - jnp.exp(-since / fault.tau)) + spread * normal
    return Channel(
        gain=jnp.where(stuck, 0, jnp.where(on, fault.scale, 1)),
        offset=jnp.where(stuck, last, jnp.where(on, faulty, std * normal)),
    )


@door
def read(c: Channel, truth):
    """The reading of a channel whose true signal is truth [channel unit]."""
    return c.gain * truth + c.offset


def check_fault(name: str, fault: Fault) -> None:
    """Refuse, with ValueError, a fault with NaN, a negative size of noise, tau <= 0 or end < onset.

    TypeError for what is no `Fault` of numbers.
    """
    check.kind(name, fault, Fault)
    for field, value in zip(Fault._fields, fault):
        if check.concrete(value):
            check.real(f"{name}.{field}", value)
    check.a_number(name, check.numbers(name, fault))
    check.positive(f"{name}.tau", fault.tau)
    for field in ("random", "growth"):
        check.not_negative(f"{name}.{field}", getattr(fault, field))
    check.one_of(f"{name}.stuck", fault.stuck, (0, 1))
    if check.concrete((fault.onset, fault.end)):
        check.each(f"{name}.end", "not lie before the onset", fault.end, np.asarray(fault.end) >= fault.onset)
