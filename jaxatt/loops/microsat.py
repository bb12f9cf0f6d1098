"""A 60 kg satellite of today that reconfigures itself: four wheels, gyro, star tracker, sun sensor, magnetometer.

It points at the Earth from a low orbit. An MEKF takes late star samples by a clone; torquers unload the wheels. Detectors
watch wheels, star tracker and gyro: a wheel that alarms is left out of the allocation, a star tracker is replaced by Sun
and magnetic field, a gyro by the rate that the wheels' momentum tells. The numbers are typical of data sheets and mean no
product. Choices by number: docs/loops/microsat.md.
"""

from __future__ import annotations

from functools import partial, reduce
from operator import add
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check, scores
from jaxatt.attitude import quat_angle, quat_conjugate, quat_from_vector, quat_normalised, quat_rate, quat_to_body
from jaxatt.bodies import Facets, aero_torque, body_acceleration, box, dipole_torque, gravity_gradient, solar_torque
from jaxatt.check import finite, flag, inertia, instant, limit, not_negative, positive
from jaxatt.compiling import shared
from jaxatt.contract import System
from jaxatt.controllers import unloading
from jaxatt.delays import aged, due, empty_line, pushed
from jaxatt.detection import Cusum, cusum, persistence, worst_above
from jaxatt.environment import Surroundings, Table, at, refuse_short
from jaxatt.faults import Fault, Reading, active, channel, heard, known, on_axes, present, read
from jaxatt.guidance import Target, nadir, orbit_rate, tracking_error
from jaxatt.mekf import Mekf, cloned, mekf_nees, predict, restarted, start, update_attitude, update_vector
from jaxatt.orbit import EARTH, MU, Elements, along, kepler
from jaxatt.sensors import (
    Gyro,
    GyroState,
    StarTracker,
    direction_read,
    gyro_read,
    interrupted,
    star_axes,
    star_read,
)
from jaxatt.torque_matrix import gram, times
from jaxatt.vec import Mat3, Quat, Vec3, cross, inverse, norm, where, zeros
from jaxatt.wheels import Friction, TorqueWheel, refuse_flat, relative_speed, wheel_drive, wheel_torque

DEG = np.pi / 180
DT = 0.1  # [s]
STAR = 2, 5  # star samples in ticks: 4 Hz
SECOND = 10  # [ticks] between readings of the magnetometer that unload the wheels, and updates of the back-up filter
LATENCY = 2  # [ticks] the oldest star sample: it must arrive before the next exposure, which clones anew
MOST = 1000  # [samples] at which the count of rejected ones stops
MASKED = 12  # [ticks] without verdicts at the start
SEEN = 0.99  # share of the Sun's disc from which the sun sensor is used
NIS_WINDOW, CROSS_WINDOW = 20, 4  # [samples]
INERTIA = Mat3(
    Vec3(3.7, 0.06, -0.04), Vec3(0.06, 3.5, 0.05), Vec3(-0.04, 0.05, 2.5)
)  # [kg m^2], rotors' axial part left out
CROSS = np.array(  # threshold_quantile(1e-8, (3, 6, ... 24))
    [40.129999, 48.362628, 55.449105, 61.934232, 68.029305, 73.84389, 79.443807, 84.872378]
)
CLEAN = np.array([16.266236, 22.457744, 27.877165, 32.90949])  # threshold_quantile(1e-3, (3, 6, 9, 12))
SHARE = 1 / 120  # of a new residual in the means of Sun and field: 30 s of samples
LEAN = float(CLEAN[0]) * SHARE / (2 - SHARE)  # the same of such a mean of white residuals
NULL = np.array([0.5, -0.5, 0.5, -0.5])  # wheel momenta without a resultant
TRACKER = StarTracker(
    boresight=Vec3(0.0, 1.0, 0.0), across=Vec3(0.0, 0.0, 1.0),
    cross=8 * DEG / 3600, roll=60 * DEG / 3600, rate_limit=1.5 * DEG,
)  # fmt: skip
SHEET = Gyro(arw=0.15 * DEG / 60, rrw=0.3 * DEG / 3600 / 60)
EPOCH = "2026-03-21T00:00"
ORBIT = Elements(a=EARTH + 500e3, i=97.4 * DEG, node=50 * DEG)


WHEEL = TorqueWheel(
    J=6.366e-4, torque_max=0.015, speed_max=628.3, knee=500.0,
    friction=Friction(coulomb=3e-4, stiction=6e-4, stribeck=3.0, viscous=1.2e-6),
)  # fmt: skip
_ACROSS, _UP = np.sin(54.7356 * DEG) * np.sqrt(0.5), np.cos(54.7356 * DEG)
AXES = Vec3(  # of the wheels, components (4,): a pyramid, in NumPy, for an import computes nothing
    _ACROSS * np.array([1.0, -1.0, -1.0, 1.0]), _ACROSS * np.array([1.0, 1.0, -1.0, -1.0]), np.full(4, _UP)
)  # fmt: skip


def orbit_table(seconds: float = 7000.0) -> Table:
    """The surroundings along the loop's orbit, for starts anywhere on it and runs of so many ``seconds``."""
    t = np.arange(-10.0, 5676.98 + seconds + 30.0, 10.0)  # one period and the run
    return along(t, *kepler(ORBIT, t), EPOCH, density=lambda t, r, epoch: np.full(len(t), 6.967e-13))


