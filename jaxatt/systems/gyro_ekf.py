"""Gyro failures on a geostationary satellite, with an extended Kalman filter as back-up (Park, 2005).

A rigid body with four wheels in a pyramid is held at zero 3-2-1 Euler angles by a PID law at 2 Hz. `system` knows
its rate from a 17-state filter of angles (sun and earth sensor), gyros, tachometers and its own dynamics;
`direct` takes the rate from the gyros alone. Units of the paper: rad, s, in-lbf (torque), in-lbf-s (momentum),
in-lbf-s^2 (inertia); the published gains assume them. Choices and errata by number: docs/loops/gyro_ekf.md.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check, scores
from jaxatt.attitude import euler_body_rate, euler_rate
from jaxatt.bodies import wheel_rate, wheeled_acceleration
from jaxatt.check import door
from jaxatt.controllers import allocation, pid
from jaxatt.detection import chi_square, smoothed, worst_above
from jaxatt.engine import System, every
from jaxatt.faults import Channel, Fault, Reading, active, channel, check_fault, dead, read
from jaxatt.kalman import Belief, ekf_predict, innovation, kalman_update, nees
from jaxatt.mounting import along, gyro_pyramid, parity_vector, total, wheel_pyramid
from jaxatt.vec import Mat3, Vec3, array, inverse, vec3

DEG = np.pi / 180
DT = 0.125  # [s] gyros, sun sensor, tachometers
CONTROL = 4  # [ticks] between commands: 2 Hz
EARTH = 2  # [ticks] between earth-sensor samples: 4 Hz
SIDEREAL = 7.2921e-5  # [rad/s] orbital rate of a geostationary satellite
INERTIA = Mat3(Vec3(81653.0, 53.0, -106.0), Vec3(53.0, 88831.0, 504.0), Vec3(-106.0, 504.0, 17758.0))  # Table 2
INTEGRAL, ANGLE, RATE, WHEEL, BIAS = (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 13), slice(13, 17))  # of the mean
GYRO = slice(3, 7)  # of the measurements: 3 angles, 4 gyros, 4 tachometers


class Params(NamedTuple):
    """What the engineer ships. Table numbers are the paper's."""

    k_f: Vec3 = Vec3(0.5, 0.5, 2.0)  # [1] Table 3
    k_p: Vec3 = Vec3(364.5, 364.5, 52.0)  # [in-lbf/rad] Table 3
    k_i: Vec3 = Vec3(2.78125, 2.78125, 0.58984)  # [in-lbf/(rad s)] Table 3
    k_d: Vec3 = Vec3(11504.0, 11504.0, 1152.0)  # [in-lbf s/rad] Table 3
    J: Mat3 = INERTIA  # [in-lbf-s^2] believed inertia
    alpha: Any = 54.7 * DEG  # () [rad] believed gyro pyramid, Table 2
    beta: Any = 60.0 * DEG  # () [rad]
    gamma: Any = 45.0 * DEG  # () [rad] believed wheel pyramid, Table 2
    P0: Any = np.ones(17)  # (17,) initial variances, Table 5; of integral and bias: choice 2
    Q: Any = np.repeat([1e-10, 1e-8, 0.0], [9, 4, 4])  # (17,) [1/s] spectral densities, Table 5 and choice 2
    R: Any = np.repeat([1.0, 1e-2, 1.0], [3, 4, 4])  # (11,) variances of the measurements, Table 5
    orbit_rate: Any = 0.0  # () [rad/s] believed rate of the reference frame about z; the paper has none
    torque_max: Any = np.inf  # () [in-lbf] limit of a wheel's command; the paper has none
    threshold: Any = np.inf  # () [1] chi-square beyond which a gyro is dropped; the paper drops none by itself
    memory: Any = 0.25  # () [1] share of a new innovation in the mean that is tested
    slew: Vec3 = Vec3(0.0, 0.0, 0.0)  # [rad/s] commanded rates of the angles, from slew_start to slew_end
    slew_start: Any = 0.0  # () [s]
    slew_end: Any = 0.0  # () [s]


