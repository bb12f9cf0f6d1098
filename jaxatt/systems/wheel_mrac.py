"""Single-axis wheel test bed: adaptive wheel-speed control and on-line inertia estimation (Eun, Park & Park, 2016).

A platform on an air bearing is turned by one reaction wheel. An outer loop, which the paper does not give
(choice 2), asks for a wheel speed; model-reference adaptive control (MRAC) makes the wheel follow it; recursive least
squares on the wheel's turns and the measured attitude estimate the platform's inertia (OPE).

Angles are in degrees and speeds in deg/s throughout, as in the paper; the gains are for these units (choice 1).
`system` adapts continuously; `sampled` adapts once per tick with a held command, as a computer would.
Choices and errata by number: docs/loops/wheel_mrac.md.
"""

from __future__ import annotations

import warnings
from functools import lru_cache, partial
from math import degrees, pi, sqrt, tanh
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check, scores
from jaxatt.bodies import Wheel, wheel_acceleration
from jaxatt.check import door
from jaxatt.controllers import Adaptation, Mrac, mrac_flow, mrac_input, mrac_sampled_bound, mrac_step
from jaxatt.engine import System
from jaxatt.estimators import LeastSquares, least_squares
from jaxatt.faults import Channel, Fault, any_active, channel, check_fault, first_onset, read

DT = 0.02  # [s] 50 Hz
DELAYS = 10  # [1] ticks by which an attitude reading may be late
RUNAWAY = 1e9  # [deg/s] wheel speed at which a run counts as diverged
PER_RAD2 = (pi / 180) ** 2  # [rad^2/deg^2] times gamma or P0 for speeds in rad/s: the same gain for deg/s
J_WHEEL = 7.133e-4  # [kg m^2] the paper's wheel


class Params(NamedTuple):
    """What the engineer ships. Every field has shape ()."""

    turn: Any = 90.0  # [deg] slew D
    duration: Any = 90.0  # [s] slew time T
    K: Any = 1.0  # [1/s] gain of the outer loop; not given in the paper (choice 2)
    forward: Any = 1.0  # [1] feed-forward of the slew rate; 0 for none
    J_w: Any = J_WHEEL  # [kg m^2] believed wheel inertia
    J_hat: Any = 5.0  # [kg m^2] believed platform inertia at the start
    a_m: Any = 10.0  # [1/s] reference model, eq. (2)
    b_m: Any = 10.0  # [1/s] reference model, eq. (2)
    a_r: Any = 1.0  # [1] control parameter at the start, eq. (5)
    a_y: Any = 0.5  # [1] control parameter at the start, eq. (5)
    law: Adaptation = Adaptation()  # eq. (6)
    ope: Any = 1.0  # [1] 1: the inertia is estimated and the attitude predicted; 0: MRAC only
    P0: Any = 1e-6  # [1/(deg^2 s)] gain of the estimator at the start, eq. (9); in [s/deg^2] if differenced
    differenced: Any = 0.0  # [1] 1: the estimator compares rates, from differenced readings; 0: angles (choice 3)
    forget: Any = 0.0  # [1/s] rate at which the estimator forgets
    blend: Any = 0.0  # [1] share L of the measured in the predicted attitude
    J_most: Any = 1e3  # [kg m^2] estimates beyond it, and those whose sign has flipped, are set to it
    residual_max: Any = 50.0  # [deg/s] alarm threshold on |y - y_m| (choice 6)


class Scenario(NamedTuple):
    """What the day brings. Every field has shape ()."""

    J_w: Any = J_WHEEL  # [kg m^2] true wheel inertia
    J_z: Any = 5.421  # [kg m^2] true platform inertia
    wheel: Wheel = Wheel()  # speeds in deg/s
    noise: Any = 0.05  # [deg] attitude noise: half-width if uniform, else standard deviation
    uniform: Any = 1.0  # [1] 1: the attitude noise is uniform; 0: Gaussian
    delay: Any = 0.0  # [s] age of the attitude readings, at most `DELAYS` ticks
    tacho_noise: Any = 0.0  # [deg/s] standard deviation of the wheel-speed noise
    tacho_step: Any = 0.0  # [deg/s] quantisation of the wheel speed; 0 for none
    momentum: Any = 0.0  # [kg m^2 deg/s] total angular momentum at the start, which eq. (1) takes as zero
    torque: Any = 0.0  # [N m] disturbance torque
    attitude: Fault = Fault()  # of the attitude sensor [deg]
    tacho: Fault = Fault()  # of the wheel-speed sensor [deg/s]
    drive: Fault = Fault()  # of the wheel's command [deg/s]; its scale is the effectiveness
    friction: Fault = Fault()  # of the wheel's friction F [deg/s^2]; its bias or drift is the growth


