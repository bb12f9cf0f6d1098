"""leo4: the world of the yardstick. A rigid body with four gyros, a star tracker and four torque wheels in a low orbit.

A tick of the system is one packet of telemetry, half a second: the star tracker is read once, then gyros, law and plant
run five times at 10 Hz. The wheels store no momentum. On board an MEKF with its steady gain and a PD law with
feed-forward; what they do is no business of a detector. Signs and frames: docs/yardstick.md.

May import: steady, check, vec, attitude, faults, contract, engine, scores, clock.
"""

from __future__ import annotations

from math import factorial, pi, sqrt
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.attitude import quat_conjugate, quat_normalised, quat_rate
from jaxatt.check import finite, flag, inertia, limit, not_negative, positive
from jaxatt.clock import time_of
from jaxatt.contract import System
from jaxatt.engine import match_state, rk4
from jaxatt.faults import Fault, active, channel, read
from jaxatt.vec import Mat3, Quat, Vec3, array, cross, inverse, norm, polynomial, where, zeros
from jaxatt.yardstick.steady import steady

DT = 0.1  # [s] of gyros, law and plant
TICKS = 5  # of them in a packet
PACKET = 0.5  # [s]
NORMALS = 11  # of each tick of gyros: white 4, walk 4, star 3, of which the packet's first is used
SECOND = pi / 180 / 3600  # [rad] an arc second; [rad/s] a degree an hour is as much
STD_GYRO = 0.02 * pi / 180 / 60 / sqrt(DT)  # [rad/s] of a sample: .02 deg/sqrt h
RRW = 0.3 * SECOND / 60  # [rad/s^1.5] .3 deg/h/sqrt h
STD_STAR = 10 * SECOND  # [rad] about each axis
STD_AXIS = STD_GYRO * sqrt(0.75)  # [rad/s] of the body rate by four gyros, about each axis
SLEW = 2 * pi / 300  # [rad/s] of the slew's sine
ORBIT = 1.1e-3  # [rad/s] of the disturbance's sine
INERTIA = Mat3(Vec3(15.0, 2.0, -1.0), Vec3(2.0, 27.0, 3.0), Vec3(-1.0, 3.0, 30.0))  # [kg m^2]
INVERSE = Mat3.of(np.linalg.inv(np.array(INERTIA)).tolist())  # [1/(kg m^2)]
_A = 1 / sqrt(3)
AXES = ((_A, -_A, -_A, _A), (_A, _A, -_A, -_A), (_A,) * 4)  # of gyros and wheels: 45 ... 315 deg around z, x y z rows
PARITY = (0.5, -0.5, 0.5, -0.5)  # V: what four gyros say apart from the rate, V G = 0


def _filter():
    """The steady MEKF of a body axis: turn and bias, five predictions to an update."""
    F, Q = np.array([[1, -DT], [0, 1]]), np.diag([(STD_AXIS * DT) ** 2, 0.75 * RRW**2 * DT])
    spread = np.zeros((2, 2))
    for _ in range(TICKS):
        spread = F @ spread @ F.T + Q
    return steady(np.linalg.matrix_power(F, TICKS), spread, np.eye(1, 2), [[STD_STAR**2]])


FILTER = _filter()
STD_INNOVATION = sqrt(FILTER.innovation[0, 0])  # [rad] sqrt S


class Params(NamedTuple):
    """What the engineer ships."""

    J: Annotated[Mat3, "kg m^2", inertia] = INERTIA  # believed, and the true one's mean
    kp: Annotated[Any, "1/s^2", positive] = 0.01  # attitude gain over inertia: .1 rad/s
    kd: Annotated[Any, "1/s", positive] = 0.18  # rate gain over inertia: damping .9
    torque_max: Annotated[Any, "N m", positive] = 0.03  # of a wheel
    k_turn: Annotated[Any, "1", finite] = float(FILTER.gain[0, 0])  # of the MEKF
    k_bias: Annotated[Any, "1/s", finite] = float(FILTER.gain[1, 0])


