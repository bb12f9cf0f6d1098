"""Loss of a control moment gyro: gains, steering and rearrangement by gradient, and where the gradient lies.

A gradient says what an infinitesimal step does. Near a singularity of the remaining modules the pseudo-inverse
commands rates far beyond the drives' limit, and the gimbals shake between the two ends of it. There the gradient is
right, as central differences show, and useless: a step of one per cent does something else. To round the corners of
the limit (tanh) makes it worse: the hard limit at least lets no change through while it is met. The robust inverse,
which does not command such rates, gives gradients that tell what a step does to the body rate.

Scenarios come from three seeds: one to tune on, one to choose by, one for the verdict, which chose nothing.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.cmg_loss import FOUR, LOOKS, informed, stacked
from experiments.report import plt
from experiments.tuning.compare import (
    contest,
    descent,
    gradient_price,
    one_by_one,
    paired_ratio,
    paired_share,
    told,
)
from jaxatt import scores, simulate, sweep, tune, varied
from jaxatt.cmg import Steering
from jaxatt.loops import cmg_loss as cmg
from jaxatt.loops.cmg_loss import DT, PROPER, Params
from jaxatt.plot import COLOURS, LINES, MARKS
from jaxatt.vec import Vec3

TUNE, CHOOSE, VERDICT = range(3)  # seeds
KEY = jax.random.key(TUNE)  # the loop draws no noise
SYSTEM = cmg.system._replace(substeps=1)  # 10 ms plant steps: they keep the shares of the classes (Monte Carlo)


def run(report) -> None:
    """Both studies."""
    evidence(report)
    tuned(report)


# where the gradient lies

LAWS = {  # with K_I as printed: whether the drives' limit has its corners rounded, and the steering
    "pseudo-inverse": (0.0, Params()),
    "pseudo-inverse, tanh limit": (1.0, Params()),
    "robust inverse": (0.0, Params(steering=Steering(lam0=0.01))),
}
STARTS = {  # structure and gimbal angles [deg]
    "pyramid, smooth": ("pyramid", (45, 45, 45, 45)),
    "pyramid, shaking": ("pyramid", (-95, 90, 85, 95)),
    "box-90, shaking": ("box-90", (-95, 90, 85, 95)),
    "box-90, stuck": ("box-90", (-90, 90, 90, 95)),
}
SPREAD = 0.05  # [deg] of the gimbal angles around each start; the first of them is the start itself
HORIZONS = np.array([1, 2, 5, 10, 20, 40, 60])  # [s]
LITTLE, STEP = 1e-6, 1e-2  # steps in ln K_P: of a central difference, and of a search


class Case(NamedTuple):
    """A scenario and what flies in it, so that a batch holds designs beside each other."""

    rounded: Any  # 1: the drives follow u_max tanh(u / u_max), 0: u clipped to u_max
    params: Params
    day: cmg.Scenario


def rounded_tick(_, case: Case, now, x, z, noise):
    """A tick of the loop, the corners of the drives' limit rounded where the case says so."""
    x, z, log = cmg.tick(case.params, case.day, now, x, z, noise)
    most = case.day.u_max
    smooth = jnp.where(cmg.failed(case.day, now), 0, most * jnp.tanh(z.computer.u / most))
    return x, z._replace(drive=z.drive._replace(u=jnp.where(case.rounded > 0, smooth, z.drive.u))), log


CASES = SYSTEM._replace(
    init=lambda _, case: cmg.init(case.params, case.day),
    tick=rounded_tick,
    flow=lambda _, case, t, x, z: cmg.flow(case.params, case.day, t, x, z),
    check=lambda _, case: cmg.refuse_bad(case.params, case.day),
)


def curves(log_factor, case: Case, ticks: int):
    """Costs over time, K_P times exp(log_factor): one number a second, two costs of shape (seconds,).

    Rate: integral of |w|^2 / |w(0)|^2 [s]. Wear: total variation of the gimbal rates [rad/s].
    """
    changed = case.params._replace(k_p=case.params.k_p * jnp.exp(log_factor))
    log = simulate(CASES, (), case._replace(params=changed), KEY, ticks=ticks)
    square = log.w @ log.w
    each = round(1 / DT)
    return jnp.cumsum(square)[each::each] * DT / square[0], jnp.cumsum(log.variation)[each::each]