class Limits(NamedTuple):
    """When the detectors alarm, and on whom they put the blame."""

    slack: Annotated[Any, "1", positive] = 0.75  # of the wheels' CUSUM
    wheel: Annotated[Any, "1", limit] = 8.0  # its threshold
    least_speed: Annotated[Any, "rad/s", not_negative] = 10.0  # below it a wheel's friction is not known
    grace: Annotated[Any, "s", not_negative] = 4.0  # from its alarm on in which the drive may bring a wheel to rest
    moved: Annotated[Any, "N m s", not_negative] = 3e-4  # change of the drive's error after that which leaves it out
    gate: Annotated[Any, "1", limit] = 30.0  # NIS beyond which a star sample is not used
    persistent: Annotated[Any, "1", positive] = 4.0  # rejected samples that make the innovations strange
    elimination: Annotated[Any, "1", positive] = (
        8.0  # rejected samples that blame the star tracker where the gyro is not guilty
    )
    nis_sum: Annotated[Any, "1", limit] = 140.0  # on the sum of the last 20 NIS, each at most the gate
    cross: Annotated[Any, "1", limit, (8,)] = CROSS  # on the cross-check of four samples, of 3, 6, ... 24 degrees
    gyro_slack: Annotated[Any, "1", positive] = 0.5  # of the CUSUM of gyro less momentum
    gyro: Annotated[Any, "1", limit] = 12.0  # its threshold
    memory: Annotated[Any, "s", not_negative] = 30.0  # how long the gyro stays guilty
    witness: Annotated[Any, "1", flag] = 1.0  # 0: the wheels' momentum is not asked, as in the first logic (choice 6)
    arbiter: Annotated[Any, "1", flag] = (
        1.0  # 0: any disagreement is the star tracker's, as in the first logic (choice 10)
    )
    patience: Annotated[Any, "s", positive] = 5.0  # without a star sample before Sun and field take its place
    odd: Annotated[Any, "1", positive] = (
        20.0  # samples for which one of Sun and field disagrees alone before it is left out
    )


class Params(NamedTuple):
    """What the engineer ships."""

    J: Annotated[Mat3, "kg m^2", inertia] = INERTIA  # believed
    wheel: TorqueWheel = WHEEL  # believed, of one wheel
    axes: Annotated[Vec3, "1", finite, (4,)] = AXES  # believed, of the wheels
    gyro: Gyro = SHEET  # believed noise
    star: StarTracker = TRACKER  # believed
    std_sun: Annotated[Any, "rad", positive] = 0.05 * DEG  # of the sun sensor per component and sample
    std_field: Annotated[Any, "T", positive] = 200e-9  # of magnetometer and field model per component and sample
    sigma_turn: Annotated[Any, "rad", positive] = 0.1 * DEG  # of the first attitude
    sigma_bias: Annotated[Any, "rad/s", positive] = 20 * DEG / 3600  # of the first bias
    kp: Annotated[Any, "1/s^2", positive] = 0.01  # attitude gain over inertia: 0.1 rad/s, damping 0.7
    kd: Annotated[Any, "1/s", positive] = 0.14  # rate gain over inertia
    turn_max: Annotated[Any, "rad", positive] = 0.1  # limit of the turn that the law sees
    idle: Annotated[Any, "N m s", finite] = 0.2  # momentum along NULL that keeps the wheels from standing still
    k_idle: Annotated[Any, "1/s", not_negative] = 0.02
    k_wheel: Annotated[Any, "1/s", positive] = 1.0  # of the wheels' drive
    windup: Annotated[Any, "N m s", positive] = 0.005
    k_unload: Annotated[Any, "1/s", not_negative] = 2e-3
    moment_max: Annotated[Any, "A m^2", limit] = 12.0  # of a torquer
    pull: Annotated[Any, "1", positive] = 0.01  # share by which the momentum's rate follows the gyro in a tick
    limits: Limits = Limits()
    std_tacho: Annotated[Any, "N m s", positive] = 1.3e-5  # of the tachometers per sample, believed
    judged: Annotated[Any, "s", not_negative] = 440.0  # from here on `Scores.last` counts
    table: Table = orbit_table()


class WheelFault(NamedTuple):
    """What goes wrong with a wheel; a field holds one number for all four or four."""

    onset: Annotated[Any, "s", instant] = np.inf
    end: Annotated[Any, "s", instant] = np.inf
    drive: Annotated[Any, "1", finite] = 1.0  # share of the torque that the motor gives: 0 for a dead one
    wear: Annotated[Any, "1", finite, not_negative] = 1.0  # factor on all friction
    seized: Annotated[Any, "1", flag] = 0.0  # 1: stuck to the body, so that its momentum stays


class Scenario(NamedTuple):
    """What the day brings."""

    t0: Annotated[Any, "s", finite] = 0.0  # time of the table at tick 0
    turn: Annotated[Vec3, "rad", finite] = zeros()  # error of the first estimate: q = truth exp(-turn)
    bias: Annotated[Vec3, "rad/s", finite] = zeros()  # of the gyro at the start
    h: Annotated[Any, "N m s", finite, (4,)] = 0.2 * NULL  # wheel momenta
    J: Annotated[Mat3, "kg m^2", inertia] = INERTIA  # true
    wheels: TorqueWheel = WHEEL  # true, of one wheel
    axes: Annotated[Vec3, "1", finite, (4,)] = AXES  # true, of the wheels
    friction: Annotated[Any, "1", not_negative, (4,)] = np.ones(4)  # factor on the friction of each wheel
    gyro_sheet: Gyro = SHEET  # true errors
    tracker: StarTracker = TRACKER  # true errors
    latency: Annotated[Any, "ticks", positive] = 2  # of the star samples, 1 or 2
    act: Annotated[Any, "1", flag] = 1.0  # 0: verdicts are logged, and neither units nor strange samples are left out
    std_sun: Annotated[Any, "rad", not_negative] = 0.05 * DEG  # per component and sample
    std_field: Annotated[Any, "T", not_negative] = 200e-9  # per component and sample
    std_tacho: Annotated[Any, "N m s", not_negative] = 1.3e-5  # per sample
    dipole: Annotated[Vec3, "A m^2", finite] = Vec3(0.15, -0.1, 0.12)  # residual
    facets: Facets = box(0.5, 0.5, 0.7, Vec3(0.01, -0.005, 0.02))
    wheel: Annotated[WheelFault, "1", (), (4,)] = WheelFault()  # a field holds one number for all or four
    gyro: Annotated[Vec3, "rad/s"] = on_axes(Fault())  # faults per axis
    star: Annotated[Vec3, "rad"] = on_axes(
        Fault()
    )  # faults of the sample's turn about its two cross axes and the boresight
    box: Annotated[Fault, "1"] = Fault()  # of the star tracker as a whole: stuck or missing
    sun: Annotated[Vec3, "1"] = on_axes(Fault())  # faults of the sun sensor per component
    field: Annotated[Vec3, "T"] = on_axes(Fault())  # of the magnetometer
    tacho: Annotated[Fault, "N m s", (), (4,)] = Fault()  # of the tachometers