class Scenario(NamedTuple):
    """What the day brings."""

    mode: Annotated[Any, "1", flag] = 0.0  # 0 hold, 1 slew
    axis: Annotated[Vec3, "1", finite] = Vec3(1.0, 0.0, 0.0)  # of the slew, a unit vector
    psi: Annotated[Any, "rad", finite] = 0.0  # its phase
    swing: Annotated[Any, "rad", finite] = 10 * pi / 180  # its amplitude
    bias: Annotated[Any, "rad/s", finite, (4,)] = np.zeros(4)  # of the gyros at the start
    scale: Annotated[Any, "1", finite, (4,)] = np.zeros(4)  # errors of the gyros' scale factors
    stretch: Annotated[Vec3, "1", positive] = Vec3(1.0, 1.0, 1.0)  # D of J = D J0 D
    constant: Annotated[Vec3, "N m", finite] = zeros()  # disturbance
    wave: Annotated[Vec3, "N m", finite] = zeros()  # amplitude of the one with the orbit
    phi: Annotated[Vec3, "rad", finite] = zeros()  # its phase
    turn: Annotated[Vec3, "rad", finite] = zeros()  # error of the first estimate: q = estimate exp(turn)
    bias_error: Annotated[Vec3, "rad/s", finite] = zeros()  # of the first bias: truth - estimate
    std_gyro: Annotated[Any, "rad/s", not_negative] = STD_GYRO
    std_star: Annotated[Any, "rad", not_negative] = STD_STAR
    rrw: Annotated[Any, "rad/s^1.5", not_negative] = RRW
    gyro: Annotated[Fault, "rad/s", (), (4,)] = Fault()
    star: Annotated[Fault, "rad", (), (3,)] = Fault()  # of the sample's turn about the body axes
    box: Annotated[Fault, "1"] = Fault()  # of the star tracker as a whole: stuck
    wheel: Annotated[Fault, "N m", (), (4,)] = Fault()
    period: Annotated[Any, "s", positive] = 1e6  # after which a fault of the gyros comes again
    on: Annotated[Any, "s", limit] = np.inf  # how long it then lasts
    off: Annotated[Vec3, "rad", finite] = zeros()  # turn of the body from its aim at the start, about body axes
    spin: Annotated[Vec3, "rad/s", finite] = zeros()  # its rate less the commanded one at the start


class Telemetry(NamedTuple):
    """One packet, delivered after the last of its five ticks. No clock, no number, no flag of a fault."""

    gyro: Annotated[Any, "rad/s"]  # (5, 4) readings
    torque: Annotated[Any, "N m"]  # (5, 4) commanded of the wheels, after the limit
    star: Annotated[Any, "1"]  # (4,) quaternion read at the first tick, as all below
    star_valid: Annotated[Any, "1"]  # bool
    aim: Annotated[Any, "1"]  # (4,) commanded attitude
    aim_rate: Annotated[Any, "rad/s"]  # (3,)
    attitude: Annotated[Any, "1"]  # (4,) of the MEKF before its update
    bias: Annotated[Any, "rad/s"]  # (3,) likewise, in body axes
    innovation: Annotated[Any, "rad"]  # (3,)
    mode: Annotated[Any, "1"]  # int: 0 hold, 1 slew


class Reading(NamedTuple):
    """What a law gets at 10 Hz, after the gyros are read and, at a packet's first tick, the MEKF is updated."""

    gyro: Annotated[Any, "rad/s"]  # (4,) readings
    star: Annotated[Any, "1"]  # (4,) last quaternion of the star tracker
    star_valid: Annotated[Any, "1"]  # bool: it was read at this tick, each fifth
    attitude: Annotated[Any, "1"]  # (4,) of the MEKF
    rate: Annotated[Any, "rad/s"]  # (3,) of the body, the gyros' less the MEKF's bias
    aim: Annotated[Any, "1"]  # (4,) commanded attitude
    aim_rate: Annotated[Any, "rad/s"]  # (3,)
    aim_acceleration: Annotated[Any, "rad/s^2"]  # (3,)
    torque: Annotated[Any, "N m"]  # (4,) command of the wheels until now, after the limit; 0 at the start


