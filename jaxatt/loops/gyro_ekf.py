"""Gyro failures on a geostationary satellite, with an extended Kalman filter as back-up (Park, 2005).

A rigid body with four wheels in a pyramid is held at zero 3-2-1 Euler angles by a PID law at 2 Hz. `system` knows
its rate from a 17-state filter of angles (sun and earth sensor), gyros, tachometers and its own dynamics;
`direct` takes the rate from the gyros alone. Units of the paper: rad, s, in-lbf (torque), in-lbf-s (momentum),
in-lbf-s^2 (inertia); the published gains assume them. Choices and errata by number: docs/loops/gyro_ekf.md.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check, scores
from jaxatt.attitude import euler_body_rate, euler_rate, full_turn, wrapped
from jaxatt.bodies import body_acceleration
from jaxatt.check import acute, finite, flag, inertia, instant, limit, not_negative, positive, share
from jaxatt.contract import System
from jaxatt.controllers import pid
from jaxatt.detection import chi_square, smoothed, worst_above
from jaxatt.engine import every
from jaxatt.faults import Channel, Fault, Reading, active, channel, healthy, heard, known, present, read
from jaxatt.filters import Belief, innovation, nees, predict, update
from jaxatt.sensors import gyro_pyramid, parity_vector, rate_from, rate_maps
from jaxatt.vec import Mat3, Vec3, array, cross, inverse, largest, project, resultant, zeros
from jaxatt.wheels import allocation, park_pyramid, wheel_rate

DEG = np.pi / 180
DT = 0.125  # [s] gyros, sun sensor, tachometers
CONTROL = 4  # [ticks] between commands: 2 Hz
EARTH = 2  # [ticks] between earth-sensor samples: 4 Hz
SIDEREAL = 7.2921e-5  # [rad/s] orbital rate of a geostationary satellite
INERTIA = Mat3(Vec3(81653.0, 53.0, -106.0), Vec3(53.0, 88831.0, 504.0), Vec3(-106.0, 504.0, 17758.0))  # Table 2
INTEGRAL, ANGLE, RATE, WHEEL, BIAS = (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 13), slice(13, 17))  # of the mean
GYRO = slice(3, 7)  # of the measurements: 3 angles, 4 gyros, 4 tachometers
STATE = "rad s, rad, rad/s, in-lbf-s, rad/s"  # units of the filter's state
MEASURED = "rad, rad/s, in-lbf-s"  # units of the measurements
TURN = full_turn("rad")
ANGLES_MEASURED = np.repeat([TURN, np.inf], [3, 8])  # one turn of the measurements that are angles
ANGLES_ESTIMATED = np.repeat([np.inf, TURN, np.inf], [3, 3, 11])  # and of the states


class Params(NamedTuple):
    """What the engineer ships. Table numbers are the paper's."""

    k_f: Annotated[Vec3, "1", finite] = Vec3(0.5, 0.5, 2.0)  # Table 3
    k_p: Annotated[Vec3, "in-lbf/rad", finite] = Vec3(364.5, 364.5, 52.0)  # Table 3
    k_i: Annotated[Vec3, "in-lbf/(rad s)", finite] = Vec3(2.78125, 2.78125, 0.58984)  # Table 3
    k_d: Annotated[Vec3, "in-lbf s/rad", finite] = Vec3(11504.0, 11504.0, 1152.0)  # Table 3
    J: Annotated[Mat3, "in-lbf-s^2", inertia] = INERTIA  # believed inertia; J.x.y = -sum(m x y)
    alpha: Annotated[Any, "rad", acute] = 54.7 * DEG  # believed gyro pyramid, Table 2
    beta: Annotated[Any, "rad", acute] = 60.0 * DEG
    gamma: Annotated[Any, "rad", acute] = 45.0 * DEG  # believed wheel pyramid, Table 2
    # initial variances, Table 5; of integral and bias: choice 2
    P0: Annotated[Any, f"({STATE})^2", finite, not_negative, (17,)] = np.ones(17)
    # spectral densities of the process noise, Table 5 and choice 2
    Q: Annotated[Any, f"({STATE})^2/s", finite, not_negative, (17,)] = np.repeat([1e-10, 1e-8, 0.0], [9, 4, 4])
    # variances of the measurements, Table 5
    R: Annotated[Any, f"({MEASURED})^2", positive, (11,)] = np.repeat([1.0, 1e-2, 1.0], [3, 4, 4])
    orbit_rate: Annotated[Any, "rad/s", finite] = 0.0  # believed rate of the reference frame about z; paper: none
    torque_max: Annotated[Any, "in-lbf", limit] = np.inf  # limit of a wheel's command; the paper has none
    fill: Annotated[Any, "1", flag] = 0.0  # known faulty gyro, 1: innovation zero, 0: no measurement (choice 4)
    threshold: Annotated[Any, "1", limit] = np.inf  # chi-square beyond which a gyro is dropped; the paper has none
    memory: Annotated[Any, "1", positive, share] = 0.25  # share of a new innovation in the mean that is tested
    slew: Annotated[Vec3, "rad/s", finite] = zeros()  # commanded rates of the angles, from slew_start to slew_end
    slew_start: Annotated[Any, "s", finite, instant] = 0.0
    slew_end: Annotated[Any, "s", finite, instant] = 0.0

    def check(self, name: str) -> None:
        """Refuse, with ValueError, a slew that ends before its start."""
        check.pair(f"{name}.slew_end", "not lie before slew_start", self.slew_end, self.slew_start, np.greater_equal)


