"""Sensor-fault detection by a nonlinear observer, tolerance by an adaptive PD law (Yun & Kang, 2020).

A rigid body is turned to a target by u = -k_q e_q - k_w e_w from measured MRP and body rate. A nonlinear observer runs
beside it; a fault is declared while the norm of its residual exceeds a threshold. The sensors are read continuously, so
torque and observer are in the flow; the errors of the sensors change once a tick. Choices and errata by number:
docs/loops/observer_pd.md.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxatt import check, scores
from jaxatt.attitude import mrp_error, mrp_inner, mrp_nearest, mrp_rate
from jaxatt.bodies import body_acceleration
from jaxatt.check import finite, inertia, limit, mrp, not_negative, positive
from jaxatt.contract import System
from jaxatt.controllers import adapted_rate_gain, pd, saturated
from jaxatt.detection import alarm
from jaxatt.faults import Fault, Reading, any_active, first_onset, healthy, known, on_axes
from jaxatt.observers import AttitudeRate, mrp_observer, residual_norm
from jaxatt.sensors import heard_triad, read_triad, triad
from jaxatt.vec import Mat3, Vec3, largest_eigenvalue, norm, where, zeros

DT = 0.1  # [s] sensor errors, alarms and adaptation
INERTIA = Mat3(Vec3(15.0, 2.0, -1.0), Vec3(2.0, 27.0, 3.0), Vec3(-1.0, 3.0, 30.0))  # [kg m^2]
STD_Q = 0.3 * np.pi / 180 / 4 / 3  # [1] accuracy 0.3 deg as an MRP (angle / 4), taken as 3 sigma (choice 1)
STD_W = 0.1 * np.pi / 180 / 3  # [rad/s] accuracy 0.1 deg/s, taken as 3 sigma
START_UP = 20.0  # [s] window reported apart: the observer converges and the slew ends


class Params(NamedTuple):
    """What the engineer ships."""

    alpha: Annotated[Any, "1/s", positive] = 1.1  # observer gain on the attitude residual, eq. (7)
    beta: Annotated[Any, "N m s", positive] = 15.0  # observer gain on the rate residual, eq. (7)
    sigma: Annotated[Any, "1, rad/s", positive] = 0.01  # detection threshold on |xi|
    k_q: Annotated[Any, "N m", positive] = 330.0  # attitude gain, eq. (10)
    k_w0: Annotated[Any, "N m s", positive] = 125.0  # rate gain at the start, eq. (19)
    eps: Annotated[Any, "1/s"] = 0.1  # epsilon of the Lyapunov function (12), not in the paper (choice 2)
    J: Annotated[Mat3, "kg m^2", inertia] = INERTIA  # believed inertia; products are the entries, J.x.y = -sum(m x y)
    q_d: Annotated[Vec3, "1", mrp] = Vec3(0.0, 0.0, 0.0)  # target MRP
    w_d: Annotated[Vec3, "rad/s", finite] = Vec3(0.0, 0.0, 0.0)  # target rate
    u_max: Annotated[Any, "N m", limit] = np.inf  # torque limit per axis; the paper has none


class Scenario(NamedTuple):
    """What the day brings."""

    q: Annotated[Vec3, "1", mrp] = Vec3(0.4, 0.153, -0.634)  # initial MRP
    w: Annotated[Vec3, "rad/s", finite] = Vec3(-0.87, 0.44, 0.87)  # initial body rate
    q_hat: Annotated[Vec3, "1", mrp] = Vec3(0.4, 0.153, -0.634)  # initial estimate
    w_hat: Annotated[Vec3, "rad/s", finite] = Vec3(-0.87, 0.44, 0.87)  # initial estimate
    J: Annotated[Mat3, "kg m^2", inertia] = INERTIA  # true inertia, likewise
    std_q: Annotated[Any, "1", not_negative] = STD_Q  # star-sensor noise per axis and sample, one a tick
    std_w: Annotated[Any, "rad/s", not_negative] = STD_W  # gyro noise per axis and sample: angle random walk / sqrt(DT)
    star: Annotated[Vec3, "1"] = on_axes(Fault(onset=250.0, random=0.03))  # faults per axis, MRP
    gyro: Annotated[Vec3, "rad/s"] = on_axes(Fault(onset=150.0, random=0.03))  # faults per axis


class Computer(NamedTuple):
    """What the on-board computer knows."""

    estimate: AttitudeRate  # state of the observer
    k_w: Any  # [N m s] rate gain


class SensorState(NamedTuple):
    """What the sensors hold until the next tick."""

    star: Vec3  # of Channel
    gyro: Vec3  # of Channel
    y: AttitudeRate  # of Reading, those of this tick


class X(NamedTuple):
    """Continuous state: the truth and the observer's estimate."""

    q: Vec3  # [1] MRP
    w: Vec3  # [rad/s] body rate
    estimate: AttitudeRate