@partial(jax.jit, static_argnums=2)
def along(log_factors, cases: Case, ticks):
    """`curves` of cases (n, ...), and their derivatives by ln K_P: two pairs of arrays (n, seconds)."""
    one = lambda f, case: jax.jvp(lambda a: curves(a, case, ticks), (f,), (jnp.ones_like(f),))
    return jax.vmap(one)(log_factors, cases)


def evidence(report) -> None:
    """Gradient, central difference and what a real step does, as the horizon grows."""
    n, ticks = (4 if report.quick else 16), 6001
    rng = np.random.default_rng(TUNE)
    cases = []
    for structure, gamma in STARTS.values():
        moved = np.array(gamma) + SPREAD * rng.uniform(-1, 1, (n, 4)) * (np.arange(4) < 3) * (np.arange(n) > 0)[:, None]
        days = [cmg.lost(FOUR[structure], g) for g in moved]
        cases += [Case(rounded, *informed(params, day)) for rounded, params in LAWS.values() for day in days]
    cases = stacked(cases)
    zero = np.zeros(len(STARTS) * len(LAWS) * n)
    shape = (len(HORIZONS), len(STARTS), len(LAWS), n)

    def at(step):
        both = along(zero + step, cases, ticks)
        return [[np.asarray(a).T[HORIZONS - 1].reshape(shape) for a in costs] for costs in both]

    gradient = at(0.0)[1]
    little = [(up - down) / (2 * LITTLE) for up, down in zip(at(LITTLE)[0], at(-LITTLE)[0])]
    step = [(up - down) / (2 * STEP) for up, down in zip(at(STEP)[0], at(-STEP)[0])]

    report.note("median over starts within 0.05 deg, derivative of the 60 s costs by ln K_P, and the share of starts")
    report.note("where it tells what a step of 1 % in K_P does, to 20 %; rate cost [s], wear [rad/s]")
    honest = []
    for cost in range(2):
        scale = np.abs(gradient[cost]) + np.abs(step[cost]) + 1e-12
        honest.append(np.abs(gradient[cost] - step[cost]) <= 0.2 * scale / 2)
    for i, start in enumerate(STARTS):
        for j, law in enumerate(LAWS):
            words = []
            for cost, name in enumerate(("rate", "wear")):
                g, d, s = (np.median(np.abs(a[cost][-1, i, j])) for a in (gradient, little, step))
                words.append(
                    f"{name}: gradient {g:9.3g}, difference {d:9.3g}, 1 % step {s:9.3g}, told {honest[cost][-1, i, j].mean():4.0%}"
                )
            report.note(f"{start:20} {law:30} " + "; ".join(words))
    error = np.max([np.abs(g / d - 1)[:, 0, :, 0] for g, d in zip(gradient, little)])
    report.within("gradient / central difference - 1, smooth start", None, 1e-5, error, "float64, both costs, to 60 s")
    m = len(zero) // len(LAWS)
    factors = np.geomspace(0.8, 1.25, m)
    exact = cmg.lost(FOUR["pyramid"], STARTS["pyramid, shaking"][1])
    ridge = stacked([Case(*law, exact) for law in LAWS.values() for _ in range(m)])
    terrain = [np.asarray(a)[:, -1].reshape(-1, m) for a in along(np.tile(np.log(factors), 3), ridge, ticks)[0]]
    evidence_figure(report, gradient[0], step[0], honest[0], factors, terrain[1])


def evidence_figure(report, gradient, step, told_right, factors, wear) -> None:
    """Of the rate cost: gradient and real step over the horizon, how often they agree; and the wear over K_P."""
    fig, axes = plt.subplots(3, 3, figsize=(12, 9), layout="constrained", sharey="row")
    for j, law in enumerate(LAWS):
        for i, (start, colour, line, mark) in enumerate(zip(STARTS, COLOURS, LINES, MARKS)):
            look = dict(color=colour, ls=line, marker=mark, ms=4)
            axes[0, j].plot(HORIZONS, np.median(np.abs(gradient[:, i, j]), -1), label=start, **look)
            axes[0, j].plot(HORIZONS, np.median(np.abs(step[:, i, j]), -1), mark, color=colour, mfc="none", ms=9)
            apart = 0.02 * (i - 1.5)  # or one curve would hide another
            axes[1, j].plot(HORIZONS, told_right[:, i, j].mean(-1) + apart, **look)
        axes[0, j].set(title=law, yscale="log", ylim=(1e-5, 1e12))
        axes[1, j].set(ylim=(-0.05, 1.05))
        for ax in axes[:2, j]:
            ax.set(xscale="log", xlabel="horizon [s]")
            ax.set_xticks(HORIZONS, [str(h) for h in HORIZONS])
            ax.minorticks_off()
        axes[2, j].plot(factors, wear[j], color=COLOURS[1], marker=".", lw=0.8)
        axes[2, j].set(xlabel="$K_P$ / the paper's [1]", yscale="log", ylim=(0.5 * wear.min(), 2 * wear.max()))
        for ax in axes[:, j]:
            ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("|d rate cost / d ln $K_P$| [s], median;\nhollow: a 1 % step")
    axes[1, 0].set_ylabel(
        f"share of {gradient.shape[-1]} starts where the\ngradient tells a 1 % step to 20 % [1]\n(curves 0.02 apart)"
    )
    axes[2, 0].set_ylabel("wear over 60 s from pyramid\n[-95, 90, 85, 95] deg [rad/s]")
    axes[0, 0].legend(fontsize=8, loc="upper left")
    report.figure("where_the_gradient_lies", fig)