class Scenario(NamedTuple):
    """What the day brings. Defaults: Table 6, the gyros healthy."""

    angle: Annotated[Vec3, "rad", finite] = zeros()  # initial 3-2-1 angles (yaw about x, roll about y, pitch about z)
    w: Annotated[Vec3, "rad/s", finite] = Vec3(0.01 * DEG, -0.02 * DEG, 0.02 * DEG)  # initial body rate
    h: Annotated[Any, "in-lbf-s", finite, (4,)] = np.array([-10.0, 5.0, 10.0, -15.0])  # initial wheel momenta
    bias: Annotated[Any, "rad/s", finite, (4,)] = np.array([0.02, -0.01, 0.01, -0.02]) * DEG  # gyro biases
    gyro: Annotated[Fault, "rad/s", (), (4,)] = Fault()  # of the gyros; a field holds one number for all or four
    tacho: Annotated[Fault, "in-lbf-s", (), (4,)] = Fault()  # of the tachometers; likewise
    wheel: Annotated[Fault, "in-lbf", (), (4,)] = Fault()  # of the wheels' torque; likewise
    sun: Annotated[Fault, "rad"] = Fault()  # outage of the angle about x, while active
    earth: Annotated[Fault, "rad"] = Fault()  # outage of the angles about y and z, while active
    announced: Annotated[Any, "1", flag] = 1.0  # 1: the computer is told which gyros and wheels are faulty, 0: not
    std_angle: Annotated[Any, "rad", not_negative] = 1e-4  # sensor noise per sample, one a tick, Table 5
    std_gyro: Annotated[Any, "rad/s", not_negative] = 1e-6  # the same: angle random walk / sqrt(DT)
    std_tacho: Annotated[Any, "in-lbf-s", not_negative] = 1e-4  # the same, per sample
    J: Annotated[Mat3, "in-lbf-s^2", inertia] = INERTIA  # true inertia, likewise
    alpha: Annotated[Any, "rad", acute] = 54.7 * DEG  # true gyro pyramid
    beta: Annotated[Any, "rad", acute] = 60.0 * DEG
    gamma: Annotated[Any, "rad", acute] = 45.0 * DEG  # true wheel pyramid
    orbit_rate: Annotated[Any, "rad/s", finite] = 0.0  # true rate of the reference frame about z
    disturbance: Annotated[Vec3, "in-lbf", finite] = zeros()  # unmodelled torque on the body
    torque_max: Annotated[Any, "in-lbf", limit] = np.inf  # true limit of a wheel's torque
    momentum_max: Annotated[Any, "in-lbf-s", limit] = np.inf  # true limit of a wheel's momentum


class Readings(NamedTuple):
    """What the computer gets. Where a value is not valid it is that of the last sample."""

    angle: Annotated[Reading, "rad"]  # (3,)
    gyro: Annotated[Reading, "rad/s"]  # (4,)
    tacho: Annotated[Reading, "in-lbf-s"]  # (4,)
    up: Annotated[Any, "1"]  # (4,), 1 for wheels not known to be at fault
    integral: Annotated[Any, "rad s"]  # (3,), integral of the true angles, ideal; only `direct` uses it


class Computer(NamedTuple):
    """What the computer with the filter remembers."""

    belief: Belief  # 17 states: integral, angles, body rate, wheel momenta, gyro biases
    u: Any  # (4,) [in-lbf] commanded rates of wheel momentum
    mean: Any  # (5,) [1] moving means of normalised innovations: four gyros, their parity
    dropped: Any  # (4,) bool, gyros that the computer has dropped by itself