class Z(NamedTuple):
    """Held between ticks."""

    sensors: SensorState
    k_w: Any  # [N m s] rate gain


class Log(NamedTuple):
    """What a tick reports. Truth unless it says otherwise."""

    t: Annotated[Any, "s"]
    q: Annotated[Vec3, "1"]  # MRP
    w: Annotated[Vec3, "rad/s"]  # body rate
    e_q: Annotated[Vec3, "1"]  # attitude error, |e_q| <= 1
    e_w: Annotated[Vec3, "rad/s"]  # rate error
    u: Annotated[Vec3, "N m"]  # torque
    estimate: AttitudeRate  # on board
    xi: Annotated[Any, "1, rad/s"]  # norm of the observer's residual, on board
    alarm: Annotated[Any, "1"]  # bool, on board
    k_w: Annotated[Any, "N m s"]  # rate gain, on board


class Scores(NamedTuple):
    """What a sweep reports of a run. faulty: while a fault is on; start-up: the first `START_UP` seconds."""

    delay: Annotated[Any, "s"]  # from the first onset to the first alarm after it; inf if never
    start_up_alarms: Annotated[Any, "1"]  # share of alarms in the start-up window
    false_alarms: Annotated[Any, "1"]  # share of alarms between start-up and the first onset
    miss: Annotated[Any, "1"]  # share of faulty ticks without alarm
    rms_q: Annotated[Any, "1"]  # true attitude error, MRP
    rms_w: Annotated[Any, "rad/s"]  # true rate error
    rms_q_faulty: Annotated[Any, "1"]
    rms_w_faulty: Annotated[Any, "rad/s"]
    peak_q: Annotated[Any, "1"]  # after start-up
    peak_w: Annotated[Any, "rad/s"]  # after start-up
    settling: Annotated[Any, "s"]  # last time before the first onset with |e_q| > 0.01
    rms_u: Annotated[Any, "N m"]
    rms_u_faulty: Annotated[Any, "N m"]
    peak_u: Annotated[Any, "N m"]
    ok: Annotated[Any, "1"]  # bool: every number of the log was finite


def init(params: Params, scenario: Scenario):
    """x, z at the start."""
    truth, estimate = AttitudeRate(scenario.q, scenario.w), AttitudeRate(scenario.q_hat, scenario.w_hat)
    channels = Vec3(healthy(), healthy(), healthy())
    y = AttitudeRate(*(Reading(a, True) for a in truth))
    return X(truth.q, truth.w, estimate), Z(SensorState(channels, channels, y), params.k_w0)


def sense(params: Params, scenario: Scenario, now, x: X, z: Z, noise) -> SensorState:
    """How the sensors err until the next tick, and what they read now; noise: 6 normals, star sensor first."""
    star = triad(scenario.star, now.t, scenario.std_q, noise[:3], z.sensors.y.q.value)
    gyro = triad(scenario.gyro, now.t, scenario.std_w, noise[3:], z.sensors.y.w.value)
    there = heard_triad(scenario.star, now.t), heard_triad(scenario.gyro, now.t)
    return SensorState(star, gyro, AttitudeRate(*map(Reading, readings(star, gyro, x), there)))


def readings(star: Vec3, gyro: Vec3, x: X) -> AttitudeRate:
    """What the sensors read of the truth."""
    return AttitudeRate(read_triad(star, x.q), read_triad(gyro, x.w))


# on board


def computer_of(x: X, z: Z) -> Computer:
    """What the computer knows between two ticks."""
    return Computer(x.estimate, z.k_w)


def completed(y: AttitudeRate, estimate: AttitudeRate) -> AttitudeRate:
    """The readings y, and the estimate where they are missing (choice 9): its residual is zero, so it is predicted only.

    A sensor of three axes counts as a whole: an MRP that lacks a component is no attitude.
    """
    return AttitudeRate(known(y.q, estimate.q), known(y.w, estimate.w))


def errors(params: Params, y: AttitudeRate) -> AttitudeRate:
    """Tracking errors (8), with + in the cross term: as printed, e_q' = G(e_q) w fails (erratum 4)."""
    return AttitudeRate(mrp_error(y.q, params.q_d), y.w - params.w_d)


def command(params: Params, k_w, y: AttitudeRate) -> Vec3:
    """Torque (10) [N m] from readings."""
    e = errors(params, y)
    return saturated(pd(e.q, e.w, params.k_q, k_w), params.u_max)