class Scenario(NamedTuple):
    """What the day brings. Defaults: Table 6, the gyros healthy."""

    angle: Vec3 = Vec3(0.0, 0.0, 0.0)  # [rad] initial 3-2-1 angles (yaw about x, roll about y, pitch about z)
    w: Vec3 = Vec3(0.01 * DEG, -0.02 * DEG, 0.02 * DEG)  # [rad/s] initial body rate
    h: Any = np.array([-10.0, 5.0, 10.0, -15.0])  # (4,) [in-lbf-s] initial wheel momenta
    bias: Any = np.array([0.02, -0.01, 0.01, -0.02]) * DEG  # (4,) [rad/s] gyro biases
    gyro: Fault = Fault()  # of the four gyros [rad/s]: fields of shape () for all or (4,)
    wheel: Fault = Fault()  # of the four wheels' torque [in-lbf]: likewise
    sun: Fault = Fault()  # () outage of the angle about x, while active
    earth: Fault = Fault()  # () outage of the angles about y and z, while active
    announced: Any = 1.0  # () 1: the board is told which gyros and wheels are at fault, 0: it is not
    fill: Any = 0.0  # () 1: the filter takes its own prediction for a gyro known to be at fault, 0: drops the row
    std_angle: Any = 1e-4  # () [rad] sensor noise, Table 5
    std_gyro: Any = 1e-6  # () [rad/s]
    std_tacho: Any = 1e-4  # () [in-lbf-s]
    J: Mat3 = INERTIA  # [in-lbf-s^2] true inertia
    alpha: Any = 54.7 * DEG  # () [rad] true gyro pyramid
    beta: Any = 60.0 * DEG  # () [rad]
    gamma: Any = 45.0 * DEG  # () [rad] true wheel pyramid
    orbit_rate: Any = 0.0  # () [rad/s] true rate of the reference frame about z
    disturbance: Vec3 = Vec3(0.0, 0.0, 0.0)  # [in-lbf] unmodelled body torque
    torque_max: Any = np.inf  # () [in-lbf] true limit of a wheel's torque
    momentum_max: Any = np.inf  # () [in-lbf-s] true limit of a wheel's momentum


class Readings(NamedTuple):
    """What the board gets. Where a value is not valid it is that of the last sample."""

    angle: Reading  # (3,) [rad]
    gyro: Reading  # (4,) [rad/s]
    tacho: Reading  # (4,) [in-lbf-s]
    up: Any  # (4,) [1] 1 for wheels not known to be at fault
    integral: Any  # (3,) [rad s] integral of the true angle, ideal; only `direct` uses it


class Board(NamedTuple):
    """What the filter's computer remembers."""

    belief: Belief  # 17 states: integral, angles, body rate, wheel momenta, gyro biases
    u: Any  # (4,) [in-lbf] commanded rates of wheel momentum
    mean: Any  # (5,) [1] moving means of normalised innovations: four gyros, their parity
    dropped: Any  # (4,) bool, gyros that the board has dropped by itself
    fill: Any  # () how it treats a gyro known to be at fault


class DirectBoard(NamedTuple):
    """What the computer without a filter remembers."""

    u: Any  # (4,) [in-lbf]
    maps: Any  # (16, 3, 4) pseudo-inverse of the gyro axes for every subset of gyros in use


class X(NamedTuple):
    """Continuous state: the truth."""

    integral: Vec3  # [rad s] of the angles
    angle: Vec3  # [rad]
    w: Vec3  # [rad/s] body rate
    h: Any  # (4,) [in-lbf-s] wheel momenta


class Z(NamedTuple):
    """Held between ticks."""

    readings: Readings
    board: Any  # `Board` or `DirectBoard`
    motors: Channel  # (4,) how the wheels turn a command into torque [in-lbf]
    gyros: tuple  # true axes, four Vec3
    wheels: tuple
    J_inv: Mat3  # inverse of the true inertia


