"""What is my satellite really: gyro and tracker, inertia and friction, noise levels, from the innovations of simulated flights.

Three on-board codes: the attitude filter of a calibration manoeuvre, a filter of rate and wheel momenta on telemetry of the closed
`microsat`, and the filter that closes `gyro_ekf`. Each is fitted to 200 flights, one spacecraft each, and its intervals are counted.
Then cases built to be blind, the posterior beside Laplace's interval, and two models compared on flights that neither saw.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from experiments.report import interval
from jaxatt import Reading, System, fields, identify, simulate
from jaxatt.attitude import quat_from_vector, quat_normalised, quat_rate
from jaxatt.bodies import dipole_torque
from jaxatt.filters import Belief, predict, update
from jaxatt.loops import gyro_ekf as ekf
from jaxatt.loops import microsat as ms
from jaxatt.mekf import Mekf, update_attitude
from jaxatt.mekf import predict as mekf_predict
from jaxatt.mekf import start as mekf_start
from jaxatt.plot import COLOURS, GREY
from jaxatt.sensors import Gyro, GyroState, StarTracker, gyro_read, star_axes, star_read
from jaxatt.torque_matrix import times
from jaxatt.vec import Mat3, Quat, Vec3, array, cross, diagonal, inverse, scaled_identity, skew, where, zeros
from jaxatt.wheels import TorqueWheel, relative_speed, wheel_torque

KEY = jax.random.key(2300)
DEG = np.pi / 180


class Study(NamedTuple):
    """On-board code, what is unknown of it, and flights of which the truth is known."""

    title: str
    model: identify.Model
    build: Callable
    start: Any
    spread: Any
    fly: Callable  # keys (n,) -> flights, true theta (n, ...)
    units: dict[str, str] = {}  # noqa: RUF012 - of parts of theta that have one


# gyro and star tracker on a calibration manoeuvre


STEP, STARS = 0.2, 5  # [s], [ticks] between star samples
WAYS = Vec3(*(np.array(row) * 2 * np.pi for row in ((1 / 31, 0.0), (1 / 43, 1.1), (1 / 23, 2.3))))  # [rad/s] and phase
SWING = 0.7 * DEG  # [rad/s] amplitude of each axis
UNIT = StarTracker(Vec3(0.0, 1.0, 0.0), Vec3(0.0, 0.0, 1.0), 8 * DEG / 3600, 60 * DEG / 3600, 1.5 * DEG)
SHEET = Gyro(arw=0.15 * DEG / 60, rrw=3e-6)


class Calibration(NamedTuple):
    """What the attitude filter knows of its units."""

    scale: Vec3 = zeros()  # [1]
    turn: Vec3 = zeros()  # [rad] of the gyro's axes against the star tracker's
    arw: Any = SHEET.arw  # [rad/s^0.5]
    rrw: Any = SHEET.rrw  # [rad/s^1.5]
    cross: Any = UNIT.cross  # [rad]
    roll: Any = UNIT.roll  # [rad]


class Units(NamedTuple):
    """Readings of gyro and star tracker."""

    gyro: Reading
    star: Reading


class Turning(NamedTuple):
    """The truth."""

    q: Quat
    theta: Vec3  # [rad] integral of the rate


class Day(NamedTuple):
    """One spacecraft and its start."""

    unit: Calibration
    swing: Any  # [rad/s] amplitude of the manoeuvre about each axis
    bias: Vec3  # [rad/s] of the gyro
    off: Vec3  # [rad] turn of the first attitude against the believed one


class Held(NamedTuple):
    """Between ticks."""

    gyro: GyroState
    theta: Vec3
    belief: Mekf


BEGIN = 1e-3, 1e-4  # [rad], [rad/s] deviations of the first belief
LEVEL = Quat(1.0, 0.0, 0.0, 0.0)


def rate_at(day: Day, t) -> Vec3:
    """The rate [rad/s] of the manoeuvre."""
    return Vec3(*(day.swing * jnp.sin(way[0] * t + way[1]) for way in WAYS))


def decide_units(params: Calibration, now, belief: Mekf, y: Units):
    """Attitude and bias by gyro and star tracker; what the sample told."""
    seen = scaled_identity() + diagonal(params.scale) - skew(params.turn)
    belief = mekf_predict(
        belief, inverse(seen) @ y.gyro.value, jnp.where(now.k > 0, now.dt, 0.0), params.arw, params.rrw
    )
    variance = Vec3(params.cross**2, params.cross**2, params.roll**2)
    return update_attitude(belief, y.star, star_axes(UNIT), variance)


def init_units(params, day: Day):
    q = quat_from_vector(day.off)
    return Turning(q, zeros()), Held(GyroState(day.bias, zeros()), zeros(), mekf_start(LEVEL, zeros(), *BEGIN))


def tick_units(params, day: Day, now, x: Turning, z: Held, noise):
    """The units read, the filter decides; its readings are the log."""
    x, unit = x._replace(q=quat_normalised(x.q)), day.unit
    sheet = Gyro(arw=unit.arw, rrw=unit.rrw, scale=unit.scale, misalignment=-skew(unit.turn))
    turn = where(now.k == 0, now.dt * rate_at(day, now.t), x.theta - z.theta)
    gyro, rate = gyro_read(sheet, z.gyro, turn, now.dt, noise[:3], noise[3:6])
    error = Vec3(unit.cross * noise[6], unit.cross * noise[7], unit.roll * noise[8])
    star = star_read(UNIT, x.q, rate_at(day, now.t), error)
    y = Units(Reading(rate, jnp.asarray(True)), star._replace(valid=star.valid & (now.k % STARS == 0)))
    belief, _ = decide_units(params, now, z.belief, y)
    return x, Held(gyro, x.theta, belief), y


def flow_units(params, day: Day, t, x: Turning, z: Held) -> Turning:
    w = rate_at(day, t)
    return Turning(quat_rate(x.q, w), w)


MANOEUVRE = System(init_units, tick_units, flow_units, dt=STEP, normals=9)


def calibration(theta) -> Calibration:
    return Calibration(theta["scale"], theta["turn"], *(jnp.exp(theta[name]) for name in LOGS))


LOGS = "log_arw", "log_rrw", "log_cross", "log_roll"


def calibrations(ticks: int) -> Study:
    """Scale, misalignment and noise of the gyro, noise of the star tracker, by the attitude filter."""
    start = dict(scale=zeros(), turn=zeros()) | {name: float(np.log(getattr(Calibration(), name[4:]))) for name in LOGS}
    spread = dict(scale=5e-3, turn=5e-3, log_arw=1.0, log_rrw=1.0, log_cross=1.0, log_roll=1.0)
    spread = {name: jax.tree.map(lambda _, a=a: a, start[name]) for name, a in spread.items()}

    def fly(keys, swing=SWING, same=False):
        first, second = jax.vmap(jax.random.split, out_axes=1)(keys)
        return one(jnp.where(same, first[:1], first), second, jnp.full(len(keys), swing))

    @jax.jit
    @jax.vmap
    def one(first, second, swing):
        draws, begin = jax.random.normal(first, (10,)), jax.random.normal(second, (6,))
        theta = dict(scale=Vec3(*1e-3 * draws[:3]), turn=Vec3(*2e-3 * draws[3:6]))
        theta |= {name: start[name] + 0.3 * a for name, a in zip(LOGS, draws[6:])}
        day = Day(calibration(theta), swing, Vec3(*BEGIN[1] * begin[:3]), Vec3(*BEGIN[0] * begin[3:]))
        y = simulate(MANOEUVRE, Calibration(), day, jax.random.fold_in(second, 1), ticks=ticks)
        return identify.Flights(mekf_start(LEVEL, zeros(), *BEGIN), y), theta

    model = identify.Model(decide_units, lambda log: log, STEP)
    return Study("attitude filter, calibration manoeuvre", model, calibration, start, spread, fly, {"turn": "rad"})


# inertia and friction of microsat, by the momentum of its wheels


RATE, MOMENTUM, DRIFT = slice(0, 3), slice(3, 7), slice(7, 10)  # of the filter's state


class Satellite(NamedTuple):
    """What the rate filter knows of the spacecraft; its wheels' axes and moments are those of `microsat`."""

    J: Mat3  # [kg m^2]
    coulomb: Any  # [N m]
    viscous: Any  # [N m s]
    dipole: Vec3  # [A m^2] residual


