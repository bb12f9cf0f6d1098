"""Wheel test bed: outer gain K, adaptation gain gamma and estimator gain P0 by gradient; where stick-slip spoils it.

The law adapts once per tick, as a computer would, and gamma is bounded by what the sampling bears at the fastest wheel
speed (with continuous adaptation more is always better, until the integrator ends it). The day brings a true inertia, wheel friction and a loss of effectiveness; the platform always starts at rest at
zero, for the loop has no other start. Three seeds: one to tune on, one to choose the point of the search, one for the
verdict, on a finer integration, of which nothing was chosen.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.report import interval, plt
from experiments.tuning import compare
from experiments.wheel_mrac import HARDWARE
from jaxatt import scores, sweep, tune
from jaxatt.compiling import jitted
from jaxatt.controllers import Adaptation
from jaxatt.faults import Fault
from jaxatt.loops import wheel_mrac as wm
from jaxatt.plot import COLOURS, LINES, MARKS
from jaxatt.tuning import bounded, gradient_check, value_and_gradient
from jaxatt.wheels import Wheel

TICKS = 4501  # 0 to 90 s
TUNE, CHOOSE, JUDGE = 11, 12, 13  # seeds
NAMES = ("K", "gamma", "P0")
START = np.array([1.0, 1e-8, 1e-6])  # of the paper's hardware, as far as its words go
HEAVIEST = 6.4  # [kg m^2] largest true inertia of the scenarios
FASTEST = wm.fastest(wm.params) * HEAVIEST / wm.J_WHEEL  # [deg/s] wheel speed that its slew needs
STABLE = 0.5 / (wm.DT * 2 * FASTEST**2)  # [s/deg^2] gamma up to which the sampled law is stable there (choice 5)
LOW, HIGH = np.array([0.1, 1e-10, 1e-9]), np.array([30.0, STABLE, 1e-3])
GAINS = bounded(tuple(LOW), tuple(HIGH))
CHATTER = 1e-8  # [s^2] weight of the squared step of the desired wheel speed (docs/loops/wheel_mrac.md)
COARSE = wm.system_of(sampled=True, substeps=4)


def run(report) -> None:
    """Tune, choose, judge; compare with baselines; then stick-slip."""
    n = 128
    train = world(n, TUNE)
    cost = lambda gains, key: tuning_cost(gains, key, train)
    history, gradient = by_gradient(report, cost, steps=12 if report.quick else 25)
    chosen = choose(report, history, n)
    verdict(report, chosen, 512 if report.quick else 2048)
    against_baselines(report, cost, gradient, 60 if report.quick else 150, range(1 if report.quick else 3))
    stick_slip(report, 32 if report.quick else 128)


def shipped(gains):
    """Params with the gains (K [1/s], gamma [s/deg^2], P0 [1/(deg^2 s)])."""
    K, gamma, P0 = gains
    return HARDWARE._replace(J_hat=5.0, ope=1.0, K=K, law=Adaptation(gamma=gamma), P0=P0)


def world(n: int, seed: int):
    """n scenarios: true inertia within 20 % of 5.4 kg m^2, low-speed friction, effectiveness lost between 12 and 80 s."""
    rng = np.random.default_rng(seed)

    def draw(J_z, friction, onset, scale):
        return wm.scenario._replace(J_z=J_z, wheel=Wheel(friction=friction), drive=Fault(onset=onset, scale=scale))

    ranges = (4.4, HEAVIEST), (0.0, 3e4), (12.0, 80.0), (0.2, 1.0)
    return jax.vmap(draw)(*(rng.uniform(low, high, n) for low, high in ranges))


def terms(params, scenario, now, log):
    """The two terms of the cost: true error [deg^2] and steps of the desired wheel speed [deg^2/s^2]."""
    return scores.mean(log.error**2), scores.mean(log.step**2)


def each_cost(gains, key, scenarios, system=COARSE):
    """Cost of every scenario [1e-3 deg^2], shape (n,)."""
    error, step = sweep(system, shipped(gains), scenarios, key, ticks=TICKS, score=terms, progress=False)
    return 1e3 * (error + CHATTER * step)


def tuning_cost(gains, key, scenarios):
    """Its mean. NaN where a run diverges."""
    return jnp.mean(each_cost(gains, key, scenarios))


def by_gradient(report, cost, steps: int):
    """Adam on the logarithm of the cost, gains within bounds. Returns the history in gains, and its trace."""
    free = GAINS.free(tuple(START))
    key = jax.random.key(TUNE)
    logarithm = lambda free, key: jnp.log(cost(GAINS.within(free), key))
    checked = gradient_check(logarithm, free, key)
    report.check("gradient against central difference, relative", 0, float(checked.relative.max()), 1e-5, "issue: 1e-5")
    optimizer = optax.adam(optax.exponential_decay(1.0, 3, 0.6), b1=0.5, b2=0.9)  # a short memory for a short search
    _, history = tune(logarithm, free, optimizer, steps, key)
    history = history._replace(theta=jax.vmap(GAINS.within)(history.theta), cost=np.exp(history.cost))
    return history, compare.descent(history, compare.gradient_price(3))


def choose(report, history, n: int):
    """Of the five points with the least cost on the tuning seed the best on another one."""
    there, key = world(n, CHOOSE), jax.random.key(CHOOSE)
    points = np.stack(history.theta, axis=1)
    few = points[np.argsort(np.where(np.isfinite(history.cost), history.cost, np.inf))[:5]]
    judge = jitted(lambda gains: tuning_cost(gains, key, there))
    costs = [float(judge(x)) for x in few]
    chosen = few[int(np.nanargmin(costs))]
    report.note(
        f"chosen on another seed: cost {float(judge(START)):.4g} -> {min(costs):.4g} [1e-3 deg^2]; "
        + ", ".join(f"{name} {a:.3g} -> {b:.3g}" for name, a, b in zip(NAMES, START, chosen))
    )
    return chosen


def verdict(report, chosen, n: int) -> None:
    """Before and after on scenarios and noise that nothing was chosen on, at half the integration step."""
    fresh, key = world(n, JUDGE), jax.random.key(JUDGE)
    judge = lambda gains: sweep(
        wm.sampled, shipped(gains), fresh, key, ticks=TICKS, score=lambda *a: (wm.score(*a), terms(*a))
    )
    (before, terms_before), (after, terms_after) = judge(START), judge(chosen)
    both = before.ok & after.ok
    for name, s in (("before", before), ("after", after)):
        low, high = interval(int(np.sum(~s.ok)), n)
        report.note(f"runs that diverged, {name}: {np.sum(~s.ok)} of {n} (95 %: {low:.2g} to {high:.2g})")
    report.check("tuned: runs that diverge on fresh scenarios", 0, int(np.sum(~after.ok)), 0, f"{n} scenarios")
    cost = lambda terms: 1e3 * (terms[0] + CHATTER * terms[1])[both]
    change = compare.paired_ratio(cost(terms_before), cost(terms_after))
    report.note(compare.told("cost [1e-3 deg^2]", change, ratio=True))
    report.within("tuned / start, cost, upper end of 95 % interval", None, 1.0, change.high, f"{n} fresh scenarios")
    root = lambda a, axis: np.sqrt(np.mean(a, axis=axis))
    pairs = {
        "rms true error [deg]": (terms_before[0], terms_after[0], root),
        "rms step of r [deg/s]": (terms_before[1], terms_after[1], root),
        "peak true error, median [deg]": (before.peak, after.peak, np.median),
        "peak true error, 95 % below [deg]": (before.peak, after.peak, partial(np.quantile, q=0.95)),
        "peak after the fault, median [deg]": (before.peak_faulty, after.peak_faulty, np.median),
    }
    for name, (a, b, statistic) in pairs.items():
        report.note(compare.told(name, compare.paired_ratio(a[both], b[both], statistic, 1000), ratio=True))
    settled = [np.isfinite(s.settling_faulty[both]) & (s.settling_faulty[both] < 5) for s in (before, after)]
    report.note(compare.told("within 0.05 deg 5 s after the fault", compare.paired_share(*settled)))
    falsely = [s.false_alarms[both] > 0 for s in (before, after)]
    report.note(compare.told("runs with a false alarm of |y - y_m|", compare.paired_share(*falsely)))
    fig, ax = plt.subplots(figsize=(6, 4.5), layout="constrained")
    ax.loglog(before.peak[both], after.peak[both], ".", ms=3, color=COLOURS[0], alpha=0.4, label="a scenario")
    ends = [before.peak[both].min(), before.peak[both].max()]
    ax.plot(ends, ends, color="k", lw=0.8, label="no change")
    ax.set(
        xlabel="peak true error before [deg]",
        ylabel="after tuning [deg]",
        title=f"{both.sum()} scenarios that no choice was made on",
    )
    ax.grid(alpha=0.3)
    ax.legend()
    report.figure("before_after", fig)


def against_baselines(report, cost, gradient, budget: int, seeds) -> None:
    """Random search, CMA-ES and Nelder-Mead on the same cost, bounds and start."""
    key = jax.random.key(TUNE)
    value = jitted(lambda logs: cost(jnp.exp(logs), key))
    slope = jitted(lambda logs: value_and_gradient(lambda logs, key: cost(jnp.exp(logs), key), logs, key))
    start, low, high = np.log(START), np.log(LOW), np.log(HIGH)
    dearer = compare.cpu_ratio(slope, value, start)
    costs = compare.one_by_one(value)
    compare.contest(report, gradient, costs, start, low, high, budget, "$10^{-3}$ deg$^2$", dearer, seeds)


# stick-slip

SIZES = (0.0, 3e3, 1e4, 3e4, 1e5)  # [deg/s^2] friction, dead drive; b_p times the width of dead zone and gate
KINDS = ("friction", "dead_drive", "dead_zone", "gate")
STEPS = (1e-4, 1e-2, 0.3)  # of the central difference, in log K


def stuck(n: int):
    """n noisy slews for each kind and size of friction: scenarios of shape (kinds * sizes * n,)."""
    wheels = []
    for kind in KINDS:
        for size in SIZES:
            width = size / 20.0 if kind in ("dead_zone", "gate") else size  # b_p = 20 1/s
            wheels += [Wheel(**{kind: width})] * n
    wheel = jax.tree.map(lambda *a: np.array(a, float), *wheels)
    return jax.vmap(lambda wheel: wm.scenario._replace(wheel=wheel))(wheel)


def slopes(n: int):
    """d log cost / d log K of every run of `stuck`, exact and by central differences, shapes (kinds, sizes, n)."""
    scenarios, key = stuck(n), jax.random.key(JUDGE + 1)

    def each(log_K, noise):
        return jnp.log(each_cost((jnp.exp(log_K), START[1], START[2]), key, scenarios, wm.sampled))

    shape = (len(KINDS), len(SIZES), n)
    exact = jitted(lambda a: jax.jvp(lambda a: each(a, key), (a,), (1.0,))[1])
    value = jitted(lambda a: each(a, key))
    central = [np.asarray(value(h) - value(-h)).reshape(shape) / (2 * h) for h in STEPS]
    return np.asarray(exact(0.0)).reshape(shape), central


def stick_slip(report, n: int) -> None:
    """How far a gradient tells what a change of K will do, as friction grows."""
    exact, central = slopes(n)
    report.note("d log cost / d log K at K = 1 over runs that differ in noise only, and its central differences")
    report.note(
        "kind, size [deg/s^2]: mean +- std; median |exact / difference - 1| for steps 1e-4, 0.01, 0.3; same sign"
    )
    for i, kind in enumerate(KINDS):
        for j, size in enumerate(SIZES):
            g, d = exact[i, j], [c[i, j] for c in central]
            apart = ", ".join(f"{np.median(np.abs(g / c - 1)):.1e}" for c in d)
            same = np.mean(np.sign(g) == np.sign(d[-1]))
            report.note(f"  {kind:9} {size:8.0f}: {g.mean():9.3g} +- {g.std(ddof=1):8.2g}; {apart}; {same:.0%}")
    smooth = np.median(np.abs(exact[:, 0] / central[0][:, 0] - 1))
    report.within("no friction: median |gradient / central difference - 1|", None, 1e-5, smooth, "smooth case")
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    at = np.array([1e3, *SIZES[1:]])
    for i, kind in enumerate(KINDS):
        label, look = kind.replace("_", " "), dict(color=COLOURS[i], marker=MARKS[i])
        mean, spread = exact[i].mean(axis=1), exact[i].std(axis=1, ddof=1)
        left.semilogx(at, mean, ls=LINES[i], label=label, **look)
        left.fill_between(at, mean - spread, mean + spread, color=COLOURS[i], alpha=0.15, lw=0)
        for c, style, name in ((central[1], "-", "0.01"), (central[2], ":", "0.3")):
            apart = np.median(np.abs(exact[i] / c[i] - 1), axis=1)
            right.loglog(at, apart, ls=style, ms=4, label=f"{label}, step {name}", **look)
    left.set(ylabel="d log cost / d log K [1], mean and spread over runs", title="Exact gradient")
    right.set(ylabel="median |gradient / difference - 1| [1]", title="Against central differences")
    for ax in (left, right):
        ax.set_xlabel("friction, dead drive, $b_p$ x dead zone or gate [deg/s$^2$]")
        ax.set_xticks([1e3, 1e4, 1e5], ["none", "$10^4$", "$10^5$"])
        ax.grid(alpha=0.3)
        ax.legend(fontsize=7, ncols=1 if ax is left else 2)
    report.figure("stick_slip", fig)
