"""The satellite that reconfigures itself: attitude and rate gain by gradient, judged on days that chose nothing.

Pointing alone asks for ever more gain, for the law has no integral and the residual dipole leaves an offset; the rate
error, which blurs pictures, asks for less. The cost is their sum of squares, ten seconds of rate error counting as much
as the pointing error. Three seeds: one to tune on, one to choose by, one for the verdict.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.microsat import days
from experiments.report import plt
from experiments.tuning.compare import paired_ratio, told
from jaxatt import scores, sweep, tune
from jaxatt.loops import microsat as ms
from jaxatt.plot import COLOURS
from jaxatt.tuning import bounded

DEG = np.pi / 180
TUNE, CHOOSE, JUDGE = 41, 42, 43  # seeds
NAMES = "kp", "kd"
START = np.array([ms.params.kp, ms.params.kd])
LOW, HIGH = np.array([0.001, 0.02]), np.array([0.1, 0.6])
GAINS = bounded(tuple(LOW), tuple(HIGH))
SETTLED, TICKS = 40.0, 1000  # [s] from here on the cost counts; length of a run
SPAN = 10.0  # [s] of rate error that count as pointing error


def run(report) -> None:
    """Tune, choose, judge."""
    history = by_gradient(report, days(TUNE, 16 if report.quick else 64), 8 if report.quick else 20)
    chosen = choose(report, history, 64 if report.quick else 128)
    verdict(report, chosen, 128 if report.quick else 1024)


def shipped(gains) -> ms.Params:
    """Params with the gains (kp [1/s^2], kd [1/s])."""
    return ms.params._replace(kp=gains[0], kd=gains[1])


def terms(params, scenario, now, log):
    """The terms of the cost: mean squares of pointing [deg^2] and rate error [deg^2/s^2], once settled."""
    late = now.t >= SETTLED
    return scores.mean((log.pointing / DEG) ** 2, late), scores.mean((log.rate_error / DEG) ** 2, late)


def weighed(pointing, rate):
    """Cost of each run [1e-4 deg^2]."""
    return 1e4 * (pointing + SPAN**2 * rate)


def tuning_cost(gains, key, scenarios, ticks: int = TICKS):
    """Mean cost of the scenarios [1e-4 deg^2]."""
    found = sweep(ms.system, shipped(gains), scenarios, key, ticks=ticks, score=terms, progress=False)
    return jnp.mean(weighed(*found))


def by_gradient(report, scenarios, steps: int):
    """Adam on the logarithm of the cost, the gains within bounds; its history in gains."""
    cost = lambda free, key: jnp.log(tuning_cost(GAINS.within(free), key, scenarios))
    _, history = tune(cost, GAINS.free(tuple(START)), optax.adam(0.3, b1=0.5, b2=0.9), steps, jax.random.key(TUNE))
    history = history._replace(theta=jax.vmap(GAINS.within)(history.theta), cost=np.exp(history.cost))
    report.note("cost on the way [1e-4 deg^2]: " + "  ".join(f"{c:.3f}" for c in history.cost))
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    axes[0].plot(history.cost, "o-", color=COLOURS[0])
    axes[0].set(xlabel="step", ylabel="cost on the tuning days [1e-4 deg²]")
    axes[1].loglog(*history.theta, "o-", color=COLOURS[1])
    axes[1].set(xlabel="attitude gain kp [1/s²]", ylabel="rate gain kd [1/s]")
    report.figure("descent", fig)
    return history


def swept(gains, seed: int, n: int):
    """Terms of the cost of n days of a seed, (n,) each."""
    return sweep(
        ms.system, shipped(gains), days(seed, n), jax.random.key(seed), ticks=TICKS, score=terms, progress=False
    )


def choose(report, history, n: int):
    """Of the three points with the least cost on the tuning days the best on others."""
    points = np.stack(history.theta, axis=1)
    few = points[np.argsort(history.cost)[:3]]
    costs = [float(np.mean(weighed(*swept(gains, CHOOSE, n)))) for gains in few]
    chosen = few[int(np.argmin(costs))]
    report.note(", ".join(f"{name} {a:.4g} -> {b:.4g}" for name, a, b in zip(NAMES, START, chosen)))
    return chosen


def verdict(report, chosen, n: int) -> None:
    """Before and after on days and noise that nothing was chosen on."""
    before, after = (swept(gains, JUDGE, n) for gains in (START, chosen))
    change = paired_ratio(weighed(*before), weighed(*after))
    report.note(told("cost [1e-4 deg^2]", change, ratio=True))
    root = lambda a, axis: np.sqrt(np.mean(a, axis=axis))
    for name, a, b in zip(("pointing, rms [deg]", "rate error, rms [deg/s]"), before, after):
        report.note(told(name, paired_ratio(a, b, root, 1000), ratio=True))
    report.within("tuned / start, cost, upper end of 95 % interval", None, 1.0, change.high, f"{n} fresh days")