class DirectComputer(NamedTuple):
    """What the computer without a filter remembers."""

    u: Any  # (4,) [in-lbf]
    angle: Any  # (3,) [rad] last readings
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
    computer: Any  # `Computer` or `DirectComputer`
    motors: Channel  # (4,) how the wheels turn a command into torque [in-lbf]
    wheels: tuple  # true axes, four `Vec3`: their sines in every stage of the flow would take a third of its time


class FilterLog(NamedTuple):
    """What the filter reports."""

    mean: Annotated[Any, STATE]  # (17,)
    variance: Annotated[Any, f"({STATE})^2"]  # (17,)
    error: Annotated[Any, STATE]  # (17,) truth less mean
    nees: Annotated[Any, "1"]  # normalised estimation error squared, 17 degrees of freedom
    nis: Annotated[Any, "1"]  # normalised innovation squared
    rows: Annotated[Any, "1"]  # measurements used: degrees of freedom of nis
    nll: Annotated[Any, "1"]  # negative log-likelihood of the measurements
    statistic: Annotated[Any, "1"]  # (4,) chi-square of the gyros' smoothed innovations
    parity: Annotated[Any, "1"]  # chi-square of the gyros' parity
    dropped: Annotated[Any, "1"]  # (4,) bool, gyros that the computer has dropped by itself


class Log(NamedTuple):
    """What a tick reports. Truth unless it says otherwise."""

    t: Annotated[Any, "s"]
    integral: Annotated[Vec3, "rad s"]
    angle: Annotated[Vec3, "rad"]
    error: Annotated[Vec3, "rad"]  # angle less commanded angle
    w: Annotated[Vec3, "rad/s"]
    h: Annotated[Any, "in-lbf-s"]  # (4,)
    u: Annotated[Any, "in-lbf"]  # (4,) commanded rates of wheel momentum
    torque: Annotated[Vec3, "in-lbf"]  # of the wheels on the body
    filter: Any  # `FilterLog`; None for `direct`


# the truth


def init_truth(scenario: Scenario, computer):
    """x, z at the start."""
    # within half a turn of the filter's start, for its integral and the true one are those of one and the same angle
    x = X(zeros(), Vec3(*map(wrapped, scenario.angle)), scenario.w, scenario.h)
    no = jnp.zeros(4, bool)
    gyro = project(gyro_pyramid(scenario.alpha, scenario.beta), x.w) + scenario.bias
    readings = Readings(Reading(array(x.angle), no[:3]), Reading(gyro, no), Reading(x.h, no), jnp.ones(4), jnp.zeros(3))
    return x, Z(readings, computer, four(healthy()), park_pyramid(scenario.gamma))


def four(tree):
    """Every number of a tree for four gyros or wheels, (4,)."""
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (4,)), tree)


def sense(params: Params, scenario: Scenario, now, x: X, z: Z, noise) -> Readings:
    """What the sensors read; noise: 11 normals, those of 3 angles, 4 gyros, 4 tachometers."""
    last = z.readings
    sun = ~active(scenario.sun, now.t)
    earth = ~active(scenario.earth, now.t) & (now.k % EARTH == 0)
    fresh = jnp.stack([sun, earth, earth])
    angle = jnp.where(fresh, array(x.angle) + scenario.std_angle * noise[:3], last.angle.value)
    w = project(gyro_pyramid(scenario.alpha, scenario.beta), x.w) + scenario.bias
    gyro = read(channel(scenario.gyro, now.t, scenario.std_gyro, noise[GYRO], last.gyro.value), w)
    tacho = read(channel(scenario.tacho, now.t, scenario.std_tacho, noise[7:], last.tacho.value), x.h)
    told = lambda fault: four((scenario.announced > 0) & active(fault, now.t))
    return Readings(
        angle=Reading(angle, fresh),
        gyro=Reading(gyro, ~told(scenario.gyro) & heard(scenario.gyro, now.t)),
        tacho=Reading(tacho, four(heard(scenario.tacho, now.t))),
        up=jnp.where(told(scenario.wheel), 0.0, 1.0),
        integral=array(x.integral),
    )


def motors(scenario: Scenario, now) -> Channel:
    """How the wheels turn a command into torque until the next tick; a stuck one gives none."""
    return four(channel(scenario.wheel, now.t, 0.0, 0.0, 0.0))


