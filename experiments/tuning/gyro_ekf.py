"""Gyro failures: gains that need no filter, PID gains with it, and its noise levels, all by gradient.

1. Without the filter a dead gyro reads zero. The sampled, linearised loop is affine in the nine gains, so ten
   linearisations give its matrix for any gains, and its eigenvalues their gradient. One set of gains holds every
   subset of dead gyros but those with both B and C; and why not those.
2. With the filter: PID gains for all sixteen subsets, in forward mode through loop and filter.
3. Q and R by the likelihood of innovations, on recorded readings whose noise is not what the filter believes.

Scenarios come from three seeds: one to tune on, one to choose by, one for the verdict, which chose nothing.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.gyro_ekf import SIX_LOOKS, SUBSETS, mask
from experiments.report import plt
from experiments.tuning.compare import (
    contest,
    descent,
    gradient_price,
    one_by_one,
    paired_mean,
    paired_ratio,
    told,
)
from jaxatt import scores, simulate, sweep, tune
from jaxatt.contract import Now
from jaxatt.faults import dead_where
from jaxatt.linear import growth_rates, sampled
from jaxatt.loops import gyro_ekf
from jaxatt.loops.gyro_ekf import CONTROL, DEG, DT, INERTIA, Params, Scenario, direct, params
from jaxatt.plot import COLOURS, GREY
from jaxatt.soft_scores import growth_rate, penalty
from jaxatt.tuning import multi_start
from jaxatt.vec import Mat3, Vec3, array, inverse, largest, resultant

NAMES = ("k_p", "k_i", "k_d")
PERIOD = CONTROL * DT  # [s] between commands
TUNE, CHOOSE, VERDICT = range(3)  # seeds
QUASI_NEWTON = optax.lbfgs(learning_rate=1.0, memory_size=6, linesearch=None)  # one gradient a step


def run(report) -> None:
    """All three studies."""
    without_filter(report)
    pid_gains(report)
    noise_levels(report)


# without the filter: growth rates

HELD = [i for i, s in enumerate(SUBSETS) if not {"B", "C"} <= set(s)]  # subsets that some gains stabilise
BC = SUBSETS.index("BC")
MARGIN = 5e-3  # [1/s] wanted growth rate: below -MARGIN
BOX = np.log(100.0)  # search for BC: every gain from a hundredth to a hundred times the paper's


class Loops(NamedTuple):
    """The sampled loop of each subset: open + sum of gain / paper's gain times slope. State: integral, angle, w."""

    open: Any  # (16, 9, 9)
    slope: Any  # (9, 16, 9, 9), of K_P x, y, z, K_I x, y, z, K_D x, y, z


def scaled(factors) -> Params:
    """The paper's gains times factors (9,) or (3, 3): K_P, K_I, K_D of x, y, z."""
    gains = factors.reshape(3, 3) * np.array([[*getattr(params, name)] for name in NAMES])
    return params._replace(**{name: Vec3(*row) for name, row in zip(NAMES, gains)})


@jax.jit
def linearised(factors, J):
    """The matrix of one period without filter for every subset, (16, 9, 9).

    Of a satellite at rest with inertia J (3, 3), on which a dead gyro reads zero.
    """
    none, states = np.zeros(4), ("x.integral", "x.angle", "x.w")
    still = Scenario(w=Vec3(0.0, 0.0, 0.0), h=none, bias=none, announced=0.0, J=Mat3.of(J))
    period = lambda scenario: sampled(direct, scaled(factors), scenario, ticks=CONTROL, states=states)
    return jax.vmap(lambda dead: period(still._replace(gyro=dead_where(dead))))(mask(*SUBSETS))


def loops(coupling: float = 1.0) -> Loops:
    """Of a satellite at rest whose J_xy, J_xz and J_yz are so many times the paper's."""
    J = np.where(np.eye(3) > 0, 1.0, coupling) * np.array([[*row] for row in INERTIA])
    still = np.asarray(linearised(np.zeros(9), J))
    return Loops(still, np.stack([np.asarray(linearised(unit, J)) for unit in np.eye(9)]) - still)


def matrix(loops: Loops, log_factors, subsets):
    """Of some subsets at the paper's gains times exp(log_factors (9,))."""
    return loops.open[subsets] + jnp.tensordot(jnp.exp(log_factors), loops.slope[:, subsets], 1)