class Board(NamedTuple):
    """What the on-board computer knows."""

    mrac: Mrac  # controller
    estimate: LeastSquares  # of a = -J_w / J_z
    turns: Any  # () [deg] W, integral of the wheel speed as read
    r: Any  # () [deg/s] desired wheel speed
    u: Any  # () [deg/s] command; the continuous law goes on changing it until the next tick
    theta: Any  # () [deg] last attitude reading
    turns_then: Any  # () [deg] W at that reading
    predicted: Any  # () [deg] attitude that the estimate predicts


class Readings(NamedTuple):
    """What the sensors say at a tick."""

    theta: Any  # () [deg] attitude
    y: Any  # () [deg/s] wheel speed


class Held(NamedTuple):
    """What the sensors hold until the next tick."""

    line: Any  # (DELAYS + 1,) [deg] the latest attitude readings, newest first
    tacho: Channel  # the wheel speed is read continuously
    readings: Readings


class X(NamedTuple):
    """Continuous state: the truth, and what the computer integrates."""

    theta: Any  # () [deg] attitude
    y: Any  # () [deg/s] wheel speed
    mrac: Mrac
    turns: Any  # () [deg] W


class Z(NamedTuple):
    """Held between ticks."""

    sensors: Held
    board: Board  # but for mrac and turns, which are in X
    drive: Channel  # effectiveness and offset of the command
    friction: Any  # () [deg/s^2] F at present
    failed: Any  # () bool, the run has diverged and stands still


class Log(NamedTuple):
    """What a tick reports. Truth unless it says otherwise. NaN once the run has diverged."""

    theta: Any  # () [deg] attitude
    rate: Any  # () [deg/s] its rate
    target: Any  # () [deg] desired attitude
    target_rate: Any  # () [deg/s]
    error: Any  # () [deg] desired minus true attitude
    measured: Any  # () [deg] desired minus read attitude, on board
    y: Any  # () [deg/s] wheel speed
    y_m: Any  # () [deg/s] reference model, on board
    r: Any  # () [deg/s] desired wheel speed, on board
    step: Any  # () [deg/s] its change since the last tick; 0 at the first
    r_ideal: Any  # () [deg/s] wheel speed that the slew needs
    u: Any  # () [deg/s] command, on board
    a_r: Any  # () [1] on board
    a_y: Any  # () [1] on board
    J_hat: Any  # () [kg m^2] on board
    P: Any  # () gain of the estimator, on board
    residual: Any  # () [deg/s] read wheel speed minus reference model, on board
    alarm: Any  # () bool, on board
    flipped: Any  # () bool, the estimate was set to J_most, on board
    failed: Any  # () bool, the run has diverged


class Scores(NamedTuple):
    """Tallies of a run: what a sweep reports. ill: a fault is on; late: after the first `START_UP` seconds."""

    peak: Any  # [deg] true error
    peak_late: Any  # [deg]
    rms: Any  # [deg]
    rms_late: Any  # [deg]
    peak_measured: Any  # [deg] error as measured
    peak_measured_late: Any  # [deg]
    rms_measured_late: Any  # [deg]
    mean_measured: Any  # [deg] of its size
    chatter: Any  # [deg/s] rms change of the desired speed from tick to tick, late
    spans: Any  # three [deg/s]: peak to peak of r - r_ideal in the `WINDOWS`
    peaks: Any  # three [deg]: true error in the `WINDOWS`
    peak_speed: Any  # [deg/s]
    J_hat: Any  # [kg m^2] at the end
    J_settling: Any  # [s] until J_hat stays within 0.5 %
    a_r: Any  # [1] at the end
    a_y: Any  # [1] at the end
    delay: Any  # [s] from the first onset to the first alarm after it; inf if never
    false_alarms: Any  # [1] share of alarms between start-up and the first onset
    peak_residual_ill: Any  # [deg/s]
    peak_ill: Any  # [deg] true error
    settling_ill: Any  # [s] from the first onset until the true error stays within 0.05 deg
    unstable_at: Any  # [s] first late time outside the bound of sampled adaptation; inf if never
    flipped_at: Any  # [s] first time at which the estimate was set to J_most; inf if never
    failed_at: Any  # [s] first time at which the run had diverged; inf if never
    ok: Any  # bool, every number of the log was finite


