"""Single-axis wheel test bed: adaptive wheel-speed control and on-line inertia estimation (Eun, Park & Park, 2016).

A platform on an air bearing is turned by one reaction wheel. An outer loop, which the paper does not give
(choice 2), asks for a wheel speed; model-reference adaptive control (MRAC) makes the wheel follow it; recursive least
squares on the wheel's turns and the measured attitude estimate the platform's inertia (OPE).

Angles are in degrees and speeds in deg/s throughout, as in the paper; the gains are for these units (choice 1).
`system` adapts continuously; `sampled` adapts once per tick with a held command, as a computer would.
Choices and errata by number: docs/loops/wheel_mrac.md.
"""

from __future__ import annotations

from functools import lru_cache, partial
from math import degrees, pi, sqrt, tanh
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check, scores
from jaxatt.attitude import nearest_angle
from jaxatt.check import a_number, finite, flag, not_negative, positive
from jaxatt.compiling import shared
from jaxatt.contract import System
from jaxatt.controllers import Adaptation, Mrac, mrac_flow, mrac_flow_bound, mrac_input, mrac_sampled_bound, mrac_step
from jaxatt.delays import delayed, pushed
from jaxatt.faults import Channel, Fault, Reading, any_active, channel, first_onset, heard, known, present, read
from jaxatt.observers import LeastSquares, least_squares
from jaxatt.sensors import quantised
from jaxatt.wheels import Wheel, wheel_acceleration

DT = 0.02  # [s] 50 Hz
DELAYS = 10  # [1] ticks by which an attitude reading may be late
RUNAWAY = 1e9  # [deg/s] wheel speed at which a run counts as diverged
PER_RAD2 = (pi / 180) ** 2  # [rad^2/deg^2] times gamma or P0 for speeds in rad/s: the same gain for deg/s
J_WHEEL = 7.133e-4  # [kg m^2] the paper's wheel
START_UP = 10.0  # [s] window reported apart: the parameters leave their start
WINDOWS = ((0.0, 20.0), (20.0, 60.0), (60.0, jnp.inf))  # [s] of the paper's words on Fig. 10


class Params(NamedTuple):
    """What the engineer ships."""

    turn: Annotated[Any, "deg", finite] = 90.0  # slew D
    duration: Annotated[Any, "s", positive] = 90.0  # slew time T
    K: Annotated[Any, "1/s", positive] = 1.0  # gain of the outer loop; not given in the paper (choice 2)
    forward: Annotated[Any, "1", finite] = 1.0  # feed-forward of the slew rate; 0 for none
    J_w: Annotated[Any, "kg m^2", positive] = J_WHEEL  # believed wheel inertia
    J_hat: Annotated[Any, "kg m^2", positive] = 5.0  # believed platform inertia at the start
    a_m: Annotated[Any, "1/s", positive] = 10.0  # reference model, eq. (2)
    b_m: Annotated[Any, "1/s", finite] = 10.0  # reference model, eq. (2)
    a_r: Annotated[Any, "1", finite] = 1.0  # control parameter at the start, eq. (5)
    a_y: Annotated[Any, "1", finite] = 0.5  # control parameter at the start, eq. (5)
    law: Adaptation = Adaptation()  # eq. (6)
    ope: Annotated[Any, "1", flag] = 1.0  # 1: the inertia is estimated and the attitude predicted; 0: MRAC only
    P0: Annotated[Any, "1/(deg^2 s)", positive] = 1e-6  # gain of the estimator at the start, eq. (9); s/deg^2 for rates
    differenced: Annotated[Any, "1", flag] = 0.0  # 1: the estimator compares rates of readings; 0: angles (choice 3)
    forget: Annotated[Any, "1/s", finite, not_negative] = 0.0  # rate at which the estimator forgets
    blend: Annotated[Any, "1", finite] = 0.0  # share L of the measured in the predicted attitude
    J_most: Annotated[Any, "kg m^2", a_number] = 1e3  # set in place of larger estimates and of those of flipped sign
    residual_max: Annotated[Any, "deg/s", positive] = 50.0  # alarm threshold on |y - y_m| (choice 6)

    def check(self, name: str) -> None:
        """Refuse, with ValueError, a bound on the estimate below its start."""
        check.pair(f"{name}.J_most", f"be greater than {name}.J_hat", self.J_most, self.J_hat, np.greater)


