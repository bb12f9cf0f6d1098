"""Rate stabilisation after the loss of a control moment gyro (Jin & Leeghim, 2021).

A spacecraft at zero total momentum turns because the momentum of its control moment gyros (CMG) has to go
somewhere. One module fails: its gimbal is stopped and its wheel runs down. The others shall stop the turning by
PI control of the body rate and a steering law. At a singularity of the remaining modules they lock or shake.
The plant is integrated at 1 ms, logs and scores see 10 ms, control runs every 0.1 s. Choices
and errata by number: docs/loops/cmg_loss.md.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxatt import check, scores
from jaxatt.attitude import quat_normalised, quat_rate, quat_rotate
from jaxatt.bodies import ModuleInertia, cluster_inertia, cluster_momentum, cmg_motion
from jaxatt.check import door
from jaxatt.controllers import Steering, rate_pi, steer
from jaxatt.engine import System, every
from jaxatt.mounting import GimbalAxes, check_gimbal_axes, cmg_axes, cmg_triads
from jaxatt.singularity import condition_and_rank
from jaxatt.vec import Mat3, Quat, Vec3, inverse, norm

DT = 0.01  # [s] logs, scores, failures
SUBSTEPS = 10  # integration steps of 1 ms in between
PERIOD = 10  # ticks between control samples
PYRAMID, BOX = 54.7, 90.0  # [deg] skew of the paper's structures
MODULE = ModuleInertia(I_cr=5e-4, I_cs=1e-3, I_ct=5e-4, I_ws=1e-3)  # Table 4
PROPER, LOCK, FLUCTUATION = 0, 1, 2  # classes of `classify`


class Params(NamedTuple):
    """What the engineer ships."""

    k_p: Any = 0.2  # () [1/s] rate gain, eq. (7)
    k_i: Any = 0.02  # () [1/s^2] integral gain as printed in Table 4, which contradicts Table 5 (erratum 7): `table5`
    steering: Steering = Steering()
    J: Mat3 = Mat3(Vec3(50.0, 0.0, 0.0), Vec3(0.0, 50.0, 0.0), Vec3(0.0, 0.0, 30.0))  # [kg m^2] believed, J_S
    module: ModuleInertia = MODULE  # believed
    spin: Any = 600.0  # () [rad/s] believed wheel speed: h_w = I_ws spin


class Failure(NamedTuple):
    """What befalls each module, shape (n, *lanes). From its onset on the gimbal's command is zero.

    Table 1: wheel stop: brake > 0; gimbal stuck: brake = 0; gimbal free: free = 1.
    """

    onset: Any  # [s] inf for a healthy module
    brake: Any  # [N m s] b_r: the wheel runs down with time constant I_ws / b_r; 0: it spins on
    free: Any  # [1] 1: the gimbal's drive lets go and the gimbal swings, 0: it holds the gimbal
    friction: Any  # [N m s] of a free gimbal


class Scenario(NamedTuple):
    """What the day brings, for n modules."""

    gamma: Any  # (n,) [rad] initial gimbal angles
    failure: Failure
    axes: GimbalAxes  # (n,) how the modules are mounted
    known: GimbalAxes | None = None  # (n,) mounting as the on-board computer has it; None: the true one
    rate: Any = np.zeros(4)  # (n,) [rad/s] initial gimbal rates
    spin: Any = np.full(4, 600.0)  # (n,) [rad/s] wheel speeds
    h: Vec3 = Vec3(0.0, 0.0, 0.0)  # [N m s] total momentum at the start, body components; it sets the body rate
    J: Mat3 = Params().J  # [kg m^2] true inertia of the spacecraft without modules
    module: ModuleInertia = MODULE  # true
    tau_g: Any = 0.05  # () [s] lag of the gimbal rates
    u_max: Any = 1.0  # () [rad/s] limit of the gimbal rates; printed with rad/s^2 (erratum 3)
    std_w: Any = 0.0  # () [rad/s] gyro noise per axis
    bias_w: Vec3 = Vec3(0.0, 0.0, 0.0)  # [rad/s] gyro bias


class Readings(NamedTuple):
    """What the on-board computer gets."""

    w: Vec3  # [rad/s] gyro
    gamma: Any  # (n,) [rad] gimbal angles
    healthy: Any  # (n,) 1 or 0: telemetry of the modules


class Board(NamedTuple):
    """What the on-board computer remembers."""

    axes: GimbalAxes  # (n,)
    integral: Vec3  # [rad] of the rate error
    u: Any  # (n,) [rad/s] gimbal-rate command before the limit


class Drive(NamedTuple):
    """What the modules' drives do until the next tick, shape (n,)."""

    u: Any  # [rad/s] gimbal-rate command after the limit
    brake: Any  # [N m s]
    free: Any  # [1] 1 or 0