def driven(scenario: Scenario, z: Z, h) -> tuple[Any, Vec3]:
    """Rates of the wheels' momenta (4,) that the motors make of the command, and their torque on the body [in-lbf].

    z: holds the command and the motors; h: (4,) wheel momenta [in-lbf-s].
    """
    u = read(z.motors, wheel_rate(z.computer.u, h, scenario.torque_max, scenario.momentum_max))
    return u, -resultant(z.wheels, u)


def flow(params: Params, scenario: Scenario, t, x: X, z: Z) -> X:
    """dx/dt of the truth, the command held."""
    u, by_wheels = driven(scenario, z, x.h)
    torque = scenario.disturbance + by_wheels
    return X(
        integral=x.angle,
        angle=euler_rate(x.angle, x.w) - Vec3(0.0, 0.0, scenario.orbit_rate),  # eq. (4) inverted
        w=body_acceleration(x.w, torque, scenario.J, resultant(z.wheels, x.h)),  # eq. (3)
        h=u,
    )


# on board


def computer_of(x: X, z: Z) -> Computer:
    """What the computer knows between two ticks."""
    return z.computer


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


def angle_error(angle: Vec3, of: Vec3) -> Vec3:
    """Difference of angles [rad], each modulo a turn."""
    return Vec3(*map(wrapped, angle - of))


def command(params: Params, now, up, integral: Vec3, angle: Vec3, w: Vec3):
    """Rates of wheel momentum u (4,) [in-lbf] for the torque of the PID law (5), shared among the wheels that are up."""
    aim = target(params, now.t)
    errors = angle_error(angle, aim.angle), integral - aim.integral, w - aim.w
    torque = pid(*errors, params.k_f, params.k_p, params.k_i, params.k_d)
    return jnp.clip(allocation(-torque, park_pyramid(params.gamma), up), -params.torque_max, params.torque_max)


def drift(params: Params, u, x):
    """f: rates of integral, angles and body rate, three `Vec3`, of the filter's state x (17,) under command u (4,)."""
    wheels = park_pyramid(params.gamma)
    angle, w = Vec3.of(x[ANGLE]), Vec3.of(x[RATE])
    angle_rate = euler_rate(angle, w) - Vec3(0.0, 0.0, params.orbit_rate)
    momentum = params.J @ w + resultant(wheels, x[WHEEL])
    # eq. (3), written out: the barrier in `body_acceleration` would double the time of the linearised filter
    w_rate = inverse(params.J) @ (-resultant(wheels, u) - cross(w, momentum))
    return angle, angle_rate, w_rate


def measured(params: Params, x):
    """h: three angles, four gyros, four tachometers of the filter's state x (17,); linear."""
    return x[ANGLE], gyros_read(params, x), x[WHEEL]


def gyros_read(params: Params, x) -> list:
    """What the four gyros read according to the filter's state x (17,): G w + b; linear."""
    w = Vec3.of(x[RATE])
    return [axis @ w + bias for axis, bias in zip(gyro_pyramid(params.alpha, params.beta), x[BIAS])]


def decide(params: Params, now, computer: Computer, y: Readings):
    """One tick of the computer with the filter: predict, test the gyros, update, command."""
    elapsed = jnp.where(now.k > 0, now.dt, 0.0)  # nothing lies before the first tick
    unmoved = jnp.concatenate([computer.u, jnp.zeros_like(computer.u)])
    prior = predict(computer.belief, partial(drift, params, computer.u), unmoved, params.Q, elapsed)

    suspicion = suspect(params, now, computer, prior, y)
    caught = worst_above(suspicion.gyro, params.threshold)
    dropped = computer.dropped | caught
    used = present(y.gyro) & ~dropped

    gyro = jnp.where(used, y.gyro.value, jnp.stack(gyros_read(params, prior.mean)))
    value = jnp.concatenate([y.angle.value, gyro, y.tacho.value])
    valid = jnp.concatenate([y.angle.valid, used | (params.fill > 0), y.tacho.valid]) & (now.k > 0)
    belief, met = update(prior, Reading(value, valid), partial(measured, params), params.R, ANGLES_MEASURED)

    state = [Vec3.of(belief.mean[part]) for part in (INTEGRAL, ANGLE, RATE)]
    u = every(CONTROL, now, lambda: command(params, now, y.up, *state), computer.u)
    mean = jnp.where(jnp.any(caught), 0, suspicion.mean)  # one fault taints all innovations: begin anew
    return Computer(belief, u, mean, dropped), (met, suspicion)