class Aim(NamedTuple):
    """Commanded attitude, rate and acceleration."""

    q: Quat
    w: Vec3  # [rad/s]
    a: Vec3  # [rad/s^2]


class Truth(NamedTuple):
    """The plant and the memory of its sensors."""

    q: Quat
    w: Vec3  # [rad/s]
    bias: Any  # (4,) [rad/s] of the gyros
    gyro: Any  # (4,) [rad/s] last readings
    star: Quat  # last sample


class Computer(NamedTuple):
    """What the computer knows."""

    q: Quat
    b: Vec3  # [rad/s] bias in body axes


class Z(NamedTuple):
    """Held between packets: all of the state, for the plant moves within a tick."""

    truth: Truth
    computer: Computer


class Log(NamedTuple):
    """What a packet reports."""

    t: Annotated[Any, "s"]  # of its first tick
    telemetry: Telemetry
    pointing: Annotated[Any, "rad"]  # (5,) angle between true and commanded attitude
    q: Annotated[Quat, "1"]  # true, at the first tick, as below
    w: Annotated[Vec3, "rad/s"]
    knowledge: Annotated[Vec3, "rad"]  # true turn against the estimate before its update


# parts


def small_turn(v: Vec3) -> Quat:
    """Quaternion of a small rotation vector [rad], to fifth order."""
    h = 0.25 * (v @ v)
    return Quat(1 - h / 2 + h * h / 24, *((0.5 - h / 12) * v))


def vector_part(p: Quat) -> Vec3:
    """Twice the vector part, the small turn [rad], of p or -p, whichever has a positive scalar."""
    return jnp.where(p.w < 0, -2, 2) * p.v


_COS, _SINC = ([(-1.0) ** k / factorial(2 * k + odd) for k in range(9)] for odd in (0, 1))


def aim_at(scenario: Scenario, t) -> Aim:
    """The commanded motion at t [s]: a turn th = swing sin(2 pi t / 300 s + psi) about the axis; at rest in mode 0."""
    swing = jnp.where(scenario.mode > 0, scenario.swing, 0)
    cosine, sine = swing * jnp.cos(scenario.psi), swing * jnp.sin(scenario.psi)
    c, s = jnp.cos(SLEW * t), jnp.sin(SLEW * t)
    th, rate = cosine * s + sine * c, SLEW * (cosine * c - sine * s)
    hh = 0.25 * th * th  # half an angle below .5 rad: nine terms of the series are exact to rounding
    q = Quat(polynomial(_COS, hh), *(0.5 * th * polynomial(_SINC, hh) * scenario.axis))
    return Aim(q, rate * scenario.axis, (-SLEW * SLEW * th) * scenario.axis)


def gyros_read(scenario: Scenario, t, truth: Truth, noise) -> Truth:
    """The truth with new readings of the gyros, and their biases a tick later; noise: 4 white, 4 of the walk."""
    again = jnp.maximum(jnp.floor((t - scenario.gyro.onset) / scenario.period), 0)
    onset = jnp.where(again > 0, scenario.gyro.onset + scenario.period * again, scenario.gyro.onset)
    fault = scenario.gyro._replace(onset=onset, end=jnp.minimum(scenario.gyro.end, onset + scenario.on))
    signal = (1 + scenario.scale) * along(truth.w) + truth.bias
    y = read(channel(fault, t, scenario.std_gyro, noise[:4], truth.gyro), signal)
    return truth._replace(gyro=y, bias=truth.bias + scenario.rrw * sqrt(DT) * noise[4:8])


def star_read(scenario: Scenario, t, truth: Truth, noise) -> Truth:
    """The truth with a new sample of the star tracker, q_m = q exp(error); noise: 3."""
    error = channel(scenario.star, t, scenario.std_star, noise, 0 * noise).offset
    sample = truth.q * small_turn(Vec3.of(error))
    frozen = active(scenario.box, t) & (scenario.box.stuck > 0)
    return truth._replace(star=where(frozen, truth.star, sample))


