"""Losses that plain sampling never meets: false alarms, a lost filter, a missed fault, and a gain tuned against one of them.

Each study asks for the probability that a score of a shipped loop exceeds a number, by `jaxatt.rare`, over eight decades.
Plain runs are counted beside it as far down as they reach. The reference numbers of the observer are those of an
independent implementation (96 repeats, 1.73 million runs).
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from experiments.report import interval
from jaxatt import Fault, on_axes, rare, scores, simulate, sweep
from jaxatt.loops import gyro_ekf as ekf
from jaxatt.loops import microsat as ms
from jaxatt.loops import observer_pd as op
from jaxatt.plot import COLOURS, GREY, LINES
from jaxatt.vec import Vec3, norm

KEY = jax.random.key(2000)
REFERENCE = "independent implementation"
AT_ONCE = 2**15  # plain runs of one sweep
DEG = np.pi / 180


def single(tree):
    """Every number of a tree in float32."""
    return jax.tree.map(lambda a: np.asarray(a, np.float32), tree)


class Study(NamedTuple):
    """An event of one loop."""

    title: str
    axis: str  # what the score is, with its unit
    unit: float  # of the axis in units of the score
    system: Any
    params: Any
    scenario: Any
    ticks: int
    score: Callable
    shipped: float  # threshold of the loop as it ships, or that the page speaks of
    above: float  # as far as the curve goes
    plain: tuple[int, int]  # runs counted, quick and full
    normals: int = 0  # random numbers of the scenario, which is a function then


# the events


def peak_residual(params, scenario, now, log):
    """Largest residual of the observer after its start."""
    return scores.peak(log.xi, now.k >= 100)


def lost_lock(params, scenario, now, log):
    """Largest error of an estimated angle once two gyros are dead."""
    return scores.peak(jnp.max(jnp.abs(log.filter.error[ekf.ANGLE])), now.t >= 25.0)


def false_safe_mode(params, scenario, now, log):
    """What drops the star tracker in the first logic, over its threshold: in the Earth's shadow nothing is left without it."""
    told = log.statistics
    return scores.peak(jnp.maximum(told.cross, told.nis_sum / params.limits.nis_sum), now.k >= ms.MASKED)


WEAR_ON = 5.0  # [s]


def unseen(params, scenario, now, log):
    """Time from the onset of wear until the wheel's CUSUM alarms."""
    return scores.alarm_time(now, log.statistics.wheel[0], params.limits.wheel, since=WEAR_ON)


def worn(u) -> ms.Scenario:
    """A wheel whose friction grows by half, give or take 10 % of that, at a momentum of .2 N m s, give or take .02."""
    first = np.arange(4) == 0
    wear = jnp.where(first, 1 + 0.5 * jnp.exp(0.1 * u[0]), 1.0)
    h = (0.2 + 0.02 * u[1]) * ms.NULL
    fault = ms.WheelFault(onset=np.where(first, WEAR_ON, np.inf), wear=wear)
    return ms.scenario._replace(wheel=fault, h=jnp.asarray(h, u.dtype))


def studies() -> dict[str, Study]:
    """All events by name."""
    healthy = on_axes(Fault())
    still = op.scenario._replace(star=healthy, gyro=healthy)
    two_dead = ekf.scenario.gyro._replace(onset=np.array([20.0, 20.0, np.inf, np.inf]))
    sat = single(ms.params)
    first_logic = sat._replace(limits=sat.limits._replace(arbiter=np.float32(0)))
    return {
        "observer_pd": Study(
            "observer_pd: residual of a healthy day", "peak residual, 10 to 30 s [MRP, rad/s]", 1.0,
            op.system, single(op.params), single(still), 300, peak_residual, 0.0040, 0.0044, (2**16, 10**7),
        ),
        "gyro_ekf": Study(
            "gyro_ekf: two of four gyros dead", "largest error of an estimated angle, 25 to 60 s [deg]", DEG,
            ekf.system, single(ekf.params), single(ekf.scenario._replace(gyro=two_dead)), 480, lost_lock,
            0.0065 * DEG, 0.007 * DEG, (2**13, 10**6),
        ),
        "safe_mode": Study(
            "microsat, first logic: healthy, in the Earth's shadow", "test of star samples over its threshold, 30 s", 1.0,
            ms.system, first_logic, single(ms.scenario._replace(t0=2500.0)), 300, false_safe_mode, 1.0, 1.15, (2**15, 10**6),
        ),
        "wheel": Study(
            "microsat: a wheel's friction grows by half", "time until the alarm [s]", 1.0,
            ms.system, sat, worn, 260, unseen, 10.0, 20.0, (2**15, 10**6), 2,
        ),
    }  # fmt: skip


# the studies


