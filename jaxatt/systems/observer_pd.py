"""Sensor-fault detection by a nonlinear observer, tolerance by an adaptive PD law (Yun & Kang, 2020).

A rigid body is turned to a target by u = -k_q e_q - k_w e_w from *measured* MRP and body rate. A nonlinear
observer runs beside it; a fault is declared while the norm of its residual exceeds a threshold. Sensor errors
are held between ticks, but the sensors are read continuously: torque and observer live in the flow. Choices and
errata by number: docs/loops/observer_pd.md.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from numpy import sqrt

from jaxatt import check, scores
from jaxatt.attitude import mrp_error, mrp_inner, mrp_nearest, mrp_rate
from jaxatt.bodies import body_acceleration
from jaxatt.check import door
from jaxatt.controllers import adapted_rate_gain, pd, rate_gain_floor, saturated
from jaxatt.engine import System
from jaxatt.estimators import AttitudeRate, mrp_observer, residual_norm
from jaxatt.faults import Channel, Fault, any_active, check_fault, first_onset, on_axes
from jaxatt.sensors import read_triad, triad
from jaxatt.vec import Mat3, Vec3, array, inverse, norm

DT = 0.1  # [s] sensor errors, alarms and adaptation
INERTIA = Mat3(Vec3(15.0, 2.0, -1.0), Vec3(2.0, 27.0, 3.0), Vec3(-1.0, 3.0, 30.0))  # [kg m^2]
STD_Q = 0.3 * jnp.pi / 180 / 4 / 3  # [1] accuracy 0.3 deg as an MRP (angle / 4), taken as 3 sigma (choice 1)
STD_W = 0.1 * jnp.pi / 180 / 3  # [rad/s] accuracy 0.1 deg/s, taken as 3 sigma


class Params(NamedTuple):
    """What the engineer ships."""

    alpha: Any = 1.1  # () [1/s] observer gain on the attitude residual, eq. (7)
    beta: Any = 15.0  # () [N m s] observer gain on the rate residual, eq. (7)
    sigma: Any = 0.01  # () [1, rad/s] detection threshold on |xi|
    k_q: Any = 330.0  # () [N m] attitude gain, eq. (10)
    k_w0: Any = 125.0  # () [N m s] rate gain at the start, eq. (19)
    eps: Any = 0.1  # () [1/s] epsilon of the Lyapunov function (12); not given in the paper (choice 2)
    J: Mat3 = INERTIA  # [kg m^2] believed inertia
    q_d: Vec3 = Vec3(0.0, 0.0, 0.0)  # [1] target MRP
    w_d: Vec3 = Vec3(0.0, 0.0, 0.0)  # [rad/s] target rate
    u_max: Any = jnp.inf  # () [N m] torque limit per axis; the paper has none
    sign: Any = -1.0  # () [1] of w x J w in the observer: -1 Euler, +1 as printed (erratum 1)


class Scenario(NamedTuple):
    """What the day brings."""

    q: Vec3 = Vec3(0.4, 0.153, -0.634)  # [1] initial MRP
    w: Vec3 = Vec3(-0.87, 0.44, 0.87)  # [rad/s] initial body rate
    q_hat: Vec3 = Vec3(0.4, 0.153, -0.634)  # [1] initial estimate
    w_hat: Vec3 = Vec3(-0.87, 0.44, 0.87)  # [rad/s] initial estimate
    J: Mat3 = INERTIA  # [kg m^2] true inertia
    sign: Any = -1.0  # () [1] of w x J w in the plant: -1 Euler, +1 as printed (erratum 1)
    std_q: Any = STD_Q  # () [1] star-sensor noise per axis
    std_w: Any = STD_W  # () [rad/s] gyro noise per axis
    star: Vec3 = on_axes(Fault(onset=250.0, random=0.03))  # faults per axis [1]
    gyro: Vec3 = on_axes(Fault(onset=150.0, random=0.03))  # faults per axis [rad/s]


class Board(NamedTuple):
    """What the on-board computer knows."""

    estimate: AttitudeRate  # state of the observer
    k_w: Any  # () [N m s] rate gain
    J_inv: Mat3  # [1/(kg m^2)] inverse of the believed inertia
    lambda_max: Any  # () [kg m^2] largest principal moment of the believed inertia


class Held(NamedTuple):
    """What the sensors hold until the next tick."""

    star: Vec3  # of Channel
    gyro: Vec3  # of Channel
    y: AttitudeRate  # the readings of this tick


class X(NamedTuple):
    """Continuous state: the truth, and the observer, which is continuous too."""

    q: Vec3  # [1] MRP
    w: Vec3  # [rad/s] body rate
    estimate: AttitudeRate  # the observer's


class Z(NamedTuple):
    """Held between ticks."""

    sensors: Held
    board: Board  # but for its continuous estimate, which is x.estimate
    J_inv: Mat3  # [1/(kg m^2)] inverse of the true inertia


class Log(NamedTuple):
    """What a tick reports. Truth unless it says otherwise."""

    q: Vec3  # [1] MRP
    w: Vec3  # [rad/s] body rate
    e_q: Vec3  # [1] attitude error, |e_q| <= 1
    e_w: Vec3  # [rad/s] rate error
    u: Vec3  # [N m] torque
    xi: Any  # () norm of the observer's residual, on board
    alarm: Any  # () bool, on board
    k_w: Any  # () [N m s] rate gain, on board


class Scores(NamedTuple):
    """Tallies of a run: what a sweep reports. ill: a fault is on; start-up: the first `START_UP` seconds."""

    delay: Any  # [s] from the first onset to the first alarm after it; inf if never
    start_up_alarms: Any  # [1] share of alarms in the start-up window
    false_alarms: Any  # [1] share of alarms between start-up and the first onset
    miss: Any  # [1] share of ill ticks without alarm
    rms_q: Any  # [1] true attitude error, MRP
    rms_w: Any  # [rad/s] true rate error
    rms_q_ill: Any  # [1] while ill
    rms_w_ill: Any  # [rad/s] while ill
    peak_q: Any  # [1] after start-up
    peak_w: Any  # [rad/s] after start-up
    settling: Any  # [s] last time before the first onset with |e_q| > 0.01
    rms_u: Any  # [N m]
    rms_u_ill: Any  # [N m] while ill
    peak_u: Any  # [N m]
    ok: Any  # bool, every number of the log was finite


START_UP = 20.0  # [s] window reported apart: the observer converges and the slew ends


def init(params: Params, scenario: Scenario):
    """x, z at the start."""
    o = jnp.zeros(())
    healthy = Vec3(Channel(o, o), Channel(o, o), Channel(o, o))
    y = AttitudeRate(scenario.q, scenario.w)
    estimate = AttitudeRate(scenario.q_hat, scenario.w_hat)
    lambda_max = jnp.linalg.eigvalsh(array(params.J))[-1]
    board = Board(estimate, params.k_w0, inverse(params.J), lambda_max)
    return X(scenario.q, scenario.w, estimate), Z(Held(healthy, healthy, y), board, inverse(scenario.J))


def sense(params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """How the sensors err until the next tick, and what they read now; noise: 6 normals, star sensor first."""
    star = triad(scenario.star, now.t, scenario.std_q, noise[:3], z.sensors.y.q)
    gyro = triad(scenario.gyro, now.t, scenario.std_w, noise[3:], z.sensors.y.w)
    y = AttitudeRate(read_triad(star, x.q), read_triad(gyro, x.w))
    return Held(star, gyro, y)


def decide(params: Params, now, board: Board, y: AttitudeRate):
    """One tick on board: observer's shadow set, residual and alarm, adaptation. Returns board and (xi, alarm)."""
    estimate = board.estimate._replace(q=mrp_nearest(board.estimate.q, y.q))
    xi = residual_norm(y, estimate)
    alarm = ~(xi <= params.sigma)  # so that NaN alarms
    e = errors(params, y)
    elapsed = jnp.where(now.k > 0, now.dt, 0.0)
    k_w = adapted_rate_gain(board.k_w, e.q, e.w, params.eps, board.lambda_max, elapsed)
    return board._replace(estimate=estimate, k_w=k_w), (xi, alarm)