class Telemetry(NamedTuple):
    """A tick of microsat's telemetry."""

    gyro: Reading  # [rad/s] mean since the last tick
    tacho: Reading  # [N m s]
    torque: Any  # (4,) [N m] commanded, held from now on
    moment: Vec3  # [A m^2] likewise
    field: Vec3  # [T] body axes


class Observer(NamedTuple):
    """What the rate filter remembers."""

    belief: Belief  # rate, wheel momenta, gyro bias
    last: Telemetry


def rubbing(coulomb, viscous) -> TorqueWheel:
    """A wheel of microsat with this friction; at rest it is twice Coulomb's, as in the data sheet."""
    friction = ms.WHEEL.friction._replace(coulomb=coulomb, viscous=viscous, stiction=2 * coulomb)
    return ms.WHEEL._replace(friction=friction)


def moved(params: Satellite, last: Telemetry, h_rate, x):
    """Rates of body rate and wheel momenta, `Vec3` and (4,), of the filter's state x (10,); h_rate (4,) is held over the tick."""
    w, h = Vec3.of(x[RATE]), x[MOMENTUM]
    magnetic = dipole_torque(last.moment + params.dipole, last.field)
    torque = magnetic - times(ms.AXES, h_rate) - cross(w, params.J @ w + times(ms.AXES, h))
    return inverse(params.J) @ torque, h_rate