def run(report) -> None:
    """All studies, what their failures look like, and the gain that is tuned."""
    known, found, counted = studies(), {}, {}
    for i, (name, study) in enumerate(known.items()):
        found[name], counted[name] = probability(report, name, study, 10 * i)
    curves(report, known, found, counted)
    observer(report, known["observer_pd"], found["observer_pd"])
    common(report, known, found)
    tuned(report)


def timed(f: Callable):
    """f() and the CPU time [s] that it took."""
    start = time.process_time()
    result = f()
    return result, time.process_time() - start


def estimate(study: Study, seed: int, quick: bool, **other):
    """The loss of a study; flags are checked, not warned of."""
    chains, repeats = 128, 4 if quick and study.score is not peak_residual else 8
    ask: dict[str, Any] = dict(ticks=study.ticks, score=study.score, above=study.above, normals=study.normals)
    ask |= dict(chains=chains, repeats=repeats)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        key = jax.random.fold_in(KEY, seed)
        return rare.probability(study.system, study.params, study.scenario, key, progress=False, **ask | other)


def counted_runs(study: Study, runs: int, seed: int) -> np.ndarray:
    """Scores of plain runs."""
    ask: dict[str, Any] = dict(ticks=study.ticks, score=study.score)

    def part(first: int):
        n = min(AT_ONCE, runs - first)
        key, draws = jax.random.split(jax.random.fold_in(jax.random.fold_in(KEY, seed), first))
        if study.normals:
            many = single(jax.vmap(study.scenario)(jax.random.normal(draws, (n, study.normals), np.float32)))
        else:
            many = jax.tree.map(lambda a: np.broadcast_to(a, (n, *np.shape(a))), study.scenario)
        return sweep(study.system, study.params, many, key, **ask)

    return np.concatenate([part(first) for first in range(0, runs, AT_ONCE)])


def exceeding(curve, b):
    """P, low and high of the curve at b, by lines in the logarithm; where no run came further, those at its end."""
    met = curve.p > 0
    return [np.exp(np.interp(b, curve.b[met], np.log(a[met]))) for a in (curve.p, curve.low, curve.high)]


def probability(report, name: str, study: Study, seed: int):
    """The loss of a study and the plain runs beside it, with what they must agree in."""
    loss = estimate(study, seed, report.quick)
    runs = study.plain[not report.quick]
    plain = counted_runs(study, min(runs, AT_ONCE), seed + 2)
    _, each = timed(lambda: counted_runs(study, 1024, seed + 3))
    if runs > len(plain):
        plain = counted_runs(study, runs, seed + 2)
    b = np.sort(plain)[-101]  # beyond it lie 100 of the plain runs
    p, low, high = exceeding(loss.curve, b)
    share, of_curve = 100 / runs, np.log(high / low) / 2 / 1.96
    apart = np.log(p / share) / np.hypot(of_curve, 0.1)  # a count of 100 is known to 10 %
    report.check(f"{name}: curve against {runs} plain runs, P = {share:.0e}", 0, apart, 2, "2 standard errors")
    at_shipped = [float(a) for a in exceeding(loss.curve, study.shipped)]
    report.within(f"{name}: 95 % interval, its upper end over P", 1, 3 if report.quick else 2, loss.high / max(loss.p, 1e-300),
                  "the interval is of use")  # fmt: skip
    if loss.p == 0:
        return loss, plain
    needed = (1 - loss.p) / (loss.p * loss.cv**2)
    report.note(
        f"{name}: P(score > {study.shipped:g}) = {at_shipped[0]:.2g} ({at_shipped[1]:.1g} to {at_shipped[2]:.1g})"
    )
    report.note(f"  {loss}; {needed / loss.runs:.2g} times fewer runs than plain sampling to the same spread")
    if not report.quick:
        _, cpu = timed(lambda: estimate(study, seed + 1, False))  # again, now that it is compiled
        ratio = needed * each / 1024 / cpu
        report.note(f"  {cpu:.0f} CPU s, {1e3 * each / 1024:.2g} ms a plain run: {ratio:.2g} times less CPU time")
    return loss, plain


def observer(report, study: Study, loss) -> None:
    """The observer's probabilities against those known; at full size also its nearest failures, which are not how it fails."""
    rows = (0.00323, 1.067e-3), (0.0036, 3.22e-5), (0.0038, 4.15e-6), (0.0040, 4.79e-7), (0.0044, 4.44e-9)
    for b, p in rows:
        measured = float(exceeding(loss.curve, b)[0])
        report.within(f"observer_pd: P(peak residual > {b}) / {p}", 0.65, 1.5, measured / p, REFERENCE)
    if report.quick:
        return
    for b, beta in ((0.0036, 6.040), (0.0040, 6.712)):
        points = rare.design_point(
            study.system, study.params, study.scenario, KEY, ticks=study.ticks, score=study.score, above=b, starts=3, steps=40
        )  # fmt: skip
        report.check(
            f"observer_pd: distance of the nearest failure beyond {b}", beta, float(points.beta[0]), 0.01, REFERENCE
        )
        report.check(f"observer_pd: score there over {b}", 1, (points.score / b).tolist(), 1e-4, "on the edge")
        report.note(
            f"  {points.form[0]:.1e} beyond a flat edge there, {exceeding(loss.curve, b)[0]:.1e} in truth: not how it fails"
        )