class Sky(NamedTuple):
    """What the on-board table tells of sun and field."""

    sun: Vec3  # unit vector in reference axes
    lit: Any  # [1] share of the Sun's disc that is seen
    field: Vec3  # [T] in reference axes


class Exposure(NamedTuple):
    """A star sample, and what else was measured at its instant."""

    star: Reading  # `Quat`
    sun: Reading  # `Vec3` in body axes
    field: Reading  # [T] `Vec3` in body axes
    sky: Sky


class Readings(NamedTuple):
    """What the computer gets. A triad counts as a whole: it is not used where a component is missing."""

    gyro: Annotated[Reading, "rad/s"]  # a `Vec3`: mean rate since the last tick
    arrived: Exposure  # late by the latency; its star sample is valid where there is one
    sun: Annotated[Reading, "1"]  # a `Vec3`
    field: Annotated[Reading, "T"]  # a `Vec3`
    tacho: Annotated[Reading, "N m s"]  # (4,) momentum against the body, flags (4,)
    orbit: Surroundings  # of now, by the on-board table


class SensorState(NamedTuple):
    """What the sensors keep for the next tick."""

    readings: Readings
    gyro: GyroState
    theta: Vec3  # [rad] integral of the rate at the last tick
    line: Exposure  # the last exposures, newest first
    error: Vec3  # [rad] of the last star sample


class Verdict(NamedTuple):
    """What the computer has found out; what is out stays out."""

    suspect: Any  # (4,) bool: wheels that have alarmed
    in_use: Any  # (4,) 1 for a wheel in the allocation
    star_out: Any  # bool
    gyro_out: Any  # bool
    sun_out: Any  # bool
    field_out: Any  # bool
    fault: Any  # bool: no attitude is left that could be trusted; the mode machine goes to safe mode


class Computer(NamedTuple):
    """What the on-board computer knows."""

    belief: Mekf
    act: Any  # bool: whether it acts on its verdicts
    w: Vec3  # [rad/s] body rate by the momentum of the wheels
    bias: Vec3  # [rad/s] the gyro's when it was left out
    wheel: Cusum  # (4,) of the wheels' residuals
    since: Any  # (4,) [ticks] since a wheel's alarm
    error: Any  # (4,) [N m s] of a wheel's drive at the end of its grace
    gyro: Cusum  # `Vec3` of gyro less momentum
    guilty: Any  # [ticks] since that CUSUM was last above its threshold
    rejected: Any  # [1] persistence of rejected star samples
    nis: Any  # (20,) last NIS of star samples, newest first
    sun: Any  # (4,) last cross-checks of star sample and Sun, newest first, 0 where there was none
    field: Any  # (4,) likewise of star sample and magnetic field
    dof: Any  # (4, 2) degrees of freedom of both
    lean: tuple  # means of the residuals of Sun and field, two `Vec3`, each over its standard deviation
    silent: Any  # [ticks] since the last star sample
    odd: Any  # (2,) samples for which the Sun, or the field, has disagreed alone
    verdict: Verdict
    reference: Any  # (4,) [N m s] of the wheels' drive
    torque: Any  # (4,) [N m] commanded
    tacho: Any  # (4,) [N m s] last, or what was expected instead
    magnetic: Vec3  # [T] last of the magnetometer, once a second
    moment: Vec3  # [A m^2] commanded


class X(NamedTuple):
    """Continuous state: the truth."""

    q: Quat  # attitude, body to inertial
    w: Vec3  # [rad/s] body rate
    h: Any  # (4,) [N m s] absolute momenta of the wheels
    theta: Vec3  # [rad] integral of w, which the gyro reads


class Z(NamedTuple):
    """Held between ticks."""

    sensors: SensorState
    computer: Computer
    torque: Any  # (4,) [N m] on the wheels
    outer: Vec3  # [N m] of the surroundings and the torquers on the body


class Statistics(NamedTuple):
    """The detectors at a tick."""

    wheel: Annotated[Any, "1"]  # (4,)
    gyro: Annotated[Any, "1"]  # largest of the three axes
    nis: Annotated[Any, "1"]  # of this tick's star sample
    used: Annotated[Any, "1"]  # bool, whether there was one
    nis_sum: Annotated[Any, "1"]
    rejected: Annotated[Any, "1"]
    cross: Annotated[Any, "1"]  # cross-check over its threshold