class X(NamedTuple):
    """Continuous state: the truth."""

    q: Quat  # [1] attitude, body to inertial
    w: Vec3  # [rad/s] body rate
    gamma: Any  # (n,) [rad] gimbal angles
    rate: Any  # (n,) [rad/s] gimbal rates
    spin: Any  # (n,) [rad/s] wheel speeds


class Z(NamedTuple):
    """Held state."""

    board: Board
    drive: Drive
    rate: Any  # (n,) [rad/s] gimbal rates at the tick before
    w0: Any  # () [rad/s] |w| at the start


class Log(NamedTuple):
    """What a tick reports, all truth."""

    w: Vec3  # [rad/s] body rate
    gamma: Any  # (n,) [rad] gimbal angles
    rate: Any  # (n,) [rad/s] gimbal rates
    spin: Any  # (n,) [rad/s] wheel speeds
    u: Any  # (n,) [rad/s] gimbal-rate commands after the limit
    momentum: Vec3  # [N m s] total, inertial components: constant
    condition: Any  # () of the torque matrix of the healthy modules; inf where it is singular
    rank_one: Any  # () bool: sigma_2 is zero too, to a millionth
    variation: Any  # () [rad/s] sum over healthy modules of the change of the gimbal rates since the tick before
    jumps: Any  # () number of commands that changed by more than u_max
    acceleration: Any  # () [rad^2/s^4] mean square of the healthy gimbals' accelerations
    w0: Any  # () [rad/s] |w| at the start


class Scores(NamedTuple):
    """Tallies of a run: what a sweep reports; `classify` reads them."""

    variation: Any  # [rad/s] total variation of the healthy gimbal rates, sampled at 10 ms
    jumps: Any  # [1] command changes of more than u_max
    acceleration: Any  # [rad/s^2] rms of the healthy gimbals' accelerations
    condition: Any  # [1] peak
    condition_at: Any  # [s] its time
    settling: Any  # [s] last time with |w| > 5 % of its start; inf if still so at the end
    final: Any  # [rad/s] |w| at the end
    start: Any  # [rad/s] |w| at the start
    momentum: Any  # [N m s] |total momentum| at the end
    rank_one: Any  # bool, rank one of the torque matrix was met
    absorbable: Any  # bool, the start's total momentum lies within the hull of what the healthy modules can hold
    ok: Any  # bool, rate, momentum and gimbal rates were finite


def init(params: Params, scenario: Scenario):
    """x, z at the start; the body rate follows from the total momentum, eq. (6)."""
    at = cmg_triads(scenario.axes, scenario.gamma)
    o = jnp.zeros_like(scenario.h.x)
    J_T = cluster_inertia(scenario.J, at, scenario.module)
    stored = cluster_momentum(Vec3(o, o, o), scenario.rate, scenario.spin, at, J_T, scenario.module)
    w = inverse(J_T) @ (scenario.h - stored)
    none = jnp.zeros_like(scenario.gamma)
    known = scenario.axes if scenario.known is None else scenario.known
    x = X(Quat(jnp.ones_like(o), o, o, o), w, scenario.gamma, scenario.rate, scenario.spin)
    return x, Z(Board(known, Vec3(o, o, o), none), Drive(none, none, none), scenario.rate, norm(w))


def sense(params: Params, scenario: Scenario, now, x: X, z: Z, noise) -> Readings:
    """What is read now; noise: 3 normals for the gyro."""
    w = x.w + scenario.bias_w + scenario.std_w * Vec3(*noise)
    return Readings(w, x.gamma, jnp.where(failed(scenario, now), 0.0, jnp.ones_like(x.gamma)))


def failed(scenario: Scenario, now):
    """Which modules have failed by now, bool of shape (n,)."""
    return now.t >= scenario.failure.onset