def growth(loops: Loops, log_factors) -> np.ndarray:
    """Growth rates of all subsets, (16,) [1/s]."""
    return growth_rates(matrix(loops, log_factors, np.arange(16)), PERIOD)[:, 0]


def margin_cost(loops: Loops, log_factors, key):
    """How far the held subsets miss the margin, and a small price for leaving the paper's gains."""
    rates = growth_rate(matrix(loops, log_factors, np.array(HELD)), PERIOD, 2000.0)
    return jnp.sum(penalty(1e3 * (rates + MARGIN))) + 0.01 * jnp.sum(log_factors**2)


def least_growth(several: list[Loops], starts: int, steps: int) -> np.ndarray:
    """The least growth rate of BC, for each of several loops, that searches from many starts find in the box [1/s]."""
    free = np.random.default_rng(TUNE).uniform(-1.5, 1.5, (starts, len(several), 9))

    def matrices(free):
        return [matrix(loops, BOX * jnp.tanh(a), BC) for loops, a in zip(several, free)]

    def cost(free, key):  # of loops that have nothing to do with each other: their searches go side by side
        return 1e3 * jnp.sum(growth_rate(jnp.stack(matrices(free)), PERIOD, 2e5))

    _, history = multi_start(cost, free, optax.adam(0.03), steps, jax.random.key(TUNE))
    met = jnp.concatenate([history.theta[::10].reshape(-1, len(several), 9), history.theta[-1]])
    rates = growth_rates(jnp.stack(jax.vmap(matrices)(met)), PERIOD)[..., 0]
    return rates.min(1)


def x_axis(p, q):
    """Matrix (..., 3, 3) of the x loop alone without rate feedback: integral, angle, rate times the period T.

    p = K_F K_P T^2 / (2 J), q = K_F K_I T^3 / (6 J).
    """
    p, q = np.broadcast_arrays(p, q)
    free = np.array([[1, 1, 0.5], [0, 1, 1], [0, 0, 1]])
    push = np.array([1 / 6, 0.5, 1.0])
    gain = np.stack([6 * q, 2 * p, 0 * p], axis=-1)
    return free - push[:, None] * gain[..., None, :]


def without_filter(report) -> None:
    """Part 1."""
    nominal = loops()
    paper = growth(nominal, np.zeros(9))
    anew = growth_rates(linearised(np.full(9, 1.3), np.array(INERTIA)), PERIOD)[:, 0]
    report.check("growth rates by the affine form at 1.3 x gains [1/s]", anew,
                 growth(nominal, np.full(9, np.log(1.3))), 1e-9, "the loop linearised there")  # fmt: skip

    theta, history = tune(partial(margin_cost, nominal), np.zeros(9), optax.adam(0.02), 400, jax.random.key(TUNE))
    theta = np.asarray(theta)
    tuned = growth(nominal, theta)
    report.note("factors on the paper's gains, x, y, z: " + "; ".join(
        f"{name} {', '.join(f'{a:.3g}' for a in row)}" for name, row in zip(NAMES, np.exp(theta).reshape(3, 3))))  # fmt: skip
    report.note("subset     growth [1e-3 1/s]  paper's gains  tuned")
    for s, a, b in zip(SUBSETS, paper, tuned):
        report.note(f"{s or 'none':8}  {1e3 * a:30.3f} {1e3 * b:8.3f}")
    for s in ("AB", "AC"):
        report.within(f"growth rate, {s} dead, no filter, tuned gains [1/s]", None, -2e-3, tuned[SUBSETS.index(s)],
                      "+0.0039 at the paper's gains")  # fmt: skip
    report.within("growth rate, all subsets without both B and C [1/s]", None, -2e-3, tuned[HELD], "one set of gains")
    simulated(report, theta)
    why_not_both(report, nominal)
    growth_figure(report, paper, tuned, history)