class Scenario(NamedTuple):
    """What the day brings."""

    J_w: Annotated[Any, "kg m^2", positive] = J_WHEEL  # true wheel inertia
    J_z: Annotated[Any, "kg m^2", positive] = 5.421  # true platform inertia
    wheel: Wheel = Wheel()  # speeds in deg/s
    noise: Annotated[Any, "deg", finite, not_negative] = 0.05  # of the attitude per sample: half-width, std if Gaussian
    uniform: Annotated[Any, "1", flag] = 1.0  # 1: the attitude noise is uniform; 0: Gaussian
    delay: Annotated[Any, "s", not_negative] = 0.0  # age of the attitude readings, at most `DELAYS` ticks
    tacho_noise: Annotated[Any, "deg/s", finite, not_negative] = 0.0  # std of the wheel-speed noise per sample
    tacho_step: Annotated[Any, "deg/s", finite, not_negative] = 0.0  # quantisation of the wheel speed; 0 for none
    momentum: Annotated[Any, "kg m^2 deg/s", finite] = 0.0  # total at the start, which eq. (1) takes as zero
    torque: Annotated[Any, "N m", finite] = 0.0  # disturbance
    attitude: Annotated[Fault, "deg"] = Fault()  # of the attitude sensor
    tacho: Annotated[Fault, "deg/s"] = Fault()  # of the wheel-speed sensor
    drive: Annotated[Fault, "deg/s"] = Fault()  # of the wheel's command; its scale is the effectiveness
    friction: Annotated[Fault, "deg/s^2"] = Fault()  # of the wheel's friction F; its bias or drift is the growth


class Readings(NamedTuple):
    """What the sensors say at a tick."""

    theta: Reading  # [deg] attitude
    y: Reading  # [deg/s] wheel speed


class Memory(NamedTuple):
    """What the on-board computer holds between ticks."""

    estimate: LeastSquares  # of a = -J_w / J_z
    r: Any  # [deg/s] desired wheel speed
    u: Any  # [deg/s] command; the continuous law goes on changing it until the next tick
    theta: Any  # [deg] last attitude reading, or what the wheel's turns since make of it
    fresh: Any  # bool, theta was read
    turns: Any  # [deg] W then
    predicted: Any  # [deg] attitude that the estimate predicts


class Computer(NamedTuple):
    """What the on-board computer knows."""

    mrac: Mrac  # controller
    turns: Any  # [deg] W, integral of the wheel speed as read
    memory: Memory


class SensorState(NamedTuple):
    """What the sensors hold until the next tick."""

    line: Reading  # (DELAYS + 1,) [deg] the latest attitude readings, newest first
    tacho: Channel  # the wheel speed is read continuously
    readings: Readings


class X(NamedTuple):
    """Continuous state: the truth, and what the computer integrates."""

    theta: Any  # [deg] attitude
    y: Any  # [deg/s] wheel speed
    mrac: Mrac
    turns: Any  # [deg] W


class Z(NamedTuple):
    """Held between ticks."""

    sensors: SensorState
    memory: Memory
    drive: Channel  # effectiveness and offset of the command
    friction: Any  # [deg/s^2] F at present
    failed: Any  # bool, the run has diverged and stands still


class Log(NamedTuple):
    """What a tick reports. Truth unless it says otherwise. NaN once the run has diverged."""

    t: Annotated[Any, "s"]
    theta: Annotated[Any, "deg"]  # attitude
    rate: Annotated[Any, "deg/s"]  # its rate
    target: Annotated[Any, "deg"]  # desired attitude
    target_rate: Annotated[Any, "deg/s"]
    error: Annotated[Any, "deg"]  # desired minus true attitude
    measured: Annotated[Any, "deg"]  # desired minus read attitude, on board; minus the expected one where none is read
    y: Annotated[Any, "deg/s"]  # wheel speed
    y_m: Annotated[Any, "deg/s"]  # reference model, on board
    r: Annotated[Any, "deg/s"]  # desired wheel speed, on board
    step: Annotated[Any, "deg/s"]  # its change since the last tick; 0 at the first
    r_ideal: Annotated[Any, "deg/s"]  # wheel speed that the slew needs
    u: Annotated[Any, "deg/s"]  # command, on board
    a_r: Annotated[Any, "1"]  # on board
    a_y: Annotated[Any, "1"]  # on board
    J_hat: Annotated[Any, "kg m^2"]  # on board
    P: Annotated[Any, "1/(deg^2 s)"]  # gain of the estimator, on board
    residual: Annotated[Any, "deg/s"]  # read wheel speed minus reference model, on board; 0 where none is read
    alarm: Annotated[Any, "1"]  # bool, on board
    flipped: Annotated[Any, "1"]  # bool, the estimate was set to J_most, on board
    failed: Annotated[Any, "1"]  # bool, the run has diverged