def errors(params: Params, y: AttitudeRate) -> AttitudeRate:
    """Tracking errors (8), with + in the cross term: as printed, e_q' = G(e_q) w fails (erratum 4)."""
    return AttitudeRate(mrp_error(y.q, params.q_d), y.w - params.w_d)


def command(params: Params, board: Board, y: AttitudeRate) -> Vec3:
    """Torque (10) [N m] from readings."""
    e = errors(params, y)
    return saturated(pd(e.q, e.w, params.k_q, board.k_w), params.u_max)


def board_flow(params: Params, board: Board, y: AttitudeRate) -> dict[str, Any]:
    """Rates of what moves on board between ticks: the observer's estimate (7)."""
    u = command(params, board, y)
    rate = mrp_observer(board.estimate, y, u, params.J, board.J_inv, params.alpha, params.beta, params.sign)
    return dict(estimate=rate)


def tick(params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """One tick: the truth keeps to |q| <= 1, sensors read, the board decides, a log is written."""
    x = x._replace(q=mrp_inner(x.q))
    sensors = sense(params, scenario, now, x, z, noise)
    board, (xi, alarm) = decide(params, now, z.board._replace(estimate=x.estimate), sensors.y)
    e = errors(params, AttitudeRate(x.q, x.w))
    log = Log(x.q, x.w, e.q, e.w, command(params, board, sensors.y), xi, alarm, board.k_w)
    return x._replace(estimate=board.estimate), Z(sensors, board, z.J_inv), log


def flow(params: Params, scenario: Scenario, t, x: X, z: Z) -> X:
    """dx/dt between ticks: sensors are read continuously, with the errors that the tick left them."""
    y = AttitudeRate(read_triad(z.sensors.star, x.q), read_triad(z.sensors.gyro, x.w))
    board = z.board._replace(estimate=x.estimate)
    u = command(params, board, y)
    return X(
        q=mrp_rate(x.q, x.w),  # eq. (1)
        w=body_acceleration(x.w, u, scenario.J, z.J_inv, scenario.sign),  # eq. (4), sign: erratum 1
        **board_flow(params, board, y),
    )


def score(params: Params, scenario: Scenario, now, log: Log) -> Scores:
    """The tallies of one tick."""
    faults = (*scenario.star, *scenario.gyro)
    onset = first_onset(faults)
    ill = any_active(faults, now.t)
    start, before = now.t < START_UP, now.t < onset
    qq, ww, uu = log.e_q @ log.e_q, log.e_w @ log.e_w, log.u @ log.u
    return Scores(
        delay=scores.first(now, log.alarm & ~before, since=onset),
        start_up_alarms=scores.mean(log.alarm, start & before),
        false_alarms=scores.mean(log.alarm, ~start & before),
        miss=scores.mean(~log.alarm, ill),
        rms_q=scores.rms(qq),
        rms_w=scores.rms(ww),
        rms_q_ill=scores.rms(qq, ill),
        rms_w_ill=scores.rms(ww, ill),
        peak_q=scores.peak(norm(log.e_q), ~start),
        peak_w=scores.peak(norm(log.e_w), ~start),
        settling=scores.settling(now, (qq > 0.01**2), before),
        rms_u=scores.rms(uu),
        rms_u_ill=scores.rms(uu, ill),
        peak_u=scores.peak(norm(log.u)),
        ok=scores.always(scores.finite(log)),
    )


class Margins(NamedTuple):
    """What the paper's proof of stability leaves; all positive: it holds there."""

    k_q: Any  # [N m] above the least attitude gain, eq. (18)
    eps: Any  # [1/s] below the largest epsilon with Q > 0, after eq. (12)
    T: Any  # [N m/s] of T_I > 0, eq. (16), for constant gains


@door
def margins(params: Params, lambda_max, e_q=0.0, e_w=0.0) -> Margins:
    """The margins at tracking errors of norms e_q [1] and e_w [rad/s], with k_w = k_w0.

    lambda_max: largest principal moment of the believed inertia [kg m^2]. Pure: its penalty keeps a search of gains
    where the proof holds. The adaptation (19) leaves that region in time whatever the gains are (erratum 7).
    """
    eps, k_q = params.eps, params.k_q
    c = eps * lambda_max * e_w + 1 + e_q * e_q
    room = params.k_w0 - rate_gain_floor(Vec3(e_q, 0.0, 0.0), eps, lambda_max)
    positive = room > 0
    held = eps * k_q - 0.5 * eps * eps - 1 - c * c / jnp.where(positive, room, 1)
    return Margins(
        k_q=k_q - eps / 2 - 1 / eps,
        eps=2 / jnp.sqrt(lambda_max) - eps,
        T=jnp.where(positive, held, room - 1),
    )


def refuse_bad(params: Params, scenario: Scenario) -> tuple:
    """The system's check: ValueError on input outside the paper's and physics' domain; returns the lanes."""
    lanes = check.shapes(params, scenario, Params(), Scenario())
    moments = check.moments("params.J", params.J)
    for name in ("alpha", "beta", "sigma", "k_q", "k_w0"):
        check.positive(f"params.{name}", getattr(params, name))
    if moments is not None:
        limit = 2 / sqrt(moments[-1])  # Q > 0 in (12)
        check.between("params.eps", params.eps, 0, limit, "0 to 2 / sqrt(largest principal moment of params.J)")
    check.finite("params.q_d", params.q_d)
    check.finite("params.w_d", params.w_d)
    check.above("params.u_max", params.u_max, 0, "inf for no limit")
    check.one_of("params.sign", params.sign, (-1, 1))
    check.moments("scenario.J", scenario.J)
    check.one_of("scenario.sign", scenario.sign, (-1, 1))
    for name in ("q", "w", "q_hat", "w_hat"):
        check.finite(f"scenario.{name}", getattr(scenario, name))
    for name in ("std_q", "std_w"):
        check.not_negative(f"scenario.{name}", getattr(scenario, name))
    for name in ("star", "gyro"):
        for axis, fault in getattr(scenario, name)._asdict().items():
            check_fault(f"scenario.{name}.{axis}", fault)
    return lanes


system = System(init, tick, flow, dt=DT, substeps=4, normals=6, check=refuse_bad)
params = Params()
scenario = Scenario()