def decide_momentum(params: Satellite, now, computer: Observer, y: Telemetry):
    """Body rate, wheel momenta and gyro bias by gyro and tachometers; what they told."""
    elapsed = jnp.where(now.k > 0, now.dt, 0.0)
    x = computer.belief.mean
    wheel = rubbing(params.coulomb, params.viscous)
    h_rate = wheel_torque(
        wheel, computer.last.torque, relative_speed(wheel.J, x[MOMENTUM], ms.AXES, Vec3.of(x[RATE])), now.dt
    )
    f = lambda x: moved(params, computer.last, h_rate, x)
    belief = predict(computer.belief, f, jnp.zeros(3), NOISE, elapsed)

    def expected(x):
        w = Vec3.of(x[RATE])
        mean = w - 0.5 * now.dt * f(x)[0] + Vec3.of(x[DRIFT])  # the gyro tells the mean rate since the last tick
        return mean, x[MOMENTUM] - ms.WHEEL.J * (ms.AXES @ w)

    value = jnp.concatenate([array(y.gyro.value), y.tacho.value])
    valid = jnp.append(jnp.repeat(y.gyro.valid, 3), y.tacho.valid) & (now.k > 0)
    belief, met = update(belief, Reading(value, valid), expected, VARIANCE)
    return Observer(belief, y), met


NOISE = np.repeat([1e-14, 1e-16, ms.SHEET.rrw**2], [3, 4, 3])
VARIANCE = np.repeat([ms.SHEET.arw**2 / ms.DT, ms.params.std_tacho**2], [3, 4])
FIRST = np.repeat([0.01, 0.02, 1e-4], [3, 4, 3])  # deviations of the first belief


def acquiring(params, scenario):
    """`microsat` off its target: the scenario's turn is the truth's, and the filter knows it."""
    x, z = ms.init(params, scenario._replace(turn=zeros()))
    q = quat_normalised(x.q * quat_from_vector(scenario.turn))
    belief = z.computer.belief
    return x._replace(q=q), z._replace(computer=z.computer._replace(belief=belief._replace(q=q, clone=q)))


def tick_sat(params, scenario, now, x, z, noise):
    """`microsat`, with its telemetry for a log."""
    x, z, _ = ms.tick(params, scenario, now, x, z, noise)
    y, computer = z.sensors.readings, z.computer
    return x, z, Telemetry(y.gyro, y.tacho, computer.torque, computer.moment, y.field.value)