# gains, steering and rearrangement

BASES = {"pyramid": (-90, 90, 90, 95), "box-90": (-90, 90, 90, 95)}  # both shake, [deg]
LIMIT = np.radians(5.0)  # of the rearrangement
STD_H = 0.15  # [N m s] per axis, total momentum at the start
SECONDS = 30
WEAR = 1e-3  # [s^4/rad^2] price of the mean square acceleration of the gimbals, against the rate's energy
NAMES = ("K_P [1/s]", "K_I [1/s^2]", "lam0", "mu", "dither")
START = np.concatenate([np.log([0.2, 0.02, 0.01, 10.0, 0.1]), np.zeros(6)])


def momenta(seed: int, n: int) -> np.ndarray:
    """Initial total momenta, (n, 3) [N m s]."""
    return STD_H * np.random.default_rng([seed, 11]).normal(size=(3, n)).T


def days(h, shift):
    """Scenarios (2 n, ...): momenta h (n, 3) in the pyramid, then in box-90, gimbals rearranged by shift (2, 3) [rad]."""

    def of(day, shift):
        moved = day.gamma + jnp.append(shift, 0.0)  # the lost module is not rearranged
        return jax.vmap(lambda h: day._replace(h=Vec3.of(h), gamma=moved))(h)

    both = [of(cmg.lost(FOUR[name], gamma), a) for (name, gamma), a in zip(BASES.items(), shift)]
    return jax.tree.map(lambda *a: jnp.concatenate(a), *both)


def design(theta) -> tuple[Params, Any]:
    """Gains and steering, and the rearrangement (2, 3) [rad], of theta (11,): logarithms, and a bounded number each."""
    k_p, k_i, lam0, mu, dither = jnp.exp(theta[:5])
    steering = Steering(lam0=lam0, mu=mu, dither=dither)
    return Params(k_p=k_p, k_i=k_i, steering=steering), LIMIT * jnp.tanh(theta[5:].reshape(2, 3))


def costs(params: Params, scenarios):
    """Rate's energy over its start, priced wear added, of each of scenarios (n, ...), (n,)."""

    def one(scenario):
        log = simulate(SYSTEM, *informed(params, scenario), KEY, ticks=round(SECONDS / DT))
        square = log.w @ log.w
        return jnp.sum(square) * DT / square[0] + WEAR * SECONDS * jnp.mean(log.acceleration)

    return jax.vmap(one)(scenarios)


BEFORE = {
    "as printed": (Params(), np.zeros((2, 3))),
    "K_I = 0": (cmg.table5, np.zeros((2, 3))),
    "K_I = 0, grid rearranged": (cmg.table5, np.radians([[-5.0, 0, -5], [-5, 0, -5]])),
    "robust inverse": (LAWS["robust inverse"][1], np.zeros((2, 3))),
}