class Log(NamedTuple):
    """What a tick reports. Truth unless it says otherwise."""

    t: Annotated[Any, "s"]
    q: Annotated[Quat, "1"]
    w: Annotated[Vec3, "rad/s"]
    h: Annotated[Any, "N m s"]  # (4,)
    pointing: Annotated[Any, "rad"]  # angle to the nadir attitude
    estimate: Annotated[Quat, "1"]  # on board
    bias: Annotated[Vec3, "rad/s"]  # estimated, on board
    knowledge: Annotated[Any, "rad"]  # angle by which the estimate errs
    rate_error: Annotated[Any, "rad/s"]  # body rate less that of the nadir attitude
    nees: Annotated[Any, "1"]  # of attitude and bias: 6 degrees of freedom
    statistics: Statistics  # on board
    suspect: Annotated[Any, "1"]  # (4,) bool, on board: wheels that have alarmed
    in_use: Annotated[Any, "1"]  # (4,) on board
    star_out: Annotated[Any, "1"]  # bool, on board
    gyro_out: Annotated[Any, "1"]  # bool, on board
    sun_out: Annotated[Any, "1"]  # bool, on board
    field_out: Annotated[Any, "1"]  # bool, on board
    fault: Annotated[Any, "1"]  # bool, on board
    torque: Annotated[Any, "N m"]  # (4,) commanded of the wheels, on board
    moment: Annotated[Vec3, "A m^2"]  # commanded of the torquers, on board
    lit: Annotated[Any, "1"]  # share of the Sun's disc that is seen


# the truth


def init(params: Params, scenario: Scenario):
    """x, z at the start: at the nadir attitude, turning with it, the filter off by the scenario's turn."""
    orbit = at(params.table, scenario.t0)
    q, w, _ = earth_pointing(orbit)
    belief = cloned(
        start(quat_normalised(q * quat_from_vector(-scenario.turn)), zeros(), params.sigma_turn, params.sigma_bias)
    )
    four = jnp.zeros(4)
    tacho = scenario.h - scenario.wheels.J * (scenario.axes @ w)
    field = quat_to_body(q, orbit.field)
    no = jnp.asarray(False)
    sun, seen = Reading(quat_to_body(q, orbit.sun), no), Reading(field, no)
    arrived = Exposure(Reading(q, no), sun, seen, Sky(orbit.sun, orbit.lit, orbit.field))
    readings = Readings(Reading(w, no), arrived, sun, seen, Reading(tacho, jnp.zeros(4, bool)), orbit)
    verdict = Verdict(jnp.zeros(4, bool), jnp.ones(4), no, no, no, no, no)
    computer = Computer(
        belief, jnp.asarray(scenario.act > 0), w, zeros(), Cusum(four, four), four, four, Cusum(zeros(), zeros()), jnp.asarray(np.inf), jnp.asarray(0.0),
        jnp.full(NIS_WINDOW, 3.0), jnp.zeros(CROSS_WINDOW), jnp.zeros(CROSS_WINDOW), jnp.full((CROSS_WINDOW, 2), 3.0),
        (zeros(), zeros()), jnp.asarray(0.0), jnp.zeros(2), verdict, scenario.h, four,
        scenario.h, field, zeros(),
    )  # fmt: skip
    gyro = GyroState(scenario.bias, zeros())
    sensors = SensorState(readings, gyro, zeros(), empty_line(arrived, LATENCY + 1), zeros())
    return X(q, w, scenario.h, zeros()), Z(sensors, computer, four, zeros())


def sense(params: Params, scenario: Scenario, now, x: X, z: Z, noise) -> SensorState:
    """What the sensors read.

    noise: 19 normals: gyro white 3, its walk 3, star sample 3 (along its axes), sun sensor 3, magnetometer 3,
    tachometers 4.
    """
    last, before = z.sensors, z.sensors.readings
    orbit = at(params.table, scenario.t0 + now.t)
    first, exposed = now.k == 0, due(now.k, *STAR)
    turn = where(first, now.dt * x.w, x.theta - last.theta)  # nothing lies before the first tick
    walk = noise[3:6] * jnp.where(first, 0, 1)
    gyro, rate = gyro_read(scenario.gyro_sheet, last.gyro, turn, now.dt, noise[:3], walk)
    gyro, rate = where(first, (last.gyro, x.w + last.gyro.bias), (gyro, rate))
    seen = direction_read(quat_to_body(x.q, orbit.sun), scenario.std_sun, noise[9:12])

    # four triads: gyro, Sun, field, and the small turns of the star sample about its axes, the channels side by side
    faults = jax.tree.map(lambda *a: jnp.stack(a), *scenario.gyro, *scenario.sun, *scenario.field, *scenario.star)
    cross, roll, none = scenario.tracker.cross, scenario.tracker.roll, (0 * scenario.std_field,) * 6
    std = jnp.stack([*none, *(scenario.std_field,) * 3, cross, cross, roll])
    held = jnp.stack([*before.gyro.value, *before.sun.value, *before.field.value, *last.error])
    channels = channel(faults, now.t, std, jnp.concatenate([noise[:3], noise[9:15], noise[6:9]]), held)
    truth = jnp.stack([*rate, *seen, *quat_to_body(x.q, orbit.field), *(0 * x.w)])
    rate, sun, field, error = (Vec3(*a) for a in read(channels, truth).reshape(4, 3))
    there = jnp.all(heard(faults, now.t).reshape(4, 3), axis=1)  # a triad counts as a whole

    sample = Quat(*(a[0] for a in last.line.star.value))  # of the last exposure
    box_before = Reading(sample, sample @ sample > 0)
    star = interrupted(star_read(scenario.tracker, x.q, x.w, error), now.t, box_before, scenario.box)
    star = Reading(where(exposed, star.value, sample), star.valid & exposed & there[3])
    momentum = scenario.wheels.J * relative_speed(scenario.wheels.J, x.h, scenario.axes, x.w)
    tacho = read(channel(scenario.tacho, now.t, scenario.std_tacho, noise[15:19], before.tacho.value), momentum)
    tacho = Reading(tacho, jnp.broadcast_to(heard(scenario.tacho, now.t), (4,)))
    rate, sun, field = (Reading(a, there[i]) for i, a in enumerate((rate, sun, field)))
    line = pushed(last.line, Exposure(star, sun, field, Sky(orbit.sun, orbit.lit, orbit.field)))
    readings = Readings(rate, aged(line, scenario.latency), sun, field, tacho, orbit)
    return SensorState(readings, gyro, x.theta, line, where(exposed, error, last.error))


