"""When gradients lie: what a gradient says against what a change of the number really does, as runs grow longer.

A gradient is exact for the run it was taken of, to rounding. What a search needs is another thing: what becomes of
the cost when the number changes by a useful amount, here 2 %. The two part where the cost has structure finer than
that: behind a hard threshold, in stick-slip, and in a loop that amplifies small differences.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from jaxatt import objectives, scores, sweep
from jaxatt.engine import compiled
from jaxatt.faults import Fault, on_axes
from jaxatt.systems import cmg_loss as cmg
from jaxatt.systems import observer_pd as op
from jaxatt.systems import wheel_mrac as wm
from jaxatt.vec import norm

CHANGE = 0.02  # of the logarithm of the number, to either side


class Case(NamedTuple):
    """A loop, the number that is changed, and what is looked at."""

    label: str
    system: Any
    params: Callable  # logarithm of a factor on the number -> params
    scenarios: Any
    cost: Callable  # (params, log) -> the cost of one tick
    horizons: Any  # [s] increasing


class Evidence(NamedTuple):
    """Gradient and difference of the mean cost up to each horizon; arrays (horizons, n), one run each."""

    horizons: Any  # (horizons,) [s]
    cost: Any
    gradient: Any
    difference: Any  # (cost(+CHANGE) - cost(-CHANGE)) / (2 CHANGE)

    def right_sign(self):
        """Share of runs, (horizons,), whose gradient has the sign of the difference; zeros count as wrong."""
        return np.mean(self.gradient * self.difference > 0, axis=1)

    def disagreement(self):
        """|gradient - difference| over the larger of the two, median over runs, (horizons,)."""
        larger = np.maximum(np.abs(self.gradient), np.abs(self.difference))
        return np.median(np.abs(self.gradient - self.difference) / np.where(larger > 0, larger, 1), axis=1)

    def spread(self):
        """Standard deviation of the gradient over runs, in sizes of its mean difference, (horizons,)."""
        return self.gradient.std(axis=1) / np.abs(self.difference.mean(axis=1))


def evidence(case: Case, key) -> Evidence:
    """The costs of all runs of a case, their gradient and their difference in the number."""
    ticks = round(case.horizons[-1] / case.system.dt)

    def score(params, scenario, now, log):
        cost = case.cost(params, log)
        return [scores.mean(cost, now.t < horizon) for horizon in case.horizons]

    def costs(change, scenarios, key):
        swept = sweep(case.system, case.params(change), scenarios, key, ticks=ticks, score=score, progress=False)
        return jnp.stack(swept)

    slope = compiled(lambda s, key: jax.jvp(lambda a: costs(a, s, key), (jnp.zeros(()),), (jnp.ones(()),)), 0)
    value = compiled(costs, 0)
    cost, gradient = slope(case.scenarios, key)
    ahead, behind = (value(jnp.asarray(by), case.scenarios, key) for by in (CHANGE, -CHANGE))
    return Evidence(np.asarray(case.horizons), *map(np.asarray, (cost, gradient, (ahead - behind) / (2 * CHANGE))))


def cases(n: int) -> list[Case]:
    """Smooth loops and rough ones, n runs each that differ in noise and start."""
    rng = np.random.default_rng(8)
    lanes = lambda tree: jax.tree.map(lambda a: np.repeat(np.asarray(a)[..., None], n, axis=-1), tree)
    slew = lanes(op.scenario._replace(star=on_axes(Fault()), gyro=on_axes(Fault(5.0, drift=0.03, tau=5.0))))
    observer = lambda **change: (
        lambda a: op.params._replace(**{name: getattr(op.params, name) * jnp.exp(a) for name in change})
    )
    alarms = lambda params, log: log.alarm * 1.0
    soft = lambda params, log: objectives.alarm(log.xi, params.sigma, 0.1 * params.sigma)
    wheel = lambda base: lambda a: base._replace(K=base.K * jnp.exp(a))
    hardware = wm.hardware_scenario._replace(wheel=wm.hardware_scenario.wheel._replace(stiction=12_000.0, creep=10.0))
    gimbals = lambda start, spread: lanes(cmg.lost(cmg.PYRAMID, start))._replace(
        gamma=np.radians(np.array(start, float)[:, None] + spread * rng.normal(size=(4, n)))
    )
    steering = lambda a: cmg.table5._replace(k_p=cmg.table5.k_p * jnp.exp(a))
    rates = lambda params, log: norm(log.w)
    seconds = (2.0, 5.0, 10.0, 20.0, 40.0)
    track = lambda params, log: log.error**2
    return [
        Case("observer loop, attitude error by k_q", op.system, observer(k_q=1), slew,
             lambda params, log: norm(log.e_q), seconds),
        Case("observer loop, soft alarms by sigma", op.system, observer(sigma=1), slew, soft, seconds),
        Case("observer loop, alarms by sigma", op.system, observer(sigma=1), slew, alarms, seconds),
        Case("wheel, error by K", wm.loop(substeps=8), wheel(wm.params), lanes(wm.scenario), track, seconds),
        Case("wheel with stick-slip, error by K", wm.loop(substeps=80), wheel(wm.hardware_params), lanes(hardware),
             track, seconds),
        Case("CMGs, proper start, rate by K_P", cmg.system, steering, gimbals((45, 45, 45, 45), 2.0), rates, seconds),
        Case("CMGs, bang-bang start, rate by K_P", cmg.system, steering, gimbals((-90, 90, 90, 95), 2.0), rates,
             seconds),
    ]  # fmt: skip


STYLE = (("#0072B2", "-", "o"), ("#56B4E9", "--", "s"), ("#D55E00", "-.", "X"), ("#009E73", "-", "^"),
         ("#E69F00", "-.", "v"), ("#000000", "--", "D"), ("#CC79A7", "-.", "P"))  # fmt: skip


def run(report) -> None:
    """The table and the figure of the guide."""
    n = 32 if report.quick else 128
    found = {case.label: evidence(case, jax.random.key(4)) for case in cases(n)}
    fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for (label, e), (colour, dashes, marker) in zip(found.items(), STYLE):
        pairs = "  ".join(f"{t:g} s: {s:.2f}, {d:.1g}" for t, s, d in zip(e.horizons, e.right_sign(), e.disagreement()))
        report.note(f"{label}: right sign, disagreement: {pairs}; largest |gradient| {np.abs(e.gradient[-1]).max():.1e}"
                    f" against |difference| {np.abs(e.difference[-1]).max():.1e}")  # fmt: skip
        left.plot(e.horizons, e.right_sign(), color=colour, ls=dashes, marker=marker, label=label)
        right.plot(e.horizons, np.maximum(e.disagreement(), 1e-5), color=colour, ls=dashes, marker=marker)
    left.set(xlabel="length of the run [s]", ylabel="share of runs whose gradient has the right sign", xscale="log",
             ylim=(-0.03, 1.03))  # fmt: skip
    right.set(xlabel="length of the run [s]", ylabel="gradient against difference over $\\pm$2 %, relative",
              xscale="log", yscale="log")  # fmt: skip
    for ax in (left, right):
        ax.grid(alpha=0.3)
        ax.set_xticks(found[label].horizons, [f"{t:g}" for t in found[label].horizons])
    fig.legend(loc="outside lower center", ncols=3, fontsize=8)
    report.figure("horizon", fig)
    smooth = [label for label in found if "by k_q" in label or "soft" in label or "proper" in label]
    for label in smooth:
        report.within(f"{label}: right sign, longest run", 0.95, None, float(found[label].right_sign()[-1]), "smooth")
    hard = "observer loop, alarms by sigma"
    report.check(f"{hard}: gradient", 0, np.abs(found[hard].gradient).max(), 0, "a threshold has none")