def tuned(report) -> None:
    """Tune, choose, judge."""
    n = 16
    steps = 6 if report.quick else 14
    here = momenta(TUNE, n)

    def mean_cost(theta, h):
        params, shift = design(theta)
        return jnp.mean(costs(params, days(h, shift)))

    cost = lambda theta, key: mean_cost(theta, here)
    _, history = tune(cost, START, OPTIMIZER, steps, KEY, forward=True)
    value = jax.jit(mean_cost)
    budget = 60 if report.quick else 160
    low, high = START - np.repeat([np.log(10), 2.5], [5, 6]), START + np.repeat([np.log(10), 2.5], [5, 6])
    contest(report, descent(history, gradient_price(START.size)), one_by_one(lambda x: value(x, here)), START, low, high,
            budget, "s", dearer=None, seeds=range(2))  # fmt: skip
    other = momenta(CHOOSE, n)
    best = history.theta[int(np.argmin([float(value(theta, other)) for theta in history.theta]))]
    params, shift = jax.tree.map(np.asarray, design(best))
    report.note("tuned: " + ", ".join(f"{name} {a:.3g}" for name, a in zip(NAMES, np.exp(best[:5]))))
    for (name, gamma), move in zip(BASES.items(), np.degrees(shift)):
        report.note(f"  {name} {list(gamma)} deg rearranged by {', '.join(f'{a:.2f}' for a in move)} deg")

    n = 64 if report.quick else 256
    h = momenta(VERDICT, n)
    runs = {name: judged(design, h) for name, design in (BEFORE | {"tuned": (params, shift)}).items()}
    after = runs["tuned"]
    for name, before in runs.items():
        shares = np.bincount(before["class"], minlength=3) / (2 * n)
        report.note(f"{name:26} proper {shares[0]:.3f}, lock {shares[1]:.3f}, fluctuation {shares[2]:.3f}; "
                    f"median settling {np.median(before['settling']):.1f} s, wear {before['wear'].mean():.3g} rad/s")  # fmt: skip
    report.note(f"verdict: {n} held-out momenta for each structure, 60 s")
    for name in BEFORE:
        before = runs[name]
        report.note(f"tuned against {name}:")
        report.note(told("  share proper", paired_share(before["class"] == PROPER, after["class"] == PROPER)))
        report.note(told("  cost", paired_ratio(before["cost"], after["cost"]), ratio=True))
        report.note(told("  rate energy [s]", paired_ratio(before["rate"], after["rate"]), ratio=True))
        report.note(told("  wear [rad/s]", paired_ratio(before["wear"], after["wear"]), ratio=True))
        ratio = paired_ratio(before["cost"], after["cost"])
        report.within(f"cost, tuned / {name}, upper end", None, 1.0, ratio.high, "held-out momenta, paired 95 %")
    printed = runs["as printed"]
    share = paired_share(printed["class"] == PROPER, after["class"] == PROPER)
    report.within(
        "share of proper runs, tuned less as printed, lower end", 0.0, None, share.low, "held-out, paired 95 %"
    )
    tuned_figure(report, runs, n)


OPTIMIZER = optax.adam(0.5, b2=0.9)


def verdict_score(params, scenario, now, log):
    """What the verdict looks at, beside the scores of the loop."""
    within = now.t < SECONDS
    square = log.w @ log.w
    return (
        cmg.score(params, scenario, now, log),
        scores.mean(square / log.w0**2, within),
        scores.mean(log.acceleration, within),
    )


def judged(design, h) -> dict:
    """Classes, costs and so on of a design on held-out momenta."""
    params, shift = design
    pairs = jax.vmap(lambda scenario: informed(params, scenario))(days(h, shift))
    got, rate, acceleration = sweep(varied(SYSTEM), (), pairs, KEY, ticks=6001, score=varied(verdict_score))
    cost = SECONDS * (rate + WEAR * acceleration)
    return dict(
        cost=cost, rate=SECONDS * rate, wear=got.variation, settling=got.settling, **{"class": cmg.classify(got)}
    )


def tuned_figure(report, runs: dict, n: int) -> None:
    fig, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained", sharey=True)
    for ax, (structure, part) in zip(axes, (("pyramid", slice(0, n)), ("box-90", slice(n, None)))):
        for x, name in enumerate(runs):
            cls, bottom = runs[name]["class"][part], 0.0
            for k, (label, colour, hatch) in enumerate(LOOKS):
                share = np.mean(cls == k)
                look = dict(color=colour, hatch=hatch, edgecolor="white")
                ax.bar(x, share, bottom=bottom, label=label if x == 0 else None, **look)
                bottom += share
        ax.set_xticks(
            range(len(runs)), [name.replace(", ", ",\n").replace("K_I", "$K_I$") for name in runs], fontsize=8
        )
        ax.set_title(f"{structure} {list(BASES[structure])} deg, {n} held-out momenta", fontsize=10)
    axes[0].set_ylabel("share of runs [1]")
    fig.legend(*axes[1].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    report.figure("classes_before_after", fig)
