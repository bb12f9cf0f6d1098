"""Star-sensor isolation: window, threshold and believed gyro noise by gradient of a smooth surrogate.

An alarm is a step, and the gradient of a step is zero. The search therefore moves a surrogate: a window of real
length and a sigmoid in place of the step; every verdict is by the hard alarms of the loop itself. The filters run on
recorded readings, for the truth does not depend on them: only what the engineer ships is computed anew.

The day brings a small gyro bias, which the filters do not know, and a constant fault across the boresight of one
star sensor. A believed gyro noise that is too small makes the bias look like a fault; one that is too large lets the
filter swallow the fault. Three seeds: one to tune on, one to choose the whole window, one for the verdict.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.report import interval, plt
from experiments.star_isolation import drawn
from experiments.tuning import compare
from jaxatt import Fault, Vec3, detection, evaluation, plot, scores, simulate, soft_scores, sweep, tune
from jaxatt.compiling import compiled
from jaxatt.loops import star_isolation as si
from jaxatt.loops.star_isolation import DT, PITCH, ROLL
from jaxatt.star_filters import LMMSE
from jaxatt.tuning import bounded, gradient_check, value_and_gradient

SETTLED, ONSET, END = 200, 600, 700  # [ticks] of the tuning runs: false alarms count, fault, end
TUNE, CHOOSE, JUDGE = 21, 22, 23  # seeds
WITHIN = 10.0  # [s] after the onset in which a fault is to be found
PATIENCE = 1.0  # [s] that the verdict on the cause waits for the other filter
STD_BIAS = 1e-6  # [rad/s] gyro bias per axis, 0.2 deg/h
LONGEST = 50  # [1] longest window
WEIGHT = 2e4  # [s] of false alarms: one in 1e5 samples costs as much as 0.2 s of delay
TEMPERATURE = 1.0  # [1] of the soft alarm, in J: below the 2 that the tail of a chi-square number decays with
NAMES = ("window", "margin", "std_gyro")
LOW, HIGH = np.array([1.0, 3.0, 3e-7]), np.array([float(LONGEST), 15.0, 3e-5])
RULES = {  # window, margin, std_gyro: thresholds known before
    "paper (3 sigma, N = 1)": np.array([1.0, 24 / np.sqrt(6), 3e-6]),
    "textbook (moment 5, N = 10)": np.array([10.0, 5.0, 3e-6]),
}
START = RULES["textbook (moment 5, N = 10)"]
NUMBERS = bounded(tuple(LOW), tuple(HIGH))


class Recorded(NamedTuple):
    """Runs that were flown once; filters are run on their readings."""

    readings: Any  # of `simulate`, leaves (n, END, ...)
    q_hat: Any  # leaves (n, 2), initial estimates
    faulty: Any  # (n,) the faulty star sensor


def run(report) -> None:
    """Tune, choose, judge; compare with baselines; what the temperature does to the surrogate."""
    n = 128 if report.quick else 512
    train = recorded(n, TUNE)
    history, gradient = by_gradient(report, train, 10 if report.quick else 25)
    chosen = choose(report, history, recorded(n, CHOOSE))
    verdict(report, chosen, 512 if report.quick else 4096)
    against_baselines(report, train, gradient, 60 if report.quick else 150, range(1 if report.quick else 3))
    temperatures(report, train)


# scenarios


def world(n: int, seed: int, onset: Any = ONSET * DT):
    """n scenarios with a fault of 2 to 5 noise deviations of one star sensor, either sign; and which sensor."""
    rng = np.random.default_rng(seed)
    faulty = rng.integers(2, size=n)
    size = rng.uniform(2, 5, n) * rng.choice([-1, 1], n) * si.params.std_star / np.sqrt(2)  # on both tangential axes
    own = lambda sensor: np.where(faulty == sensor, size, 0)
    o = np.zeros(n)
    pair = Fault(onset=np.reshape(onset, (-1, 1)))
    pair = jax.tree.map(lambda a: np.broadcast_to(a, (n, 2)), pair)
    star = Vec3(
        pair._replace(bias=np.stack([o, own(PITCH)], axis=-1)),
        pair._replace(bias=np.stack([own(ROLL), o], axis=-1)),
        pair._replace(bias=np.stack([own(ROLL), own(PITCH)], axis=-1)),
    )
    bias = Vec3(*(STD_BIAS * rng.standard_normal((3, n))))
    return drawn(n, seed)._replace(star=star, bias=bias), faulty


def recorded(n: int, seed: int) -> Recorded:
    """The readings of n tuning runs."""
    scenarios, faulty = world(n, seed)
    keys = jax.random.split(jax.random.key(seed), n)
    fly = lambda scenario, key: simulate(si.system, si.params, scenario, key, ticks=END).readings
    return Recorded(jax.jit(jax.vmap(fly))(scenarios, keys), scenarios.q_hat, faulty)


# the surrogate


def threshold_of(window, margin):
    """Threshold on J: mean of its chi-square distribution and ``margin`` standard deviations."""
    return detection.threshold_moment(margin, 3 * window)


def residuals(params, data: Recorded):
    """r' M^-1 r of both filters at every tick but the first, shape (END - 1, n, 2).

    The filters alone: `jaxatt.replay.replay` would run the rest of the computer too, tangents and all.
    """

    def step(carry, told):
        filters, gyro = carry
        filters, innovation = si.advanced(LMMSE, params, filters, gyro, told.stars, DT)
        return (filters, told.gyro.value), innovation.nis

    def one(readings, q_hat):
        filters = jax.vmap(partial(LMMSE.start, params))(q_hat)
        first, later = (jax.tree.map(lambda a, part=part: a[part], readings) for part in (0, slice(1, None)))
        return jax.lax.scan(step, (filters, first.gyro.value), later)[1]

    return jax.vmap(one, out_axes=1)(data.readings, data.q_hat)


def evaluated(numbers, data: Recorded):
    """J of both filters with a window of real length, shape (END - 1, n, 2)."""
    window, _, std_gyro = numbers
    return soft_scores.soft_windowed(residuals(si.params._replace(std_gyro=std_gyro), data), window, LONGEST)


def terms_of(p, faulty):
    """Delay [s] and share of false alarms of every run, shape (n,) each, from alarms p, (END - 1, n, 2), 0 to 1."""
    first = faulty == ROLL
    own, other = jnp.where(first, p[..., ROLL], p[..., PITCH]), jnp.where(first, p[..., PITCH], p[..., ROLL])
    quiet = jnp.concatenate([own[SETTLED : ONSET - 1], other[SETTLED:]])  # what should be silent
    return soft_scores.soft_delay(own[ONSET - 1 :], DT), jnp.mean(quiet, axis=0)


def cost_of(delay, false):
    """Cost [s] of every run."""
    return delay + WEIGHT * false


def each_cost(numbers, data: Recorded, temperature=TEMPERATURE, hard: bool = False):
    """Cost [s] of every run, shape (n,); hard: by steps, with no gradient."""
    J, threshold = evaluated(numbers, data), threshold_of(*numbers[:2])
    p = 1.0 * (threshold < J) if hard else soft_scores.soft_alarm(J, threshold, temperature)
    return cost_of(*terms_of(p, data.faulty))


def tuning_cost(numbers, data: Recorded, temperature=TEMPERATURE):
    """Its mean."""
    return jnp.mean(each_cost(numbers, data, temperature))


def by_gradient(report, train: Recorded, steps: int):
    """Adam on the logarithm of the surrogate, numbers within bounds. Returns the history, and its trace."""
    on = lambda data: lambda free, key: jnp.log(tuning_cost(NUMBERS.within(free), data))  # no noise is drawn: no key
    off_the_kinks = NUMBERS.free((9.7, 5.0, 3e-6))  # the surrogate is linear in the window between whole numbers
    few = jax.tree.map(lambda a: a[:32], train)
    checked = gradient_check(on(few), off_the_kinks, jax.random.key(TUNE))
    report.check("gradient against central difference, relative", 0, checked.relative.max(), 1e-5, "issue: 1e-5")
    optimizer = optax.adam(optax.exponential_decay(0.5, 4, 0.6), b1=0.5, b2=0.9)  # a short memory for a short search
    _, history = tune(on(train), NUMBERS.free(tuple(START)), optimizer, steps, jax.random.key(TUNE))
    history = history._replace(theta=jax.vmap(NUMBERS.within)(history.theta), cost=np.exp(history.cost))
    return history, compare.descent(history, compare.gradient_price(3))


def choose(report, history, data: Recorded):
    """The point of least surrogate, its window rounded up or down: whichever has the lower hard cost elsewhere."""
    window, margin, std_gyro = np.stack(history.theta, axis=1)[np.argmin(history.cost)]
    points = [np.array([w, margin, std_gyro]) for w in (np.floor(window), np.ceil(window))]
    judge = compiled(lambda numbers: jnp.mean(each_cost(numbers, data, hard=True)), 0)
    costs = [float(judge(x)) for x in points]
    chosen = points[int(np.argmin(costs))]
    report.note(
        f"tuned: window {window:.2f}, margin {margin:.3f}, believed gyro noise {std_gyro:.3g} rad/s; on another seed "
        f"N = {chosen[0]:.0f} has the hard cost {min(costs):.3f} s, "
        + ", ".join(f"{name} {float(judge(x)):.3f} s" for name, x in RULES.items())
    )
    return chosen


# the verdict, by the loop itself


def hard_score(params, scenario, now, log):
    """The loop's delays, and what says whether it was luck: alarms and largest J before and after the onset."""
    onset = scenario.star.z.onset[ROLL]
    before, after = (now.t >= SETTLED * DT) & (now.t < onset), (now.t >= onset) & (now.t < onset + WITHIN)
    just_before = (now.t >= onset - WITHIN) & (now.t < onset)
    alarm, J = log.verdict.alarm, log.verdict.J
    return dict(
        delay=scores.first(now, alarm & after, since=onset),
        early=scores.first(now, alarm & before),
        rate=scores.mean(alarm, before),
        luck=scores.first(now, alarm & just_before, since=onset - WITHIN),
        healthy=scores.peak(J, just_before),
        faulty=scores.peak(J, after),
        ok=scores.always(scores.finite(J).all()),
    )