START_UP = 10.0  # [s] window reported apart: the parameters leave their start
WINDOWS = ((0.0, 20.0), (20.0, 60.0), (60.0, jnp.inf))  # [s] of the paper's words on Fig. 10


@door
def slew(params: Params, t):
    """Desired attitude [deg] and rate [deg/s] at t [s]: a tanh from 0 to D in T, not quite from rest to rest."""
    s = jnp.tanh(5 * (t - params.duration / 2) / params.duration)
    half = params.turn / 2
    return half * (s / tanh(2.5) + 1), half * 5 / (params.duration * tanh(2.5)) * (1 - s * s)


def init(params: Params, scenario: Scenario):
    """x, z at the start: everything at rest at zero."""
    o = jnp.zeros(())
    mrac = Mrac(o, params.a_r, params.a_y)
    board = Board(mrac, LeastSquares(-params.J_w / params.J_hat, params.P0), *[o] * 6)
    sensors = Held(jnp.zeros(DELAYS + 1), Channel(o, o), Readings(o, o))
    return X(o, o, mrac, o), Z(sensors, board, Channel(o, o), o, jnp.asarray(False))


def sense(params: Params, scenario: Scenario, now, x: X, z: Z, noise) -> Held:
    """What the sensors read now and hold until the next tick; noise: 3 normals (attitude, wheel speed, drive)."""
    shape = jnp.where(scenario.uniform > 0, jax.lax.erf(noise[0] / sqrt(2)), noise[0])
    attitude = channel(scenario.attitude, now.t, scenario.noise, shape, z.sensors.line[0])
    line = jnp.concatenate([read(attitude, x.theta)[None], z.sensors.line[:-1]])
    tacho = channel(scenario.tacho, now.t, scenario.tacho_noise, noise[1], z.sensors.readings.y)
    return Held(line, tacho, Readings(delayed(line, scenario.delay / now.dt), tachometer(scenario, tacho, x.y)))


def tachometer(scenario: Scenario, tacho: Channel, y):
    """Wheel speed y as read [deg/s]; the steps of the quantisation are passed over by gradients."""
    y, step = read(tacho, y), scenario.tacho_step
    coarse = step > 0
    safe = jnp.where(coarse, step, 1)
    return y + jax.lax.stop_gradient(jnp.where(coarse, safe * jnp.round(y / safe) - y, 0))


def delayed(line, ticks):
    """The reading of the line (k, *lanes), newest first, that is ``ticks`` old, between two linearly interpolated."""
    age = jnp.arange(len(line)).reshape(-1, *[1] * (line.ndim - 1))
    return jnp.sum(jnp.maximum(1 - jnp.abs(age - ticks), 0) * line, axis=0)


def decide(params: Params, now, board: Board, readings: Readings):
    """One tick on board (choice 4): estimate, then desired speed. Returns board and (residual, alarm, flipped)."""
    estimate, flipped = estimated(params, now, board, readings)
    target, target_rate = slew(params, now.t)
    increment = board.predicted + estimate.a * (board.turns - board.turns_then)
    predicted = jnp.where(params.differenced > 0, increment, estimate.a * board.turns)
    blended = predicted + params.blend * (readings.theta - predicted)
    feedback = jnp.where(params.ope > 0, blended, readings.theta)
    r = (params.forward * target_rate + params.K * (target - feedback)) / estimate.a  # choice 2
    residual = readings.y - board.mrac.y_m
    alarm = ~(jnp.abs(residual) <= params.residual_max)  # so that NaN alarms
    u = mrac_input(board.mrac, r, readings.y)
    board = Board(board.mrac, estimate, board.turns, r, u, readings.theta, board.turns, predicted)
    return board, (residual, alarm, flipped)


def decide_sampled(params: Params, now, board: Board, readings: Readings):
    """`decide`, then the adaptation law by one step of forward Euler."""
    board, out = decide(params, now, board, readings)
    return board._replace(mrac=mrac_step(board.mrac, params.law, board.r, readings.y, now.dt)), out


