"""Which of two star sensors has failed? Two linear minimum-mean-square-error filters tell (Yuan, He, Xing & Xiong).

A satellite on a circular orbit points at the Earth. One star sensor looks along its roll axis, one along its pitch
axis; each feeds a filter of its own, and both filters share the gyro. A filter whose weighted residual is too
large blames its sensor; both together blame the gyro. The control loop closes on ideal attitude and rate unless
told otherwise, so that sensor faults do not enter it. The paper's Table 1 is lost: every number here is ours
(choices 1 and 4). Leaves of shape (2,): roll-axis star sensor, pitch-axis star sensor. Choices and errata by number:
docs/loops/star_isolation.md.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check, scores
from jaxatt.attitude import quat_error, quat_normalised, quat_rate, quat_to_body
from jaxatt.bodies import body_acceleration, gravity_gradient
from jaxatt.check import finite, flag, inertia, limit, not_negative, positive, unit
from jaxatt.compiling import shared
from jaxatt.contract import System
from jaxatt.controllers import quaternion_pd, saturated
from jaxatt.detection import NONE, alarm, isolate, window_sum
from jaxatt.faults import Fault, Reading, any_active, first_onset, known, on_axes, present
from jaxatt.sensors import heard_triad, read_triad, triad
from jaxatt.star_filters import LMMSE, Innovation, StarFilter, orbit_rate, star_angle
from jaxatt.vec import Mat3, Quat, Vec3, cross, norm, where, zeros

DT = 0.1  # [s]
ARCSEC = np.pi / 180 / 3600  # [rad]
DEG = np.pi / 180  # [rad]
INERTIA = Mat3(Vec3(1200.0, 0.0, 0.0), Vec3(0.0, 1000.0, 0.0), Vec3(0.0, 0.0, 800.0))  # [kg m^2]
LINEAR_RANGE = 0.5 * DEG  # [rad] pointing error up to which C of eq. (7) holds (choice 6)
ROLL, PITCH = 0, 1  # the star sensors, by the axis they look along


def _turn(x, y, z) -> Quat:
    """Unit quaternion of a small rotation vector [deg]."""
    r = np.array([x, y, z]) * DEG
    angle = float(np.linalg.norm(r))
    return Quat(float(np.cos(angle / 2)), *(float(a) for a in np.sin(angle / 2) * r / angle))


def _rate(q: Quat, x, y, z) -> Vec3:
    """The body rate, in body axes, that differs from the orbital one by x, y, z [deg/s] at the attitude q."""
    w = quat_to_body(q, Vec3(0.0, -1.1e-3, 0.0)) + DEG * Vec3(x, y, z)
    return Vec3(*map(float, w))


def on_sensor(number: int, faults: Vec3) -> Vec3:
    """Faults per axis of one star sensor, number `ROLL` or `PITCH`, the other healthy: a `Vec3` of `Fault` (2,)."""
    check.one_of("number", number, (ROLL, PITCH))
    healthy = on_axes(Fault())
    pair = (faults, healthy) if number == ROLL else (healthy, faults)
    stack = np.stack if check.concrete(faults) else jnp.stack
    return jax.tree.map(lambda a, b: stack([a, b]), *pair)


def tangential(number: int, fault: Fault) -> Vec3:
    """The same fault on the two axes of star sensor ``number`` across its boresight; along it a turn moves nothing."""
    check.one_of("number", number, (ROLL, PITCH))
    return Vec3(Fault(), fault, fault) if number == ROLL else Vec3(fault, Fault(), fault)


class Params(NamedTuple):
    """What the engineer ships."""

    std_gyro: Annotated[Any, "rad/s", positive] = 3e-6  # believed noise of the gyro per sample
    std_star: Annotated[Any, "1", positive] = 10 * ARCSEC  # believed noise of a star sensor per component and sample
    std_q0: Annotated[Any, "1", positive] = 1e-6  # standard deviation of the initial estimate, scalar part
    std_qv: Annotated[Any, "1", positive] = 1e-3  # the same, each component of the vector part
    std_bias: Annotated[Any, "rad/s", positive] = 10 * DEG / 3600  # prior of the gyro bias per axis; `WITH_BIAS` only
    walk: Annotated[Any, "rad/s/sqrt(s)", not_negative] = 0.0  # believed random walk of the bias; `WITH_BIAS` only
    law: Annotated[Any, "1", partial(check.one_of, allowed=(0, 1, 2, 3))] = 0.0  # of `star_filters.noise_moment`
    stars: Annotated[Vec3, "1", unit, (2,)] = Vec3(np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.zeros(2))  # catalogue
    threshold: Annotated[Any, "1", positive] = 27.0  # on the windowed r' M^-1 r: n^2 3 N with n = 3, N = 1 (choice 2)
    angle_threshold: Annotated[Any, "1", positive] = 20.5  # on the squared angle between the stars, chi-square of one
    unit: Annotated[Any, "1", flag] = 0.0  # 1: readings are made unit vectors, which leaves J two degrees of freedom
    feedback: Annotated[Any, "1", partial(check.one_of, allowed=(0, 1, 2))] = 0.0  # to the control; see `command`
    q_d: Annotated[Quat, "1", unit] = Quat(1.0, 0.0, 0.0, 0.0)  # target attitude in the orbit frame
    orbit_rate: Annotated[Any, "rad/s", finite] = 1.1e-3  # believed
    J: Annotated[Mat3, "kg m^2", inertia] = INERTIA  # believed inertia; products are the entries, J.x.y = -sum(m x y)
    bandwidth: Annotated[Any, "rad/s", positive] = 0.05  # of the PD control
    damping: Annotated[Any, "1", positive] = 0.9
    u_max: Annotated[Any, "N m", limit] = 0.2  # torque limit per axis


class Scenario(NamedTuple):
    """What the day brings."""

    q: Annotated[Quat, "1", unit] = _turn(0.10, -0.08, 0.12)  # initial attitude in the orbit frame, body to orbit
    w: Annotated[Vec3, "rad/s", finite] = _rate(q, 2e-3, -1e-3, 1.5e-3)  # initial, of the inertial motion, body axes
    q_hat: Annotated[Quat, "1", partial(unit, tolerance=0.01), (2,)] = Quat(  # initial estimates; not of unit length
        np.ones(2), np.zeros(2), np.zeros(2), np.zeros(2)
    )
    stars: Annotated[Vec3, "1", unit, (2,)] = Params().stars  # true directions, orbit frame
    orbit_rate: Annotated[Any, "rad/s", finite] = 1.1e-3  # true
    J: Annotated[Mat3, "kg m^2", inertia] = INERTIA  # true inertia, likewise
    torque: Annotated[Vec3, "N m", finite] = Vec3(2e-4, -1e-4, 1.5e-4)  # constant disturbance, body axes
    std_gyro: Annotated[Any, "rad/s", not_negative] = (
        3e-6  # true noise of the gyro per sample: angle random walk / sqrt(dt)
    )
    std_star: Annotated[Any, "1", not_negative] = 10 * ARCSEC  # true noise of a star sensor per component and sample
    bias: Annotated[Vec3, "rad/s", finite] = zeros()  # gyro bias at the start, eq. (4)
    walk: Annotated[Any, "rad/s/sqrt(s)", not_negative] = 0.0  # its random walk, eq. (4)
    star: Annotated[Vec3, "1", (2,)] = on_sensor(ROLL, tangential(ROLL, Fault(onset=100.0, bias=100 * ARCSEC)))
    gyro: Annotated[Vec3, "rad/s"] = on_axes(Fault())  # faults per axis
    actuator: Annotated[Vec3, "N m"] = on_axes(Fault())  # faults per axis


class Readings(NamedTuple):
    """What the sensors say at a tick. A triad counts as a whole: it is not used where a component is NaN."""

    gyro: Annotated[Reading, "rad/s"]  # a `Vec3`, one flag
    stars: Annotated[Reading, "1"]  # star directions in body axes, a `Vec3` of (2,), flags (2,)
    q: Annotated[Quat, "1"]  # ideal attitude, from a navigation of which the paper says nothing
    w: Annotated[Vec3, "rad/s"]  # ideal rate


class SensorState(NamedTuple):
    """Readings, and what the sensors keep for the next tick."""

    readings: Readings
    bias: Vec3  # [rad/s] gyro bias


class Computer(NamedTuple):
    """What the on-board computer knows."""

    filters: Any  # Moments or Belief, each leaf (2,): one filter for each star sensor
    gyro: Vec3  # [rad/s] last reading: the prediction from k-1 to k uses that of k-1
    recent: Any  # (window, 2) [1] values of r' M^-1 r of the last stars
    latched: Any  # (2,) bool: alarms so far, for that of a constant fault ends by itself
    cause: Any  # () [1] by latched alarms, when both filters last had a star


class X(NamedTuple):
    """Continuous state: the truth."""

    q: Quat  # [1] attitude in the orbit frame
    w: Vec3  # [rad/s] body rate, inertial


class Z(NamedTuple):
    """Held between ticks."""

    sensors: SensorState
    computer: Computer
    torque: Vec3  # [N m] what the actuators give


class Verdict(NamedTuple):
    """What the computer concludes at a tick."""

    innovation: Annotated[Innovation, "1"]  # each (2,): of both filters; no star is used at tick 0
    J: Annotated[Any, "1"]  # (2,) evaluation, eq. (18); that of the last star where there is none
    alarm: Annotated[Any, "1"]  # (2,) bool; never without a star
    latched: Annotated[Any, "1"]  # (2,) bool: an alarm now or before
    cause: Annotated[Any, "1"]  # of detection: NONE, FIRST (roll star), SECOND (pitch star), COMMON (gyro), eq. (20)
    latched_cause: Annotated[Any, "1"]  # the same from latched alarms; both wait until both filters have a star
    angle: Annotated[Any, "1"]  # squared error of the angle between the measured stars, chi-square with one degree
    angle_alarm: Annotated[Any, "1"]  # bool: one of the stars and not the gyro


class Log(NamedTuple):
    """What a tick reports. Truth unless it says otherwise. Shape (2,), one for each filter, where it says each."""

    t: Annotated[Any, "s"]
    q: Annotated[Quat, "1"]  # attitude in the orbit frame
    w: Annotated[Vec3, "rad/s"]  # body rate
    u: Annotated[Vec3, "N m"]  # torque of the actuators
    verdict: Verdict  # on board
    error: Annotated[Vec3, "rad"]  # each: turn by which the estimate errs
    std: Annotated[Vec3, "rad"]  # each: what the filter believes of it, on board
    nees: Annotated[Any, "1"]  # each: error squared in units of its covariance, vector part: 3 degrees of freedom
    nees_q: Annotated[Any, "1"]  # each: the same of all four components (three where the filter has no more)
    bias: Annotated[Vec3, "rad/s"]  # each: estimated gyro bias, on board; zero where the filter has none
    estimate: Annotated[Quat, "1"]  # each: attitude, on board
    readings: Readings  # what the computer was told


class Scores(NamedTuple):
    """Tallies of a run: what a sweep reports. Shape (2,), one for each filter, where it says each."""

    delay: Annotated[Any, "s"]  # each: from the first onset to the first alarm not before it; inf if never
    alarm_end: Annotated[Any, "s"]  # each: last alarm after the first onset; 0 if none, inf if it lasts
    false_alarms: Annotated[Any, "1"]  # each: share of alarms before the first onset
    miss: Annotated[Any, "1"]  # each: share of ticks without alarm while a fault is on
    angle_delay: Annotated[Any, "s"]  # the same delay of the angle between the stars
    peak: Annotated[Any, "1"]  # each: largest J after the first onset
    nis: Annotated[Any, "1"]  # each: mean of r' M^-1 r
    nees: Annotated[Any, "1"]  # each: at the end
    error: Annotated[Any, "rad"]  # each: rms of the attitude error
    pointing: Annotated[Any, "rad"]  # rms of the angle to the target's frame
    peak_u: Annotated[Any, "N m"]
    verdict: Annotated[Any, "1"]  # cause by the latched alarms at the end, as a float
    ok: Annotated[Any, "1"]  # bool, every number of the log was finite


HEALTHY = on_sensor(ROLL, on_axes(Fault()))  # no fault of either star sensor


# the loop


def init(star_filter: StarFilter, window: int, params: Params, scenario: Scenario):
    """x, z at the start; window: how many values the evaluation sums."""
    filters = jax.vmap(partial(star_filter.start, params))(scenario.q_hat)
    stars = Reading(scenario.stars, jnp.ones(2, bool))
    readings = Readings(Reading(scenario.w, True), stars, scenario.q, scenario.w)
    computer = Computer(filters, scenario.w, jnp.zeros((window, 2)), jnp.zeros(2, bool), jnp.asarray(NONE))
    return X(scenario.q, scenario.w), Z(SensorState(readings, scenario.bias), computer, zeros())


def sense(params: Params, scenario: Scenario, now, x: X, z: Z, noise) -> SensorState:
    """What the sensors read; noise: 12 normals, gyro, walk of its bias, stars by axis and then by sensor."""
    last = z.sensors.readings
    gyro = triad(scenario.gyro, now.t, scenario.std_gyro, noise[:3], last.gyro.value)
    gyro = Reading(read_triad(gyro, x.w + z.sensors.bias), heard_triad(scenario.gyro, now.t))
    axes = Vec3(noise[6:8], noise[8:10], noise[10:12])
    stars = triad(scenario.star, now.t, scenario.std_star, axes, last.stars.value)  # eq. (10)
    stars = read_triad(stars, quat_to_body(x.q, scenario.stars))  # eq. (6)
    stars = Reading(stars, heard_triad(scenario.star, now.t))
    bias = z.sensors.bias + scenario.walk * now.dt**0.5 * Vec3(*noise[3:6])  # eq. (4)
    return SensorState(Readings(gyro, stars, x.q, x.w), bias)


def advanced(star_filter: StarFilter, params: Params, filters, gyro: Vec3, y: Reading, dt):
    """Both filters one tick of dt [s] on: predicted with the last gyro reading, updated by the stars y, leaves (2,)."""

    def one(belief, y, s):
        ahead = shared(lambda belief, w: star_filter.predict(params, belief, w, dt), belief, gyro)
        return star_filter.update(params, ahead, y, s)

    return jax.lax.map(lambda a: one(*a), (filters, y, params.stars))


def computer_of(x: X, z: Z) -> Computer:
    """What the computer knows between two ticks."""
    return z.computer


def decide(params: Params, now, computer: Computer, readings: Readings, star_filter: StarFilter = LMMSE):
    """One tick on board: both filters, alarms, their cause. Returns computer and `Verdict`.

    A star that is missing is not used: its filter predicts, its window stands still. For a missing gyro the last reading
    stands. Both verdicts wait until both filters have a star, for one alone cannot tell its sensor from the gyro.
    """
    there = present(readings.stars)
    stars = known(readings.stars, params.stars)
    lengths = norm(stars)
    pointing = stars / jnp.where(lengths > 0, lengths, 1)
    used = there & (now.k > 0)
    y = Reading(where(params.unit > 0, pointing, stars), used)
    elapsed = jnp.where(now.k > 0, now.dt, 0.0)  # the filters start with what is believed at tick 0
    filters, innovation = advanced(star_filter, params, computer.filters, computer.gyro, y, elapsed)

    recent = jnp.where(used, window_sum(computer.recent, innovation.nis)[0], computer.recent)
    J = recent.sum(axis=0)  # eq. (18)
    alarms = used & alarm(J, params.threshold)
    latched = computer.latched | alarms
    angle = jnp.where(there.all(), star_angle(*_pair(pointing), *_pair(params.stars), std=params.std_star), 0)
    cause = jnp.where(used.all(), isolate(*alarms), NONE)  # eq. (20)
    latched_cause = jnp.where(used.all(), isolate(*latched), computer.cause)
    angle_alarm = alarm(angle, params.angle_threshold)
    verdict = Verdict(innovation, J, alarms, latched, cause, latched_cause, angle, angle_alarm)
    return Computer(filters, known(readings.gyro, computer.gyro), recent, latched, latched_cause), verdict


def _pair(v: Vec3):
    """The two vectors of a `Vec3` with leaves (2,)."""
    return Vec3(*(a[ROLL] for a in v)), Vec3(*(a[PITCH] for a in v))


def command(star_filter: StarFilter, params: Params, computer: Computer, readings: Readings) -> Vec3:
    """PD torque [N m].

    From the ideal attitude and rate (``params.feedback`` 0), or from the roll (1) or pitch (2) filter and the gyro less
    its estimated bias.
    """
    pitch = params.feedback == 2
    mean = jax.tree.map(lambda a: jnp.where(pitch, a[PITCH], a[ROLL]), computer.filters.mean)
    estimated = star_filter.attitude(mean), computer.gyro - star_filter.bias(mean)
    q, w = where(params.feedback > 0, estimated, (readings.q, readings.w))
    e_w = w - quat_to_body(q, orbit_rate(params.orbit_rate))
    u = quaternion_pd(quat_error(q, params.q_d), e_w, w, params.J, params.bandwidth, params.damping)
    return saturated(u, params.u_max)


def tick(star_filter: StarFilter, params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """One tick: the truth keeps to |q| = 1, sensors read, the computer decides, actuators follow, a log is written."""
    x = x._replace(q=quat_normalised(x.q))
    sensors = sense(params, scenario, now, x, z, noise)
    computer, verdict = decide(params, now, z.computer, sensors.readings, star_filter)
    u = command(star_filter, params, computer, sensors.readings)
    torque = read_triad(triad(scenario.actuator, now.t, 0.0, zeros(), z.torque), u)
    errors = jax.lax.map(lambda belief: star_filter.error(belief, x.q), computer.filters)
    mean = computer.filters.mean
    on_board = dict(bias=star_filter.bias(mean), estimate=star_filter.attitude(mean), readings=sensors.readings)
    log = Log(now.t, x.q, x.w, torque, verdict, *errors, **on_board)
    return x, Z(sensors, computer, torque), log


def flow(params: Params, scenario: Scenario, t, x: X, z: Z) -> X:
    """dx/dt between ticks."""
    down = quat_to_body(x.q, Vec3(0.0, 0.0, 1.0))
    u = z.torque + gravity_gradient(down, scenario.J, scenario.orbit_rate) + scenario.torque
    w_r = Quat(0.0, *orbit_rate(scenario.orbit_rate))
    return X(
        q=quat_rate(x.q, x.w) - 0.5 * (w_r * x.q),  # eq. (2)
        w=body_acceleration(x.w, u, scenario.J),  # choice 4
    )


def score(params: Params, scenario: Scenario, now, log: Log) -> Scores:
    """The tallies of one tick."""
    others = scenario.gyro, scenario.actuator
    onset = jnp.minimum(first_onset(scenario.star).min(), first_onset(others))
    faulty = any_active(scenario.star, now.t).any() | any_active(others, now.t)
    after, verdict = now.t >= onset, log.verdict
    return Scores(
        delay=scores.first(now, verdict.alarm & after, since=onset),
        alarm_end=scores.settling(now._replace(t=now.t - onset), verdict.alarm, after),
        false_alarms=scores.mean(verdict.alarm, ~after & (now.k > 0)),
        miss=scores.mean(~verdict.alarm, faulty),
        angle_delay=scores.first(now, verdict.angle_alarm & after, since=onset),
        peak=scores.peak(verdict.J, after),
        nis=scores.mean(verdict.innovation.nis, verdict.innovation.rows > 0),
        nees=scores.final(log.nees),
        error=scores.rms(log.error @ log.error),
        pointing=scores.rms(4 * (log.q.v @ log.q.v)),
        peak_u=scores.peak(norm(log.u)),
        verdict=scores.final(1.0 * verdict.latched_cause),
        ok=scores.always(scores.finite((verdict.J, log.error)).all() & scores.finite(log.w)),
    )


def refuse_bad(star_filter: StarFilter, params: Params, scenario: Scenario) -> None:
    """The system's check: ValueError for stars too close, warnings for pointing and precision of the linear filters."""
    check.kinds(params, Params, scenario, Scenario)
    for name, stars in (("params.stars", params.stars), ("scenario.stars", scenario.stars)):
        across = cross(*_pair(stars))
        apart = np.degrees(np.arcsin(np.minimum(np.sqrt(across @ across), 1)))
        check.each(name, "lie in directions at least 1 deg from parallel (in deg)", apart, apart >= 1)
    if not star_filter.linear:
        return
    for name, q in (("params.q_d", params.q_d), ("scenario.q", scenario.q)):
        off = np.max(2 * np.arcsin(np.minimum(np.sqrt(q.v @ q.v), 1)))
        if off > LINEAR_RANGE:
            check.warn(
                f"`{name}` lies {off / DEG:.3g} deg from the orbit frame, beyond the {LINEAR_RANGE / DEG:g} deg for which the "
                "filters' measurement (7) is linear: their residuals grow without a fault. `MEKF` has no such limit."
            )
    least = np.min(params.std_star)
    if least < 1e-3:  # python -m benchmarks.precision: 3e-6 rad/s; evaluations and alarms are right to 2e-3
        said = f"`params.std_star` = {least:.2g}: below 1e-3 the rounding of a quaternion near one in float32"
        check.precise(f"{said} turns the estimates about their stars' lines of sight", (params, scenario))


def system_of(star_filter: StarFilter = LMMSE, window: int = 1, dt: float = DT) -> System:
    """The loop with another filter, window or sampling; equal arguments give the same system, which compiles once.

    Args:
        star_filter: `LMMSE`, `WITH_BIAS` or `MEKF` of `jaxatt.star_filters`.
        window: how many values the evaluation (18) sums; ``threshold_quantile(1e-6, 3 * window)`` suits it.
        dt: [s] of a tick.

    Raises:
        ValueError: window < 1 or dt <= 0.

    Example:
        >>> seven = system_of(WITH_BIAS, window=10)
    """
    check.positive("dt", dt)
    return _system_of(star_filter, check.whole("window", window), float(dt))


@lru_cache
def _system_of(star_filter: StarFilter, window: int, dt: float) -> System:
    functions = partial(init, star_filter, window), partial(tick, star_filter), flow
    return System(*functions, dt=dt, normals=12, check=partial(refuse_bad, star_filter))


system = system_of()
params = Params()
scenario = Scenario()