class FilterLog(NamedTuple):
    """What the filter reports."""

    mean: Any  # (17,)
    variance: Any  # (17,)
    error: Any  # (17,) truth less mean
    nees: Any  # () normalised estimation error squared, 17 degrees of freedom
    nis: Any  # () normalised innovation squared
    rows: Any  # () measurements used: degrees of freedom of nis
    nll: Any  # () negative log-likelihood of the measurements
    statistic: Any  # (4,) chi-square of the gyros' smoothed innovations
    parity: Any  # () chi-square of the gyros' parity
    dropped: Any  # (4,) bool, gyros that the board has dropped by itself


class Log(NamedTuple):
    """What a tick reports. Truth unless it says otherwise."""

    integral: Vec3  # [rad s]
    angle: Vec3  # [rad]
    error: Vec3  # [rad] angle less commanded angle
    w: Vec3  # [rad/s]
    h: Any  # (4,) [in-lbf-s]
    u: Any  # (4,) [in-lbf] commanded rates of wheel momentum
    filter: Any  # `FilterLog`; None for `direct`


# the truth


@door
def failed(mask, onset: Any = 0.0) -> Fault:
    """Gyros or wheels that are dead from the onset [s] on where mask, (4, *lanes) of bool, is true."""
    mask = np.asarray(mask, bool)
    return jax.tree.map(lambda a: np.broadcast_to(a, mask.shape), dead())._replace(onset=np.where(mask, onset, np.inf))


def init_truth(scenario: Scenario):
    """x, and what z holds but for the board."""
    x = X(Vec3(*jnp.zeros(3)), scenario.angle, scenario.w, scenario.h)
    gyros, wheels = gyro_pyramid(scenario.alpha, scenario.beta), wheel_pyramid(scenario.gamma)
    no = jnp.zeros(4, bool)
    readings = Readings(
        angle=Reading(array(x.angle), no[:3]),
        gyro=Reading(along(gyros, x.w) + scenario.bias, no),
        tacho=Reading(scenario.h, no),
        up=jnp.ones(4),
        integral=jnp.zeros(3),
    )
    healthy = Channel(jnp.ones(4), jnp.zeros(4))
    return x, Z(readings, None, healthy, gyros, wheels, inverse(scenario.J))


def sense(params: Params, scenario: Scenario, now, x: X, z: Z, noise) -> Readings:
    """What the sensors read; noise: 11 normals, those of 3 angles, 4 gyros, 4 tachometers."""
    told = scenario.announced > 0
    sun = ~active(scenario.sun, now.t)
    earth = ~active(scenario.earth, now.t) & (now.k % EARTH == 0)
    fresh = jnp.stack([sun, earth, earth])
    angle = jnp.where(fresh, array(x.angle) + scenario.std_angle * noise[:3], z.readings.angle.value)
    gyro = channel(scenario.gyro, now.t, scenario.std_gyro, noise[GYRO], z.readings.gyro.value)
    tacho = x.h + scenario.std_tacho * noise[7:]
    ill = lambda fault: jnp.broadcast_to(told & active(fault, now.t), x.h.shape)
    return Readings(
        angle=Reading(angle, fresh),
        gyro=Reading(read(gyro, along(z.gyros, x.w) + scenario.bias), ~ill(scenario.gyro)),
        tacho=Reading(tacho, jnp.ones(tacho.shape, bool)),
        up=jnp.where(ill(scenario.wheel), 0.0, 1.0).astype(tacho.dtype),
        integral=array(x.integral),
    )


def motors(scenario: Scenario, now) -> Channel:
    """How the wheels turn a command into torque until the next tick; a stuck one gives none."""
    wheels = channel(scenario.wheel, now.t, 0.0, 0.0, 0.0)
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (4, *jnp.shape(scenario.bias)[1:])), wheels)


def flow(params: Params, scenario: Scenario, t, x: X, z: Z) -> X:
    """dx/dt of the truth, the command held."""
    u = wheel_rate(z.board.u, x.h, scenario.torque_max, scenario.momentum_max)
    u = read(z.motors, u)
    T = total(z.wheels, u) - scenario.disturbance
    return X(
        integral=x.angle,
        angle=euler_rate(x.angle, x.w) - Vec3(0.0, 0.0, scenario.orbit_rate),  # eq. (4) inverted
        w=wheeled_acceleration(x.w, total(z.wheels, x.h), T, scenario.J, z.J_inv),  # eq. (3)
        h=u,
    )


