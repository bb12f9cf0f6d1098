"""Detectors for the world microsat, each a `Detector` of known numbers: nothing is fitted to telemetry.

Rows: chi-square of the MEKF's innovation, CUSUMs of what wheels and gyro do against what they should, of all sixteen
residuals, and the logic by which the computer of the loop would act.

May import: microsat, microsat_days, loops.microsat, references, steady, telemetry, attitude, detection, vec.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxatt.attitude import quat_to_body
from jaxatt.detection import Cusum, cusum
from jaxatt.loops import microsat as loop
from jaxatt.vec import Quat, Vec3, array
from jaxatt.yardstick import microsat_days
from jaxatt.yardstick.microsat import PACKET, TICKS, Telemetry, params
from jaxatt.yardstick.references import references, summed, window_of
from jaxatt.yardstick.steady import steady
from jaxatt.yardstick.telemetry import Detector, OnResiduals, Verdict, with_residuals

CHANNELS = sum(microsat_days.UNITS.values())
MEMORY = 200.0  # [packets] of the residuals' baselines
GYRO, STAR, WHEEL, SUN, FIELD = (
    slice(start, start + n) for start, n in zip(np.cumsum([0, 3, 3, 4, 3]), microsat_days.UNITS.values())
)  # of the residuals and of the blame
ODD = 27.86  # chi-square of six degrees at 1e-4: of two samples of the Sun, or of the field, against the stars


def _std_innovation(std: float) -> float:
    """Standard deviation [rad] of the steady MEKF's innovation about an axis, four samples of ``std`` [rad] a second."""
    T, arw, rrw = 0.25, loop.SHEET.arw, loop.SHEET.rrw
    Q = [[arw**2 * T + rrw**2 * T**3 / 3, -(rrw**2) * T**2 / 2], [-(rrw**2) * T**2 / 2, rrw**2 * T]]
    return float(np.sqrt(steady([[1, -T], [0, 1]], Q, np.eye(1, 2), [[std**2]]).innovation[0, 0]))


_CROSS, _ROLL = (_std_innovation(std) for std in (loop.TRACKER.cross, loop.TRACKER.roll))
SCALES = np.concatenate([  # of what a packet adds up, were it white
    [TICKS**-0.5 * loop.SHEET.arw / np.sqrt(loop.DT)] * 3, 2**0.5 * np.array([_CROSS, _CROSS, _ROLL]),
    [2**0.5 * params.std_tacho] * 4, [2**0.5 * params.std_sun] * 3, [2**0.5 * params.std_field] * 3,
]).astype(np.float32)  # fmt: skip


# residuals


class Residuals(NamedTuple):
    """What the residuals remember."""

    baseline: Any  # (16,) [1]
    seen: Any  # [packets]
    tacho: Any  # (4,) [N m s] last
    torque: Any  # (4,) [N m] last


def residuals_init() -> Residuals:
    """Before the first packet."""
    return Residuals(jnp.zeros(CHANNELS), jnp.zeros(()), jnp.zeros(4), jnp.zeros(4))


def residuals_step(state: Residuals, telemetry: Telemetry) -> tuple[Residuals, Any]:
    """The residuals (16,) of a packet over their standard deviations, less their causal means.

    Gyro less bias and momentum's rate (3); the MEKF's innovations about the star tracker's axes z, x, y (3); what the
    wheels' momenta changed beyond torque and friction (4); Sun (3) and field (3) as measured less as star samples and
    table have them. Means: B += r max(1 / (k + 1), 1 / 200), k packets seen.
    """
    apart = jnp.sum(telemetry.gyro - telemetry.momentum_rate, axis=0) / TICKS - telemetry.bias
    x, y, z = jnp.sum(telemetry.innovation, axis=0)
    before = [
        jnp.concatenate([old[None], new[:-1]]) for old, new in zip(state[2:], (telemetry.tacho, telemetry.torque))
    ]
    tacho, torque = before
    speed, friction = tacho / params.wheel.J, params.wheel.friction
    given = torque - jnp.sign(speed) * friction.coulomb - friction.viscous * speed
    wheels = jnp.where(state.seen > 0, jnp.sum(telemetry.tacho - tacho - loop.DT * given, axis=0), 0)
    sun, field = against_stars(telemetry)
    r = jnp.concatenate([apart, jnp.stack([z, x, y]), wheels, jnp.sum(sun, axis=0), jnp.sum(field, axis=0)]) / SCALES
    baseline = state.baseline + (r - state.baseline) * jnp.maximum(1 / (state.seen + 1), 1 / MEMORY)
    after = Residuals(baseline, jnp.minimum(state.seen + 1, 1e6), telemetry.tacho[-1], telemetry.torque[-1])
    return after, r - state.baseline


def against_stars(telemetry: Telemetry):
    """Sun [1] and field [T] as measured less as a star sample and the table have them, (2, 3) each; 0 without a sample."""
    found = []
    for measured, there in ((telemetry.sun, telemetry.sun_there), (telemetry.field, telemetry.field_there)):
        rows = [m - array(quat_to_body(Quat.of(q), Vec3.of(r))) for m, q, r in zip(measured, telemetry.star, there)]
        found.append(jnp.where(telemetry.star_valid[:, None], jnp.stack(rows), 0))
    return jnp.where(telemetry.mode > 0, 0, found[0]), found[1]


# rows