def judged(numbers, scenarios):
    """`hard_score` of the loop with a window, a margin and a believed gyro noise."""
    window, margin, std_gyro = (float(a) for a in numbers)
    params = si.params._replace(threshold=float(threshold_of(window, margin)), std_gyro=std_gyro)
    system = si.system_of(window=round(window))
    return sweep(system, params, scenarios, jax.random.key(JUDGE), ticks=END + 400, score=hard_score)


def verdict(report, chosen, n: int) -> None:
    """Every rule on fresh runs of 110 s whose fault comes at a random time from 60 to 100 s."""
    onset = np.random.default_rng(JUDGE + 1).uniform(60, 100, n)
    scenarios, faulty = world(n, JUDGE, onset)
    rules = {**RULES, "tuned": chosen}
    results = {name: judged(numbers, scenarios) for name, numbers in rules.items()}
    of = lambda a: a[np.arange(n), faulty]
    table = {}
    for name, s in results.items():
        delay = of(s["delay"])
        cause = detection.isolate_first(*s["delay"].T, patience=PATIENCE)
        by_luck = detection.isolate_first(*s["luck"].T, patience=PATIENCE)
        table[name] = dict(
            miss=~np.isfinite(delay),
            delay=np.minimum(np.where(np.isfinite(delay), delay, np.inf), WITHIN),
            false=np.isfinite(s["early"]).any(axis=1),
            right=np.asarray(cause) == faulty + 1,
            lucky=np.isfinite(of(s["luck"])),
            lucky_right=np.asarray(by_luck) == faulty + 1,
        )
        share = lambda a: "{:.4f} ({:.4f} to {:.4f})".format(a.mean(), *interval(int(a.sum()), n))
        t = table[name]
        report.note(
            f"{name}: N = {rules[name][0]:.0f}, threshold {float(threshold_of(*rules[name][:2])):.1f}, believed gyro "
            f"noise {rules[name][2]:.3g} rad/s, {n} fresh runs (95 % intervals)"
        )
        report.note(
            f"  missed for {WITHIN:g} s {share(t['miss'])}; found by chance {share(t['lucky'])}; mean delay, misses as "
            f"{WITHIN:g} s, {t['delay'].mean():.3f} s"
        )
        report.note(
            f"  right sensor {share(t['right'])}, by chance {share(t['lucky_right'])}; runs with a false alarm "
            f"{share(t['false'])}, {s['rate'].mean():.1e} per sample"
        )
        report.check(f"{name}: finite runs", n, int(s["ok"].sum()), 0, "all of them")
    tuned = table["tuned"]
    for name in RULES:
        report.note(f"tuned against {name}, paired")
        change = compare.paired_mean(table[name]["delay"], tuned["delay"])
        report.note(compare.told("  mean delay [s]", change))
        for key, label in (("miss", "  missed"), ("right", "  right sensor"), ("false", "  runs with a false alarm")):
            c = compare.paired_share(table[name][key], tuned[key])
            p = compare.mcnemar(table[name][key], tuned[key])
            report.note(compare.told(label, c) + (f", p = {p:.2g}" if p > 0 else ", p < 1e-300"))
        if name.startswith("paper"):
            report.within("tuned - paper, mean delay, upper end [s]", None, 0.0, change.high, f"{n} fresh runs")
    roc_figure(report, results, faulty)