def simulated(report, theta) -> None:
    """The tuned gains in the full loop: noise, biases, wheels turning, held-out initial states."""
    n = 8 if report.quick else 32
    days = drawn(VERDICT, range(16), n)._replace(announced=np.zeros(16 * n))
    report.note(f"no filter, {n} held-out initial states for each subset, 2000 s: largest |angle| at the end [deg]")
    ends = []
    for factors in (np.ones(9), np.exp(theta)):
        got = sweep(direct, scaled(factors), days, jax.random.key(VERDICT), ticks=16001, score=gyro_ekf.score)
        ends.append(np.where(got.ok, got.final_error / DEG, np.inf).reshape(16, n))
    for s, before, after in zip(SUBSETS, *ends):
        report.note(f"{s or 'none':8} paper's gains {before.max():10.3g}, tuned {after.max():10.3g}")
    report.within("|angle| at 2000 s, subsets without both B and C [deg]", None, 0.01, ends[1][HELD].max(),
                  f"pointing band, {n} held-out states each")  # fmt: skip


def why_not_both(report, nominal: Loops) -> None:
    """B and C dead: the x axis has no rate feedback, and no gains make up for it."""
    # x alone: s^3 + k_p s + k_i has no s^2 term: the sum of its roots is 0, so one of them is not in the left half.
    # Sampled: with z = (1 + w) / (1 - w) the polynomial is (8 + 2q) w^3 - (4p + 2q) w^2 + (4p - 6q) w + 6q, and no
    # p, q of any sign give its coefficients one sign, which all roots in the left half would need.
    T, J_x = PERIOD, INERTIA.x.x
    p, q = params.k_f.x * params.k_p.x * T**2 / (2 * J_x), params.k_f.x * params.k_i.x * T**3 / (6 * J_x)
    x = np.array([0, 3, 6])
    block = np.asarray(matrix(nominal, np.zeros(9), BC))[np.ix_(x, x)]
    report.check("B and C dead: sum of the x rates, log det / T [1/s]", np.log1p(p - q) / T,
                 np.log(np.linalg.det(block)) / T, 1e-8, "sampled x loop in closed form; > 0")  # fmt: skip
    size = np.concatenate([-np.geomspace(20, 1e-6, 200), np.geomspace(1e-6, 20, 200)])
    radius = np.abs(np.linalg.eigvals(x_axis(*np.meshgrid(size, size)))).max(-1)
    report.within("B and C dead: spectral radius, x alone, 160 000 gains of any sign", 1.0, None, radius.min(),
                  "Hurwitz: never < 1")  # fmt: skip

    # within the box the x axis alone is least unstable at the least K_I
    factors = np.exp(np.linspace(-BOX, BOX, 20001))
    alone = growth_rates(x_axis(p * factors, q * np.exp(-BOX)), T)[:, 0].min()
    starts, steps = (16, 150) if report.quick else (128, 500)
    factors = (0.0, 1.0, 3.0, 10.0)
    least = least_growth([loops(f) for f in factors], starts, steps)
    report.relative("B and C dead: least growth in the box, no products of inertia", alone, least[0], 0.02,
                    "x alone at the least K_I")  # fmt: skip
    report.within("B and C dead: least growth in the box, the paper's inertia [1/s]", 0.0, None, least[1],
                  f"{starts} searches, gains 1/100 to 100 x")  # fmt: skip
    for f, g in zip(factors, least):
        report.note(
            f"  J_xy, J_xz, J_yz x {f:g}: least growth rate found {1e3 * g:.4f}e-3 1/s; x alone {1e3 * alone:.4f}e-3"
        )


def growth_figure(report, paper, tuned, history) -> None:
    fig, ax = plt.subplots(figsize=(9, 3.8), layout="constrained")
    place = np.arange(16)
    ax.bar(place - 0.2, 1e3 * paper, 0.4, color=COLOURS[0], label="paper's gains")
    ax.bar(place + 0.2, 1e3 * tuned, 0.4, color=COLOURS[1], label="tuned, one set for all")
    ax.axhline(0, color="k", lw=0.8)
    ax.axhline(-2, color=GREY, lw=0.8, ls="--")
    ax.set_xticks(place, [s or "none" for s in SUBSETS])
    ax.set(xlabel="dead gyros", ylabel="growth rate [1e-3 / s]", title="without the filter: positive rates diverge")
    ax.legend()
    report.figure("growth_without_filter", fig)


# scenarios of all studies