# on board


class Target(NamedTuple):
    """Where the satellite should be."""

    integral: Vec3  # [rad s] of the angles
    angle: Vec3  # [rad]
    w: Vec3  # [rad/s]


def target(params: Params, t) -> Target:
    """The commanded slew at t [s]: angles at constant rate from slew_start to slew_end, its integral and body rate."""
    span = params.slew_end - params.slew_start
    s = jnp.clip(t - params.slew_start, 0, span)
    after = jnp.maximum(t - params.slew_end, 0)
    moving = (t >= params.slew_start) & (t < params.slew_end)
    rate = params.slew * jnp.where(moving, 1, 0) + Vec3(0.0, 0.0, params.orbit_rate)
    angle = params.slew * s
    return Target(params.slew * (s * s / 2 + span * after), angle, euler_body_rate(angle, rate))


def command(params: Params, now, up, integral: Vec3, angle: Vec3, w: Vec3):
    """Rates of wheel momentum u (4,) [in-lbf] from the PID law (5), shared among the wheels that are up."""
    aim = target(params, now.t)
    T = pid(angle - aim.angle, integral - aim.integral, w - aim.w, params.k_f, params.k_p, params.k_i, params.k_d)
    return jnp.clip(allocation(T, wheel_pyramid(params.gamma), up), -params.torque_max, params.torque_max)


def drift(params: Params, u, x):
    """f: rates of integral, angles and body rate (9, *lanes) of the filter's state x (17, *lanes) under command u."""
    wheels, J_inv = wheel_pyramid(params.gamma), inverse(params.J)
    angle, w = vec3(x[ANGLE]), vec3(x[RATE])
    angle_rate = euler_rate(angle, w) - Vec3(0.0, 0.0, params.orbit_rate)
    w_rate = wheeled_acceleration(w, total(wheels, x[WHEEL]), total(wheels, u), params.J, J_inv)
    return jnp.stack([*angle, *angle_rate, *w_rate])


def measured(params: Params, x):
    """h: angles, gyros, tachometers (11, ...) of the filter's state (17, ...); linear."""
    gyros = along(gyro_pyramid(params.alpha, params.beta), vec3(x[RATE])) + x[BIAS]
    return jnp.concatenate([x[ANGLE], gyros, x[WHEEL]])


def decide(params: Params, now, board: Board, y: Readings):
    """One tick of the computer with the filter: predict, test the gyros, update, command."""
    elapsed = jnp.where(now.k > 0, jnp.asarray(now.dt, board.u.dtype), 0)  # nothing lies before the first tick
    h = partial(measured, params)
    unmoved = jnp.concatenate([board.u, jnp.zeros_like(board.u)])
    prior = ekf_predict(board.belief, partial(drift, params, board.u), unmoved, params.Q, elapsed)

    suspicion = suspect(params, now, board, prior, y)
    caught = worst_above(suspicion.gyro, params.threshold)
    dropped = board.dropped | caught
    known = y.gyro.valid & ~dropped

    fill = board.fill > 0
    gyro = Reading(jnp.where(known, y.gyro.value, h(prior.mean)[GYRO]), known | fill)  # `fill`: innovation zero
    valid = jnp.concatenate([y.angle.valid, gyro.valid, y.tacho.valid]) & (now.k > 0)
    value = jnp.concatenate([y.angle.value, gyro.value, y.tacho.value])
    belief, met = kalman_update(prior, Reading(value, valid), h, params.R)

    x = belief.mean
    law = lambda: command(params, now, y.up, vec3(x[INTEGRAL]), vec3(x[ANGLE]), vec3(x[RATE]))
    u = every(CONTROL, now, law, board.u)
    mean = jnp.where(jnp.any(caught, axis=0), 0, suspicion.mean)  # one fault taints all innovations: begin anew
    return Board(belief, u, mean, dropped, board.fill), (met, suspicion)