def satellite(theta) -> Satellite:
    J = identify.put(ms.INERTIA, {f"{i}.{i}": a for i, a in zip("xyz", theta["J"])})
    return Satellite(J, jnp.exp(theta["log_coulomb"]), jnp.exp(theta["log_viscous"]), ms.scenario.dipole)


def satellites(ticks: int) -> Study:
    """Inertia and friction of microsat after an acquisition, the loop closed on a wrong inertia."""
    J, friction = ms.INERTIA, ms.WHEEL.friction
    logs = {f"log_{name}": float(np.log(getattr(friction, name))) for name in ("coulomb", "viscous")}
    start = dict(J=Vec3(J.x.x, J.y.y, J.z.z)) | logs
    spread = dict(J=Vec3(0.3, 0.3, 0.3), log_coulomb=0.5, log_viscous=0.5)
    params = ms.params._replace(turn_max=0.25)
    system = ms.system._replace(init=acquiring, tick=tick_sat)
    still = ms.scenario.facets._replace(
        area=0 * ms.scenario.facets.area
    )  # no air and light, which the filter does not know

    def one(key):
        first, second = jax.random.split(key)
        draws = jax.random.normal(first, (11,))
        off = iter(draws)
        theta = jax.tree.map(lambda a, s: a + 0.3 * s * next(off), start, spread)
        told = satellite(theta)
        scenario = ms.scenario._replace(
            J=told.J, wheels=rubbing(told.coulomb, told.viscous), facets=still, act=0.0,
            turn=Vec3(*0.3 * draws[5:8]), bias=Vec3(*FIRST[-1] * draws[8:]),
        )  # fmt: skip
        y = simulate(system, params, scenario, second, ticks=ticks)
        belief = Belief(jnp.concatenate([jnp.zeros(3), jnp.asarray(ms.scenario.h), jnp.zeros(3)]), jnp.diag(FIRST**2))
        return identify.Flights(Observer(belief, jax.tree.map(lambda a: a[0], y)), y), theta

    model = identify.Model(decide_momentum, lambda log: log, ms.DT)
    title, units = "rate filter on microsat's telemetry", {"J": "kg m^2"}
    return Study(title, model, satellite, start, spread, jax.jit(jax.vmap(one)), units)


# the filter that closes gyro_ekf


class Flown(NamedTuple):
    """A tick of gyro_ekf's telemetry."""

    readings: ekf.Readings
    u: Any  # (4,) [in-lbf] commanded rates of wheel momentum, from now on


def tick_ekf(params, scenario, now, x, z, noise):
    """`gyro_ekf`, with its telemetry for a log."""
    x, z, _ = ekf.tick(params, scenario, now, x, z, noise)
    return x, z, Flown(z.readings, z.computer.u)


def decide_flown(params, now, computer, told: Flown):
    """``decide`` of gyro_ekf on telemetry: the wheels had the command that flew, not that of other params."""
    computer, log = ekf.decide(params, now, computer, told.readings)
    return computer._replace(u=told.u), log


SLEWING = ekf.consistent(ekf.params)._replace(
    slew=Vec3(0.1 * DEG, 0.08 * DEG, -0.12 * DEG), slew_start=5.0, slew_end=25.0
)


def shipped(theta) -> ekf.Params:
    R = jnp.asarray(SLEWING.R).at[ekf.GYRO].set(jnp.exp(2 * theta["log_gyro"]))
    by_axis = {f"J.{i}.{i}": a for i, a in zip("xyz", theta["J"])}
    return identify.put(SLEWING, by_axis | {"alpha": theta["alpha"], "R": R})