def board_flow(params: Params, board: Board, readings: Readings) -> dict[str, Any]:
    """Rates of what moves on board between ticks with continuous adaptation: r is held, u is not."""
    mrac = mrac_flow(board.mrac, params.law, board.r, readings.y, params.a_m, params.b_m)
    return dict(mrac=mrac, turns=readings.y)


def board_flow_sampled(params: Params, board: Board, readings: Readings) -> dict[str, Any]:
    """The same with sampled adaptation: r and u are held."""
    y_m = params.b_m * board.r - params.a_m * board.mrac.y_m  # eq. (2)
    return dict(mrac=Mrac(y_m, jnp.zeros_like(y_m), jnp.zeros_like(y_m)), turns=readings.y)


def estimated(params: Params, now, board: Board, readings: Readings):
    """The estimate of a after eqs. (7)-(10), and whether it had to be kept from changing its sign."""
    old, rates = board.estimate, params.differenced > 0
    W = jnp.where(rates, (board.turns - board.turns_then) / now.dt, board.turns)
    output = jnp.where(rates, (readings.theta - board.theta) / now.dt, readings.theta)
    due = (params.ope > 0) & (now.k > 0)
    new = least_squares(old, W, output, now.dt, params.forget)
    least = -params.J_w / params.J_most
    flipped = due & (new.a > least)
    a = jnp.where(due, jnp.minimum(new.a, least), old.a)
    return LeastSquares(a, jnp.where(due, jnp.minimum(new.P, params.P0), old.P)), flipped


def _tick(decide, params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    sensors = sense(params, scenario, now, x, z, noise)
    board, (residual, alarm, flipped) = decide(
        params, now, z.board._replace(mrac=x.mrac, turns=x.turns), sensors.readings
    )
    drive = channel(scenario.drive, now.t, 0.0, noise[2], z.board.u)
    friction = read(channel(scenario.friction, now.t, 0.0, 0.0, scenario.wheel.friction), scenario.wheel.friction)
    failed = z.failed | ~(jnp.abs(x.y) < RUNAWAY)
    target, target_rate = slew(params, now.t)

    def shown(a):
        return jnp.where(failed, jnp.nan, a)

    log = Log(
        theta=shown(x.theta),
        rate=shown(body_rate(scenario, now.t, x.y)),
        target=shown(target),
        target_rate=shown(target_rate),
        error=shown(target - x.theta),
        measured=shown(target - sensors.readings.theta),
        y=shown(x.y),
        y_m=shown(x.mrac.y_m),
        r=shown(board.r),
        step=shown(jnp.where(now.k > 0, board.r - z.board.r, 0)),
        r_ideal=shown(-scenario.J_z / scenario.J_w * target_rate),
        u=shown(board.u),
        a_r=shown(x.mrac.a_r),
        a_y=shown(x.mrac.a_y),
        J_hat=shown(-params.J_w / board.estimate.a),
        P=shown(board.estimate.P),
        residual=shown(residual),
        alarm=alarm | failed,
        flipped=flipped & ~failed,
        failed=failed,
    )
    return x._replace(mrac=board.mrac), Z(sensors, board, drive, friction, failed), log


tick = partial(_tick, decide)  # continuous adaptation
tick_sampled = partial(_tick, decide_sampled)


def body_rate(scenario: Scenario, t, y):
    """Rate of the platform [deg/s] at wheel speed y [deg/s]: eq. (1), and the momentum that it leaves out."""
    return (scenario.momentum + degrees(1) * scenario.torque * t - scenario.J_w * y) / scenario.J_z


def flow(params: Params, scenario: Scenario, t, x: X, z: Z) -> X:
    """dx/dt between ticks with continuous adaptation; the wheel speed is read continuously."""
    x, moving = _moving(x, z)
    board, readings = _at(scenario, x, z)
    u = mrac_input(board.mrac, board.r, readings.y)
    return moving(X(*_plant(scenario, t, x, z, u), **board_flow(params, board, readings)))


def flow_sampled(params: Params, scenario: Scenario, t, x: X, z: Z) -> X:
    """dx/dt between ticks with sampled adaptation: the command is held."""
    x, moving = _moving(x, z)
    board, readings = _at(scenario, x, z)
    return moving(X(*_plant(scenario, t, x, z, board.u), **board_flow_sampled(params, board, readings)))


def _at(scenario: Scenario, x: X, z: Z) -> tuple[Board, Readings]:
    y = tachometer(scenario, z.sensors.tacho, x.y)
    return z.board._replace(mrac=x.mrac, turns=x.turns), z.sensors.readings._replace(y=y)


def _plant(scenario: Scenario, t, x: X, z: Z, u):
    # rates of attitude and wheel speed
    wheel = scenario.wheel._replace(friction=z.friction)
    u = jnp.clip(u, -wheel.u_max, wheel.u_max)  # what the drive loses, it loses after its bound
    return (
        body_rate(scenario, t, x.y),
        wheel_acceleration(wheel._replace(u_max=jnp.inf), x.y, read(z.drive, u)),  # eq. (3)
    )


def _moving(x: X, z: Z):
    # a diverging run stands still before it overflows, so that neither it nor its gradient is NaN
    sane = ~z.failed & (jnp.abs(x.y) < RUNAWAY)
    x = x._replace(y=jnp.where(sane, x.y, 0))
    return x, lambda rate: jax.tree.map(lambda a: jnp.where(sane, a, 0), rate)


def score(params: Params, scenario: Scenario, now, log: Log) -> Scores:
    """The tallies of one tick."""
    faults = (scenario.attitude, scenario.tacho, scenario.drive, scenario.friction)
    onset, ill = first_onset(faults), any_active(faults, now.t)
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
        peak_residual_ill=scores.peak(residual, ill),
        peak_ill=scores.peak(error, ill),
        settling_ill=scores.settling(now._replace(t=now.t - onset), error > 0.05, ill),
        unstable_at=scores.first(now, late & ~(log.r**2 + log.y**2 < bound)),
        flipped_at=scores.first(now, log.flipped),
        failed_at=scores.first(now, log.failed),
        ok=scores.always(scores.finite(log)),
    )