class Suspicion(NamedTuple):
    """How far the gyros' readings are from what the filter expects."""

    mean: Any  # (5,) [1] moving means of normalised innovations: four gyros, parity
    gyro: Any  # (4,) [1] their chi-squares
    parity: Any  # () [1] chi-square of the component of the readings that no body rate explains


def suspect(params: Params, now, board: Board, prior: Belief, y: Readings) -> Suspicion:
    """Chi-squares of the gyros' innovations, each for itself, and of their parity; honest if R = sigma^2."""
    value = jnp.concatenate([y.angle.value, y.gyro.value, y.tacho.value])
    residual, variance = innovation(prior, value, partial(measured, params), params.R)
    v = parity_vector(gyro_pyramid(params.alpha, params.beta))
    parity = sum(v[i] * residual[GYRO][i] for i in range(4))  # v' G = 0: free of the body rate
    P_b = prior.cov[BIAS, BIAS]
    spread = sum(v[i] * v[j] * P_b[i, j] for i in range(4) for j in range(4)) + jnp.sum(v * v * params.R[GYRO], axis=0)
    readable = y.gyro.valid & jnp.isfinite(y.gyro.value)
    normalised = jnp.concatenate([residual[GYRO] / jnp.sqrt(variance[GYRO]), (parity / jnp.sqrt(spread))[None]])
    usable = jnp.concatenate([readable & ~board.dropped, jnp.all(readable, axis=0)[None]])
    mean = smoothed(board.mean, jnp.where(usable & (now.k > 0), normalised, 0), params.memory)
    statistic = chi_square(mean, params.memory)
    return Suspicion(mean, statistic[:4], statistic[4])


def decide_direct(params: Params, now, board: DirectBoard, y: Readings):
    """One tick of the computer without a filter: the rate by pseudo-inverse of the gyros in use. No log."""

    def law():
        a, b, c, d = y.gyro.valid
        subset = a + 2 * b + 4 * c + 8 * d
        number = jnp.arange(16).reshape(-1, 1, 1, *(1,) * subset.ndim)
        chosen = jnp.sum(jnp.where(subset == number, board.maps, 0), axis=0)
        used = jnp.where(y.gyro.valid, y.gyro.value, 0)
        w = Vec3(*(sum(row[i] * used[i] for i in range(4)) for row in chosen))
        return command(params, now, y.up, vec3(y.integral), vec3(y.angle.value), w)

    return board._replace(u=every(CONTROL, now, law, board.u)), ()


# the two closed loops


def init(params: Params, scenario: Scenario):
    """x, z at the start; the filter starts at zero, as in the paper."""
    x, z = init_truth(scenario)
    four = jnp.zeros(4)
    belief = Belief(jnp.zeros(17), jnp.diag(params.P0))
    board = Board(belief, four, jnp.zeros(5), four > 0, scenario.fill)
    return x, z._replace(board=board)


def init_direct(params: Params, scenario: Scenario):
    """x, z at the start of the loop without a filter."""
    x, z = init_truth(scenario)
    G = along(gyro_pyramid(params.alpha, params.beta), Vec3(*jnp.eye(3)))
    maps = jnp.stack([jnp.linalg.pinv(G * np.array([[s >> i & 1] for i in range(4)]), rtol=1e-5) for s in range(16)])
    return x, z._replace(board=DirectBoard(jnp.zeros(4), maps))