def drawn(seed: int, subsets, n: int) -> Scenario:
    """Every subset of dead gyros, by number, with the same n random initial states, wheel momenta and biases.

    They have the size of Table 6's; len(subsets) * n scenarios, subset by subset.
    """
    rng, m = np.random.default_rng([seed, 7]), len(subsets)
    normal = lambda k: np.tile(rng.normal(size=(k, n)), m).T
    dead = np.repeat(mask(*(SUBSETS[i] for i in subsets)), n, axis=0)

    def day(angle, w, h, bias, dead):
        return Scenario(angle=Vec3.of(angle), w=Vec3.of(w), h=h, bias=bias, gyro=dead_where(dead))

    return jax.vmap(day)(0.03 * DEG * normal(3), 0.02 * DEG * normal(3), 10.0 * normal(4), 0.02 * DEG * normal(4), dead)


# with the filter: PID gains

PRICE = 5e-6  # [rad^2 / (in-lbf)^2] of torque: 1 in-lbf counts as 0.13 deg
TICKS = 640  # 80 s: the transients of the PID loop
PID_BOX = np.log(8.0)  # searches: every gain from an eighth to eight times the paper's
STD_TORQUE, STD_WHEEL = 1e-7, 3e-4  # [rad/s], [in-lbf-s] per tick: random kicks on body and wheels
NORMALS = gyro_ekf.system.normals


class Trial(NamedTuple):
    """A scenario, and the gains that fly in it, so that candidates fly side by side."""

    gains: Any  # (6,) [1] logarithms of factors on the paper's K_P x, y, z, K_D x, y, z
    unrest: Any  # 1: random torques on the body and friction of the wheels, 0: none
    day: Scenario


class Flight(NamedTuple):
    """What a tick reports."""

    angle: Vec3  # [rad]
    w: Vec3  # [rad/s]
    torque: Vec3  # [in-lbf] commanded, on the body
    u: Any  # (4,) [in-lbf] commanded rates of wheel momentum
    readings: gyro_ekf.Readings


def pid(log_factors) -> Params:
    """Gains times exp(log_factors (6,)), K_I in step with K_P.

    The integral time K_P / K_I stays the paper's: with no lasting torque in the scenarios a search would switch the
    integral off.
    """
    p, d = Vec3(*jnp.exp(log_factors[:3])), Vec3(*jnp.exp(log_factors[3:]))
    times = lambda a, b: Vec3(*map(jnp.multiply, a, b))
    return params._replace(k_p=times(p, params.k_p), k_i=times(p, params.k_i), k_d=times(d, params.k_d))


def restless_tick(params: Params, trial: Trial, now, x, z, noise):
    """A tick of the loop with filter; random torques kick the body, random friction the wheels."""
    own = pid(trial.gains)
    kick = trial.unrest * STD_WHEEL * noise[NORMALS + 3 :]
    push = trial.unrest * STD_TORQUE * Vec3.of(noise[NORMALS : NORMALS + 3])
    push = push - inverse(trial.day.J) @ resultant(z.wheels, kick)
    x = x._replace(w=x.w + push, h=x.h + kick)
    aboard = params._replace(k_p=own.k_p, k_i=own.k_i, k_d=own.k_d)
    x, z, log = gyro_ekf.tick(aboard, trial.day, now, x, z, noise[:NORMALS])
    return x, z, Flight(log.angle, log.w, -resultant(z.wheels, log.u), log.u, z.readings)


restless = gyro_ekf.system._replace(
    init=lambda params, trial: gyro_ekf.init(params, trial.day),
    tick=restless_tick,
    flow=lambda params, trial, t, x, z: gyro_ekf.flow(params, trial.day, t, x, z),
    normals=NORMALS + 7,
    check=lambda params, trial: gyro_ekf.refuse_bad(params, trial.day),
)


def trials(log_factors, days: Scenario, unrest=0.0) -> Trial:
    """Every day under gains of log_factors (6,)."""
    return jax.vmap(lambda day: Trial(log_factors, unrest, day))(days)


def flights(params: Params, trials: Trial, seed: int) -> Flight:
    """Their logs, (n, TICKS, ...)."""
    keys = jax.random.split(jax.random.key(seed), len(trials.unrest))
    return jax.vmap(lambda trial, key: simulate(restless, params, trial, key, ticks=TICKS))(trials, keys)


def pid_costs(log_factors, days: Scenario, seed: int):
    """Mean square of angle and priced torque of every day, (n,) [rad^2]."""
    log = flights(params, trials(jnp.asarray(log_factors), days), seed)
    return jnp.mean(log.angle @ log.angle + PRICE * (log.torque @ log.torque), axis=1)