class Scores(NamedTuple):
    """Tallies of a run: what a sweep reports. faulty: while a fault is on; late: after the first `START_UP` seconds."""

    peak: Annotated[Any, "deg"]  # true error
    peak_late: Annotated[Any, "deg"]
    rms: Annotated[Any, "deg"]
    rms_late: Annotated[Any, "deg"]
    peak_measured: Annotated[Any, "deg"]  # error as measured
    peak_measured_late: Annotated[Any, "deg"]
    rms_measured_late: Annotated[Any, "deg"]
    mean_measured: Annotated[Any, "deg"]  # of its size
    chatter: Annotated[Any, "deg/s"]  # rms change of the desired speed from tick to tick, late
    spans: Annotated[Any, "deg/s"]  # three: peak to peak of r - r_ideal in the `WINDOWS`
    peaks: Annotated[Any, "deg"]  # three: true error in the `WINDOWS`
    peak_speed: Annotated[Any, "deg/s"]
    J_hat: Annotated[Any, "kg m^2"]  # at the end
    J_settling: Annotated[Any, "s"]  # until J_hat stays within 0.5 %
    a_r: Annotated[Any, "1"]  # at the end
    a_y: Annotated[Any, "1"]  # at the end
    delay: Annotated[Any, "s"]  # from the first onset to the first alarm after it; inf if never
    false_alarms: Annotated[Any, "1"]  # share of alarms between start-up and the first onset
    peak_residual_faulty: Annotated[Any, "deg/s"]
    peak_faulty: Annotated[Any, "deg"]  # true error
    settling_faulty: Annotated[Any, "s"]  # from the first onset until the true error stays within 0.05 deg
    unstable_at: Annotated[Any, "s"]  # first late time outside the bound of sampled adaptation; inf if never
    flipped_at: Annotated[Any, "s"]  # first time at which the estimate was set to J_most; inf if never
    failed_at: Annotated[Any, "s"]  # first time at which the run had diverged; inf if never
    ok: Annotated[Any, "1"]  # bool, every number of the log was finite


def slew(params: Params, t):
    """Desired attitude [deg] and rate [deg/s] at t [s]: a tanh from 0 to D in T, not quite from rest to rest."""
    s = jnp.tanh(5 * (t - params.duration / 2) / params.duration)
    return params.turn / 2 * (s / tanh(2.5) + 1), fastest(params) * (1 - s * s)


def fastest(params: Params):
    """The slew's rate at its middle, the largest [deg/s]."""
    return params.turn / 2 * 5 / (params.duration * tanh(2.5))


def init(params: Params, scenario: Scenario):
    """x, z at the start: everything at rest at zero."""
    mrac = Mrac(0.0, params.a_r, params.a_y)
    memory = Memory(LeastSquares(-params.J_w / params.J_hat, params.P0), 0.0, 0.0, 0.0, True, 0.0, 0.0)
    line, nothing = Reading(jnp.zeros(DELAYS + 1), jnp.ones(DELAYS + 1, bool)), Reading(0.0, True)
    sensors = SensorState(line, Channel(0.0, 0.0), Readings(nothing, nothing))
    return X(0.0, 0.0, mrac, 0.0), Z(sensors, memory, Channel(0.0, 0.0), 0.0, False)


