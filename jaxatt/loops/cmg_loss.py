"""Rate stabilisation after the loss of a control moment gyro (Jin & Leeghim, 2021).

A spacecraft at zero total momentum turns because the momentum of its control moment gyros (CMG) has to go somewhere. One
module fails: its gimbal is stopped and its wheel runs down. The others shall stop the turning by PI control of the body
rate and a steering law. At a singularity of the remaining modules they lock or shake. The plant is integrated at 1 ms,
logs and scores see 10 ms, control runs every 0.1 s. Choices and errata by number: docs/loops/cmg_loss.md.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxatt import check, scores
from jaxatt.attitude import quat_normalised, quat_rate, quat_rotate
from jaxatt.check import finite, flag, inertia, instant, limit, not_negative, positive
from jaxatt.cmg import (
    GimbalAxes,
    ModuleInertia,
    Steering,
    check_cluster,
    cluster_inertia,
    cluster_momentum,
    cmg_axes,
    cmg_motion,
    cmg_triads,
    rate_pi,
    steer,
)
from jaxatt.contract import System
from jaxatt.engine import every
from jaxatt.faults import Fault, Reading, known, on_axes
from jaxatt.sensors import heard_triad, read_triad, triad
from jaxatt.torque_matrix import condition_and_rank
from jaxatt.vec import Mat3, Quat, Vec3, cross, inverse, norm, zeros

DT = 0.01  # [s] logs, scores, failures
SUBSTEPS = 10  # integration steps of 1 ms in between
PERIOD = 10  # ticks between control samples
PYRAMID, BOX = (cmg_axes(np.radians(skew), np.radians([0.0, 90.0, 180.0, 270.0])) for skew in (54.7, 90.0))
INERTIA = Mat3(Vec3(50.0, 0.0, 0.0), Vec3(0.0, 50.0, 0.0), Vec3(0.0, 0.0, 30.0))  # [kg m^2] J_S of Table 4
MODULE = ModuleInertia(I_cr=5e-4, I_cs=1e-3, I_ct=5e-4, I_ws=1e-3)  # Table 4
SPIN = 600.0  # [rad/s] wheel speed, Table 4
PROPER, LOCK, FLUCTUATION = 0, 1, 2  # classes of `classify`


class Params(NamedTuple):
    """What the engineer ships. For the paper's other structure, box-90: ``params._replace(axes=BOX)``."""

    k_p: Annotated[Any, "1/s", not_negative] = 0.2  # rate gain, eq. (7)
    k_i: Annotated[Any, "1/s^2", not_negative] = 0.02  # integral gain of Table 4, against Table 5 (erratum 7): `table5`
    steering: Steering = Steering()
    axes: GimbalAxes = PYRAMID  # believed mounting of the n modules
    J: Annotated[Mat3, "kg m^2", inertia] = INERTIA  # believed, without modules; J.x.y = -sum(m x y)
    module: ModuleInertia = MODULE  # believed
    spin: Annotated[Any, "rad/s", positive] = SPIN  # believed wheel speed: h_w = I_ws spin


class Failure(NamedTuple):
    """What befalls each of n modules. From its onset on the gimbal's command is zero.

    Table 1: wheel stop: brake > 0; gimbal stuck: brake = 0; gimbal free: free = 1.
    """

    onset: Annotated[Any, "s", not_negative, instant, ("n",)]  # inf for a healthy module
    brake: Annotated[Any, "N m s", not_negative, ("n",)]  # b_r: time constant I_ws / b_r of the wheel; 0: it spins on
    free: Annotated[Any, "1", flag, ("n",)]  # 1: the gimbal's drive lets go and the gimbal swings, 0: it holds it
    friction: Annotated[Any, "N m s", not_negative, ("n",)]  # of a free gimbal


