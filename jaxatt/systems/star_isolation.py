"""Which of two star sensors has failed? Two linear minimum-mean-square-error filters tell (Yuan, He, Xing & Xiong).

A satellite on a circular orbit points at the Earth. One star sensor looks along its roll axis, one along its pitch
axis; each feeds a filter of its own, and both filters share the gyro. A filter whose weighted residual is too
large blames its sensor; both together blame the gyro. The control loop closes on ideal attitude and rate unless
told otherwise, so that sensor faults do not enter it. The paper's Table 1 is lost: every number here is ours
(choices 1 and 4). Leaves with a sensor axis have shape (2, *lanes): roll-axis star sensor, pitch-axis star sensor.
Choices and errata by number: docs/loops/star_isolation.md.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check, scores
from jaxatt.attitude import quat_conjugate, quat_error, quat_normalised, quat_rate, quat_rotate
from jaxatt.bodies import body_acceleration, gravity_gradient
from jaxatt.check import door
from jaxatt.controllers import quaternion_pd, saturated
from jaxatt.detection import alarm, isolate
from jaxatt.engine import System
from jaxatt.faults import Fault, any_active, check_fault, first_onset, on_axes
from jaxatt.lmmse import (
    AttitudeBias,
    Estimate,
    Innovation,
    bias_predict,
    bias_update,
    lmmse_predict,
    lmmse_start,
    lmmse_update,
    turn_predict,
    turn_update,
)
from jaxatt.sensors import read_triad, triad
from jaxatt.vec import Mat3, Quat, Vec3, cross, inverse, norm, once

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


@door
def on_sensor(number: int, faults: Vec3) -> Vec3:
    """Faults per axis of one star sensor, number `ROLL` or `PITCH`, the other healthy: a `Vec3` of `Fault` (2,)."""
    check.one_of("number", number, (ROLL, PITCH))
    healthy = on_axes(Fault())
    pair = (faults, healthy) if number == ROLL else (healthy, faults)
    return jax.tree.map(lambda a, b: np.stack(np.broadcast_arrays(a, b)), *pair)


@door
def tangential(number: int, fault: Fault) -> Vec3:
    """The same fault on the two axes of star sensor ``number`` across its boresight; along it a turn moves nothing."""
    check.one_of("number", number, (ROLL, PITCH))
    return Vec3(Fault(), fault, fault) if number == ROLL else Vec3(fault, Fault(), fault)


class Params(NamedTuple):
    """What the engineer ships."""

    std_gyro: Any = 3e-6  # () [rad/s] believed noise of the gyro per sample: angle random walk / sqrt(dt)
    std_star: Any = 10 * ARCSEC  # () [1] believed noise of a star sensor per component
    std_q0: Any = 1e-6  # () [1] standard deviation of the initial estimate, scalar part
    std_qv: Any = 1e-3  # () [1] the same, each component of the vector part
    std_bias: Any = 10 * DEG / 3600  # () [rad/s] prior of the gyro bias per axis; 7-state filter only
    walk: Any = 0.0  # () [rad/s/sqrt(s)] believed random walk of the gyro bias; 7-state filter only
    law: Any = 0.0  # () where gyro noise is evaluated: 0 second moment (11), 1 estimate, 2 identity, 3 Q - P
    stars: Vec3 = Vec3(np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array([0.0, 0.0]))  # (2,) catalogue directions
    threshold: Any = 27.0  # () [1] on the windowed r' M^-1 r: n^2 3 N with n = 3, N = 1 (choice 2)
    angle_threshold: Any = 20.5  # () [1] on the squared angle between the stars, chi-square with one degree
    unit: Any = 0.0  # () 1: readings are made unit vectors first, which leaves J two degrees of freedom
    feedback: Any = 0.0  # () what the control closes on: 0 ideal attitude and rate, 1 roll filter, 2 pitch filter
    q_d: Quat = Quat(1.0, 0.0, 0.0, 0.0)  # [1] target attitude in the orbit frame
    orbit_rate: Any = 1.1e-3  # () [rad/s] believed
    J: Mat3 = INERTIA  # [kg m^2] believed inertia
    bandwidth: Any = 0.05  # () [rad/s] of the PD control
    damping: Any = 0.9  # () [1]
    u_max: Any = 0.2  # () [N m] torque limit per axis


class Scenario(NamedTuple):
    """What the day brings."""

    q: Quat = _turn(0.10, -0.08, 0.12)  # [1] initial attitude in the orbit frame, body to orbit
    w: Vec3 = Vec3(2e-3 * DEG, -1e-3 * DEG - 1.1e-3, 1.5e-3 * DEG)  # [rad/s] initial body rate, inertial
    q_hat: Quat = Quat(np.ones(2), np.zeros(2), np.zeros(2), np.zeros(2))  # (2, *lanes) [1] initial estimates
    stars: Vec3 = Params().stars  # (2, *lanes) [1] true directions, orbit frame
    orbit_rate: Any = 1.1e-3  # () [rad/s] true
    J: Mat3 = INERTIA  # [kg m^2] true inertia
    torque: Vec3 = Vec3(2e-4, -1e-4, 1.5e-4)  # [N m] constant disturbance, body axes
    std_gyro: Any = 3e-6  # () [rad/s] true noise of the gyro per sample
    std_star: Any = 10 * ARCSEC  # () [1] true noise of a star sensor per component
    bias: Vec3 = Vec3(0.0, 0.0, 0.0)  # [rad/s] gyro bias at the start, eq. (4)
    walk: Any = 0.0  # () [rad/s/sqrt(s)] its random walk, eq. (4)
    star: Vec3 = on_sensor(ROLL, tangential(ROLL, Fault(onset=100.0, bias=100 * ARCSEC)))  # (2, *lanes) faults [1]
    gyro: Vec3 = on_axes(Fault())  # faults per axis [rad/s]
    actuator: Vec3 = on_axes(Fault())  # faults per axis [N m]


class Readings(NamedTuple):
    """What the sensors say at a tick."""

    gyro: Vec3  # [rad/s]
    stars: Vec3  # (2, *lanes) [1] star directions in body axes
    q: Quat  # [1] ideal attitude, from a navigation of which the paper says nothing
    w: Vec3  # [rad/s] ideal rate


class Sensors(NamedTuple):
    """Readings, and what the sensors keep for the next tick."""

    readings: Readings
    bias: Vec3  # [rad/s] gyro bias


class Board(NamedTuple):
    """What the on-board computer knows."""

    filters: Any  # (2, *lanes) Moments or Estimate: one filter per star sensor
    gyro: Vec3  # [rad/s] last reading: the prediction from k-1 to k uses that of k-1
    recent: Any  # (window, 2, *lanes) [1] last values of r' M^-1 r
    latched: Any  # (2, *lanes) bool: alarms so far, for that of a constant fault ends by itself
    u: Vec3  # [N m] torque command


class X(NamedTuple):
    """Continuous state: the truth."""

    q: Quat  # [1] attitude in the orbit frame
    w: Vec3  # [rad/s] body rate, inertial


class Z(NamedTuple):
    """Held between ticks."""

    sensors: Sensors
    board: Board
    torque: Vec3  # [N m] what the actuators give
    J_inv: Mat3  # [1/(kg m^2)] inverse of the true inertia


class Verdict(NamedTuple):
    """What the board concludes at a tick."""

    innovation: Innovation  # (2, *lanes) of each filter; zero at tick 0, whose reading is not used
    J: Any  # (2, *lanes) [1] evaluation, eq. (18)
    alarm: Any  # (2, *lanes) bool
    latched: Any  # (2, *lanes) bool: an alarm now or before
    cause: Any  # () of detection: NONE, FIRST (roll star), SECOND (pitch star), COMMON (gyro), eq. (20)
    latched_cause: Any  # () the same from latched alarms
    angle: Any  # () [1] squared error of the angle between the measured stars, chi-square with one degree
    angle_alarm: Any  # () bool: one of the stars and not the gyro


class Log(NamedTuple):
    """What a tick reports. Truth unless it says otherwise."""

    q: Quat  # [1] attitude in the orbit frame
    w: Vec3  # [rad/s] body rate
    u: Vec3  # [N m] torque of the actuators
    board: Verdict
    error: Vec3  # (2, *lanes) [rad] turn by which each estimate errs
    std: Vec3  # (2, *lanes) [rad] what each filter believes of it, on board
    nees: Any  # (2, *lanes) [1] error squared in units of its covariance, vector part: 3 degrees of freedom
    nees_q: Any  # (2, *lanes) [1] the same of all four components (three where the filter has no more)
    bias: Vec3  # (2, *lanes) [rad/s] estimated gyro bias, on board; zero where the filter has none
    readings: Readings  # what the board was told


class Scores(NamedTuple):
    """Tallies of a run: what a sweep reports. Shape (2, *lanes) where it says each."""

    delay: Any  # [s] each: from the first onset to the first alarm not before it; inf if never
    alarm_end: Any  # [s] each: last alarm after the first onset; 0 if none, inf if it lasts
    false_alarms: Any  # [1] each: share of alarms before the first onset
    miss: Any  # [1] each: share of ticks without alarm while a fault is on
    angle_delay: Any  # [s] the same delay of the angle between the stars
    peak: Any  # [1] each: largest J after the first onset
    nis: Any  # [1] each: mean of r' M^-1 r, tick 0 apart
    nees: Any  # [1] each: at the end
    error: Any  # [rad] each: rms of the attitude error
    pointing: Any  # [rad] rms of the angle to the target's frame
    peak_u: Any  # [N m]
    verdict: Any  # [1] cause by the latched alarms at the end, as a float
    ok: Any  # bool, every number of the log was finite


HEALTHY = on_sensor(ROLL, on_axes(Fault()))  # no fault of either star sensor


class Generator(NamedTuple):
    """A residual generator: a filter for one star sensor, as functions."""

    start: Callable  # (params, q_hat) -> estimate
    predict: Callable  # (params, estimate, gyro reading, dt) -> estimate
    update: Callable  # (params, estimate, y, s) -> estimate, Innovation
    attitude: Callable  # (estimate) -> unit Quat
    bias: Callable  # (estimate) -> Vec3 [rad/s]
    error: Callable  # (estimate, q) -> turn Vec3 [rad], std Vec3 [rad], nees, nees_q
    linear: bool  # whether pointing must stay within LINEAR_RANGE


@door
def orbit_rate(rate) -> Vec3:
    """w_r = (0, -wo, 0): rate of the orbit frame in its own axes [rad/s]."""
    o = jnp.zeros_like(rate)
    return Vec3(o, -rate, o)


@door
def quaternion_error(x: Quat, P, q: Quat):
    """Turn [rad] by which the estimate x of q errs, its deviation, NEES of the vector part and of all four.

    P: covariance of x, 4 rows of 4.
    """
    e = x - q
    b = Vec3(*P[0][1:4])
    D_inv = inverse(Mat3(*(Vec3(*row[1:4]) for row in P[1:4])))
    nees = e.v @ (D_inv @ e.v)
    rest = e.w - b @ (D_inv @ e.v)  # block elimination of the vector part leaves the scalar part's own share
    nees_q = nees + rest * rest / (P[0][0] - b @ (D_inv @ b))
    std = Vec3(*(2 * jnp.sqrt(P[i][i]) for i in (1, 2, 3)))
    return 2 * e.v, std, nees, nees_q


def _turn_error(e: Estimate, q: Quat):
    error = quat_error(e.x, q)
    turn = error.v * jnp.where(error.w < 0, -2, 2)
    nees = turn @ (inverse(Mat3(*(Vec3(*row) for row in e.P))) @ turn)
    return turn, Vec3(*(jnp.sqrt(e.P[i][i]) for i in range(3))), nees, nees


def _no_bias(x) -> Vec3:
    o = jnp.zeros_like(x.w)
    return Vec3(o, o, o)


def _diagonal(*variances):
    return tuple(tuple(a if i == j else jnp.zeros(()) for j in range(len(variances))) for i, a in enumerate(variances))


LMMSE = Generator(  # the paper's, eqs. (11) to (16)
    start=lambda params, q: lmmse_start(q, _diagonal(params.std_q0**2, *[params.std_qv**2] * 3)),
    predict=lambda params, e, w, dt: lmmse_predict(
        e, w, orbit_rate(params.orbit_rate), params.std_gyro, dt, params.law
    ),
    update=lambda params, e, y, s: lmmse_update(e, y, s, params.std_star),
    attitude=lambda e: quat_normalised(e.x),
    bias=lambda e: _no_bias(e.x),
    error=lambda e, q: quaternion_error(e.x, e.P, q),
    linear=True,
)
WITH_BIAS = Generator(  # seven states: the gyro's bias is estimated too
    start=lambda params, q: Estimate(
        AttitudeBias(*(*q, *_no_bias(q))),
        _diagonal(params.std_q0**2, *[params.std_qv**2] * 3, *[params.std_bias**2] * 3),
    ),
    predict=lambda params, e, w, dt: bias_predict(
        e, w, orbit_rate(params.orbit_rate), params.std_gyro, params.walk, dt
    ),
    update=lambda params, e, y, s: bias_update(e, y, s, params.std_star),
    attitude=lambda e: quat_normalised(e.x.q),
    bias=lambda e: e.x.b,
    error=lambda e, q: quaternion_error(e.x.q, e.P, q),
    linear=True,
)
TURN = Generator(  # multiplicative EKF with the exact residual, for large pointing offsets
    start=lambda params, q: Estimate(quat_normalised(q), _diagonal(*[4 * params.std_qv**2] * 3)),
    predict=lambda params, e, w, dt: turn_predict(e, w, orbit_rate(params.orbit_rate), params.std_gyro, dt),
    update=lambda params, e, y, s: turn_update(e, y, s, params.std_star),
    attitude=lambda e: e.x,
    bias=lambda e: _no_bias(e.x),
    error=_turn_error,
    linear=False,
)


def init(generator: Generator, window: int, params: Params, scenario: Scenario):
    """x, z at the start; window: how many values the evaluation sums."""
    o = jnp.zeros(())
    zero = Vec3(o, o, o)
    filters = jax.vmap(partial(generator.start, params))(scenario.q_hat)
    readings = Readings(scenario.w, scenario.stars, scenario.q, scenario.w)
    board = Board(filters, scenario.w, jnp.zeros((window, 2)), jnp.zeros(2, bool), zero)
    return X(scenario.q, scenario.w), Z(Sensors(readings, scenario.bias), board, zero, inverse(scenario.J))


def seen(q: Quat, v: Vec3) -> Vec3:
    """A(q) v: a vector of the orbit frame in body axes."""
    return quat_rotate(quat_conjugate(q), v)


def sense(params: Params, scenario: Scenario, now, x: X, z: Z, noise) -> Sensors:
    """What the sensors read; noise: 12 normals, gyro, walk of its bias, stars by axis and then by sensor."""
    last = z.sensors.readings
    gyro = read_triad(triad(scenario.gyro, now.t, scenario.std_gyro, noise[:3], last.gyro), x.w + z.sensors.bias)
    axes = Vec3(noise[6:8], noise[8:10], noise[10:12])
    stars = triad(scenario.star, now.t, scenario.std_star, axes, last.stars)  # eq. (10)
    stars = read_triad(stars, seen(x.q, scenario.stars))  # eq. (6)
    bias = z.sensors.bias + scenario.walk * now.dt**0.5 * Vec3(*noise[3:6])  # eq. (4)
    return Sensors(Readings(gyro, stars, x.q, x.w), bias)


def advanced(generator: Generator, params: Params, filters, gyro: Vec3, y: Vec3, dt):
    """The bank of filters, (2, *lanes), one tick on: predicted with the last gyro reading, updated by the stars y.

    dt: [s] of the tick.
    """

    def one(e, y, s):
        ahead = once(lambda e, w: generator.predict(params, e, w, dt), e, gyro)
        return generator.update(params, ahead, y, s)

    return jax.vmap(one)(filters, y, params.stars)


def decide(params: Params, now, board: Board, readings: Readings, generator: Generator = LMMSE):
    """One tick on board: both filters, alarms, their cause, the torque command. Returns board and `Verdict`."""
    lengths = norm(readings.stars)
    pointing = readings.stars / jnp.where(lengths > 0, lengths, 1)
    y = Vec3(*(jnp.where(params.unit > 0, a, b) for a, b in zip(pointing, readings.stars)))
    # jit, so that it is traced once for its shapes and its values
    step = jax.jit(lambda: advanced(generator, params, board.filters, board.gyro, y, now.dt), inline=True)
    start = lambda: (board.filters, jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(step)[1]))
    filters, innovation = jax.lax.cond(now.k > 0, step, start)

    recent = jnp.concatenate([board.recent[1:], innovation.nis[None]])
    J = recent.sum(axis=0)  # eq. (18)
    alarms = alarm(J, params.threshold)
    latched = board.latched | alarms
    angle = star_angle(pointing, params)
    verdict = Verdict(
        innovation, J, alarms, latched, isolate(*alarms), isolate(*latched), angle, alarm(angle, params.angle_threshold)
    )
    u = command(generator, params, filters, readings)
    return Board(filters, readings.gyro, recent, latched, u), verdict


def star_angle(pointing: Vec3, params: Params):
    """Squared error of the cosine between the two measured stars in units of its variance: needs no gyro, no filter.

    pointing: (2, *lanes) unit vectors.
    """
    (a, b), (s, p) = _pair(pointing), _pair(params.stars)
    error = a @ b - s @ p
    variance = 2 * params.std_star**2 * (1 - (s @ p) ** 2)
    return error * error / variance


def _pair(v: Vec3):
    return tuple(Vec3(*(a[i] for a in v)) for i in (ROLL, PITCH))


def command(generator: Generator, params: Params, filters, readings: Readings) -> Vec3:
    """PD torque [N m] from the ideal attitude, or from one of the filters and the gyro less its estimated bias."""
    q, w = readings.q, readings.w
    attitudes, biases = jax.vmap(generator.attitude)(filters), jax.vmap(generator.bias)(filters)
    for i in (ROLL, PITCH):
        here = params.feedback == i + 1
        q = Quat(*(jnp.where(here, a[i], b) for a, b in zip(attitudes, q)))
        w = Vec3(*(jnp.where(here, g - a[i], b) for g, a, b in zip(readings.gyro, biases, w)))
    e_w = w - seen(q, orbit_rate(params.orbit_rate))
    u = quaternion_pd(quat_error(q, params.q_d), e_w, w, params.J, params.bandwidth, params.damping)
    return saturated(u, params.u_max)


def tick(generator: Generator, params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """One tick: the truth keeps to |q| = 1, sensors read, the board decides, actuators follow, a log is written."""
    x = x._replace(q=quat_normalised(x.q))
    sensors = sense(params, scenario, now, x, z, noise)
    board, verdict = decide(params, now, z.board, sensors.readings, generator)
    o = jnp.zeros_like(x.w.x)
    torque = read_triad(triad(scenario.actuator, now.t, 0.0, (o, o, o), z.torque), board.u)
    error, std, nees, nees_q = jax.vmap(generator.error, (0, None))(board.filters, x.q)
    bias = jax.vmap(generator.bias)(board.filters)
    log = Log(x.q, x.w, torque, verdict, error, std, nees, nees_q, bias, sensors.readings)
    return x, Z(sensors, board, torque, z.J_inv), log


def flow(params: Params, scenario: Scenario, t, x: X, z: Z) -> X:
    """dx/dt between ticks."""
    o = jnp.zeros_like(x.q.w)
    down = seen(x.q, Vec3(o, o, jnp.ones_like(o)))
    u = z.torque + gravity_gradient(down, scenario.J, scenario.orbit_rate) + scenario.torque
    w_r = Quat(o, *orbit_rate(scenario.orbit_rate))
    return X(
        q=quat_rate(x.q, x.w) - 0.5 * (w_r * x.q),  # eq. (2)
        w=body_acceleration(x.w, u, scenario.J, z.J_inv),  # choice 4
    )


def score(params: Params, scenario: Scenario, now, log: Log) -> Scores:
    """The tallies of one tick."""
    others = (*scenario.gyro, *scenario.actuator)
    onset = jnp.minimum(first_onset(scenario.star).min(axis=0), first_onset(others))
    ill = any_active(scenario.star, now.t).any(axis=0) | any_active(others, now.t)
    after = now.t >= onset
    board, running = log.board, now.k > 0
    return Scores(
        delay=scores.first(now, board.alarm & after, since=onset),
        alarm_end=scores.settling(now._replace(t=now.t - onset), board.alarm, after),
        false_alarms=scores.mean(board.alarm, ~after & running),
        miss=scores.mean(~board.alarm, ill),
        angle_delay=scores.first(now, board.angle_alarm & after, since=onset),
        peak=scores.peak(board.J, after),
        nis=scores.mean(board.innovation.nis, running),
        nees=scores.final(log.nees),
        error=scores.rms(log.error @ log.error),
        pointing=scores.rms(4 * (log.q.v @ log.q.v)),
        peak_u=scores.peak(norm(log.u)),
        verdict=scores.final(board.latched_cause + jnp.zeros_like(onset)),
        ok=scores.always(
            scores.finite(jax.tree.map(lambda a: a.sum(axis=0), (board.J, log.error))) & scores.finite(log.w)
        ),
    )


def _unit(name: str, v, tolerance: float) -> None:
    if check.concrete(v):
        length = np.sqrt(sum(np.square(np.asarray(a, float)) for a in v))
        check.each(f"|{name}|", "be 1", length, np.abs(length - 1) <= tolerance)


def _stars(name: str, stars: Vec3) -> None:
    _unit(name, stars, 1e-6)
    if check.concrete(stars):
        s, p = _pair(Vec3(*(np.asarray(a, float) for a in stars)))
        apart = np.degrees(np.arcsin(np.clip(np.sqrt(cross(s, p) @ cross(s, p)), 0, 1)))
        check.each(f"{name}", "lie in directions at least 1 deg from parallel (in deg)", apart, apart >= 1)


def _within_range(name: str, q: Quat) -> None:
    if check.concrete(q):
        x, y, z = (np.asarray(a, float) for a in q.v)
        worst = float(2 * np.arcsin(np.minimum(np.sqrt(x * x + y * y + z * z), 1)).max())
        if worst > LINEAR_RANGE:
            warnings.warn(
                f"`{name}` lies {np.degrees(worst):.3g} deg from the orbit frame, "
                f"beyond the {np.degrees(LINEAR_RANGE):g} deg for which the filters' measurement (7) is linear: "
                "their residuals grow without a fault. `system_of(TURN)` has no such limit.",
                stacklevel=4,
            )


def refuse_bad(generator: Generator, params: Params, scenario: Scenario) -> tuple:
    """The system's check: ValueError on bad input, a warning for pointing beyond the filter's linear range.

    Returns the lanes.
    """
    lanes = check.shapes(params, scenario, Params(), Scenario())
    for name in ("std_gyro", "std_star", "std_q0", "std_qv", "std_bias", "threshold", "angle_threshold"):
        check.positive(f"params.{name}", getattr(params, name))
    for name in ("bandwidth", "damping", "u_max"):
        check.positive(f"params.{name}", getattr(params, name))
    check.not_negative("params.walk", params.walk)
    check.one_of("params.law", params.law, (0, 1, 2, 3))
    check.one_of("params.unit", params.unit, (0, 1))
    check.one_of("params.feedback", params.feedback, (0, 1, 2))
    check.finite("params.orbit_rate", params.orbit_rate)
    check.moments("params.J", params.J)
    check.moments("scenario.J", scenario.J)
    _unit("params.q_d", params.q_d, 1e-6)
    _unit("scenario.q", scenario.q, 1e-6)
    _unit("scenario.q_hat", scenario.q_hat, 0.01)  # a filter's estimate is not of unit length
    _stars("params.stars", params.stars)
    _stars("scenario.stars", scenario.stars)
    if generator.linear:
        _within_range("params.q_d", params.q_d)
        _within_range("scenario.q", scenario.q)
    for name in ("w", "torque", "bias", "orbit_rate"):
        check.finite(f"scenario.{name}", getattr(scenario, name))
    for name in ("std_gyro", "std_star", "walk"):
        check.not_negative(f"scenario.{name}", getattr(scenario, name))
    for name in ("star", "gyro", "actuator"):
        for axis, fault in getattr(scenario, name)._asdict().items():
            check_fault(f"scenario.{name}.{axis}", fault)
    if generator.linear and check.concrete(params.std_star):
        least = np.min(params.std_star)
        if least < 1e-3:  # python -m benchmarks.precision: 3e-6 rad/s; evaluations and alarms are right to 2e-3
            said = f"`params.std_star` = {least:.2g}: below 1e-3 the rounding of a quaternion near one in float32"
            check.precise(f"{said} turns the estimates about their stars' lines of sight", (params, scenario))
    return lanes


@door
def system_of(generator: Generator = LMMSE, window: int = 1, dt: float = DT) -> System:
    """The loop with another filter (`WITH_BIAS`, `TURN`), a window of N values in eq. (18), or another sampling.

    The threshold belongs to the window: ``threshold_quantile(1e-6, 3 * window)``, for instance.
    Raises ValueError for window < 1 or dt <= 0.
    """
    check.positive("dt", dt)
    window = check.whole("window", window)
    return System(
        partial(init, generator, window),
        partial(tick, generator),
        flow,
        dt=dt,
        normals=12,
        check=partial(refuse_bad, generator),
    )


system = system_of()
params = Params()
scenario = Scenario()
