"""CPU time of the parts of a satellite, each by itself: ``python -m benchmarks parts``.

One call of a part in each of 1024 scenarios, in blocks of 128 as the engine runs them, on numbers that are new at every
tick; reading the numbers and adding up what comes out is in it.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.measure import cpu_ns
from jaxatt import attitude, bodies, controllers, detection, guidance, mekf, sensors, single_frame, usque, wheels
from jaxatt.engine import over_lanes
from jaxatt.environment import at
from jaxatt.faults import Reading
from jaxatt.loops import microsat as ms
from jaxatt.noise import BLOCK
from jaxatt.vec import Quat, Vec3

LANES, TICKS, DT = 1024, 50, 0.1
RULES = guidance.Rule(0, 0, 30, 1), guidance.Rule(1, 1, 30, 2), guidance.Rule(2, 2, 1, 0)


def unit(x) -> Quat:
    return attitude.quat_normalised(Quat(*x))


def seen(x) -> Reading:
    return Reading(Vec3(*x), x[0] < 9)


def belief(x, clone=False):
    """Near the identity, with a covariance that the ticks change."""
    one = mekf.start(unit(x[:4]), Vec3(*(1e-4 * x[4:7])), 1e-2 + 1e-3 * jnp.abs(x[7]), 1e-4)
    return mekf.cloned(one) if clone else one


def both_frames(x):
    body, reference = Vec3(*x[:3]), Vec3(*x[3:6])
    return (body, Vec3(*x[6:9])), (reference, Vec3(*x[9:12]))


# name: how many numbers a tick takes, what it does with params, scenario and them
PARTS = {
    "gyro by data sheet": (12, lambda p, s, x: sensors.gyro_read(p.gyro, sensors.GyroState(Vec3(*x[:3]), Vec3(*x[3:6])), Vec3(*x[6:9]), DT, x[9:], x[:3])),
    "star tracker": (10, lambda p, s, x: sensors.star_read(p.star, unit(x[:4]), Vec3(*x[4:7]), Vec3(*x[7:]))),
    "sun or horizon sensor": (6, lambda p, s, x: sensors.direction_read(Vec3(*x[:3]), 1e-3, x[3:])),
    "Sun from six coarse cells": (6, lambda p, s, x: sensors.sun_from_six(x)),
    "TRIAD": (12, lambda p, s, x: single_frame.triad_attitude(*both_frames(x)[0], *both_frames(x)[1])),
    "Davenport, two vectors": (12, lambda p, s, x: single_frame.davenport(*both_frames(x), (1.0, 2.0)).q),
    "MEKF: prediction": (11, lambda p, s, x: mekf.predict(belief(x), Vec3(*x[8:]), DT, p.gyro.arw, p.gyro.rrw)),
    "MEKF: prediction, vector": (14, lambda p, s, x: mekf.update_vector(mekf.predict(belief(x), Vec3(*x[8:11]), DT, p.gyro.arw, p.gyro.rrw), seen(x[11:]), Vec3(*x[:3]), 1e-3)),
    "MEKF with a clone: prediction, late attitude": (12, lambda p, s, x: mekf.update_attitude(mekf.predict(belief(x, True), Vec3(*x[8:11]), DT, p.gyro.arw, p.gyro.rrw), Reading(unit(x[8:12]), x[0] < 9), sensors.star_axes(p.star), Vec3(1e-8, 1e-8, 1e-7), late=True)),
    "USQUE: step with a vector": (14, lambda p, s, x: usque.usque_step(belief(x), Vec3(*x[8:11]), DT, p.gyro.arw, p.gyro.rrw, seen(x[11:]), Vec3(*x[:3]), 1e-3)),
    "four wheels: motor, friction, limits": (8, lambda p, s, x: wheels.wheel_torque(p.wheel, x[:4], x[4:], DT)),
    "allocation, four wheels": (7, lambda p, s, x: wheels.allocation(Vec3(*x[:3]), p.axes, x[3:] < 9)),
    "minimax allocation, four wheels": (7, lambda p, s, x: wheels.minimax(Vec3(*x[:3]), p.axes, x[3:] < 9)),
    "drive of four wheels": (12, lambda p, s, x: wheels.wheel_drive(x[:4], x[4:8], x[8:], DT, 1.0, 0.005)),
    "B-dot": (6, lambda p, s, x: controllers.bdot(Vec3(*x[:3]), Vec3(*x[3:]), DT, 0.01, 12.0)),
    "unloading by torquers": (6, lambda p, s, x: controllers.unloading(Vec3(*x[:3]), Vec3(*x[3:]), 2e-3, 12.0)),
    "surroundings from the table": (1, lambda p, s, x: at(p.table, 1e3 * jnp.abs(x[0]))),
    "drag and sunlight on six faces": (6, lambda p, s, x: (bodies.aero_torque(s.facets, Vec3(*x[:3]), 1e-12), bodies.solar_torque(s.facets, Vec3(*x[3:]), 1.0))),
    "nadir target and tracking error": (13, lambda p, s, x: guidance.tracking_error(unit(x[:4]), Vec3(*x[4:7]), guidance.Target(guidance.nadir(Vec3(*x[7:10]), Vec3(*x[10:])), Vec3(*x[4:7]), Vec3(*x[7:10])))),
    "slew": (9, lambda p, s, x: guidance.slew_at(guidance.slew(unit(x[:4]), unit(x[4:8]), 0.01, 1e-3), 10 * jnp.abs(x[8]))),
    "mode machine, three rules": (3, lambda p, s, x: guidance.next_mode(RULES, guidance.first_mode(RULES, 0), x > 0)),
    "CUSUM": (3, lambda p, s, x: detection.cusum(detection.Cusum(x[0], x[1]), x[2], 0.75)),
    "GLR, twenty values": (21, lambda p, s, x: detection.glr(x[:20], x[20])),
}  # fmt: skip


def runner(part, params, scenario):
    """Fifty ticks of a part in blocks of 128 scenarios: the sum of all that comes out."""

    def total(x):
        return sum(jnp.sum(jnp.asarray(a, x.dtype)) for a in jax.tree.leaves(part(params, scenario, x)))

    @jax.jit
    def run(x):  # (blocks, ticks, numbers, BLOCK)
        def block(x):
            tick = lambda held, now: (held + over_lanes(total, BLOCK)(now), None)
            return jax.lax.scan(tick, jnp.zeros(BLOCK, x.dtype), x)[0]

        return jax.lax.map(block, x)

    return run


def rows(quick: bool):
    """ns of each part a scenario and call, float32 and float64."""
    for real in (np.float32,) if quick else (np.float32, np.float64):
        cast = partial(jax.tree.map, partial(np.asarray, dtype=real))
        given = cast(ms.params), cast(ms.scenario)
        for name, (numbers, part) in PARTS.items():
            x = np.random.default_rng(0).normal(size=(LANES // BLOCK, TICKS, numbers, BLOCK)).astype(real)
            ns = cpu_ns(partial(runner(part, *given), x), LANES * TICKS, 3 if quick else 9)
            yield {"name": f"{name}, {np.dtype(real).name}", "value": ns, "unit": "CPU ns"}