def roc_figure(report, results, faulty) -> None:
    """Detection within 10 s against false alarms within 10 s, over all thresholds of each window and gyro noise."""
    fig, ax = plt.subplots(figsize=(6.5, 4.5), layout="constrained")
    for (name, s), colour, style in zip(results.items(), plot.COLOURS, plot.LINES):
        of = lambda a: a[np.arange(len(faulty)), faulty]
        healthy, bad = of(s["healthy"]), of(s["faulty"])
        curve = evaluation.roc(healthy, bad)
        lucky, found = np.isfinite(of(s["luck"])).mean(), np.isfinite(of(s["delay"])).mean()
        least = 0.5 / len(faulty)
        ax.step(np.maximum(curve.false_alarm, least), curve.detection, where="post", color=colour, ls=style, label=name)
        ax.plot(max(lucky, least), found, "o", color=colour, mec="black", ms=8)
        report.note(
            f"{name}: area under the ROC curve of 10 s windows {evaluation.area(curve):.4f}; found at false alarms of "
            f"1e-2 per window {evaluation.detection_at(healthy, bad, 1e-2):.4f}"
        )
    x = np.geomspace(0.5 / len(faulty), 1, 100)
    ax.plot(x, x, color=plot.GREY, ls=":", label="chance")
    ax.set(
        xscale="log",
        xlabel="share of healthy windows of 10 s with an alarm [1]",
        ylabel="share of faults found within 10 s [1]",
        title="Dots: the rules as shipped (left edge: no false alarm seen)",
        ylim=(0, 1.02),
    )
    ax.grid(alpha=0.3)
    ax.legend(loc="lower right")
    report.figure("roc", fig)