def pid_score(params, trial: Trial, now, log: Flight):
    """What the verdict looks at."""
    size, torque, late = log.angle @ log.angle, log.torque @ log.torque, now.t >= gyro_ekf.SETTLED
    early = now.t < TICKS * DT
    return dict(
        cost=scores.mean(size + PRICE * torque, early),
        angle=scores.rms(size, early),
        peak=scores.peak(largest(log.angle)),
        settling=scores.settling(now, ~(largest(log.angle) <= gyro_ekf.BAND)),
        late=scores.rms(size, late),
        torque=scores.rms(torque, early),
        peak_torque=scores.peak(largest(log.torque)),
        late_torque=scores.rms(torque, late),
    )


def pid_gains(report) -> None:
    """Part 2."""
    days = drawn(TUNE, range(16), 2)
    paper = float(jnp.mean(pid_costs(np.zeros(6), days, TUNE)))
    cost = lambda theta, key: jnp.mean(pid_costs(theta, days, TUNE)) / paper
    steps = 4 if report.quick else 14
    _, history = tune(cost, np.zeros(6), QUASI_NEWTON, steps, jax.random.key(TUNE), forward=True)

    budget = 60 if report.quick else 160
    price = gradient_price(6)
    contest(report, descent(history, price), one_by_one(lambda x: cost(x, None)), np.zeros(6),
                    np.full(6, -PID_BOX), np.full(6, PID_BOX), budget, "of the paper's gains", dearer=None, seeds=range(2), figure="budget_pid")  # fmt: skip

    # chosen on other states
    other = drawn(CHOOSE, range(16), 2)
    judged = [float(jnp.mean(pid_costs(theta, other, CHOOSE))) for theta in history.theta]
    best = history.theta[int(np.argmin(judged))]
    report.note(
        f"cost, of the paper's gains: tuned on {history.cost.min():.4f}, chosen on {min(judged) / judged[0]:.4f}"
    )
    report.note(
        "factors on the paper's gains, x, y, z: K_P and K_I {:.3g}, {:.3g}, {:.3g}; K_D {:.3g}, {:.3g}, {:.3g}".format(
            *np.exp(best)
        )
    )

    n = 8 if report.quick else 64
    fresh = drawn(VERDICT, range(16), n)
    got = []
    for theta in (np.zeros(6), best):
        key = jax.random.key(VERDICT)
        got.append(sweep(restless, params, trials(theta, fresh), key, ticks=4801, score=pid_score))
    before, after = ({k: np.asarray(v).reshape(16, n) for k, v in g.items()} for g in got)
    report.note(f"verdict: {n} held-out initial states, each with all 16 subsets; means over the subsets")
    for name, unit, what in VERDICT_TABLE:
        report.note(told(what, paired_ratio(before[name].mean(0) / unit, after[name].mean(0) / unit), ratio=True))
    ratio = paired_ratio(before["cost"].mean(0), after["cost"].mean(0))
    report.within(
        "PID cost of the 16-subset mean, tuned / paper's, held-out", None, 0.85, ratio.change, f"{n} initial states"
    )
    report.within("  upper end of its paired 95 % interval", None, 0.85, ratio.high, "bootstrap over states")
    report.within("  settling to 0.01 deg, all subsets [s]", None, 600.0, after["settling"].max(), "the run's end")
    pid_figure(report, before, after)


VERDICT_TABLE = [
    ("cost", 1.0, "cost, first 80 s [rad^2]"),
    ("angle", DEG, "rms angle, first 80 s [deg]"),
    ("peak", DEG, "peak angle [deg]"),
    ("settling", 1.0, "settling to 0.01 deg [s]"),
    ("late", DEG, "rms angle after 300 s [deg]"),
    ("torque", 1.0, "rms torque, first 80 s [in-lbf]"),
    ("peak_torque", 1.0, "peak torque [in-lbf]"),
    ("late_torque", 1.0, "rms torque after 300 s [in-lbf]"),
]