def flow(params: Params, scenario: Scenario, t, x: X, z: Z) -> X:
    """dx/dt of the truth; torques on wheels and body are held."""
    axes = scenario.axes
    torque = z.outer - times(axes, z.torque)
    return X(quat_rate(x.q, x.w), body_acceleration(x.w, torque, scenario.J, times(axes, x.h)), z.torque, x.w)


def wheels_torque(scenario: Scenario, now, x: X, command):
    """Torques (4,) [N m] of motors and friction on the wheels at the ``command`` (4,) [N m], faults included."""
    fault = scenario.wheel
    on = active(Fault(fault.onset, fault.end), now.t)
    speed = relative_speed(scenario.wheels.J, x.h, scenario.axes, x.w)
    wear = scenario.friction * jnp.where(on, fault.wear, 1)
    given = jnp.where(on, fault.drive, 1), wear, on & (fault.seized > 0)
    return wheel_torque(scenario.wheels, command, speed, now.dt, *given)


def outer_torque(scenario: Scenario, x: X, orbit: Surroundings, moment: Vec3) -> Vec3:
    """Torque [N m] of the surroundings and of the torquers' moment [A m^2] on the body."""
    field, sun = quat_to_body(x.q, orbit.field), quat_to_body(x.q, orbit.sun)
    down = quat_to_body(x.q, -orbit.r) / norm(orbit.r)
    rate = jnp.sqrt(MU / norm(orbit.r)) / norm(orbit.r)
    air = aero_torque(scenario.facets, quat_to_body(x.q, orbit.v), orbit.density)
    light = solar_torque(scenario.facets, sun, orbit.lit)
    return gravity_gradient(down, scenario.J, rate) + dipole_torque(moment + scenario.dipole, field) + air + light


# on board


def computer_of(x: X, z: Z) -> Computer:
    """What the computer knows between two ticks."""
    return z.computer


def decide(params: Params, now, computer: Computer, y: Readings) -> tuple[Computer, Statistics]:
    """One tick on board: attitude, verdicts, reconfiguration, command."""
    expected = computer.tacho + now.dt * wheels_expected(params, computer)
    y = y._replace(tacho=Reading(known(y.tacho, expected), present(y.tacho)))
    computer, y, gyro = shared(partial(momentum_rate, params, now), computer, y)
    out = acted_on(computer)
    rate = where(out.gyro_out, computer.w, y.gyro.value)
    arw, rrw = (jnp.where(out.gyro_out, 1e-5, a) for a in (params.gyro.arw, params.gyro.rrw))
    prior = predict(computer.belief, rate, jnp.where(now.k > 0, now.dt, 0), arw, rrw)

    computer, star = star_sample(params, computer._replace(belief=prior), y.arrived)
    computer = judge(params, now, computer, star)
    belief = backup(params, now, computer, y)
    computer = computer._replace(belief=cloned(belief, when=due(now.k, *STAR)))
    computer, wheel = shared(partial(wheel_residual, params, now), computer, y)
    seen = y.field._replace(valid=y.field.valid & ~acted_on(computer).field_out)
    magnetic = known(seen, quat_to_body(belief.q, y.orbit.field))
    computer = computer._replace(magnetic=where(now.k % SECOND == 0, magnetic, computer.magnetic))
    reference, torque, moment = shared(partial(command, params, now), computer, y)
    nis_sum = jnp.sum(computer.nis, axis=0)
    told = Statistics(wheel, gyro, star.nis, star.arrived, nis_sum, computer.rejected, star.cross)
    return computer._replace(reference=reference, torque=torque, moment=moment, tacho=y.tacho.value), told


def acted_on(computer: Computer) -> Verdict:
    """The verdict, or that nothing is out where the computer does not act."""
    verdict, act = computer.verdict, computer.act
    in_use = jnp.where(act, verdict.in_use, 1.0)
    star, gyro, sun, field = (out & act for out in verdict[2:6])
    return Verdict(verdict.suspect, in_use, star, gyro, sun, field, verdict.fault)


def momentum_rate(params: Params, now, computer: Computer, y: Readings) -> tuple[Computer, Readings, Any]:
    """The body rate by the momentum of the wheels, and the CUSUM of what the gyro says against it.

    w <- w + dt J^-1 (m x B - w x (J w + W h)) - J^-1 W (h - last h); while the gyro is trusted it follows it slowly. A
    missing reading of the gyro is replaced by it.
    """
    w, axes = computer.w, params.axes
    torque = dipole_torque(computer.moment, computer.magnetic) - cross(w, params.J @ w + times(axes, y.tacho.value))
    change = inverse(params.J) @ (now.dt * torque - times(axes, y.tacho.value - computer.tacho))
    w = where(now.k > 0, w + change, w)
    there, rate = present(y.gyro), known(y.gyro, w + computer.belief.b)
    apart = rate - computer.belief.b - w
    std = params.gyro.arw / jnp.sqrt(now.dt)
    sums = [cusum(Cusum(*s), a / std, params.limits.gyro_slack, there) for s, a in zip(zip(*computer.gyro), apart)]
    states = Cusum(*(Vec3(*side) for side in zip(*(state for state, _ in sums))))
    statistic = jnp.max(jnp.stack([value for _, value in sums]), axis=0)
    guilty = jnp.where(~there | (statistic > params.limits.gyro), 0.0, computer.guilty + 1)  # silence is guilt
    w = where(acted_on(computer).gyro_out, w, w + params.pull * apart)
    return computer._replace(w=w, gyro=states, guilty=guilty), y._replace(gyro=Reading(rate, there)), statistic