class Scenario(NamedTuple):
    """What the day brings, for n modules; `lost` makes the paper's."""

    gamma: Annotated[Any, "rad", finite, ("n",)]  # initial gimbal angles
    failure: Failure
    axes: GimbalAxes  # true mounting
    rate: Annotated[Any, "rad/s", finite, ("n",)] = np.zeros(4)  # initial gimbal rates
    spin: Annotated[Any, "rad/s", finite, ("n",)] = np.full(4, SPIN)  # wheel speeds
    h: Annotated[Vec3, "N m s", finite] = Vec3(0.0, 0.0, 0.0)  # total momentum at the start; it sets the body rate
    J: Annotated[Mat3, "kg m^2", inertia] = INERTIA  # true, of the spacecraft without modules, likewise
    module: ModuleInertia = MODULE  # true
    tau_g: Annotated[Any, "s", positive] = 0.05  # lag of the gimbal rates
    u_max: Annotated[Any, "rad/s", limit] = 1.0  # limit of the gimbal rates; printed with rad/s^2 (erratum 3)
    std_w: Annotated[Any, "rad/s", not_negative] = 0.0  # gyro noise per axis and sample, one a tick
    bias_w: Annotated[Vec3, "rad/s", finite] = Vec3(0.0, 0.0, 0.0)  # gyro bias
    gyro: Annotated[Vec3, "rad/s"] = on_axes(Fault())  # faults per axis


class Readings(NamedTuple):
    """What the on-board computer gets."""

    w: Reading  # [rad/s] gyro, a `Vec3`
    gamma: Reading  # (n,) [rad] gimbal angles
    healthy: Any  # (n,) 1 or 0: telemetry of the modules


class Computer(NamedTuple):
    """What the on-board computer remembers."""

    integral: Vec3  # [rad] of the rate error
    u: Any  # (n,) [rad/s] gimbal-rate commands before the limit
    w: Vec3  # [rad/s] last reading of the gyro
    gamma: Any  # (n,) [rad] last readings of the gimbal angles


class Drive(NamedTuple):
    """What the modules' drives do until the next tick."""

    u: Any  # (n,) [rad/s] gimbal-rate commands after the limit
    brake: Any  # (n,) [N m s]
    free: Any  # (n,) 1 or 0


class X(NamedTuple):
    """Continuous state: the truth."""

    q: Quat  # [1] attitude, body to inertial
    w: Vec3  # [rad/s] body rate
    gamma: Any  # (n,) [rad] gimbal angles
    rate: Any  # (n,) [rad/s] gimbal rates
    spin: Any  # (n,) [rad/s] wheel speeds


class Z(NamedTuple):
    """Held between ticks."""

    computer: Computer
    drive: Drive
    rate: Any  # (n,) [rad/s] gimbal rates at the tick before
    w0: Any  # [rad/s] |w| at the start


class Log(NamedTuple):
    """What a tick reports, all truth."""

    t: Annotated[Any, "s"]
    w: Annotated[Vec3, "rad/s"]  # body rate
    gamma: Annotated[Any, "rad", ("n",)]  # gimbal angles
    rate: Annotated[Any, "rad/s", ("n",)]  # gimbal rates
    spin: Annotated[Any, "rad/s", ("n",)]  # wheel speeds
    u: Annotated[Any, "rad/s", ("n",)]  # gimbal-rate commands after the limit
    momentum: Annotated[Vec3, "N m s"]  # total, inertial components: constant
    condition: Annotated[Any, "1"]  # of the torque matrix of the healthy modules; inf where it is singular
    rank_one: Annotated[Any, "1"]  # bool: sigma_2 is zero too, to a millionth
    variation: Annotated[Any, "rad/s"]  # sum over healthy modules of the change of the rates since the tick before
    jumps: Annotated[Any, "1"]  # number of commands that changed by more than u_max
    acceleration: Annotated[Any, "rad^2/s^4"]  # mean square of the healthy gimbals' accelerations
    w0: Annotated[Any, "rad/s"]  # |w| at the start


class Scores(NamedTuple):
    """Tallies of a run: what a sweep reports; `classify` reads them."""

    variation: Annotated[Any, "rad/s"]  # total variation of the healthy gimbal rates, sampled at 10 ms
    jumps: Annotated[Any, "1"]  # command changes of more than u_max
    acceleration: Annotated[Any, "rad/s^2"]  # rms of the healthy gimbals' accelerations
    condition: Annotated[Any, "1"]  # peak
    condition_at: Annotated[Any, "s"]  # its time
    settling: Annotated[Any, "s"]  # last time with |w| > 5 % of its start; inf if still so at the end
    final: Annotated[Any, "rad/s"]  # |w| at the end
    start: Annotated[Any, "rad/s"]  # |w| at the start
    momentum: Annotated[Any, "N m s"]  # |total momentum| at the end
    rank_one: Annotated[Any, "1"]  # bool, rank one of the torque matrix was met
    absorbable: Annotated[Any, "1"]  # bool, the total momentum lies in the hull of what the healthy modules can hold
    ok: Annotated[Any, "1"]  # bool, rate, momentum and gimbal rates were finite