def pid_figure(report, before, after) -> None:
    fig, axes = plt.subplots(3, 1, figsize=(9, 7), sharex=True, layout="constrained")
    place = np.arange(16)
    rows = (
        ("angle", DEG, "rms angle, 80 s [deg]"),
        ("settling", 1.0, "settling to 0.01 deg [s]"),
        ("torque", 1.0, "rms torque, 80 s [in-lbf]"),
    )
    for ax, (name, unit, label) in zip(axes, rows):
        for offset, values, colour, who in (
            (-0.2, before, COLOURS[0], "paper's gains"),
            (0.2, after, COLOURS[1], "tuned"),
        ):
            mean = values[name].mean(1) / unit
            half = 1.96 * values[name].std(1, ddof=1) / unit / np.sqrt(values[name].shape[1])
            ax.bar(place + offset, mean, 0.4, yerr=half, color=colour, label=who, ecolor="0.3", capsize=2)
        ax.set_ylabel(label)
    axes[0].legend()
    axes[-1].set_xticks(place, [s or "none" for s in SUBSETS])
    axes[-1].set_xlabel("dead gyros")
    fig.suptitle("with the filter: mean over held-out initial states, 95 % interval")
    report.figure("pid_with_filter", fig)


# with the filter: Q and R from recorded readings

TRUE_STD = dict(std_angle=3e-4, std_gyro=4e-6, std_tacho=3e-4)  # [rad], [rad/s], [in-lbf-s]; Table 5: 1e-4, 1e-6, 1e-4
LEVELS = ("R angle", "R gyro", "R tacho", "Q angle", "Q rate", "Q wheel")
UNITS = ("rad^2", "rad^2/s^2", "in-lbf^2 s^2", "rad^2/s", "rad^2/s^3", "in-lbf^2 s")
TRUE = np.array([9e-8, 1.6e-11, 9e-8, np.nan, STD_TORQUE**2 / DT, STD_WHEEL**2 / DT])  # Q angle: none
PRINTED = np.array([1.0, 1e-2, 1.0, 1e-10, 1e-10, 1e-8])  # Table 5
FROM = 160  # [ticks] before, the innovations are those of the start


def filter_with(levels) -> Params:
    """The filter with the six levels (6,) and initial variances on the scale of its readings."""
    R = jnp.repeat(levels[:3], np.array([3, 4, 4]), total_repeat_length=11)
    Q = jnp.concatenate([jnp.repeat(levels[3:], np.array([6, 3, 4]), total_repeat_length=13), jnp.zeros(4)])
    return gyro_ekf.consistent(params)._replace(R=R, Q=Q)


def recorded(seed: int, n: int) -> Flight:
    """Readings, commands and truth of n flights, the gyros healthy, noise and kicks at their true levels."""
    days = drawn(seed, [0], n)
    days = days._replace(**{name: np.full(n, value) for name, value in TRUE_STD.items()})
    return flights(params, trials(np.zeros(6), days, unrest=1.0), seed)


def replayed(aboard: Params, log: Flight):
    """On-board code on the readings of one flight: (nll, nis, rows) of each update, errors of angles and rates (ticks, 6).

    The recorded command is the one the wheels followed.
    """
    _, z = gyro_ekf.init(aboard, Scenario())

    def tick(computer, now_and_log):
        k, y, u = now_and_log
        computer, (met, _) = gyro_ekf.decide(aboard, Now(k, k * DT, DT), computer, y)
        return computer._replace(u=u), ((met.nll, met.nis, met.rows), computer.belief.mean[3:9])

    _, (met, mean) = jax.lax.scan(jax.checkpoint(tick), z.computer, (jnp.arange(len(log.u)), log.readings, log.u))
    return met, jnp.concatenate([array(log.angle), array(log.w)]).T - mean


@jax.jit
def honesty(aboard: Params, logs: Flight):
    """Negative log-likelihood and NIS for each measurement, rms errors of angle [rad] and rate [rad/s]; each (n,)."""

    def one(log):
        (nll, nis, rows), error = replayed(aboard, log)
        rows = jnp.sum(rows[FROM:])
        rms = lambda part: jnp.sqrt(jnp.mean(jnp.sum(error[FROM:, part] ** 2, axis=1)))
        return dict(
            nll=jnp.sum(nll[FROM:]) / rows, nis=jnp.sum(nis[FROM:]) / rows, angle=rms(slice(0, 3)), w=rms(slice(3, 6))
        )

    return jax.vmap(one)(logs)


