"""The days of microsat: its catalogue of faults, how its days differ, and how one is drawn.

A day of number i has the same noise, place in orbit and onset in every cell, so all comparisons are paired. Even days run in
sunlight, odd ones in the Earth's shadow, each from its start to its end.

May import: microsat, kinds, loops.microsat, faults, vec.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt.faults import Fault
from jaxatt.loops import microsat as loop
from jaxatt.vec import Mat3, Vec3
from jaxatt.yardstick import microsat
from jaxatt.yardstick.kinds import Effect, effects, placed

WARMUP, WINDOW, LATEST = 100.0, 300.0, 240.0  # [s] without verdicts; with; the last onset
UNITS = {
    "gyro": 3,
    "star": 3,
    "wheel": 4,
    "sun": 3,
    "field": 3,
}  # channels; those of the star tracker: across z, x, about y


def _eight(first: float, last: float) -> tuple[float, ...]:
    """Eight sizes in equal ratios, three digits each."""
    return tuple(float(f"{size:.3g}") for size in np.geomspace(first, last, 8))


# kind -> sizes, from invisible to obvious; units: `kinds.UNIT`
SIZED = {
    "gyro_bias": _eight(2, 300),
    "gyro_drift": _eight(1000, 200_000),
    "gyro_noise": _eight(1.1, 6),
    "star_bias": _eight(10, 1000),
    "star_misalignment": _eight(0.5, 100),
    "star_noise": _eight(1.2, 6),
    "wheel_loss": _eight(0.01, 1),
    "wheel_friction": _eight(0.005, 5),
    "sun_bias": _eight(0.01, 0.5),
    "sun_noise": _eight(1.2, 6),
    "field_bias": _eight(40, 2000),
    "field_noise": _eight(1.2, 6),
}
PLAIN = {"gyro_stuck": (1.0,), "gyro_dead": (1.0,), "star_frozen": (1.0,), "wheel_seized": (1.0,)}
PAIRS = {f"gyro_bias+{second}": tuple(zip(SIZED["gyro_bias"], SIZED[second])) for second in ("gyro_bias", "star_bias")}
# kinds in no catalogue, for the held-out column: never used to tune
HELD_OUT = {"gyro_scale": (0.1, 0.3, 1.0), "wheel_loss+wheel_friction": ((0.02, 0.02), (0.1, 0.1))}


class Spread(NamedTuple):
    """How the days of a world differ."""

    inertia: float = 0.02  # [1] of J about each axis
    friction: float = 0.1  # [1] of a wheel's friction, uniform
    dipole: float = 0.2  # [A m^2] of the residual one about each axis
    gyro: float = 1.0  # [1] factor on the gyro's noise
    star: float = 1.0  # [1] on the star tracker's
    field: float = 1.0  # [1] on that of magnetometer and field model


NOMINAL = Spread()
MISMATCH = {
    "microsat star noise x1.15": NOMINAL._replace(star=1.15),
    "microsat gyro noise x1.15": NOMINAL._replace(gyro=1.15),
    "microsat field noise x1.5": NOMINAL._replace(field=1.5),
    "microsat friction 30 %": NOMINAL._replace(friction=0.3),
    "microsat inertia 6 %": NOMINAL._replace(inertia=0.06),
    "microsat dipole x3": NOMINAL._replace(dipole=0.6),
}


def _arcs() -> tuple[tuple[float, float], tuple[float, float]]:
    """First and last start [s] of runs in sunlight, and of runs in the shadow: of the first whole arc of each in the table."""
    table = loop.params.table
    lit, t = np.asarray(table.lit), table.start + table.step * np.arange(len(table.lit))
    found = []
    for there in (lit >= 1, lit <= 0):
        edges = np.flatnonzero(np.diff(there.astype(int)))  # the last row before each change
        first, last = next((a + 1, b) for a, b in pairwise(edges) if there[a + 1])
        found.append((float(t[first]), float(t[last]) - WARMUP - WINDOW))
    return found[0], found[1]


SUNLIT, SHADOW = _arcs()


def draw(name, spread: Spread, key, index, cell=None) -> loop.Scenario:
    """The scenario of one day of a world.

    name: crc32 of the world's name; cell: (kind, size), its `effects`, or None without a fault.
    """
    both = effects(cell)
    key = jax.random.fold_in(jax.random.fold_in(key, name), index)
    gauss, even = jax.random.split(key)  # in float32 whatever the precision of the process
    turn, bias, stretch, dipole = jnp.split(jax.random.normal(gauss, (12,), jnp.float32), 4)
    uniform = jax.random.uniform(even, (10,), jnp.float32)
    place, friction = uniform[0], uniform[1:5]
    onset, where, sign, second, sign2 = uniform[5:]
    first, last = (jnp.where(index % 2 == 0, a, b) for a, b in zip(SUNLIT, SHADOW))
    D = jnp.sqrt(1 + spread.inertia * stretch)
    sheet, tracker, params = loop.SHEET, loop.TRACKER, microsat.params
    faulty = placed(UNITS, both, WARMUP + LATEST * onset, (where, second), (sign, sign2))
    return loop.Scenario(
        t0=first + (last - first) * place,
        turn=Vec3.of(params.sigma_turn * turn),
        bias=Vec3.of(params.sigma_bias * bias),
        J=Mat3(*(Vec3(*(D[i] * a * D[j] for j, a in enumerate(row))) for i, row in enumerate(loop.INERTIA))),
        friction=1 + spread.friction * (2 * friction - 1),
        gyro_sheet=sheet._replace(arw=spread.gyro * sheet.arw),
        tracker=tracker._replace(cross=spread.star * tracker.cross, roll=spread.star * tracker.roll),
        act=0.0,
        std_field=spread.field * params.std_field,
        dipole=Vec3.of(spread.dipole * dipole),
        **_faults(both, faulty),
    )


def _faults(both: tuple[Effect, Effect], faulty: dict[str, Fault]) -> dict:
    """The fault fields of a scenario: those of the wheels are the loop's own, all others `Fault`s per axis.

    The noise of gyro and sun sensor is in the signal that their channels get, so more of it is `Fault.random`, which has
    the same normal numbers: n times the standard deviation s is s and (n - 1) s more.
    """
    own = {"gyro": loop.SHEET.arw / np.sqrt(loop.DT), "sun": loop.Scenario().std_sun}
    fields: dict = {"box": faulty["box"]}
    for unit, fault in faulty.items():
        if unit in own:
            fault = fault._replace(random=jnp.maximum(fault.growth - 1, 0) * own[unit])
        if unit == "wheel":
            fields[unit] = loop.WheelFault(fault.onset, fault.end, fault.scale, fault.growth, fault.stuck)
        elif unit != "box":
            fields[unit] = Vec3(*(jax.tree.map(lambda a, i=i: a[i], fault) for i in range(3)))
    return fields


def onsets(scenario: loop.Scenario):
    """Onsets [s] of the channels of gyro, star tracker, wheels, sun sensor, magnetometer; inf for a healthy one."""
    gyro, star, sun, field = (
        jnp.stack([fault.onset for fault in unit], axis=-1)
        for unit in (scenario.gyro, scenario.star, scenario.sun, scenario.field)
    )
    return gyro, jnp.minimum(star, scenario.box.onset[..., None]), scenario.wheel.onset, sun, field


def example() -> microsat.Telemetry:
    """A packet of zeros, unit quaternions and unit vectors, float32."""
    zeros, q = lambda *shape: np.zeros(shape, np.float32), np.array([1, 0, 0, 0], np.float32)
    two, z = lambda a: np.stack([a, a]), np.array([0, 0, 1], np.float32)
    return microsat.Telemetry(
        zeros(5, 3), zeros(5, 4), zeros(5, 4), zeros(5, 3), zeros(5, 3), two(q), np.array([True, True]), two(z), two(z), two(z),
        two(z), q, zeros(3), zeros(2, 3), zeros(2), zeros(4), zeros(), zeros(), zeros(), zeros(), np.zeros((), np.int32),
    )  # fmt: skip


def odd(whole: microsat.Telemetry) -> microsat.Telemetry:
    """Packets (packets, days, ...) made ones that a fault may bring: no star sample, gyros that read zero, wheels at rest.

    Each in a third of the days.
    """
    some = np.arange(whole.mode.shape[1]) % 3
    none = (some == 0)[:, None]
    without = lambda a, which: np.where((some == which)[:, None, None], 0 * a, a)
    return whole._replace(
        star_valid=whole.star_valid & ~none, innovation=without(whole.innovation, 0), nis=np.where(none, 0 * whole.nis, whole.nis),
        gyro=without(whole.gyro, 1), tacho=without(whole.tacho, 2), torque=without(whole.torque, 2),
    )  # fmt: skip