def chi2_step(params, z, telemetry: Telemetry):
    """Sum of the NIS of the MEKF over the window of packets."""
    z, score = summed(z, jnp.sum(telemetry.nis))
    return z, Verdict(score, jnp.ones(CHANNELS, score.dtype))


class CusumParams(NamedTuple):
    """Which residuals a CUSUM sees, and its slack."""

    seen: Any  # (16,) 1 or 0
    slack: Any = np.float32(0.25)  # [1] half the shift that matters


def cusum_init(params: CusumParams) -> Cusum:
    """No sums yet, (16,) each."""
    return Cusum(jnp.zeros(CHANNELS), jnp.zeros(CHANNELS))


def cusum_step(params: CusumParams, sums: Cusum, r, telemetry: Telemetry):
    """Page's sums of the residuals that are seen; the blame is on the channel of the largest."""
    sums, channels = cusum(sums, r * params.seen, params.slack)
    score = jnp.max(channels)
    return sums, Verdict(score, jnp.where(channels >= score, 1.0, 0.0).astype(score.dtype))


def fdir_init(limits: loop.Limits):
    """Packets since the gyro was last found apart from the momentum."""
    return jnp.asarray(1e6)


def fdir_step(limits: loop.Limits, since, telemetry: Telemetry):
    """The largest of the computer's own statistics over its limits, and its verdict on who is to blame.

    A wheel by its CUSUM. Strange innovations: the gyro if it was apart from the momentum within the last half minute, else
    the star tracker. A star sample that Sun and field contradict: the star tracker, or the one that contradicts alone.
    """
    since = jnp.where(telemetry.gyro_cusum > limits.gyro, 0.0, jnp.minimum(since + 1, 1e6)).astype(since.dtype)
    guilty = since * PACKET <= limits.memory
    wheels = telemetry.wheel_cusum / limits.wheel
    strange = jnp.maximum(telemetry.nis_sum / limits.nis_sum, telemetry.rejected / limits.persistent)
    wheel, score = jnp.max(wheels), jnp.maximum(jnp.max(wheels), jnp.maximum(strange, telemetry.cross))
    sun, field = (
        jnp.sum(jnp.square(a / std)) > ODD
        for a, std in zip(against_stars(telemetry), (params.std_sun, params.std_field))
    )
    by_wheel, by_cross = wheel >= score, telemetry.cross >= score
    alone = by_cross & (strange < 1) & (sun != field)
    gyro = ~by_wheel & ~by_cross & guilty
    star = ~by_wheel & ~gyro & ~alone
    units = (gyro, 3), (star, 3), (alone & sun, 3), (alone & field, 3)
    of_gyro, of_star, of_sun, of_field = (jnp.where(jnp.full(n, a), 1.0, 0.0) for a, n in units)
    blame = jnp.concatenate([of_gyro, of_star, jnp.where(by_wheel & (wheels >= wheel), 1.0, 0.0), of_sun, of_field])
    return since, Verdict(score, blame.astype(score.dtype))


class Flat(NamedTuple):
    """Last readings, and for how many readings each has been the same."""

    gyro: Any  # (3,)
    star: Any  # (4,)
    gyro_same: Any  # (3,)
    star_same: Any


def flat_init(params) -> Flat:
    return Flat(jnp.zeros(3), jnp.zeros(4), jnp.zeros(3), jnp.zeros(()))


def flat_step(params, z: Flat, telemetry: Telemetry):
    """For how many readings in a row a gyro or the star tracker has repeated itself exactly."""
    gyro, star, gyro_same, star_same = z
    for reading in telemetry.gyro:
        gyro_same, gyro = jnp.where(reading == gyro, gyro_same + 1, 0), reading
    for sample, valid in zip(telemetry.star, telemetry.star_valid):
        again = jnp.where(jnp.all(sample == star), star_same + 1, 0)
        star_same, star = jnp.where(valid, again, star_same), jnp.where(valid, sample, star)
    score = jnp.maximum(jnp.max(gyro_same), star_same)
    blame = jnp.concatenate([gyro_same, jnp.full(3, star_same), jnp.zeros(CHANNELS - 6, score.dtype)]) + 1e-6
    return Flat(gyro, star, gyro_same, star_same), Verdict(score, blame.astype(score.dtype))


def chi2(packets: int) -> Detector:
    """The chi-square row of so many packets."""
    return Detector(f"chi2_{packets}", window_of(packets), chi2_step)


def page(name: str, *parts: slice) -> Detector:
    """A row of CUSUMs of some of the residuals."""
    seen = np.zeros(CHANNELS, np.float32)
    for part in parts:
        seen[part] = 1
    step = OnResiduals(cusum_step, residuals_step)
    return Detector(name, with_residuals(cusum_init, residuals_init), step, CusumParams(seen), 1)


_LIMITS = loop.Limits(*(np.asarray(a, np.float32) for a in loop.Limits()))
MICROSAT_ROWS = {
    row.name: row
    for row in (
        *map(chi2, (1, 10, 60)), page("wheels", WHEEL), page("momentum", GYRO), page("cusum", slice(None)),
        Detector("fdir", fdir_init, fdir_step, _LIMITS, 4),
    )
}  # fmt: skip
_RUN = (round(seconds / PACKET) for seconds in (microsat_days.WARMUP, microsat_days.WINDOW))
REFERENCE = (*references(CHANNELS, chi2(10), *_RUN), Detector("flatline", flat_init, flat_step))