def sense(params: Params, scenario: Scenario, now, x: X, z: Z, noise) -> SensorState:
    """What the sensors read now and hold until the next tick; noise: 3 normals (attitude, wheel speed, drive)."""
    shape = jnp.where(scenario.uniform > 0, jax.lax.erf(noise[0] / sqrt(2)), noise[0])
    attitude = channel(scenario.attitude, now.t, scenario.noise, shape, z.sensors.line.value[0])
    newest = Reading(read(attitude, x.theta), heard(scenario.attitude, now.t))
    line, age = Reading(*map(pushed, z.sensors.line, newest)), scenario.delay / now.dt
    theta = Reading(delayed(line.value, age), delayed(jnp.where(line.valid, 0.0, 1.0), age) == 0)
    tacho = channel(scenario.tacho, now.t, scenario.tacho_noise, noise[1], z.sensors.readings.y.value)
    y = Reading(tachometer(scenario, tacho, x.y), heard(scenario.tacho, now.t))
    return SensorState(line, tacho, Readings(theta, y))


def tachometer(scenario: Scenario, tacho: Channel, y):
    """Wheel speed y as read [deg/s]."""
    return quantised(read(tacho, y), scenario.tacho_step)


# on board


def computer_of(x: X, z: Z) -> Computer:
    """What the computer knows between two ticks."""
    return Computer(x.mrac, x.turns, z.memory)


def decide(params: Params, now, computer: Computer, readings: Readings):
    """One tick on board (choice 4): estimate, then desired speed. Returns computer and (residual, alarm, flipped).

    Of what is missing (choice 9) the computer takes what it expects: the attitude from the wheel's turns, the wheel speed
    from the reference model.
    """
    mrac, turns, last = computer
    expected = last.theta + last.estimate.a * (turns - last.turns)
    reading = nearest_angle(readings.theta.value, expected, 360.0)  # a sensor may start anew at a turn
    readings = readings._replace(theta=readings.theta._replace(value=reading))
    estimate, flipped = estimated(params, now, computer, readings)
    target, target_rate = slew(params, now.t)
    moved = estimate.a * (turns - last.turns)
    predicted = jnp.where(params.differenced > 0, last.predicted + moved, estimate.a * turns)
    fresh, theta = present(readings.theta), known(readings.theta, last.theta + moved)
    blended = predicted + jnp.where(fresh, params.blend * (theta - predicted), 0)
    feedback = jnp.where(params.ope > 0, blended, theta)
    r = (params.forward * target_rate + params.K * (target - feedback)) / estimate.a  # choice 2
    y = known(readings.y, mrac.y_m)
    residual = y - mrac.y_m
    alarm = ~(jnp.abs(residual) <= params.residual_max)  # so that NaN alarms
    memory = Memory(estimate, r, mrac_input(mrac, r, y), theta, fresh, turns, predicted)
    return computer._replace(memory=memory), (residual, alarm, flipped)


def decide_sampled(params: Params, now, computer: Computer, readings: Readings):
    """`decide`, then the adaptation law by one step of forward Euler."""
    computer, out = decide(params, now, computer, readings)
    y = known(readings.y, computer.mrac.y_m)
    return computer._replace(mrac=mrac_step(computer.mrac, params.law, computer.memory.r, y, now.dt)), out


def estimated(params: Params, now, computer: Computer, readings: Readings):
    """The estimate of a after eqs. (7)-(10), and whether it had to be kept from changing its sign."""
    turns, last, rates = computer.turns, computer.memory, params.differenced > 0
    theta = known(readings.theta, 0.0)
    used = present(readings.theta) & (
        last.fresh | jnp.logical_not(rates)
    )  # without a reading the estimator forgets and learns nothing
    W = jnp.where(used, jnp.where(rates, (turns - last.turns) / now.dt, turns), 0)
    output = jnp.where(used, jnp.where(rates, (theta - last.theta) / now.dt, theta), 0)
    due = (params.ope > 0) & (now.k > 0)
    new = least_squares(last.estimate, W, output, now.dt, params.forget)
    least = -params.J_w / params.J_most
    flipped = due & (new.a > least)
    a = jnp.where(due, jnp.minimum(new.a, least), last.estimate.a)
    return LeastSquares(a, jnp.where(due, jnp.minimum(new.P, params.P0), last.estimate.P)), flipped