def geostationary(ticks: int) -> Study:
    """Inertia, skew of the gyros' pyramid and their noise of the geostationary satellite in a slew, by its own ``decide``."""
    J = ekf.INERTIA
    start = dict(J=Vec3(J.x.x, J.y.y, J.z.z), alpha=SLEWING.alpha, log_gyro=float(np.log(ekf.scenario.std_gyro)))
    spread = dict(J=Vec3(4000.0, 4000.0, 1000.0), alpha=0.01, log_gyro=1.0)
    system = ekf.system._replace(tick=tick_ekf)

    def one(key):
        first, second = jax.random.split(key)
        draws = jax.random.normal(first, (12,))
        off = iter(draws)
        theta = jax.tree.map(lambda a, s: a + 0.3 * s * next(off), start, spread)
        inertia = identify.put(J, {f"{i}.{i}": a for i, a in zip("xyz", theta["J"])})
        scenario = ekf.scenario._replace(
            J=inertia, alpha=theta["alpha"], std_gyro=jnp.exp(theta["log_gyro"]), bias=1e-4 * draws[8:]
        )
        y = simulate(system, SLEWING, scenario, second, ticks=ticks)
        return identify.Flights(ekf.computer_of(*ekf.init(SLEWING, scenario)), y), theta

    model = identify.Model(decide_flown, lambda log: log[0], ekf.DT)
    title, units = "gyro_ekf in a slew, its own filter", {"J": "in-lbf-s^2", "alpha": "rad"}
    return Study(title, model, shipped, start, spread, jax.jit(jax.vmap(one)), units)


# a walk that is measured: small enough for everything


class Walk(NamedTuple):
    """A bias that forgets itself, measured with noise: x' = decay x + sqrt(q) N, y = gain x + sqrt(r) N."""

    decay: Any
    q: Any
    r: Any
    gain: Any = 1.0


def decide_walk(params: Walk, now, belief: Belief, y):
    """Its Kalman filter; the innovation and its variance."""
    mean, P = params.decay * belief.mean, params.decay**2 * belief.cov + params.q
    nu, S = y - params.gain * mean, params.gain**2 * P + params.r
    K = P * params.gain / S
    return Belief(mean + K * nu, (1 - K * params.gain) * P), (nu[None], S[None, None])


WALK = identify.Model(decide_walk, lambda log: log, 1.0)
TRUE_WALK = Walk(0.9, 0.2, 0.5)


def walks(n: int, ticks: int, seed: int = 3) -> identify.Flights:
    rng, true = np.random.default_rng(seed), TRUE_WALK
    x, y = np.zeros(n), np.zeros((n, ticks))
    for k in range(ticks):
        x = true.decay * x + np.sqrt(true.q) * rng.normal(size=n)
        y[:, k] = x + np.sqrt(true.r) * rng.normal(size=n)
    return identify.Flights(Belief(np.zeros(n), np.zeros(n)), y)


def plain_walk(theta) -> Walk:
    return Walk(theta["decay"], jnp.exp(theta["log_q"]), jnp.exp(theta["log_r"]))


def walking(keys):
    """Flights, one for each key, and what is true of all of them."""
    n, true = len(keys), TRUE_WALK
    theta = dict(decay=true.decay, log_q=np.log(true.q), log_r=np.log(true.r))
    return walks(n, 1000), {name: np.full(n, a) for name, a in theta.items()}


def white_walk(theta) -> Walk:
    """No memory: the measurements are white."""
    return Walk(0.0, 1e-9, jnp.exp(theta["log_r"]))


WALK_START, WALK_SPREAD = dict(decay=0.5, log_q=0.0, log_r=0.0), dict(decay=0.5, log_q=2.0, log_r=2.0)


def with_gain(theta) -> Walk:
    """Only gain^2 q counts."""
    return plain_walk(theta)._replace(gain=jnp.exp(theta["log_gain"]))


def two_noises(theta) -> Walk:
    """Two noises of the sensor, of which only the sum counts, and a number that nothing depends on."""
    return plain_walk(theta)._replace(r=jnp.exp(theta["log_r"]) * (1 + 0 * theta["colour"]) * jnp.exp(theta["log_s"]))


BLIND = {
    "gain and q": (with_gain, dict(log_gain=0.0), dict(log_gain=1.0), [{"log_gain", "log_q"}]),
    "two factors and an unused number": (
        two_noises, dict(log_s=0.0, colour=1.0), dict(log_s=1.0, colour=1.0), [{"log_r", "log_s"}, {"colour"}],
    ),
}  # fmt: skip


# the studies


SIZES = {calibrations: 1000, satellites: 300, geostationary: 240}  # ticks


