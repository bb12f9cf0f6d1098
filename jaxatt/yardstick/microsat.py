"""microsat: the second world of the yardstick, the loop `jaxatt.loops.microsat` whose computer reports in packets.

A tick of the system is one packet of five ticks of the loop, half a second. The computer does not act on its own verdicts:
no unit and no sample is left out, so that every detector sees a fault for as long as it lasts. What its own detectors say
is part of the telemetry.

May import: loops.microsat, contract, clock, engine, faults, vec, attitude.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxatt.attitude import quat_conjugate, vector_from_quat
from jaxatt.clock import time_of
from jaxatt.contract import Now, System
from jaxatt.engine import match_state, rk4
from jaxatt.loops import microsat as loop
from jaxatt.vec import array

TICKS = 5  # of the loop in a packet
PACKET = 0.5  # [s]
ARRIVALS = 0, 2  # ticks of a packet at which star samples arrive, two ticks old; of the first packet the second alone
SAMPLES = (
    "star",
    "star_valid",
    "sun",
    "field",
    "sun_there",
    "field_there",
    "innovation",
    "nis",
)  # told of arrivals alone
LARGEST = "wheel_cusum", "gyro_cusum", "nis_sum", "rejected", "cross"  # of the packet
# the filter starts near its steady state, which its bias would need an hour to reach
PARTS = {"sigma_turn": 10 * loop.DEG / 3600, "sigma_bias": 0.3 * loop.DEG / 3600}


class Telemetry(NamedTuple):
    """One packet, delivered after the last of its five ticks. No clock, no number, no flag of a fault, nothing of the truth."""

    gyro: Annotated[Any, "rad/s"]  # (5, 3) readings
    tacho: Annotated[Any, "N m s"]  # (5, 4) momenta of the wheels against the body, readings
    torque: Annotated[Any, "N m"]  # (5, 4) commanded of the wheels after each reading
    moment: Annotated[Any, "A m^2"]  # (5, 3) commanded of the torquers
    momentum_rate: Annotated[Any, "rad/s"]  # (5, 3) of the body, as the computer works it out from the wheels' momentum
    star: Annotated[Any, "1"]  # (2, 4) samples that arrived
    star_valid: Annotated[Any, "1"]  # (2,) bool: there was one
    sun: Annotated[Any, "1"]  # (2, 3) of the sun sensor at their instants, body axes; 0 in eclipse
    field: Annotated[Any, "T"]  # (2, 3) of the magnetometer
    sun_there: Annotated[Any, "1"]  # (2, 3) where the Sun is by the on-board table, reference axes
    field_there: Annotated[Any, "T"]  # (2, 3) the field by the on-board table
    attitude: Annotated[Any, "1"]  # (4,) of the MEKF before the packet
    bias: Annotated[Any, "rad/s"]  # (3,) likewise
    innovation: Annotated[Any, "rad"]  # (2, 3) of the MEKF, body axes; 0 where no sample arrived
    nis: Annotated[Any, "1"]  # (2,) its normalised square, chi-square of three degrees
    wheel_cusum: Annotated[Any, "1"]  # (4,) of the computer's own detectors the largest of the packet: of the wheels
    gyro_cusum: Annotated[Any, "1"]  # of gyro less momentum
    nis_sum: Annotated[Any, "1"]  # of the last 20 NIS
    rejected: Annotated[Any, "1"]  # persistence of samples beyond its gate
    cross: Annotated[Any, "1"]  # of star samples against Sun and field, over its threshold
    mode: Annotated[Any, "1"]  # int: 0 sunlit, 1 eclipse


class Log(NamedTuple):
    """What a packet reports."""

    t: Annotated[Any, "s"]  # of its first tick
    telemetry: Telemetry
    pointing: Annotated[Any, "rad"]  # (5,) angle to the nadir attitude


def init(params: loop.Params, scenario: loop.Scenario):
    """x, z at the start: all of the state is z, for the plant moves within a packet."""
    return (), loop.init(params, scenario)


def tick(params: loop.Params, scenario: loop.Scenario, now, x, z, noise):
    """One packet: five times the loop's tick and its flow."""
    normals, before = loop.system.normals, z[1].computer.belief
    noise = jnp.stack(
        [noise[normals * i : normals * (i + 1)] for i in range(TICKS)]
    )  # not reshaped: a batch lies behind
    numbers = TICKS * now.k + jnp.arange(TICKS, dtype=jnp.int32)

    def one(state, told):
        k, t, noise = told
        x, z = state
        clone = z.computer.belief.clone
        x, z, log = loop.tick(params, scenario, Now(k, t, loop.DT), x, z, noise)
        z = match_state(z, state[1], "tick", "z")
        ahead = rk4(lambda t, x: loop.flow(params, scenario, t, x, z), t, x, loop.DT)
        return (match_state(ahead, state[0], "flow", "x"), z), (seen(clone, z, log), log.pointing)

    times = time_of(numbers, loop.DT, jnp.result_type(now.t))
    z, (told, pointing) = jax.lax.scan(one, z, (numbers, times, noise))
    samples = {name: jnp.stack([getattr(told, name)[i] for i in ARRIVALS]) for name in SAMPLES}
    largest = {name: jnp.max(getattr(told, name), axis=0) for name in LARGEST}
    telemetry = told._replace(attitude=array(before.q), bias=array(before.b), mode=told.mode[0], **samples, **largest)
    return x, z, Log(now.t, telemetry, pointing)


def seen(clone, z: loop.Z, log: loop.Log) -> Telemetry:
    """What the computer knows at a tick, in the fields of a packet; clone: the filter's before it."""
    y, computer, own = z.sensors.readings, z.computer, log.statistics
    sample, sky = y.arrived, y.arrived.sky
    sun = jnp.where(sky.lit > loop.SEEN, array(sample.sun.value), 0)
    turn = array(vector_from_quat(quat_conjugate(clone) * sample.star.value))
    valid = sample.star.valid
    return Telemetry(
        array(y.gyro.value), y.tacho.value, computer.torque, array(computer.moment), array(computer.w),
        array(sample.star.value), valid, sun, array(sample.field.value), array(sky.sun),
        array(sky.field), array(computer.belief.q), array(computer.belief.b), jnp.where(valid, turn, 0), own.nis,
        own.wheel, own.gyro, own.nis_sum, own.rejected, own.cross, (y.orbit.lit <= loop.SEEN).astype(jnp.int32),
    )  # fmt: skip


def flow(params: loop.Params, scenario: loop.Scenario, t, x, z):
    """Nothing flows between packets."""
    return x


system = System(init, tick, flow, dt=PACKET, normals=TICKS * loop.system.normals, check=loop.refuse_bad)
params = loop.params._replace(**PARTS)