def curves(report, known, found, counted) -> None:
    """The exceedance curves of all studies, with plain runs on them."""
    fig, axes = plt.subplots(2, 2, figsize=(10, 7.5), layout="constrained")
    for ax, (name, study) in zip(axes.flat, known.items()):
        curve, plain = found[name].curve, np.sort(counted[name])
        x = curve.b / study.unit
        ax.fill_between(x, curve.low, curve.high, color=COLOURS[0], alpha=0.25, linewidth=0, label="95 % interval")
        ax.plot(x, curve.p, color=COLOURS[0], label="subset simulation")
        k = np.unique(np.geomspace(3, len(plain) / 2, 12).astype(int))
        low, high = np.array([interval(i, len(plain)) for i in k]).T
        p = k / len(plain)
        ax.errorbar(
            plain[-k - 1] / study.unit, p, [p - low, high - p], fmt="o", ms=3, color=COLOURS[1], label=f"{len(plain)} plain runs"
        )  # fmt: skip
        ax.axvline(study.shipped / study.unit, color=GREY, linestyle=LINES[1], label="limit")
        ax.set(
            yscale="log",
            ylim=(0.3 * curve.p[-1], 2),
            xlabel=study.axis,
            ylabel="probability of more",
            title=study.title,
        )
        ax.grid(alpha=0.3)
        ax.legend()
    report.figure("curves", fig)


# what failures have in common


def replayed(study: Study, loss):
    """Logs of all failures kept, every leaf leading with them."""
    again = lambda scenario, noise: simulate(study.system, study.params, scenario, noise, ticks=study.ticks)
    return jax.vmap(again)(loss.failures.scenario, loss.failures.noise)


BEFORE, AFTER = 60, 20  # ticks about the instant of a failure


def about(rows, at):
    """Rows (runs, ticks) about an instant of each, NaN beyond their ends."""
    filled = np.pad(np.asarray(rows, float), [(0, 0), (BEFORE, AFTER)], constant_values=np.nan)
    return np.stack([row[k : k + BEFORE + AFTER] for row, k in zip(filled, at)])


def common(report, known, found) -> None:
    """What the failures of two studies share: the draws that make them, and the test that they trip."""
    study, loss = known["observer_pd"], found["observer_pd"]
    log, noise = replayed(study, loss), loss.failures.noise
    xi = np.asarray(log.xi)
    peak = 100 + np.argmax(xi[:, 100:], axis=1)
    off = max(abs(xi[:, 100:].max(axis=1) / loss.failures.score - 1))
    report.check("observer_pd: failures replayed, score over that kept, less 1", 0, off, 1e-4, "the same run")
    report.within(
        "observer_pd: failures replayed, least score",
        study.above * (1 - 1e-4),
        None,
        xi[:, 100:].max(axis=1).min(),
        "they fail",
    )
    rows = np.arange(len(peak))
    w, w_hat = (np.stack([np.asarray(a) for a in v], axis=-1) for v in (log.w, log.estimate.w))
    apart = (w - w_hat + float(study.scenario.std_w) * noise[..., 3:])[rows, peak]
    along = np.einsum("fkj,fj->fk", noise[..., 3:], apart / np.linalg.norm(apart, axis=1, keepdims=True))
    gyro = about(along, peak)
    weight = loss.failures.weight / loss.failures.weight.sum()

    sat, lost = known["safe_mode"], found["safe_mode"]
    told = replayed(sat, lost).statistics
    tests = np.stack([np.asarray(told.cross), np.asarray(told.nis_sum) / float(sat.params.limits.nis_sum)])
    tests = np.where(np.arange(sat.ticks) >= ms.MASKED, tests, 0)
    groups = rare.groups(lost, tests.max(axis=2).T)
    at = tests.max(axis=0).argmax(axis=1)
    names = [("cross-check", "sum of NIS")[int(tests[:, i].max(axis=1).argmax())] for i in groups.index]
    for name, share, low, high in zip(names, groups.share, groups.low, groups.high):
        report.note(f"safe_mode: {share:.0%} ({low:.0%} to {high:.0%}) of the probability trips the {name}")

    fig, axes = plt.subplots(1, 3, figsize=(12, 4), layout="constrained")
    lags = np.arange(-BEFORE, AFTER)
    axes[0].axhline(0, color=GREY, linewidth=0.8)
    band(axes[0], lags * 0.1, gyro, weight, COLOURS[0], "failures: mean, 80 % of them")
    axes[0].set(
        title="observer_pd",
        xlabel="time from the peak [s]",
        ylabel="gyro noise along the residual [sigma]",
        xlim=(-3, 2),
    )
    for ax, test, name in zip(axes[1:], tests, ("cross-check", "sum of NIS")):
        for g in range(len(groups.index)):
            mine = groups.member == g
            part = lost.failures.weight[mine] / lost.failures.weight[mine].sum()
            band(ax, lags * 0.1, about(test[mine], at[mine]), part, COLOURS[g], f"{groups.share[g]:.0%} of failures")
        ax.axhline(1, color=GREY, linestyle=LINES[1], label="threshold")
        ax.set(
            title=f"microsat, safe mode: {name}", xlabel="time from the trip [s]", ylabel=f"{name} over its threshold"
        )
    for ax in axes:
        ax.legend(loc="upper left")
    report.figure("common", fig)