class Suspicion(NamedTuple):
    """How far the gyros' readings are from what the filter expects."""

    mean: Any  # (5,) [1] moving means of normalised innovations: four gyros, parity
    gyro: Any  # (4,) [1] their chi-squares
    parity: Any  # () [1] chi-square of the component of the readings that no body rate explains


def suspect(params: Params, now, computer: Computer, prior: Belief, y: Readings) -> Suspicion:
    """Chi-squares of the gyros' innovations, each for itself, and of their parity; honest if R = sigma^2.

    What is missing leaves its mean as it is.
    """
    v = parity_vector(gyro_pyramid(params.alpha, params.beta))  # v' G = 0: free of the body rate
    joined = lambda weights, gyros: [*gyros, sum(weight * a for weight, a in zip(weights, gyros))]
    expected = lambda x: joined(v, gyros_read(params, x))
    readable = present(y.gyro)
    gyros = known(y.gyro, jnp.zeros_like(y.gyro.value))
    value, R = jnp.stack(joined(v, gyros)), jnp.stack(joined(v * v, params.R[GYRO]))
    residual, variance = innovation(prior, value, expected, R)
    usable = jnp.append(readable & ~computer.dropped, jnp.all(readable)) & (now.k > 0)
    mean = jnp.where(usable, smoothed(computer.mean, residual / jnp.sqrt(variance), params.memory), computer.mean)
    statistic = chi_square(mean, params.memory)
    return Suspicion(mean, statistic[:4], statistic[4])


def decide_direct(params: Params, now, computer: DirectComputer, y: Readings):
    """One tick of the computer without a filter: the rate by pseudo-inverse of the gyros in use. No log."""
    angle = known(y.angle, computer.angle)

    def law():
        w = rate_from(computer.maps, y.gyro)
        return command(params, now, y.up, Vec3.of(y.integral), Vec3.of(angle), w)

    return computer._replace(u=every(CONTROL, now, law, computer.u), angle=angle), ()


# the two closed loops


def init(params: Params, scenario: Scenario):
    """x, z at the start; the filter starts at zero, as in the paper."""
    belief = Belief(jnp.zeros(17), jnp.diag(params.P0))
    return init_truth(scenario, Computer(belief, jnp.zeros(4), jnp.zeros(5), jnp.zeros(4, bool)))


def init_direct(params: Params, scenario: Scenario):
    """x, z at the start of the loop without a filter."""
    maps = rate_maps(gyro_pyramid(params.alpha, params.beta))
    return init_truth(scenario, DirectComputer(jnp.zeros(4), array(scenario.angle), maps))