def run(report) -> None:
    """What the small model shows; at full size also its posterior and three on-board codes, whose programs take long to compile."""
    study = Study("a walk that is measured", WALK, plain_walk, WALK_START, WALK_SPREAD, walking)
    intervals(report, "walk", study, *coverage(report, "walk", study, 200))
    blind(report, 20 if report.quick else 200)
    compared(
        report,
        "walk: without memory against with it",
        WALK,
        (white_walk, plain_walk),
        study,
        walks(20, 400),
        walks(20, 400, 4),
    )
    if report.quick:
        return
    sampled(report)
    for make in SIZES:
        study = make(SIZES[make])
        intervals(report, make.__name__, study, *coverage(report, make.__name__, study, 200))
        if make is calibrations:
            still(report, study, 200)
            one_spacecraft(report, study, 200)


def rows(tree, n: int) -> dict[str, np.ndarray]:
    """The numbers of n flights by name, (n,)."""
    found = {}
    for name, a in fields.named(tree, "theta").items():
        found[name] = np.asarray(a).reshape(n)
    return found


def coverage(report, name: str, study: Study, n: int):
    """A fit of each flight, and how many of its intervals hold the truth."""
    began = time.process_time()
    flights, truth = study.fly(jax.random.split(KEY, n))
    found = identify.fit(study.model, study.build, study.start, flights, spread=study.spread, each=True)
    true, low, high, std, at = (rows(a, n) for a in (truth, found.low, found.high, found.std, found.theta))
    held = {i: (low[i] <= true[i]) & (true[i] <= high[i]) for i in true}
    report.within(f"{name}: share of {n} fits that converged", 0.99, None, found.converged.mean(), "search")
    share = np.mean(list(held.values()))
    report.within(f"{name}: share of 95 % intervals that hold the truth", 0.93, 0.97, share, "level of the intervals")
    for i in true:
        a, b = interval(int(held[i].sum()), n)
        z = (at[i] - true[i]) / std[i]
        report.note(
            f"{name}: {i:12} std {np.nanmean(std[i]):.3g}, error over std {np.nanmean(z):+.2f} +- {np.nanstd(z):.2f}, "
            f"holds {held[i].mean():.3f} ({a:.3f} to {b:.3f})"
        )
    report.note(f"{name}: {n} flights took {time.process_time() - began:.0f} CPU s")
    return found, truth