def computer_flow(params: Params, computer: Computer, readings: Readings) -> dict[str, Any]:
    """Rates of what moves on board between ticks with continuous adaptation: r is held, u is not."""
    y = known(readings.y, computer.mrac.y_m)
    mrac = mrac_flow(computer.mrac, params.law, computer.memory.r, y, params.a_m, params.b_m)
    return dict(mrac=mrac, turns=y)


def computer_flow_sampled(params: Params, computer: Computer, readings: Readings) -> dict[str, Any]:
    """The same with sampled adaptation: r and u are held."""
    y_m = params.b_m * computer.memory.r - params.a_m * computer.mrac.y_m  # eq. (2)
    return dict(mrac=Mrac(y_m, 0.0, 0.0), turns=known(readings.y, computer.mrac.y_m))


# the loop


def tick(sampled: bool, params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """One tick: sensors read, the computer decides, a log is written; sampled: whether the adaptation law is."""
    sensors = sense(params, scenario, now, x, z, noise)
    law = decide_sampled if sampled else decide
    computer, (residual, alarm, flipped) = law(params, now, computer_of(x, z), sensors.readings)
    memory = computer.memory
    drive = channel(scenario.drive, now.t, 0.0, noise[2], z.memory.u)
    friction = read(channel(scenario.friction, now.t, 0.0, 0.0, scenario.wheel.friction), scenario.wheel.friction)
    failed = z.failed | ~(jnp.abs(x.y) < RUNAWAY)
    target, target_rate = shared(slew, params, now.t)  # rounded before a difference is taken, so that reruns are exact
    numbers = dict(
        theta=x.theta,
        rate=body_rate(scenario, now.t, x.y),
        target=target,
        target_rate=target_rate,
        error=target - x.theta,
        measured=target - memory.theta,
        y=x.y,
        y_m=x.mrac.y_m,
        r=memory.r,
        step=jnp.where(now.k > 0, memory.r - z.memory.r, 0),
        r_ideal=-scenario.J_z / scenario.J_w * target_rate,
        u=memory.u,
        a_r=x.mrac.a_r,
        a_y=x.mrac.a_y,
        J_hat=-params.J_w / memory.estimate.a,
        P=memory.estimate.P,
        residual=residual,
    )
    shown = {name: jnp.where(failed, jnp.nan, a) for name, a in numbers.items()}
    log = Log(now.t, **shown, alarm=alarm | failed, flipped=flipped & ~failed, failed=failed)
    return x._replace(mrac=computer.mrac), Z(sensors, memory, drive, friction, failed), log


def body_rate(scenario: Scenario, t, y):
    """Rate of the platform [deg/s] at wheel speed y [deg/s]: eq. (1), and the momentum that it leaves out."""
    return (scenario.momentum + degrees(1) * scenario.torque * t - scenario.J_w * y) / scenario.J_z


def flow(sampled: bool, params: Params, scenario: Scenario, t, x: X, z: Z) -> X:
    """dx/dt between ticks; sampled: with a held command, else with the wheel speed read and the law run continuously."""
    # a diverging run stands still before it overflows, so that neither it nor its gradient is NaN
    sane = ~z.failed & (jnp.abs(x.y) < RUNAWAY)
    x = x._replace(y=jnp.where(sane, x.y, 0))
    computer = computer_of(x, z)
    y = Reading(tachometer(scenario, z.sensors.tacho, x.y), z.sensors.readings.y.valid)
    readings = z.sensors.readings._replace(y=y)
    on_board = (computer_flow_sampled if sampled else computer_flow)(params, computer, readings)
    u = z.memory.u if sampled else mrac_input(x.mrac, z.memory.r, known(y, x.mrac.y_m))
    u = read(z.drive, jnp.clip(u, -scenario.wheel.u_max, scenario.wheel.u_max))  # lost after the bound, not before
    wheel = scenario.wheel._replace(friction=z.friction, u_max=jnp.inf)
    rate = X(body_rate(scenario, t, x.y), wheel_acceleration(wheel, x.y, u), **on_board)  # eqs. (1), (3)
    return jax.tree.map(lambda a: jnp.where(sane, a, 0), rate)


def score(params: Params, scenario: Scenario, now, log: Log) -> Scores:
    """The tallies of one tick."""
    onset, faulty = first_onset(scenario), any_active(scenario, now.t)
    late, before = now.t >= START_UP, now.t < onset
    windows = [(now.t >= start) & (now.t < end) for start, end in WINDOWS]
    error, measured, residual = jnp.abs(log.error), jnp.abs(log.measured), jnp.abs(log.residual)
    bound = mrac_sampled_bound(params.law, now.dt, scenario.wheel.a, scenario.wheel.b, log.a_y)
    return Scores(
        peak=scores.peak(error),
        peak_late=scores.peak(error, late),
        rms=scores.rms(log.error**2),
        rms_late=scores.rms(log.error**2, late),
        peak_measured=scores.peak(measured),
        peak_measured_late=scores.peak(measured, late),
        rms_measured_late=scores.rms(log.measured**2, late),
        mean_measured=scores.mean(measured),
        chatter=scores.rms(log.step**2, late),
        spans=tuple(scores.span(log.r - log.r_ideal, window) for window in windows),
        peaks=tuple(scores.peak(error, window) for window in windows),
        peak_speed=scores.peak(jnp.abs(log.y)),
        J_hat=scores.final(log.J_hat),
        J_settling=scores.settling(now, jnp.abs(log.J_hat / scenario.J_z - 1) > 0.005),
        a_r=scores.final(log.a_r),
        a_y=scores.final(log.a_y),
        delay=scores.first(now, log.alarm & ~before, since=onset),
        false_alarms=scores.mean(log.alarm, late & before),
        peak_residual_faulty=scores.peak(residual, faulty),
        peak_faulty=scores.peak(error, faulty),
        settling_faulty=scores.settling(now._replace(t=now.t - onset), error > 0.05, faulty),
        unstable_at=scores.first(now, late & ~(log.r**2 + log.y**2 < bound)),
        flipped_at=scores.first(now, log.flipped),
        failed_at=scores.first(now, log.failed),
        ok=scores.always(scores.finite(log)),
    )


def refuse_bad(sampled: bool, dt: float, substeps: int, params: Params, scenario: Scenario) -> None:
    """The system's check: ValueError for too late readings, a warning of adaptation too fast for dt or dt / substeps."""
    check.kinds(params, Params, scenario, Scenario)
    longest, delay = DELAYS * dt, np.asarray(scenario.delay)
    check.each("scenario.delay", f"lie in 0 to {longest:g} s", delay, delay <= longest * (1 + 1e-9))
    law, wheel, step = params.law, scenario.wheel, dt if sampled else dt / substeps
    bound = mrac_sampled_bound(law, step, wheel.a, wheel.b) if sampled else mrac_flow_bound(law, step, wheel.b)
    needed = np.abs(fastest(params)) * scenario.J_z / scenario.J_w  # y = r in the slew
    gamma, limit, needed = np.broadcast_arrays(law.gamma, np.sqrt(bound / 2), needed)
    if np.any(needed > limit):
        gamma, limit, needed = (a[needed > limit][0] for a in (gamma, limit, needed))
        how = f"sampled every {step:g} s" if sampled else f"integrated in steps of {step:g} s"
        check.warn(
            f"`params.law.gamma` = {gamma:g} s/deg^2, {how}, is stable only for wheel speeds up to {limit:.0f} deg/s, "
            f"but the slew needs {needed:.0f} deg/s."
        )


def system_of(*, sampled: bool = False, dt: float = DT, substeps: int = 20) -> System:
    """The closed loop with continuous or sampled adaptation, ticks of dt [s] and RK4 steps of dt / substeps.

    Equal arguments give the same object. Raises ValueError for dt <= 0 or substeps < 1.
    """
    check.positive("dt", dt)
    return _system_of(bool(sampled), float(dt), check.whole("substeps", substeps))


@lru_cache
def _system_of(sampled: bool, dt: float, substeps: int) -> System:
    parts, checked = (partial(tick, sampled), partial(flow, sampled)), partial(refuse_bad, sampled, dt, substeps)
    return System(init, *parts, dt=dt, substeps=substeps, normals=3, check=checked)


sampled = system_of(sampled=True, substeps=10)
mrac_only = Params(ope=0.0)

system = system_of()
params = Params()  # MRAC and inertia estimation
scenario = Scenario()