# was the gradient worth it, and can it be trusted


def against_baselines(report, train: Recorded, gradient, budget: int, seeds) -> None:
    """Random search, CMA-ES and Nelder-Mead on the same surrogate, bounds and start."""
    value = compiled(lambda logs, data: tuning_cost(jnp.exp(logs), data), 0)
    slope = compiled(
        lambda logs, data: value_and_gradient(lambda logs, data: tuning_cost(jnp.exp(logs), data), logs, data), 0
    )
    start, low, high = np.log(START), np.log(LOW), np.log(HIGH)
    dearer = compare.cpu_ratio(slope, value, start, train)
    costs = compare.one_by_one(lambda logs: value(logs, train))
    compare.contest(report, gradient, costs, start, low, high, budget, "s", dearer, seeds)


def temperatures(report, train: Recorded) -> None:
    """What the temperature does at the start: the surrogate leaves the hard cost, or its gradient drowns in noise."""
    window, margin, std_gyro = (*(START[:1] + 0.3), *START[1:])  # between two whole windows
    along = lambda margin, temperature, data: each_cost((window, margin, std_gyro), data, temperature)
    slope = compiled(lambda t, data: jax.jvp(lambda m: along(m, t, data), (margin,), (1.0,)), 0)
    hard = lambda m, data: each_cost((window, m, std_gyro), data, hard=True)
    steps = compiled(lambda m, data: jax.jvp(lambda m: hard(m, data), (m,), (1.0,)), 0)
    cost, zero = (np.asarray(a) for a in steps(margin, train))
    report.check("gradient of the hard cost in the margin", 0.0, float(np.abs(zero).max()), 0.0, "a step has none")
    wide = 0.25  # half the step of a difference that sees the hard cost's trend
    trend = float(np.mean(steps(margin + wide, train)[0] - steps(margin - wide, train)[0])) / (2 * wide)
    report.note(f"hard cost {cost.mean():.4f} s; its difference over +-{wide:g} of the margin {trend:.3f} s")
    levels = np.geomspace(0.03, 10, 6)
    gaps, errors, noises = [], [], []
    for level in levels:
        value, slopes = (np.asarray(a) for a in slope(float(level), train))
        gaps.append(abs(value.mean() / cost.mean() - 1))
        errors.append(abs(slopes.mean() / trend - 1))
        noises.append(slopes.std(ddof=1) / np.sqrt(slopes.size) / abs(slopes.mean()))
        report.note(
            f"temperature {level:6.3g}: surrogate {value.mean():9.4f} s; d/d margin {slopes.mean():9.3f} s, "
            f"{errors[-1]:.1%} from that difference, standard error over {slopes.size} runs {noises[-1]:.1%}"
        )
    fig, ax = plt.subplots(figsize=(6.5, 4), layout="constrained")
    for values, mark, colour, label in (
        (gaps, "o-", plot.COLOURS[0], "|surrogate / hard cost - 1|"),
        (errors, "^-.", plot.COLOURS[2], "|gradient / difference of the hard cost - 1|"),
        (noises, "s--", plot.COLOURS[1], "standard error of the gradient / its mean"),
    ):
        ax.loglog(levels, values, mark, color=colour, label=label)
    ax.axvline(TEMPERATURE, color=plot.GREY, ls=":", label="used")
    ax.set(xlabel="temperature of the soft alarm, in J [1]", ylabel="share [1]")
    ax.grid(alpha=0.3)
    ax.legend()
    report.figure("temperature", fig)