@door
def normals_of(v, amplitude):
    """The noise array, shape (ticks, 3, *lanes), with which `simulate` adds the attitude noise v to the readings.

    v: [deg] uniform noise in (-amplitude, amplitude), shape (ticks, *lanes); the scenario's noise must be that
    amplitude. Wheel speed and drive stay without noise. Raises ValueError for v outside.
    """
    share = np.asarray(v, float) / amplitude
    check.each("v", f"lie between +-{amplitude:g}", np.asarray(v, float), np.abs(share) < 1)
    normal = np.sqrt(2) * np.asarray(jax.lax.erf_inv(jnp.asarray(share)))
    return jnp.asarray(np.stack([normal, 0 * normal, 0 * normal], axis=1))


def refuse_bad(params: Params, scenario: Scenario) -> tuple:
    """The system's check: ValueError on input outside physics' domain; returns the lanes."""
    lanes = check.shapes(params, scenario, Params(), Scenario())
    for name in ("duration", "K", "J_w", "J_hat", "a_m", "P0", "residual_max"):
        check.positive(f"params.{name}", getattr(params, name))
    for name in ("turn", "forward", "b_m", "a_r", "a_y", "blend"):
        check.finite(f"params.{name}", getattr(params, name))
    for name in ("ope", "differenced"):
        check.one_of(f"params.{name}", getattr(params, name), (0, 1))
    if check.concrete(params.J_hat):
        check.above("params.J_most", params.J_most, np.max(params.J_hat), "params.J_hat")
    check.one_of("params.law.sign", params.law.sign, (-1, 1))
    check.finite("params.forget", params.forget)
    check.not_negative("params.forget", params.forget)
    for name in ("gamma", "normalise", "leak"):
        check.finite(f"params.law.{name}", getattr(params.law, name))
        check.not_negative(f"params.law.{name}", getattr(params.law, name))
    check.above("params.law.limit", params.law.limit, 0, "inf for no projection")
    for name in ("J_w", "J_z"):
        check.positive(f"scenario.{name}", getattr(scenario, name))
    check.finite("scenario.wheel.a", scenario.wheel.a)
    check.finite("scenario.wheel.b", scenario.wheel.b)
    if check.concrete(scenario.wheel.b):
        b = np.asarray(scenario.wheel.b)
        check.each("scenario.wheel.b", "not be zero (no command could turn the wheel)", b, b != 0)
    for name in ("u_max", "slow", "creep"):
        check.above(f"scenario.wheel.{name}", getattr(scenario.wheel, name), 0, "a size")
    for name in ("dead_zone", "gate", "weakness", "friction", "stiction"):
        check.finite(f"scenario.wheel.{name}", getattr(scenario.wheel, name))
        check.not_negative(f"scenario.wheel.{name}", getattr(scenario.wheel, name))
    if check.concrete(scenario.wheel.weakness):
        weakness = np.asarray(scenario.wheel.weakness)
        check.each("scenario.wheel.weakness", "be a share of at most 1", weakness, weakness <= 1)
    for name in ("noise", "tacho_noise", "tacho_step"):
        check.finite(f"scenario.{name}", getattr(scenario, name))
        check.not_negative(f"scenario.{name}", getattr(scenario, name))
    check.one_of("scenario.uniform", scenario.uniform, (0, 1))
    check.finite("scenario.momentum", scenario.momentum)
    check.finite("scenario.torque", scenario.torque)
    for name in ("attitude", "tacho", "drive", "friction"):
        check_fault(f"scenario.{name}", getattr(scenario, name))
    return lanes