def init(params: Params, scenario: Scenario):
    """x, z at the start; the body rate follows from the total momentum, eq. (6)."""
    s, none = scenario, jnp.zeros_like(scenario.gamma)
    at = cmg_triads(s.axes, s.gamma)
    J_T = cluster_inertia(s.J, at, s.module)
    w = inverse(J_T) @ (s.h - cluster_momentum(zeros(), s.rate, s.spin, at, J_T, s.module))
    x = X(Quat(1.0, 0.0, 0.0, 0.0), w, s.gamma, s.rate, s.spin)
    return x, Z(Computer(zeros(), none, w, s.gamma), Drive(none, none, none), s.rate, norm(w))


def sense(params: Params, scenario: Scenario, now, x: X, z: Z, noise) -> Readings:
    """What is read now; noise: 3 normals for the gyro."""
    gyro = triad(scenario.gyro, now.t, scenario.std_w, noise, z.computer.w)
    w = Reading(read_triad(gyro, x.w + scenario.bias_w), heard_triad(scenario.gyro, now.t))
    gamma = Reading(x.gamma, jnp.ones(x.gamma.shape, bool))
    return Readings(w, gamma, jnp.where(failed(scenario, now), 0.0, jnp.ones_like(x.gamma)))


def failed(scenario: Scenario, now):
    """Which modules have failed by now, bool, (n,)."""
    return now.t >= scenario.failure.onset


def computer_of(x: X, z: Z) -> Computer:
    """What the computer knows between two ticks."""
    return z.computer


def decide(params: Params, now, computer: Computer, y: Readings):
    """One tick on board: every `PERIOD` ticks PI control and steering. Returns computer and no log.

    For what is missing the last reading stands.
    """
    w, gamma = known(y.w, computer.w), known(y.gamma, computer.gamma)

    def control():
        e = -w
        integral = computer.integral + PERIOD * now.dt * e  # the present sample included
        J_T = cluster_inertia(params.J, cmg_triads(params.axes, gamma), params.module)
        torque = rate_pi(e, integral, J_T, params.k_p, params.k_i)
        a = -torque / (params.module.I_ws * params.spin)  # eq. (7): the gimbals give -h_w T rate
        return integral, steer(params.steering, a, params.axes, gamma, y.healthy, now.t)

    integral, u = every(PERIOD, now, control, (computer.integral, computer.u))
    return Computer(integral, u, w, gamma), ()


def tick(params: Params, scenario: Scenario, now, x: X, z: Z, noise):
    """One tick: modules fail, sensors read, the computer decides, the drives take their commands, a log is written."""
    x = x._replace(q=quat_normalised(x.q))
    y = sense(params, scenario, now, x, z, noise)
    computer, _ = decide(params, now, z.computer, y)
    faulty, failure, u_max = failed(scenario, now), scenario.failure, scenario.u_max
    u = jnp.where(faulty, 0, jnp.clip(computer.u, -u_max, u_max))
    drive = Drive(u, jnp.where(faulty, failure.brake, 0), jnp.where(faulty, failure.free, 0))
    at = cmg_triads(scenario.axes, x.gamma)
    J_T = cluster_inertia(scenario.J, at, scenario.module)
    kappa, rank_one = condition_and_rank(y.healthy * at.t)
    acceleration = (u - x.rate) / scenario.tau_g
    log = Log(
        t=now.t,
        w=x.w,
        gamma=x.gamma,
        rate=x.rate,
        spin=x.spin,
        u=u,
        momentum=quat_rotate(x.q, cluster_momentum(x.w, x.rate, x.spin, at, J_T, scenario.module)),
        condition=kappa,
        rank_one=rank_one,
        variation=jnp.sum(y.healthy * jnp.abs(x.rate - z.rate)),
        jumps=jnp.sum(jnp.abs(u - z.drive.u) > u_max),
        acceleration=jnp.sum(y.healthy * acceleration * acceleration) / jnp.sum(y.healthy),
        w0=z.w0,
    )
    return x, Z(computer, drive, x.rate, z.w0), log