def decide(params: Params, now, board: Board, y: Readings):
    """One tick on board: every `PERIOD` ticks PI control and steering. Returns board and no log."""

    def control():
        e = -y.w
        integral = board.integral + PERIOD * now.dt * e  # the present sample included
        J_T = cluster_inertia(params.J, cmg_triads(board.axes, y.gamma), params.module)
        torque = rate_pi(e, integral, J_T, params.k_p, params.k_i)
        a = -torque / (params.module.I_ws * params.spin)  # eq. (7): the gimbals give -h_w T rate
        return board._replace(integral=integral, u=steer(params.steering, a, board.axes, y.gamma, y.healthy, now.t))

    return every(PERIOD, now, control, board), ()


def tick(params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """One tick: modules fail, sensors read, the board decides, the drives take their commands, a log is written."""
    x = x._replace(q=quat_normalised(x.q))
    y = sense(params, scenario, now, x, z, noise)
    board, _ = decide(params, now, z.board, y)
    ill = failed(scenario, now)
    drive = Drive(
        u=jnp.where(ill, 0, jnp.clip(board.u, -scenario.u_max, scenario.u_max)),
        brake=jnp.where(ill, scenario.failure.brake, 0),
        free=jnp.where(ill, scenario.failure.free, 0),
    )
    at = cmg_triads(scenario.axes, x.gamma)
    J_T = cluster_inertia(scenario.J, at, scenario.module)
    kappa, rank_one = condition_and_rank(y.healthy * at.t)
    acceleration = (drive.u - x.rate) / scenario.tau_g
    log = Log(
        w=x.w,
        gamma=x.gamma,
        rate=x.rate,
        spin=x.spin,
        u=drive.u,
        momentum=quat_rotate(x.q, cluster_momentum(x.w, x.rate, x.spin, at, J_T, scenario.module)),
        condition=kappa,
        rank_one=rank_one,
        variation=jnp.sum(y.healthy * jnp.abs(x.rate - z.rate), axis=0),
        jumps=jnp.sum(jnp.abs(drive.u - z.drive.u) > scenario.u_max, axis=0),
        acceleration=jnp.sum(y.healthy * acceleration * acceleration, axis=0) / jnp.sum(y.healthy, axis=0),
        w0=z.w0,
    )
    return x, Z(board, drive, x.rate, z.w0), log


def flow(params: Params, scenario: Scenario, t, x: X, z: Z) -> X:
    """dx/dt between ticks, eqs. (11)-(12)."""
    at, drive = cmg_triads(scenario.axes, x.gamma), z.drive
    servo = (drive.u - x.rate) / scenario.tau_g  # eq. (7); a failed module that is held has the command zero
    friction = scenario.failure.friction
    motion = cmg_motion(x.w, x.rate, x.spin, at, scenario.J, scenario.module, servo, drive.brake, drive.free, friction)
    return X(quat_rate(x.q, x.w), motion.w, x.rate, motion.rate, motion.spin)


def score(params: Params, scenario: Scenario, now, log: Log) -> Scores:
    """The tallies of one tick."""
    w = norm(log.w)
    healthy = jnp.isinf(scenario.failure.onset)
    h = norm(scenario.h)
    u = scenario.h / jnp.where(h > 0, h, 1)
    along = scenario.axes.r @ u
    hull = jnp.sum(healthy * scenario.module.I_ws * scenario.spin * jnp.sqrt(jnp.maximum(1 - along * along, 0)), axis=0)
    return Scores(
        variation=scores.total(log.variation),
        jumps=scores.total(log.jumps),
        acceleration=scores.rms(log.acceleration),
        condition=scores.peak(log.condition),
        condition_at=scores.peak_time(now, log.condition),
        settling=scores.settling(now, w > 0.05 * log.w0),
        final=scores.final(w),
        start=scores.final(log.w0),
        momentum=scores.final(norm(log.momentum)),
        rank_one=scores.peak(jnp.asarray(log.rank_one, w.dtype)),
        absorbable=scores.always(h <= hull),
        ok=scores.always(scores.finite((log.w, log.momentum, log.variation, log.acceleration))),
    )


@door
def classify(run: Scores):
    """The class of a run (choice 2): `FLUCTUATION` of the gimbals, `LOCK` of the rate, or `PROPER`."""
    variation, ratio = np.asarray(run.variation), np.asarray(run.final) / np.asarray(run.start)
    return np.where(~(variation <= 20), FLUCTUATION, np.where(ratio > 0.2, LOCK, PROPER))


def refuse_bad(params: Params, scenario: Scenario) -> tuple:
    """The system's check: ValueError on input outside physics' domain; returns the lanes."""
    lanes = check.shapes(params, scenario, Params(), _shaped(scenario))
    check.moments("params.J", params.J)
    check.moments("scenario.J", scenario.J)
    for name in ("k_p", "k_i"):
        check.not_negative(f"params.{name}", getattr(params, name))
    for name in Steering._fields:
        check.not_negative(f"params.steering.{name}", getattr(params.steering, name))
    check.positive("params.spin", params.spin)
    for name in ModuleInertia._fields:
        check.positive(f"params.module.{name}", getattr(params.module, name))
        check.positive(f"scenario.module.{name}", getattr(scenario.module, name))
    for name in ("gamma", "rate", "spin", "h", "bias_w"):
        check.finite(f"scenario.{name}", getattr(scenario, name))
    for name in ("tau_g", "u_max"):
        check.above(f"scenario.{name}", getattr(scenario, name), 0, "a lag and a limit")
    check.not_negative("scenario.std_w", scenario.std_w)
    for name in ("brake", "friction"):
        check.not_negative(f"scenario.failure.{name}", getattr(scenario.failure, name))
    check.one_of("scenario.failure.free", scenario.failure.free, (0, 1))
    check.not_negative("scenario.failure.onset", scenario.failure.onset)
    if check.concrete(scenario.failure.onset):
        check_gimbal_axes("scenario.axes", scenario.axes, np.isinf(np.asarray(scenario.failure.onset)))
        if scenario.known is not None:
            check_gimbal_axes("scenario.known", scenario.known)
    if check.concrete((scenario.failure.brake, scenario.module.I_ws)):
        slowing = DT / SUBSTEPS * np.asarray(scenario.failure.brake) / np.asarray(scenario.module.I_ws)
        if np.any((slowing > 0) & (slowing < 1e-5)):  # python -m benchmarks.precision: momentum off by 5e-4 N m s
            least = np.min(slowing, where=slowing > 0, initial=1)
            said = f"`scenario.failure.brake` takes {least:.1g} of the wheel speed in a step: below 1e-5 float32 rounds"
            check.precise(f"{said} the run-down, and the total momentum is not conserved", (params, scenario))
    return lanes


def _shaped(scenario: Scenario) -> Scenario:
    """A scenario of the shapes that this one must have, for as many modules as it has gimbal angles."""
    check.kind("scenario", scenario, Scenario)
    n = np.shape(scenario.gamma)[:1]
    if not n:
        check.refuse("scenario.gamma", "have shape (n, *lanes)", "()")
    each = np.zeros(n)
    axes = GimbalAxes(Vec3(each, each, each), Vec3(each, each, each))
    known = None if scenario.known is None else axes
    return Scenario(each, Failure(each, each, each, each), axes, known, each, each)


@door
def lost(skew, gamma, module: int = 3, onset=0.0, brake=1e-6, free=0.0, friction=0.0) -> Scenario:
    """The paper's spacecraft with four modules, one of which is lost.

    skew: 54.7 deg for the pyramid, 90 deg for box-90 [deg]; gamma: four gimbal angles [deg]; module: the lost one,
    0 to 3; onset [s], brake [N m s], free, friction [N m s]: of its failure, by default a wheel stop at once.
    """
    check.one_of("module", module, (0, 1, 2, 3))
    this = np.arange(4) == module
    failure = Failure(*(np.where(this, a, b) for a, b in ((onset, np.inf), (brake, 0), (free, 0), (friction, 0))))
    return Scenario(np.radians(gamma), failure, cmg_axes(np.radians(skew), np.radians([0.0, 90.0, 180.0, 270.0])))


system = System(init, tick, flow, dt=DT, substeps=SUBSTEPS, normals=3, check=refuse_bad)
params = Params()
table5 = Params(k_i=0.0)  # the paper's classes come with this one
scenario = lost(PYRAMID, [45.0, 45.0, 45.0, 45.0])