def band(ax, x, rows, weight, colour, label) -> None:
    """Weighted mean of rows, and the band of 80 % of them."""
    known = ~np.isnan(rows)
    mean = np.nansum(weight[:, None] * rows, axis=0) / np.maximum(np.sum(weight[:, None] * known, axis=0), 1e-300)
    ax.plot(x, np.where(known.any(axis=0), mean, np.nan), color=colour, label=label)
    seen = known.sum(axis=0) > 1
    low, high = np.full((2, rows.shape[1]), np.nan)
    low[seen], high[seen] = np.nanquantile(rows[:, seen], [0.1, 0.9], axis=0)
    ax.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)


# a gain tuned against a loss


def pointing_lost(params, scenario, now, log):
    """Largest true attitude error 20 to 40 s after a small error."""
    return scores.peak(norm(log.e_q), now.t >= 20.0)


def gains(theta):
    """Params of the logarithms of the attitude and the rate gain."""
    return op.params._replace(k_q=jnp.exp(theta[0]), k_w0=jnp.exp(theta[1]))


def tuned(report) -> None:
    """Attitude and rate gain of the observer's loop, moved down the gradient of ln P, judged on fresh keys."""
    healthy, rest, turn = on_axes(Fault()), Vec3(0.0, 0.0, 0.0), Vec3(0.05, 0.02, -0.06)
    near = op.scenario._replace(star=healthy, gyro=healthy, w=rest, w_hat=rest, q=turn, q_hat=turn)
    study = Study("", "", 1.0, op.system, None, single(near), 400, pointing_lost, 0.0, 5.5e-4, (0, 0))
    at = lambda theta, seed, **more: estimate(study._replace(params=single(gains(theta))), seed, report.quick, **more)
    slope = lambda theta, loss: rare.sensitivity(
        loss, op.system, gains, np.float32(theta), ticks=400, score=pointing_lost
    )
    theta = np.log([330.0, 125.0])

    first = at(theta, 100, **{} if report.quick else dict(repeats=32))
    told = slope(theta, first)
    report.note(f"tuned: {first} with the paper's gains; d ln P / d ln (k_q, k_w0) = {np.asarray(told.gradient)}")
    h = 0.2
    for i, name in enumerate(("k_q", "k_w0")) if not report.quick else ():
        ends = [at(theta + sign * h * (np.arange(2) == i), 101 + i, repeats=32) for sign in (1, -1)]
        difference = np.log(ends[0].p / ends[1].p) / (2 * h)
        error = np.hypot(np.hypot(ends[0].cv, ends[1].cv) / (2 * h), float(told.error[i]))
        report.check(f"tuned: d ln P / d ln {name} against a central difference, +- 3 errors",
                     round(float(difference), 2), float(told.gradient[i]), 3 * float(error), "the same, by other means")  # fmt: skip

    path, p = [theta], [first.p]
    for step in range(2 if report.quick else 8):
        loss = at(path[-1], 200 + step)
        p.append(loss.p)
        if loss.p == 0 or not len(loss.levels):
            break
        g = np.asarray(slope(path[-1], loss).gradient, float)
        path.append(path[-1] - 0.25 * g / np.linalg.norm(g))
        report.note(f"tuned: step {step}: gains {np.exp(path[-2]).round(1)}, {loss.p:.2g}")
    best = path[int(np.argmin(p[1 : len(path)]))] if len(p) > 1 else theta
    before, after = at(theta, 300), at(best, 301)
    report.note(f"tuned: fresh keys: {before}; with gains {np.exp(best).round(1)}: {after}")
    report.within("tuned: P with the paper's gains over P tuned, fresh keys, its lower end", 1.0, None,
                  before.low / max(after.high, 1e-300), "the intervals lie apart")  # fmt: skip