def flow(params: Params, scenario: Scenario, t, x: X, z: Z) -> X:
    """dx/dt between ticks, eqs. (11)-(12)."""
    at, drive, s = cmg_triads(scenario.axes, x.gamma), z.drive, scenario
    servo = (drive.u - x.rate) / s.tau_g  # eq. (7); a failed module that is held has the command zero
    motion = cmg_motion(x.w, x.rate, x.spin, at, s.J, s.module, servo, drive.brake, drive.free, s.failure.friction)
    return X(quat_rate(x.q, x.w), motion.w, x.rate, motion.rate, motion.spin)


def score(params: Params, scenario: Scenario, now, log: Log) -> Scores:
    """The tallies of one tick."""
    w, h = norm(log.w), scenario.h
    healthy = jnp.isinf(scenario.failure.onset)
    each = scenario.module.I_ws * scenario.spin * norm(cross(scenario.axes.r, h))  # along h, by |h|
    held = jnp.sum(jnp.where(healthy, each, 0))
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
        absorbable=scores.always(h @ h <= held),
        ok=scores.always(scores.finite((log.w, log.momentum, log.variation, log.acceleration))),
    )


def classify(run: Scores):
    """The class of a run (choice 2): `FLUCTUATION` of the gimbals, `LOCK` of the rate, or `PROPER`."""
    variation, ratio = np.asarray(run.variation), np.asarray(run.final) / np.asarray(run.start)
    return np.where(~(variation <= 20), FLUCTUATION, np.where(ratio > 0.2, LOCK, PROPER))


def refuse_bad(params: Params, scenario: Scenario) -> None:
    """The system's check: three modules that work, as many as the computer believes in; a run-down that float32 shows."""
    check.kinds(params, Params, scenario, Scenario)
    n, believed, onset = len(scenario.gamma), len(params.axes.r.x), np.asarray(scenario.failure.onset)
    if n != believed:
        check.refuse("params.axes", f"be of {n} modules, as `scenario.axes`", f"of {believed}")
    check_cluster("params.axes", params.axes)
    check_cluster("scenario.axes", scenario.axes, np.isinf(onset))
    slowing = DT / SUBSTEPS * np.asarray(scenario.failure.brake) / np.asarray(scenario.module.I_ws)
    if np.any((slowing > 0) & (slowing < 1e-5)):  # python -m benchmarks.precision: momentum off by 5e-4 N m s
        least = np.min(slowing, where=slowing > 0, initial=1)
        said = f"`scenario.failure.brake` takes {least:.1g} of the wheel speed in a step: below 1e-5 float32 rounds"
        check.precise(f"{said} the run-down, and the total momentum is not conserved", (params, scenario))


def lost(axes: GimbalAxes, gamma, module: Any = 3, onset=0.0, brake=1e-6, free=0.0, friction=0.0) -> Scenario:
    """The paper's spacecraft with n modules, one of which is lost.

    Args:
        axes: `PYRAMID`, `BOX` or any other mounting; params carry the one that the computer believes in.
        gamma: gimbal angles, (n,) [deg].
        module: the lost one, from 0, or a list of them.
        onset, brake, free, friction: of its `Failure` [s], [N m s], [1], [N m s]; by default a wheel stop at once.

    Raises:
        ValueError: a module that is none of the cluster.

    Example:
        >>> scenario = lost(BOX, [10.0, 55.0, 45.0, -10.0], module=1, onset=5.0)
    """
    n = len(axes.r.x)
    check.one_of("module", module, tuple(range(n)))
    this = np.isin(np.arange(n), module)
    failure = Failure(*(np.where(this, a, b) for a, b in ((onset, np.inf), (brake, 0.0), (free, 0.0), (friction, 0.0))))
    return Scenario(np.radians(gamma), failure, axes, np.zeros(n), np.full(n, SPIN))


system = System(init, tick, flow, dt=DT, substeps=SUBSTEPS, normals=3, check=refuse_bad)
params = Params()
table5 = Params(k_i=0.0)  # the paper's classes come with this one
scenario = lost(PYRAMID, [45.0, 45.0, 45.0, 45.0])