def _refuse_bad(sampled: bool, dt: float, substeps: int, params: Params, scenario: Scenario) -> tuple:
    lanes = refuse_bad(params, scenario)
    if check.concrete(scenario.delay):
        delay, longest = np.asarray(scenario.delay), DELAYS * dt
        inside = (delay >= 0) & (delay <= longest * (1 + 1e-9))
        check.each("scenario.delay", f"lie in 0 to {longest:g} s", delay, inside)
    if check.concrete((params, scenario)):
        with jax.ensure_compile_time_eval():  # under jit too these are numbers
            _warn_of_fast_adaptation(sampled, dt, substeps, params, scenario)
    return lanes


def _warn_of_fast_adaptation(sampled: bool, dt: float, substeps: int, params: Params, scenario: Scenario) -> None:
    law, wheel = jax.tree.map(np.asarray, (params.law, scenario.wheel))
    speed = np.abs(slew(params, params.duration / 2)[1]) * np.asarray(scenario.J_z / scenario.J_w)
    if sampled:  # r = y on the matching line
        limit = np.sqrt(np.asarray(mrac_sampled_bound(law, dt, wheel.a, wheel.b)) / 2)
        means = f"sampled every {dt:g} s"
    else:  # the frequency of the adaptation is sqrt(b gamma (r^2 + y^2)) (choice 5); RK4 bears 2.8 per step
        softened = np.abs(wheel.b) * law.gamma / (1 + 2 * law.normalise * speed**2)
        limit = 2 * substeps / dt / np.sqrt(np.maximum(2 * softened, np.finfo(np.float32).tiny))
        means = f"integrated in steps of {dt / substeps:g} s"
    over = speed > limit
    if np.any(over):
        gamma, limit, speed = (np.broadcast_to(a, over.shape)[over].flat[0] for a in (law.gamma, limit, speed))
        warnings.warn(
            f"`params.law.gamma` = {gamma:g} s/deg^2, {means}, is stable only for wheel speeds up to "
            f"{limit:.0f} deg/s, but the slew needs {speed:.0f} deg/s.",
            stacklevel=5,  # of simulate and sweep
        )


@door
def loop(*, sampled: bool = False, dt: float = DT, substeps: int = 20) -> System:
    """The closed loop with continuous or sampled adaptation, ticks of dt [s] and RK4 steps of dt / substeps.

    The same arguments give the same object, which compiles once. Raises ValueError for dt <= 0 or substeps < 1.
    """
    check.positive("dt", dt)
    return _loop(bool(sampled), float(dt), check.whole("substeps", substeps))


@lru_cache
def _loop(sampled: bool, dt: float, substeps: int) -> System:
    doing = (tick_sampled, flow_sampled) if sampled else (tick, flow)
    return System(init, *doing, dt=dt, substeps=substeps, normals=3, check=partial(_refuse_bad, sampled, dt, substeps))


system = loop()
params = Params()  # MRAC and inertia estimation
scenario = Scenario()
mrac_only = Params(ope=0.0)
sampled = loop(sampled=True, substeps=10)
# The paper's hardware, as far as its words go: low-speed friction, a quiet sensor, a sampled slow law (choice 7).
hardware_params = Params(J_hat=5.421, a_r=0.5, a_y=0.0, law=Adaptation(gamma=1e-8), ope=0.0)
hardware_scenario = Scenario(wheel=Wheel(friction=25000.0), noise=0.01)