def intervals(report, name: str, study: Study, found, truth) -> None:
    """Estimates less the truth, with their intervals, of some sixty flights in the order of their errors."""
    n = len(found.nll)
    true, low, high, at = (rows(a, n) for a in (truth, found.low, found.high, found.theta))
    wide = min(5, len(true))
    deep = -(-len(true) // wide)
    fig, axes = plt.subplots(deep, wide, figsize=(2.6 * wide, 2.6 * deep), layout="constrained", squeeze=False)
    for ax, i in zip(axes.flat, true):
        by = np.argsort(at[i] - true[i])[:: max(1, n // 60)]
        error, below, above = (a[i][by] - true[i][by] for a in (at, low, high))
        out = (below > 0) | (above < 0)
        for pick, colour, label in ((~out, COLOURS[0], "holds the truth"), (out, COLOURS[1], "does not")):
            ends = error[pick] - below[pick], above[pick] - error[pick]
            ax.errorbar(np.flatnonzero(pick), error[pick], ends, fmt="o", ms=2, lw=0.8, color=colour, label=label)
        ax.axhline(0, color=GREY, lw=0.8)
        unit = study.units.get(i.split(".")[0])
        ax.set(title=f"{i} [{unit}]" if unit else i, xticks=[])
        ax.tick_params(labelsize=7)
    for ax in list(axes.flat)[len(true) :]:
        ax.set_visible(False)
    axes[0, 0].set_ylabel("estimate less truth")
    axes[0, 0].legend(fontsize=7, loc="lower right")
    fig.supxlabel("flights, in the order of their errors")
    fig.suptitle(f"{study.title}: 95 % intervals of {len(by)} of {n} flights")
    report.figure(name, fig)


def still(report, study: Study, n: int) -> None:
    """The same spacecraft without a manoeuvre: scale and misalignment cannot be seen, and are named."""
    flights, _ = study.fly(jax.random.split(jax.random.fold_in(KEY, 1), n), swing=0.0)
    found = identify.fit(study.model, study.build, study.start, flights, spread=study.spread, each=True)
    hidden = [f"{part}.{i}" for part in ("scale", "turn") for i in "xyz"]
    named = [all(any(i in said for said in words) for i in hidden) for words in found.blind]
    report.within(
        "without a manoeuvre: share of flights whose report names scale and turn", 1, 1, np.mean(named), "built so"
    )
    for said in found.blind[0]:
        report.note(f"  {said}")


def one_spacecraft(report, study: Study, n: int) -> None:
    """A filter without scale and misalignment against one with them, on flights of one spacecraft."""
    keys = jax.random.split(jax.random.fold_in(KEY, 2), 2 * n).reshape(2, n)
    seen, fresh = (study.fly(some.at[0].set(keys[0, 0]), same=True)[0] for some in keys)
    plain = lambda theta: study.build(theta | dict(scale=zeros(), turn=zeros()))
    said = "calibrations: without scale and misalignment against with them"
    compared(report, said, study.model, (plain, study.build), study, seen, fresh)


def compared(report, said: str, model, builds, study: Study, seen, fresh) -> None:
    """Two models fitted to the flights ``seen``, judged on fresh ones."""
    scores = []
    for build in builds:
        found = identify.fit(model, build, study.start, seen, spread=study.spread)
        scores.append(identify.held_out(model, build, found.theta, fresh))
    gain = identify.compare(*scores)
    report.note(f"{said}: {gain.value:.1f} +- {gain.error:.1f} nats a flight better on fresh flights")
    report.within(f"{said}: gain over its error", 2, None, gain.value / gain.error, "held-out flights")


def blind(report, n: int) -> None:
    """Cases built to have directions that no data tell: all of them are named, and no others."""
    flights = walks(n, 400)
    for case, (build, more, wide, expected) in BLIND.items():
        found = identify.fit(WALK, build, WALK_START | more, flights, spread=WALK_SPREAD | wide, each=True)
        right = [matches(words, expected, WALK_START | more) for words in found.blind]
        report.within(
            f"{case}: share of {n} flights with those directions named and no other", 1, 1, np.mean(right), "built so"
        )
        report.note(f"  {'; '.join(found.blind[0])}")
    clear = identify.fit(WALK, plain_walk, WALK_START, flights, spread=WALK_SPREAD, each=True)
    report.within(
        "nothing blind: share of flights that name a direction",
        0,
        0,
        np.mean([bool(w) for w in clear.blind]),
        "built so",
    )


def matches(words, expected, theta) -> bool:
    """Whether each sentence names the numbers of one of the expected directions, and each direction has its sentence."""
    named = [{name for name in theta if name in said} for said in words]
    return len(named) == len(expected) and all(direction in named for direction in expected)


def sampled(report) -> None:
    """The posterior of long flights beside Laplace's deviations."""
    flights = walks(4, 1000)
    laplace = identify.fit(WALK, plain_walk, WALK_START, flights, spread=WALK_SPREAD)
    try:
        draws = identify.posterior(WALK, plain_walk, WALK_START, flights, jax.random.key(7), spread=WALK_SPREAD,
                                   draws=4000, warmup=150)  # fmt: skip
    except ImportError as error:
        report.note(f"posterior: left out, {error}")
        return
    ratio = [float(np.std(draws.theta[i]) / laplace.std[i]) for i in WALK_START]
    off = [float((np.mean(draws.theta[i]) - laplace.theta[i]) / laplace.std[i]) for i in WALK_START]
    report.within(
        "posterior: deviation of the draws over Laplace's", 0.9, 1.1, ratio, "Gaussian where there is much data"
    )
    report.check("posterior: mean of the draws less the fit, in deviations", 0, off, 0.1, "Gaussian")
    report.note(f"posterior: effective draws {draws.effective.round()}, divergent {draws.divergent:.1%}")