def noise_levels(report) -> None:
    """Part 3."""
    n = 16
    to_tune, to_choose = recorded(TUNE, n), recorded(CHOOSE, n)
    # Neither gain nor estimate changes when P, Q and R are all multiplied by one number; NIS tells which it should be.
    start = np.log(PRINTED * float(jnp.mean(honesty(params, to_tune)["nis"])))
    surprise = lambda theta, log: jnp.mean(honesty(filter_with(jnp.exp(theta)), log)["nll"])
    cost = lambda theta, key: surprise(theta, to_tune)
    # Adam comes near from anywhere; L-BFGS then follows the flat valley between Q and R of one sensor.
    adam = optax.adam(optax.linear_schedule(1.5, 0.1, 20), b1=0.5, b2=0.9)
    near, first = tune(cost, start, adam, 20, jax.random.key(TUNE), forward=True)
    _, second = tune(cost, near, QUASI_NEWTON, 12, jax.random.key(TUNE), forward=True)
    history = jax.tree.map(lambda *a: np.concatenate(a), first, second)
    judged = [float(surprise(theta, to_choose)) for theta in history.theta]
    best = history.theta[int(np.argmin(judged))]
    budget = 60 if report.quick else 200
    contest(report, descent(history, gradient_price(6)), one_by_one(lambda x: cost(x, None)), start,
            start - 16, start + 16, budget, "nat per measurement", dearer=None, seeds=range(2), figure="budget_noise")  # fmt: skip

    for name, a, b, c in zip(LEVELS, PRINTED, np.exp(best), TRUE):
        report.note(f"{name:8} Table 5 {a:8.3g}, tuned {b:8.3g}, true {c:8.3g}")
    known = np.isfinite(TRUE)
    report.check("Q and R tuned / true, decades", np.zeros(5), (best / np.log(10))[known] - np.log10(TRUE[known]), 0.1,
                 "levels the readings were made with")  # fmt: skip

    batches = [recorded(VERDICT + i, n) for i in range(8 if report.quick else 16)]
    truth = jnp.where(known, TRUE, 1e-30)
    before, after, oracle = (
        jax.tree.map(lambda *a: np.concatenate(a), *(honesty(aboard, log) for log in batches))
        for aboard in (params, filter_with(np.exp(best)), filter_with(truth))
    )
    report.note(f"verdict: {len(batches) * n} held-out flights of 80 s; Table 5 -> tuned, then the true levels")
    for name, unit, what in (("nll", 1.0, "NLL for each measurement"), ("nis", 1.0, "NIS for each measurement"),
                             ("angle", DEG, "rms error of angles [deg]"), ("w", DEG, "rms error of rates [deg/s]")):  # fmt: skip
        report.note(
            told(what, paired_mean(before[name] / unit, after[name] / unit))
            + f"; true levels {oracle[name].mean() / unit:.4g}"
        )
    report.check(
        "NIS for each measurement, tuned, held-out",
        1.0,
        after["nis"].mean(),
        0.02,
        "a filter that believes what is true",
    )
    gap = paired_mean(oracle["nll"], after["nll"])
    report.within(
        "NLL, tuned less that of the true levels, upper end [nat]", None, 0.01, gap.high, "held-out, paired 95 %"
    )
    for name, what in (("angle", "angles"), ("w", "rates")):
        ratio = paired_ratio(before[name], after[name])
        report.within(
            f"rms error of {what}, tuned / Table 5, upper end", None, 1.0, ratio.high, "held-out, bootstrap 95 %"
        )
    levels_figure(report, history, before, after)


def levels_figure(report, history, before, after) -> None:
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    for name, unit, line, level, look in zip(LEVELS, UNITS, history.theta.T / np.log(10), TRUE, SIX_LOOKS):
        left.plot(line, label=f"{name} [{unit}]", **look)
        if np.isfinite(level):
            left.plot(len(line) - 1, np.log10(level), "o", color=look["color"], mfc="none")
    left.set(xlabel="step of the search [1]", title="circles: the true levels")
    left.set(ylabel="log10 of the level [units of the legend]", ylim=(None, -1))
    left.legend(ncols=2, fontsize=8)
    top = 1e3 * max(before["angle"].max(), after["angle"].max()) / DEG
    bins = np.linspace(0, top, 40)
    for values, colour, name in ((before, COLOURS[0], "Table 5"), (after, COLOURS[1], "tuned")):
        right.hist(1e3 * values["angle"] / DEG, bins, color=colour, alpha=0.7, label=name)
    right.set(xlabel="rms error of the estimated angles [1e-3 deg]", ylabel="held-out flights [1]")
    right.legend()
    report.figure("noise_levels", fig)