def decide(params: Params, now, computer: Computer, y: AttitudeRate):
    """One tick on board: the estimate's nearest representative, residual, alarm, rate gain; returns (xi, alarm) too.

    y: an `AttitudeRate` of `Reading`.
    """
    near = mrp_nearest(computer.estimate.q, known(y.q, zeros()))  # without a reading the inner one
    estimate = computer.estimate._replace(q=near)
    y = completed(y, estimate)
    xi = residual_norm(y, estimate)
    e = errors(params, y)
    elapsed = jnp.where(now.k > 0, now.dt, 0.0)
    k_w = adapted_rate_gain(computer.k_w, e.q, e.w, params.eps, largest_eigenvalue(params.J), elapsed)
    return Computer(estimate, k_w), (xi, alarm(xi, params.sigma))


def computer_flow(params: Params, computer: Computer, y: AttitudeRate) -> dict[str, Any]:
    """Rates of what moves on board between ticks, by field of `Computer`: the estimate (7); y as of `decide`."""
    y = completed(y, computer.estimate)
    return dict(estimate=estimate_flow(params, computer.estimate, y, command(params, computer.k_w, y)))


def estimate_flow(params: Params, estimate: AttitudeRate, y: AttitudeRate, u: Vec3) -> AttitudeRate:
    """Rates of the estimate (7); y: completed readings; u: the torque [N m]."""
    return mrp_observer(estimate, y, u, params.J, params.alpha, params.beta)


# the loop


def tick(params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """One tick: the truth keeps to |q| <= 1, sensors read, the computer decides, a log is written."""
    x = x._replace(q=mrp_inner(x.q))
    sensors = sense(params, scenario, now, x, z, noise)
    computer, (xi, alarmed) = decide(params, now, computer_of(x, z), sensors.y)
    e = errors(params, AttitudeRate(x.q, x.w))
    u = command(params, computer.k_w, completed(sensors.y, computer.estimate))
    log = Log(now.t, x.q, x.w, e.q, e.w, u, computer.estimate, xi, alarmed, computer.k_w)
    return x._replace(estimate=computer.estimate), Z(sensors, computer.k_w), log


def flow(params: Params, scenario: Scenario, t, x: X, z: Z) -> X:
    """dx/dt between ticks: sensors are read continuously, with the errors that the tick left them."""
    seen = readings(z.sensors.star, z.sensors.gyro, x)
    # as `completed`, without its search for NaN, which these sensors never give
    y = AttitudeRate(*(where(told.valid, a, b) for told, a, b in zip(z.sensors.y, seen, x.estimate)))
    u = command(params, z.k_w, y)
    return X(
        q=mrp_rate(x.q, x.w),  # eq. (1)
        w=body_acceleration(x.w, u, scenario.J),  # eq. (4), with Euler's sign (erratum 1)
        estimate=estimate_flow(params, x.estimate, y, u),
    )


def score(params: Params, scenario: Scenario, now, log: Log) -> Scores:
    """The tallies of one tick."""
    onset, faulty = first_onset(scenario), any_active(scenario, now.t)
    start, before = now.t < START_UP, now.t < onset
    qq, ww, uu = log.e_q @ log.e_q, log.e_w @ log.e_w, log.u @ log.u
    return Scores(
        delay=scores.first(now, log.alarm & ~before, since=onset),
        start_up_alarms=scores.mean(log.alarm, start & before),
        false_alarms=scores.mean(log.alarm, ~start & before),
        miss=scores.mean(~log.alarm, faulty),
        rms_q=scores.rms(qq),
        rms_w=scores.rms(ww),
        rms_q_faulty=scores.rms(qq, faulty),
        rms_w_faulty=scores.rms(ww, faulty),
        peak_q=scores.peak(norm(log.e_q), ~start),
        peak_w=scores.peak(norm(log.e_w), ~start),
        settling=scores.settling(now, qq > 0.01**2, before),
        rms_u=scores.rms(uu),
        rms_u_faulty=scores.rms(uu, faulty),
        peak_u=scores.peak(norm(log.u)),
        ok=scores.always(scores.finite(log)),
    )


def refuse_bad(params: Params, scenario: Scenario) -> None:
    """The system's check: epsilon must leave Q > 0 in (12)."""
    check.kinds(params, Params, scenario, Scenario)
    moments = check.moments("params.J", params.J)
    if moments is not None:
        most = 2 / np.sqrt(moments[-1])
        check.between("params.eps", params.eps, 0, most, "0 to 2 / sqrt(largest principal moment of params.J)")


system = System(init, tick, flow, dt=DT, substeps=4, normals=6, check=refuse_bad)
params = Params()
scenario = Scenario()