def tick(params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """One tick: sensors read, the computer decides, a log is written."""
    readings = sense(params, scenario, now, x, z, noise)
    computer, (met, suspicion) = decide(params, now, z.computer, readings)
    mean, cov = belief = computer.belief
    truth = jnp.concatenate([array(x.integral), array(x.angle), array(x.w), x.h, scenario.bias])
    tested = suspicion.gyro, suspicion.parity, computer.dropped
    error, squared = wrapped(truth - mean, ANGLES_ESTIMATED), nees(belief, truth, ANGLES_ESTIMATED)
    kept = FilterLog(mean, jnp.diagonal(cov), error, squared, met.nis, met.rows, met.nll, *tested)
    z = Z(readings, computer, motors(scenario, now), z.wheels)
    return x, z, report(params, scenario, now, x, z, kept)


def tick_direct(params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """One tick of the loop without a filter."""
    readings = sense(params, scenario, now, x, z, noise)
    computer, _ = decide_direct(params, now, z.computer, readings)
    z = Z(readings, computer, motors(scenario, now), z.wheels)
    return x, z, report(params, scenario, now, x, z, None)


def report(params: Params, scenario: Scenario, now, x: X, z: Z, filter_log) -> Log:
    """The log of one tick; z: after it; filter_log: `FilterLog` or None."""
    error, torque = angle_error(x.angle, target(params, now.t).angle), driven(scenario, z, x.h)[1]
    return Log(now.t, x.integral, x.angle, error, x.w, x.h, z.computer.u, torque, filter_log)


BAND = 0.01 * DEG  # [rad] pointing band of the settling time
SETTLED = 300.0  # [s] from here on estimation errors count
SINGULAR = 80 * DEG  # [rad] angle about y beyond which the Euler angles are taken as lost


class FilterScores(NamedTuple):
    """Tallies of the filter."""

    rms_angle: Annotated[Any, "rad"]  # (3,) error of the estimated angles, after `SETTLED`
    rms_w: Annotated[Any, "rad/s"]  # (3,) error of the estimated rates, after `SETTLED`
    nis: Annotated[Any, "1"]  # mean NIS per degree of freedom, after `SETTLED`
    final_bias: Annotated[Any, "rad/s"]  # (4,) error of the estimated biases at the end
    statistic: Annotated[Any, "1"]  # (4,) largest chi-square of the gyros' innovations
    caught: Annotated[Any, "s"]  # (4,) when the computer dropped the gyro by itself; inf if never
    parity: Annotated[Any, "s"]  # first time the parity's chi-square was above the threshold; inf if never


class Scores(NamedTuple):
    """Tallies of a run: what a sweep reports."""

    settling: Annotated[Any, "s"]  # last time with any |error| > 0.01 deg; inf if still so at the end
    peak_error: Annotated[Any, "rad"]  # largest |error| of any axis
    final_error: Annotated[Any, "rad"]  # largest |error| of any axis at the end
    rms_error: Annotated[Any, "rad"]  # of the pointing error's norm, after `SETTLED`
    peak_h: Annotated[Any, "in-lbf-s"]  # largest momentum of any wheel
    filter: Any  # `FilterScores`; None for `direct`
    ok: Annotated[Any, "1"]  # bool, every number was finite and the angle about y stayed clear of 90 deg


def score(params: Params, scenario: Scenario, now, log: Log) -> Scores:
    """The tallies of one tick of either loop."""
    size, late = largest(log.error), now.t >= SETTLED
    sound = scores.finite((log.angle, log.w, *log.h, *log.u)) & (jnp.abs(log.angle.y) < SINGULAR)
    return Scores(
        settling=scores.settling(now, ~(size <= BAND)),
        peak_error=scores.peak(size),
        final_error=scores.final(size),
        rms_error=scores.rms(log.error @ log.error, late),
        peak_h=scores.peak(jnp.max(jnp.abs(log.h))),
        filter=None if log.filter is None else score_filter(params, now, late, log.filter),
        ok=scores.always(sound),
    )


def score_filter(params: Params, now, late, log: FilterLog) -> FilterScores:
    """The tallies of one tick of the filter; late: whether it is after `SETTLED`."""
    return FilterScores(
        rms_angle=scores.rms(log.error[ANGLE] ** 2, late),
        rms_w=scores.rms(log.error[RATE] ** 2, late),
        nis=scores.mean(log.nis / jnp.maximum(log.rows, 1), late & (log.rows > 0)),
        final_bias=scores.final(log.error[BIAS]),
        statistic=scores.peak(log.statistic),
        caught=scores.first(now, log.dropped),
        parity=scores.first(now, log.parity > params.threshold),
    )


def consistent(params: Params) -> Params:
    """The filter with R = sigma^2, Q and P0 to match; Table 5 makes S 1e6 times too large (erratum 1)."""
    R = np.repeat([1e-4**2, 1e-6**2, 1e-4**2], [3, 4, 4])
    P0 = np.repeat([1.0, 1e-6, 1e-6, 400.0, 1e-6], [3, 3, 3, 4, 4])
    return params._replace(R=R, Q=1e-8 * np.asarray(Params().Q), P0=P0)


def refuse_bad(params: Params, scenario: Scenario) -> None:
    """The check of both systems: TypeError for params and scenarios of another loop."""
    check.kinds(params, Params, scenario, Scenario)


def refuse_bad_filter(params: Params, scenario: Scenario) -> None:
    """`refuse_bad`, and a warning where float32 does not carry the filter's covariance."""
    refuse_bad(params, scenario)
    P0, R = np.asarray(params.P0, float), np.asarray(params.R, float)
    prior = np.concatenate([P0[ANGLE], P0[RATE].max(axis=0) + P0[BIAS], P0[WHEEL]])  # of the measurements
    least = np.min(R / np.maximum(prior, np.finfo(float).tiny))
    if least < 1e-6:  # python -m benchmarks.precision: NEES off by orders of magnitude, angles by 0.2 %
        said = f"`params.R` is as small as {least:.1g} of the prior variance `params.P0`: below 1e-6 float32 loses"
        check.precise(f"{said} the filter's covariance", (params, scenario))


system = System(init, tick, flow, dt=DT, normals=11, check=refuse_bad_filter)
direct = System(init_direct, tick_direct, flow, dt=DT, normals=11, check=refuse_bad)
params = Params()
scenario = Scenario()