def updated(params: Params, computer: Computer, star: Quat) -> tuple[Computer, Vec3]:
    """The MEKF after a star sample, and its innovation [rad]."""
    nu = vector_part(quat_conjugate(computer.q) * star)
    return Computer(computer.q * small_turn(params.k_turn * nu), computer.b + params.k_bias * nu), nu


def along(v: Vec3):
    """G v, (4,): the components of v along the axes."""
    x, y, z = (jnp.asarray(row, jnp.result_type(v.x)) for row in AXES)
    return x * v.x + y * v.y + z * v.z


def summed(s) -> Vec3:
    """G' s: the sum of s (4,) along the axes; of wheels' torques the torque on the body."""
    return Vec3(*(sum(a * b for a, b in zip(row, s)) for row in AXES))


def rate_of(gyro) -> Vec3:
    """G+ y: the body rate [rad/s] that explains the readings (4,) best."""
    return 0.75 * summed(gyro)


def tracking_law(params: Params, aim: Aim, q: Quat, w: Vec3) -> Vec3:
    """u = J0 (a_aim - 2 kp vec(q_e) - kd (w - w_aim)) + w x J0 w [N m]."""
    turn = vector_part(quat_conjugate(aim.q) * q)
    return params.J @ (aim.a - params.kp * turn - params.kd * (w - aim.w)) + cross(w, params.J @ w)


def demanded(params: Params, reading: Reading) -> Vec3:
    """u of the `tracking_law` [N m] for a reading."""
    aim = Aim(Quat.of(reading.aim), Vec3.of(reading.aim_rate), Vec3.of(reading.aim_acceleration))
    return tracking_law(params, aim, Quat.of(reading.attitude), Vec3.of(reading.rate))


def shared_out(u: Vec3):
    """W+ u, (4,) [N m]: the least torques of the wheels that give u [N m]."""
    return 0.75 * along(u)


def decide(params: Params, z, reading: Reading):
    """z and the torques (4,) [N m] of the wheels; a controller replaces it."""
    return z, shared_out(demanded(params, reading))


def predicted(params: Params, computer: Computer, w: Vec3, u: Vec3) -> Computer:
    """The MEKF a tick of gyros later; w [rad/s] and torque u [N m] as it believes."""
    ahead = DT * w + (0.5 * DT * DT) * (inverse(params.J) @ (u - cross(w, params.J @ w)))
    return computer._replace(q=computer.q * small_turn(ahead))


def moved(params: Params, scenario: Scenario, t, truth: Truth, torque: Vec3) -> Truth:
    """The plant DT later under the torque of its wheels [N m]: one step of RK4.

    q' = q (0, w) / 2, J w' = torque + d(t) - w x J w, J = D J0 D.
    """
    D, J = scenario.stretch, params.J
    times = lambda a, b: Vec3(a.x * b.x, a.y * b.y, a.z * b.z)
    by = Vec3(1 / D.x, 1 / D.y, 1 / D.z)
    sine = Vec3(*(a * jnp.cos(p) for a, p in zip(scenario.wave, scenario.phi)))
    cosine = Vec3(*(a * jnp.sin(p) for a, p in zip(scenario.wave, scenario.phi)))
    held = torque + scenario.constant

    def flow(t, x):
        q, w = x
        u = held + jnp.sin(ORBIT * t) * sine + jnp.cos(ORBIT * t) * cosine
        momentum = times(D, J @ times(D, w))
        return quat_rate(q, w), times(by, inverse(J) @ times(by, u - cross(w, momentum)))

    q, w = rk4(flow, t, (truth.q, truth.w), DT)
    return truth._replace(q=q, w=w)


def true_torque(scenario: Scenario, t, command) -> Vec3:
    """The torque on the body [N m] of wheels at the command (4,) [N m], faults included."""
    return summed(read(channel(scenario.wheel, t, 0.0, 0.0, command), command))


# the closed loop


