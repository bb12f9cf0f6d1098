"""The days of leo4: its catalogue of faults, how its days differ, and how one is drawn.

A day of number i has the same noise, motion and onset in every cell, so all comparisons are paired.

May import: leo4, kinds, vec.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt.vec import Vec3
from jaxatt.yardstick import leo4
from jaxatt.yardstick.kinds import effects, placed

WARMUP, WINDOW, LATEST = 300.0, 600.0, 540.0  # [s] without verdicts; with; the last onset
PACKETS = round((WARMUP + WINDOW) / leo4.PACKET)  # of a run
UNITS = {"gyro": 4, "star": 3, "wheel": 4}  # channels

# kind -> sizes, eight in equal ratios from invisible to obvious
SIZED = {
    "gyro_bias": (1.0, 1.75, 3.06, 5.35, 9.35, 16.4, 28.6, 50.0),
    "gyro_drift": (50.0, 96.5, 186.0, 360.0, 695.0, 1341.0, 2590.0, 5000.0),
    "gyro_scale": (0.002, 0.00386, 0.00746, 0.0144, 0.0278, 0.0537, 0.104, 0.2),
    "gyro_noise": (1.2, 1.57, 2.06, 2.71, 3.55, 4.65, 6.10, 8.0),
    "star_bias": (5.0, 7.67, 11.8, 18.1, 27.7, 42.5, 65.2, 100.0),
    "star_noise": (1.2, 1.51, 1.90, 2.39, 3.01, 3.79, 4.77, 6.0),
    "wheel_loss": (0.1, 0.139, 0.193, 0.268, 0.373, 0.518, 0.720, 1.0),
    "wheel_offset": (0.05, 0.0965, 0.186, 0.360, 0.695, 1.34, 2.59, 5.0),
}
PLAIN = {"gyro_stuck": (1.0,), "gyro_dead": (1.0,), "star_frozen": (1.0,)}
PAIRS = {
    f"gyro_bias+{second}": tuple(zip(SIZED["gyro_bias"], SIZED[second])) for second in ("gyro_bias", "wheel_offset")
}
# kinds in no catalogue, for the held-out column: never used to tune
HELD_OUT = {
    "gyro_intermittent": (10.0, 30.0, 100.0),
    "star_misalignment": (0.1, 0.3, 1.0),
    "star_bias+gyro_bias": tuple(zip((18.1, 42.5), (3.06, 9.35))),
}


class Spread(NamedTuple):
    """How the days of a world differ."""

    swing: float = 10.0  # [deg] of the slew
    inertia: float = 0.03  # [1] of J about each axis
    disturbance: float = 1.0  # [1] factor on all disturbances
    scale: float = 3e-4  # [1] of the gyros' scale factors
    noise: float = 1.0  # [1] factor on the gyros' noise
    star: float = 1.0  # [1] on the star tracker's


NOMINAL = Spread()
MISMATCH = {
    "leo4 star noise x1.15": NOMINAL._replace(star=1.15),
    "leo4 slew 25 deg": NOMINAL._replace(swing=25.0),
    "leo4 inertia 10 %": NOMINAL._replace(inertia=0.1),
    "leo4 disturbance x2": NOMINAL._replace(disturbance=2.0),
    "leo4 gyro scale 1000 ppm": NOMINAL._replace(scale=1e-3),
    "leo4 both noises x1.1": NOMINAL._replace(noise=1.1, star=1.1),
}


def draw(name, spread: Spread, key, index, cell=None) -> leo4.Scenario:
    """The scenario of one day of a world.

    name: crc32 of the world's name; cell: (kind, size), its `effects`, or None without a fault.
    """
    both = effects(cell)
    key = jax.random.fold_in(jax.random.fold_in(key, name), index)
    gauss, even = jax.random.split(key)  # in float32 whatever the precision of the process
    normal = jnp.split(jax.random.normal(gauss, (26,), jnp.float32), np.cumsum([3, 4, 4, 3, 3, 3]))
    uniform = jax.random.uniform(even, (9,), jnp.float32)
    axis = Vec3.of(normal[0])
    axis = axis / jnp.sqrt(axis @ axis)
    bias, scale, stretch = (
        0.5 * leo4.SECOND * normal[1],
        spread.scale * normal[2],
        jnp.sqrt(1 + spread.inertia * normal[3]),
    )
    constant, wave, e0 = 5e-5 * spread.disturbance * normal[4], 1e-4 * spread.disturbance * normal[5], normal[6]
    psi, phi = 2 * np.pi * uniform[0], 2 * np.pi * uniform[1:4]
    onset, where, sign, second, sign2 = uniform[4:]
    (a, _), (b, c) = np.linalg.cholesky(leo4.FILTER.prior)
    faulty: dict = placed(UNITS, both, WARMUP + LATEST * onset, (where, second), (sign, sign2))
    on = jnp.minimum(*(jnp.asarray(e.on, float) for e in both))
    return leo4.Scenario(
        mode=1.0 * (index % 2), axis=axis, psi=psi, swing=spread.swing * np.pi / 180, bias=bias, scale=scale,
        stretch=Vec3.of(stretch), constant=Vec3.of(constant), wave=Vec3.of(wave), phi=Vec3.of(phi),
        turn=Vec3.of(a * e0[:3]), bias_error=Vec3.of(b * e0[:3] + c * e0[3:]),
        std_gyro=spread.noise * leo4.STD_GYRO, std_star=spread.star * leo4.STD_STAR, **faulty,
        on=on, period=jnp.where(jnp.isfinite(on), 5.0, 1e6),
    )  # fmt: skip


def onsets(scenario: leo4.Scenario):
    """Onsets [s] of the channels of gyros, star tracker and wheels, (4,), (3,), (4,); inf for a healthy one."""
    return scenario.gyro.onset, jnp.minimum(scenario.star.onset, scenario.box.onset[..., None]), scenario.wheel.onset


def example() -> leo4.Telemetry:
    """A packet of zeros and unit quaternions, float32."""
    q, zeros = np.array([1, 0, 0, 0], np.float32), lambda *shape: np.zeros(shape, np.float32)
    return leo4.Telemetry(
        zeros(5, 4), zeros(5, 4), q, np.array(True), q, zeros(3), q, zeros(3), zeros(3), np.zeros((), np.int32)
    )


def odd(whole: leo4.Telemetry) -> leo4.Telemetry:
    """Packets (packets, days, ...) made ones that a fault may bring: no star sample, gyros that read zero, torques at their limit.

    Each in a third of the days.
    """
    some = np.arange(whole.mode.shape[1]) % 3
    gyro = np.where((some == 1)[:, None, None], 0 * whole.gyro, whole.gyro)
    limit = np.where((some == 2)[:, None, None], np.sign(whole.torque) * leo4.params.torque_max, whole.torque)
    star = whole.star_valid & (some != 0)
    return whole._replace(star_valid=star, gyro=gyro, torque=limit.astype(np.float32))