def tick(params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """One tick: sensors read, the board decides, a log is written."""
    readings = sense(params, scenario, now, x, z, noise)
    board, (met, suspicion) = decide(params, now, z.board, readings)
    mean, cov = board.belief
    truth = jnp.concatenate([array(x.integral), array(x.angle), array(x.w), x.h, scenario.bias])
    variance = jnp.stack([cov[i, i] for i in range(17)])
    error, tested = nees(board.belief, truth), (suspicion.gyro, suspicion.parity)
    filter_log = FilterLog(mean, variance, truth - mean, error, *met, *tested, board.dropped)
    z = z._replace(readings=readings, board=board, motors=motors(scenario, now))
    return x, z, report(params, now, x, board.u, filter_log)


def tick_direct(params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """One tick of the loop without a filter."""
    readings = sense(params, scenario, now, x, z, noise)
    board, _ = decide_direct(params, now, z.board, readings)
    z = z._replace(readings=readings, board=board, motors=motors(scenario, now))
    return x, z, report(params, now, x, board.u, None)


def report(params: Params, now, x: X, u, filter_log) -> Log:
    """The log of one tick; u: (4,) commanded rates [in-lbf]; filter_log: `FilterLog` or None."""
    return Log(x.integral, x.angle, x.angle - target(params, now.t).angle, x.w, x.h, u, filter_log)


BAND = 0.01 * DEG  # [rad] pointing band of the settling time
SETTLED = 300.0  # [s] from here on estimation errors count
SINGULAR = 80 * DEG  # [rad] angle about y beyond which the Euler angles are taken as lost


class Scores(NamedTuple):
    """Tallies of a run: what a sweep reports."""

    settling: Any  # [s] last time with any |error| > 0.01 deg; inf if still so at the end
    peak_error: Any  # [rad] largest |error| of any axis
    final_error: Any  # [rad] largest |error| of any axis at the end
    rms_error: Any  # [rad] of the pointing error's norm, after `SETTLED`
    peak_h: Any  # [in-lbf-s] largest momentum of any wheel
    ok: Any  # bool, every number was finite and the angle about y stayed clear of 90 deg


class FilterScores(NamedTuple):
    """Tallies of a run with the filter: those of `Scores`, then its own."""

    settling: Any  # [s]
    peak_error: Any  # [rad]
    final_error: Any  # [rad]
    rms_error: Any  # [rad]
    peak_h: Any  # [in-lbf-s]
    ok: Any  # bool
    rms_angle: Any  # (3,) [rad] error of the estimated angles, after `SETTLED`
    rms_w: Any  # (3,) [rad/s] error of the estimated rates, after `SETTLED`
    nis: Any  # [1] mean NIS per degree of freedom, after `SETTLED`
    final_bias: Any  # (4,) [rad/s] error of the estimated biases at the end
    statistic: Any  # (4,) largest chi-square of the gyros' innovations
    caught: Any  # (4,) [s] when the board dropped the gyro by itself; inf if never
    parity: Any  # [s] first time the parity's chi-square was above the threshold; inf if never


@door
def worst(v):
    """Largest magnitude of v, three or four components."""
    return jnp.max(jnp.abs(jnp.stack(v)), axis=0)


def score_loop(params: Params, scenario: Scenario, now, log: Log) -> Scores:
    """The tallies of one tick of any of the two loops."""
    size = worst(log.error)
    sound = scores.finite((log.angle, log.w, *log.h, *log.u)) & (jnp.abs(log.angle.y) < SINGULAR)
    return Scores(
        settling=scores.settling(now, ~(size <= BAND)),
        peak_error=scores.peak(size),
        final_error=scores.final(size),
        rms_error=scores.rms(log.error @ log.error, now.t >= SETTLED),
        peak_h=scores.peak(worst([*log.h])),
        ok=scores.always(sound),
    )


def score(params: Params, scenario: Scenario, now, log: Log) -> FilterScores:
    """The tallies of one tick of the loop with the filter."""
    late, f = now.t >= SETTLED, log.filter
    return FilterScores(
        **score_loop(params, scenario, now, log)._asdict(),
        rms_angle=scores.rms(f.error[ANGLE] ** 2, late),
        rms_w=scores.rms(f.error[RATE] ** 2, late),
        nis=scores.mean(f.nis / jnp.maximum(f.rows, 1), late & (f.rows > 0)),
        final_bias=scores.final(f.error[BIAS]),
        statistic=scores.peak(f.statistic),
        caught=scores.first(now, f.dropped),
        parity=scores.first(now, f.parity > params.threshold),
    )


@door
def consistent(params: Params) -> Params:
    """The filter with R = sigma^2, Q and P0 to match; Table 5 makes S 1e6 times too large (erratum 1)."""
    R = np.repeat([1e-4**2, 1e-6**2, 1e-4**2], [3, 4, 4])
    P0 = np.repeat([1.0, 1e-6, 1e-6, 400.0, 1e-6], [3, 3, 3, 4, 4])
    return params._replace(R=R, Q=1e-8 * np.asarray(Params().Q), P0=P0)


def refuse_bad(params: Params, scenario: Scenario) -> tuple:
    """The system's check: ValueError on input outside physics; returns the lanes."""
    lanes = check.shapes(params, scenario, Params(), Scenario()._replace(gyro=None, wheel=None))
    for name in ("gyro", "wheel"):  # one number for all four, or four
        fault = getattr(scenario, name)
        check.kind(f"scenario.{name}", fault, Fault)
        shaped = Fault(*(np.zeros(4) if np.ndim(a) > len(lanes) else 0.0 for a in fault))
        its = check.lanes_of(f"scenario.{name}", fault, shaped)
        if its != lanes:
            check.refuse(f"scenario.{name}", f"carry the lanes of the others, {lanes}", its)
    check.moments("params.J", params.J)
    check.moments("scenario.J", scenario.J)
    for name in ("k_f", "k_p", "k_i", "k_d", "slew", "P0", "Q", "R"):
        check.finite(f"params.{name}", getattr(params, name))
    check.not_negative("params.P0", params.P0)
    check.not_negative("params.Q", params.Q)
    check.positive("params.R", params.R)
    check.above("params.torque_max", params.torque_max, 0, "inf for no limit")
    check.above("params.threshold", params.threshold, 0, "inf to drop none")
    if check.concrete(params.memory):
        check.each("params.memory", "lie in (0, 1]", params.memory, (params.memory > 0) & (params.memory <= 1))
    check.not_negative("params.slew_end - slew_start", params.slew_end - params.slew_start)
    for owner, of in (("params", params), ("scenario", scenario)):
        for name in ("alpha", "beta", "gamma"):  # within it any three axes span space
            check.between(f"{owner}.{name}", getattr(of, name), 0, np.pi / 2, "0 to 90 deg in rad")
        check.finite(f"{owner}.orbit_rate", of.orbit_rate)
    for name in ("angle", "w", "h", "bias", "disturbance"):
        check.finite(f"scenario.{name}", getattr(scenario, name))
    for name in ("std_angle", "std_gyro", "std_tacho"):
        check.not_negative(f"scenario.{name}", getattr(scenario, name))
    for name in ("torque_max", "momentum_max"):
        check.above(f"scenario.{name}", getattr(scenario, name), 0, "inf for no limit")
    for name in ("announced", "fill"):
        check.one_of(f"scenario.{name}", getattr(scenario, name), (0, 1))
    for name in ("gyro", "wheel", "sun", "earth"):
        check_fault(f"scenario.{name}", getattr(scenario, name))
    return lanes


def refuse_bad_filter(params: Params, scenario: Scenario) -> tuple:
    """`refuse_bad`, and a warning where float32 does not carry the filter's covariance."""
    lanes = refuse_bad(params, scenario)
    if check.concrete((params.P0, params.R)):
        P0, R = np.asarray(params.P0, float), np.asarray(params.R, float)
        prior = np.concatenate([P0[ANGLE], P0[RATE].max() + P0[BIAS], P0[WHEEL]])  # of the measurements
        least = np.min(R / np.maximum(prior, np.finfo(float).tiny))
        if least < 1e-6:  # python -m benchmarks.precision: NEES off by orders of magnitude, angles by 0.2 %
            said = f"`params.R` is as small as {least:.1g} of the prior variance `params.P0`: below 1e-6 float32 loses"
            check.precise(f"{said} the filter's covariance", (params, scenario))
    return lanes


system = System(init, tick, flow, dt=DT, normals=11, check=refuse_bad_filter)
direct = System(init_direct, tick_direct, flow, dt=DT, normals=11, check=refuse_bad)
params = Params()
scenario = Scenario()
TABLE_4 = Scenario(
    angle=Vec3(-0.03 * DEG, 0.05 * DEG, 0.05 * DEG),
    w=Vec3(1e-3 * DEG, -2e-3 * DEG, 2e-3 * DEG),
    bias=np.array([5e-5, 1e-5, -1e-5, -5e-5]) * DEG,
)