class Sample(NamedTuple):
    """What a star sample told."""

    arrived: Any  # bool
    nis: Any  # [1]
    cross: Any  # [1] the cross-check over its threshold
    sun: Any = np.inf  # [1] its part that is the Sun's over what is clean; inf where the Sun was not seen
    field: Any = np.inf  # [1] likewise of the field


def star_sample(params: Params, computer: Computer, arrived: Exposure) -> tuple[Computer, Sample]:
    """The filter updated by a star sample that is no stranger, and the sample's check against Sun and magnetic field."""
    limits = params.limits
    wanted = ~acted_on(computer).star_out
    gate = jnp.where(
        computer.act, jnp.where(wanted, limits.gate, -1.0), jnp.inf
    )  # -1: no sample is used, its NIS is told
    variance = Vec3(params.star.cross**2, params.star.cross**2, params.star.roll**2)
    belief, met = update_attitude(computer.belief, arrived.star, star_axes(params.star), variance, True, gate)
    came = arrived.star.valid & (met.nis > 0)
    rejected = persistence(computer.rejected, met.nis > limits.gate, MOST, came)

    q, sky = where(came, arrived.star.value, Quat(1.0, 0.0, 0.0, 0.0)), arrived.sky
    out = acted_on(computer)
    sun_there = present(arrived.sun) & (sky.lit > SEEN) & ~out.sun_out
    field_there = present(arrived.field) & ~out.field_out
    sun = (known(arrived.sun, zeros()) - quat_to_body(q, sky.sun)) / params.std_sun
    field = (known(arrived.field, zeros()) - quat_to_body(q, sky.field)) / params.std_field
    there = jnp.stack([sun_there, field_there])
    squares = jnp.where(sun_there, sun @ sun, 0), jnp.where(field_there, field @ field, 0)
    one = jnp.minimum(met.nis, limits.gate), *squares, jnp.where(there, 3.0, 0)
    lines = computer.nis, computer.sun, computer.field, computer.dof
    nis, suns, fields, dof = (jnp.where(came, pushed(line, new), line) for line, new in zip(lines, one))
    slid = [
        where(came & use, mean + SHARE * (a - mean), mean) for mean, a, use in zip(computer.lean, (sun, field), there)
    ]
    silent = jnp.where(arrived.star.valid, 0.0, computer.silent + 1)
    computer = computer._replace(belief=belief, rejected=rejected, nis=nis, sun=suns, field=fields, dof=dof)
    computer = computer._replace(lean=tuple(slid), silent=silent)
    threes, parts = jnp.sum(dof, axis=0) / 3, (jnp.sum(suns, axis=0), jnp.sum(fields, axis=0))
    index = lambda table, count: jnp.asarray(table, count.dtype)[jnp.clip(count - 1, 0, len(table) - 1).astype(int)]
    cross = (parts[0] + parts[1]) / index(limits.cross, threes[0] + threes[1])
    over = [
        jnp.where(count > 0, jnp.maximum(part / index(CLEAN, count), (mean @ mean) / LEAN), jnp.inf)
        for part, count, mean in zip(parts, threes, slid)
    ]  # of the last second, and of the last half minute, which sees a slow drift
    return computer, Sample(came, jnp.where(came, met.nis, 0), cross, *over)


def judge(params: Params, now, computer: Computer, star: Sample) -> Computer:
    """Who is to blame for strange innovations, star tracker or gyro, and the filter that goes on (choice 6)."""
    limits, out, belief = params.limits, computer.verdict, computer.belief
    nis_sum, awake, asked = jnp.sum(computer.nis, axis=0), now.k >= MASKED, limits.witness > 0
    many = nis_sum > limits.nis_sum
    disagree = star.arrived & (star.cross > 1)
    strange = (computer.rejected >= limits.persistent) | many
    guilty = computer.guilty * now.dt <= limits.memory
    alone = (computer.rejected >= limits.elimination) | (many & (computer.rejected < limits.persistent))
    # one of Sun and field that disagrees alone, while nothing is strange, is odd itself (choice 10); a gyro that departs
    # from the momentum has a bias that followed the star tracker, or torquers that a wrong field drives
    both = (star.sun < jnp.inf) & (star.field < jnp.inf)
    sun_alone, field_alone = both & (star.field <= 1), both & (star.sun <= 1)
    sure = (limits.arbiter <= 0) | strange | out.gyro_out | (both & ~sun_alone & ~field_alone)
    accused = disagree & (sure | (sun_alone & guilty))
    odd = disagree & ~sure & jnp.stack([sun_alone & ~guilty, field_alone])
    count = jnp.where(star.arrived, jnp.where(odd, computer.odd + 1, 0), computer.odd)
    left = awake & ~out.star_out & (count >= limits.odd)

    blame_star = awake & ~out.star_out & (accused | (asked & ~guilty & alone))
    blame_gyro = awake & ~out.star_out & ~out.gyro_out & ~disagree & strange & (guilty | ~asked)

    followed = computer.rejected <= 0  # the filter has taken false samples
    anew = (blame_star & (out.gyro_out | followed)) | blame_gyro
    turn, bias = jnp.where(blame_gyro, 0.1, jnp.where(out.gyro_out, 2.0, 0.2)), jnp.where(out.gyro_out, 20 / 3600, 0.01)
    bias = jnp.where(blame_gyro, 0.05, bias)
    b = where(blame_gyro, zeros(), where(out.gyro_out, computer.bias, belief.b))
    belief = restarted(belief, anew & computer.act, b, turn * DEG, bias * DEG)
    bias = where(blame_gyro, computer.belief.b, computer.bias)
    verdict = out._replace(
        star_out=out.star_out | blame_star, gyro_out=(out.gyro_out | blame_gyro) & ~blame_star,
        sun_out=out.sun_out | left[0], field_out=out.field_out | left[1],
    )  # fmt: skip
    return computer._replace(belief=belief, bias=bias, odd=count, verdict=verdict)