def init(params: Params, scenario: Scenario):
    """x, z at the start: off the aim as the scenario says, the filter in its stationary law by the scenario's errors."""
    aim = aim_at(scenario, 0.0)
    four, q = scenario.bias, aim.q * small_turn(scenario.off)
    truth = Truth(q, aim.w + scenario.spin, four, jnp.zeros_like(four), q)
    computer = Computer(q * small_turn(-scenario.turn), rate_of(four) - scenario.bias_error)
    return (), Z(truth, computer)


def tick(params: Params, scenario: Scenario, now, x, z: Z, noise):
    """One packet under the law of the world."""
    law = lambda memory, reading: decide(params, memory, reading)
    z, _, log = packet(params, scenario, now, z, noise, law, (), jnp.zeros_like(scenario.bias))
    return x, z, log


def packet(params: Params, scenario: Scenario, now, z: Z, noise, law, memory, torque):
    """One packet: star tracker and update, then five times gyros, law, plant.

    Args:
        params, scenario, now, z, noise: as of `tick`.
        law: (memory, reading) -> memory, command (4,) [N m] of the wheels, which the plant limits.
        memory: of the law.
        torque: (4,) [N m] limited command of the tick before.

    Returns:
        z, memory, and the log, whose telemetry holds the limited commands.
    """
    noise = jnp.stack(
        [noise[NORMALS * i : NORMALS * (i + 1)] for i in range(TICKS)]
    )  # not reshaped: a batch lies behind
    truth = z.truth._replace(q=quat_normalised(z.truth.q))
    computer = z.computer._replace(q=quat_normalised(z.computer.q))
    start, before = truth, computer
    aim = aim_at(scenario, now.t)
    truth = star_read(scenario, now.t, truth, noise[0, 8:])
    computer, nu = updated(params, computer, truth.star)

    def one(state, told):
        truth, computer, memory, torque = state
        t, noise, first = told
        truth = gyros_read(scenario, t, truth, noise)
        aim, w = aim_at(scenario, t), rate_of(truth.gyro) - computer.b
        reading = Reading(
            truth.gyro, array(truth.star), first, array(computer.q), array(w), array(aim.q), array(aim.w), array(aim.a),
            torque,
        )  # fmt: skip
        memory, command = law(memory, reading)
        command = jnp.clip(command, -params.torque_max, params.torque_max)
        pointing = norm(vector_part(quat_conjugate(aim.q) * truth.q))
        computer = predicted(params, computer, w, summed(command))
        truth = moved(params, scenario, t, truth, true_torque(scenario, t, command))
        return match_state((truth, computer, memory, command), state, "tick"), (truth.gyro, command, pointing)

    ticks = time_of(TICKS * now.k + jnp.arange(TICKS, dtype=jnp.int32), DT, jnp.result_type(now.t))
    first = np.arange(TICKS) == 0  # the same for all scenarios, so that a `jax.lax.cond` on it takes one branch
    begun = truth, computer, memory, torque
    (truth, computer, memory, _), (gyro, torque, pointing) = jax.lax.scan(one, begun, (ticks, noise, first))
    telemetry = Telemetry(
        gyro, torque, array(truth.star), jnp.asarray(True), array(aim.q), array(aim.w), array(before.q),
        array(before.b), array(nu), (scenario.mode > 0).astype(jnp.int32),
    )  # fmt: skip
    off = vector_part(quat_conjugate(before.q) * start.q)
    return Z(truth, computer), memory, Log(now.t, telemetry, pointing, start.q, start.w, off)


def flow(params: Params, scenario: Scenario, t, x, z: Z):
    """Nothing flows between packets."""
    return x


def refuse_bad(params: Params, scenario: Scenario) -> None:
    """The system's check: an axis of unit length, a swing below a radian."""
    check.kinds(params, Params, scenario, Scenario)
    check.unit("scenario.axis", scenario.axis)
    check.each("scenario.swing", "be less than 1 rad", scenario.swing, np.abs(scenario.swing) < 1)


system = System(init, tick, flow, dt=PACKET, normals=TICKS * NORMALS, check=refuse_bad)
params = Params()
scenario = Scenario()