def backup(params: Params, now, computer: Computer, y: Readings) -> Mekf:
    """The filter updated by Sun and magnetic field, once a second, where the star tracker is out or silent."""
    out = acted_on(computer)
    due_now = (out.star_out | (computer.silent * now.dt > params.limits.patience)) & (now.k % SECOND == 0)
    good = (y.orbit.lit > SEEN) & ~out.sun_out, ~out.field_out
    sun, field = (a._replace(valid=a.valid & due_now & use) for a, use in zip((y.sun, y.field), good))
    seen = (sun, y.orbit.sun, params.std_sun), (field, y.orbit.field, params.std_field)
    one = lambda belief, a: (
        update_vector(belief, *a)[0],
        None,
    )  # scanned: the program holds one update in place of two
    return jax.lax.scan(one, computer.belief, jax.tree.map(lambda *a: jnp.stack(a), *seen))[0]


def wheels_expected(params: Params, computer: Computer):
    """Torques (4,) [N m] on the wheels as commanded, less friction at the speed of the last tick."""
    speed, friction = computer.tacho / params.wheel.J, params.wheel.friction
    return computer.torque - jnp.sign(speed) * friction.coulomb - friction.viscous * speed


def wheel_residual(params: Params, now, computer: Computer, y: Readings) -> tuple[Computer, Any]:
    """Wheels that do not do what they are told, and those of them that leave the allocation; the CUSUMs (4,).

    r = ((tacho - last) / dt - (t - sign(Om) c_C - v Om)) / (sqrt(2) s_h / dt) with the speed Om of the last tick, and
    nothing below the least speed. sqrt(2) s_h is the noise of a difference. A wheel that follows its drive, weak as it
    may be, comes to a constant error of the drive, friction over gain; one whose error still moves some seconds after
    its alarm is left out, as long as three remain (choice 9).
    """
    limits, speed = params.limits, computer.tacho / params.wheel.J
    moved = y.tacho.value - computer.tacho - now.dt * wheels_expected(params, computer)
    r = moved / (jnp.sqrt(2.0) * params.std_tacho)
    fast = (jnp.abs(speed) >= limits.least_speed) & (now.k > 0)
    states, statistic = cusum(computer.wheel, jnp.where(fast, r, 0), limits.slack, y.tacho.valid)
    out, awake = computer.verdict, now.k >= MASKED
    alarm = worst_above(jnp.where(out.suspect, 0, statistic), limits.wheel) & awake
    suspect = out.suspect | alarm
    since = jnp.where(out.suspect, computer.since + 1, 0)
    error = computer.reference - y.tacho.value
    settles = since * now.dt <= limits.grace
    at_grace = jnp.where(settles, error, computer.error)
    lost = suspect & (out.in_use > 0) & (jnp.abs(error - at_grace) >= limits.moved)
    lost = lost & (since * now.dt >= limits.grace) & (jnp.sum(out.in_use, axis=0) > 3)
    drop = lost & (jnp.arange(4) == jnp.argmax(lost, axis=0))  # one at a time
    verdict = out._replace(suspect=suspect, in_use=jnp.where(drop, 0.0, out.in_use))
    return computer._replace(wheel=states, since=since, error=at_grace, verdict=verdict), statistic


def command(params: Params, now, computer: Computer, y: Readings):
    """Momentum references (4,) [N m s] and torques (4,) [N m] of the wheels, dipole moment [A m^2] of the torquers.

    u = -J (kp t + kd e_w) + w x (J w + W h) - J (w x A(e)' w_d), t the turn 2 sign(e_0) e_v, limited, and e_w the rate
    error; the wheels in use share -u, and what a wheel that is out loses by friction they take too.
    """
    J, axes, out = params.J, params.axes, acted_on(computer)
    q, w = computer.belief.q, where(out.gyro_out, computer.w, y.gyro.value) - computer.belief.b
    e, e_w, ahead = tracking_error(q, w, earth_pointing(y.orbit))
    turn = 2 * jnp.where(e.w < 0, -1, 1) * e.v
    turn = turn * jnp.minimum(1, params.turn_max / jnp.maximum(norm(turn), params.turn_max))
    tacho = y.tacho.value
    momentum = times(axes, tacho)
    u = J @ (ahead - params.kp * turn - params.kd * e_w) + cross(w, J @ w + momentum)

    held = Vec3(*(row * out.in_use for row in axes))
    by = inverse(gram(held))  # any three axes span space: W^+ = W' (W W')^-1
    null = NULL.astype(tacho.dtype)
    idle = jnp.where(reduce(add, out.in_use) > 3, params.k_idle * (reduce(add, null * tacho) - params.idle), 0)
    demand = held @ (by @ -u) - idle * null
    coasted = held @ (by @ times(axes, (1 - out.in_use) * (tacho - computer.tacho)))
    gains = params.k_wheel, params.windup
    reference, torque = wheel_drive(computer.reference - coasted, demand, tacho, now.dt, *gains)
    torque = out.in_use * jnp.clip(torque, -params.wheel.torque_max, params.wheel.torque_max)
    return reference, torque, unloading(momentum, computer.magnetic, params.k_unload, params.moment_max)


def earth_pointing(orbit: Surroundings) -> Target:
    """The nadir attitude, which turns with the orbit."""
    return Target(nadir(orbit.r, orbit.v), Vec3(0.0, -orbit_rate(orbit.r, orbit.v), 0.0), zeros())


# the closed loop


def tick(params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """One tick: sensors read, the computer decides, actuators follow, a log is written."""
    x = x._replace(q=quat_normalised(x.q))
    sensors = shared(lambda x, z: sense(params, scenario, now, x, z, noise), x, z)
    computer, told = decide(params, now, z.computer, sensors.readings)
    orbit = sensors.readings.orbit
    torque = wheels_torque(scenario, now, x, computer.torque)
    outer = outer_torque(scenario, x, orbit, computer.moment)

    belief, out = computer.belief, computer.verdict
    fault = out.star_out & (out.gyro_out | out.sun_out | out.field_out | (orbit.lit < SEEN))
    off, e_w, _ = tracking_error(x.q, x.w, earth_pointing(orbit))
    log = Log(
        now.t, x.q, x.w, x.h, quat_angle(off), belief.q, belief.b, quat_angle(quat_conjugate(belief.q) * x.q),
        norm(e_w), mekf_nees(belief, x.q, sensors.gyro.bias), told, out.suspect, out.in_use,
        out.star_out, out.gyro_out, out.sun_out, out.field_out, fault, computer.torque, computer.moment, orbit.lit,
    )  # fmt: skip
    computer = computer._replace(verdict=out._replace(fault=fault))
    return x, Z(sensors, computer, torque, outer), log


SETTLED = 100.0  # [s] from here on the statistics of a healthy run count
LAST = 60.0  # [s] at the end over which pointing is judged after a fault


class Largest(NamedTuple):
    """The largest that each detector reached."""

    wheel: Annotated[Any, "1"]  # (4,)
    gyro: Annotated[Any, "1"]
    nis_sum: Annotated[Any, "1"]
    cross: Annotated[Any, "1"]  # over its threshold


class Scores(NamedTuple):
    """Tallies of a run: what a sweep reports."""

    pointing: Annotated[Any, "rad"]  # rms angle to nadir, after `SETTLED`
    knowledge: Annotated[Any, "rad"]  # rms error of the estimate, after `SETTLED`
    rate_error: Annotated[Any, "rad/s"]  # rms, after `SETTLED`
    nis: Annotated[Any, "1"]  # mean per degree of freedom, after 10 s
    nees: Annotated[Any, "1"]  # at the end
    wheel_alarm: Annotated[Any, "s"]  # (4,) inf if never, as all times
    wheel_out: Annotated[Any, "s"]  # (4,) when the wheel was left out
    star_alarm: Annotated[Any, "s"]
    gyro_alarm: Annotated[Any, "s"]
    sun_alarm: Annotated[Any, "s"]
    field_alarm: Annotated[Any, "s"]
    fault: Annotated[Any, "s"]  # first time that no attitude was left to trust
    peak: Annotated[Any, "rad"]  # largest angle to nadir from the first onset, or from `SETTLED`
    last: Annotated[Any, "rad"]  # rms angle to nadir from `params.judged` on
    peak_h: Annotated[Any, "N m s"]  # largest momentum of a wheel
    statistics: Largest  # after `SETTLED`
    ok: Annotated[Any, "1"]  # bool, every number was finite


def score(params: Params, scenario: Scenario, now, log: Log) -> Scores:
    """The tallies of one tick."""
    late, told = now.t >= SETTLED, log.statistics
    square = log.pointing**2
    tested = told.wheel, told.gyro, told.nis_sum, told.cross
    return Scores(
        pointing=scores.rms(square, late),
        knowledge=scores.rms(log.knowledge**2, late),
        rate_error=scores.rms(log.rate_error**2, late),
        nis=scores.mean(told.nis / 3, told.used & (now.t >= 10.0)),
        nees=scores.final(log.nees / 6),
        wheel_alarm=scores.first(now, log.suspect),
        wheel_out=scores.first(now, log.in_use == 0),
        star_alarm=scores.first(now, log.star_out),
        gyro_alarm=scores.first(now, log.gyro_out),
        sun_alarm=scores.first(now, log.sun_out),
        field_alarm=scores.first(now, log.field_out),
        fault=scores.first(now, log.fault),
        peak=scores.peak(log.pointing, late),
        last=scores.rms(square, now.t >= params.judged),
        peak_h=scores.peak(jnp.max(jnp.abs(log.h), axis=0), late),
        statistics=Largest(*(scores.peak(a, late) for a in tested)),
        ok=scores.always(scores.finite((log.q, log.w, log.estimate, *log.h))),
    )


def refuse_bad(params: Params, scenario: Scenario) -> None:
    """The system's check: a table as long as the run, a latency that the line holds, wheels of which any three span space."""
    check.kinds(params, Params, scenario, Scenario)
    fits = np.isin(
        scenario.latency, np.arange(1, LATENCY + 1)
    )  # a sample of this tick would meet the clone of the last
    check.each("scenario.latency", f"be whole, from 1 to {LATENCY} ticks", scenario.latency, fits)
    refuse_short("params.table", params.table, scenario.t0, scenario.t0 + check.last_tick())
    for i in range(4):
        refuse_flat(f"params.axes without wheel {i}", params.axes, np.arange(4) != i)


system = System(init, tick, flow, dt=DT, normals=19, check=refuse_bad)
params = Params()
scenario = Scenario()
