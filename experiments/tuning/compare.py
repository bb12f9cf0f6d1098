"""Is the tuned point better, and was the gradient worth it? Paired statistics, and baselines at equal budget.

The unit of a budget is one *simulation*: one evaluation of the cost, which all methods share with its scenarios
and noise. A gradient of p numbers in forward mode counts 1 + p simulations (`gradient_price`): the value, and one
tangent for each number. Measured CPU time may say more or less, so a study states the measured ratio beside it.

Points are flat arrays of p coordinates in which the search is done (logarithms of gains, as a rule), within
``low`` and ``high``, shape (p,). A baseline takes ``costs``, from points (n, p) to costs (n,); `one_by_one` makes
it from a cost of one point. A cost that is not finite counts as worst.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.report import plt
from jaxatt import check
from jaxatt.plot import COLOURS, LINES

# before and after on the same scenarios


class Change(NamedTuple):
    """What a change of gains does to one number, scenario by scenario, with its 95 % confidence interval."""

    before: float
    after: float
    change: float  # after - before, or after / before of `paired_ratio`
    low: float
    high: float


def paired_mean(before, after) -> Change:
    """Change of the mean over scenarios: Student's interval of the paired differences. Shapes (n,).

    Raises ValueError for values that are not finite and for fewer than two pairs.
    """
    from scipy.stats import t

    before, after = _pairs(before, after)
    d = after - before
    half = float(t.ppf(0.975, d.size - 1) * d.std(ddof=1) / np.sqrt(d.size))
    middle = float(d.mean())
    return Change(float(before.mean()), float(after.mean()), middle, middle - half, middle + half)


def paired_ratio(before, after, statistic: Callable = np.mean, resamples: int = 2000, seed: int = 0) -> Change:
    """Ratio after / before of a statistic over scenarios: percentile bootstrap over pairs. Shapes (n,).

    For quantiles of few scenarios that before and after treat alike, the interval is wider than it need be.
    statistic: a function of values and ``axis``: ``np.mean``, ``partial(np.quantile, q=0.95)``, a root mean square.
    Raises ValueError for values that are not finite and for fewer than two pairs.
    """
    before, after = _pairs(before, after)
    rng = np.random.default_rng(seed)
    most = max(1, 2_000_000 // before.size)  # numbers that are drawn at once
    ratios = []
    for start in range(0, resamples, most):
        pick = rng.integers(before.size, size=(min(most, resamples - start), before.size))
        ratios.append(statistic(after[pick], axis=1) / statistic(before[pick], axis=1))
    low, high = np.quantile(np.concatenate(ratios), (0.025, 0.975))
    b, a = float(statistic(before, axis=0)), float(statistic(after, axis=0))
    return Change(b, a, a / b, float(low), float(high))


def paired_share(before, after) -> Change:
    """Change of a share from paired yes and no, shapes (n,): the adjusted Wald interval of Agresti & Min (2005).

    One half is added to each of the four cells of the table of pairs, so that no discordant pair is not certainty.
    """
    before, after = _pairs(np.asarray(before, bool), np.asarray(after, bool))
    n = before.size + 2
    gained, lost = float(np.sum(after > before)) + 0.5, float(np.sum(after < before)) + 0.5
    middle = (gained - lost) / n
    half = 1.959964 * np.sqrt(gained + lost - (gained - lost) ** 2 / n) / n
    b, a = float(before.mean()), float(after.mean())
    return Change(b, a, a - b, max(-1.0, float(middle - half)), min(1.0, float(middle + half)))


def mcnemar(before, after) -> float:
    """Exact two-sided p-value that a share has not changed, from paired yes and no, shapes (n,)."""
    from scipy.stats import binom

    before, after = np.asarray(before, bool), np.asarray(after, bool)
    gained, lost = int(np.sum(after & ~before)), int(np.sum(before & ~after))
    return min(1.0, 2 * float(binom.cdf(min(gained, lost), gained + lost, 0.5)))


def told(name: str, c: Change, ratio: bool = False) -> str:
    """A line for the report."""
    kind = "ratio" if ratio else "change"
    sign = "" if ratio else "+"
    return (
        f"{name:34} {c.before:10.4g} -> {c.after:10.4g}  paired {kind} {c.change:{sign}.4g} "
        f"(95 %: {c.low:{sign}.4g} to {c.high:{sign}.4g})"
    )


def _pairs(before, after):
    before, after = np.asarray(before, float), np.asarray(after, float)
    if before.shape != after.shape or before.ndim != 1 or before.size < 2:
        check.refuse(
            "before, after", "be two arrays of one shape (n,), n >= 2", f"of shapes {before.shape}, {after.shape}"
        )
    check.finite("before", before)
    check.finite("after", after)
    return before, after


# what a search spends


class Trace(NamedTuple):
    """The points a search asked for, in order; n of them."""

    spent: Any  # (n,) simulations spent once the cost was known
    cost: Any  # (n,) inf where it was not finite
    theta: Any  # (n, p)


class Race(NamedTuple):
    """A gradient search against a baseline."""

    target: float  # lowest cost of the baseline
    budget: float  # simulations that the baseline was given
    baseline: float  # simulations after which the baseline had the target
    gradient: float  # simulations after which the gradient had it; inf if never

    @property
    def fewer(self) -> float:
        """How many times fewer simulations the gradient needed for the target than the baseline itself."""
        return self.baseline / self.gradient

    @property
    def fewer_than_budget(self) -> float:
        """The same against the baseline's whole budget."""
        return self.budget / self.gradient


def gradient_price(numbers: int) -> int:
    """Simulations that one value and gradient in forward mode counts for."""
    return 1 + numbers


def descent(history, price: float) -> Trace:
    """The trace of a search by `jaxatt.tune`: every step spends ``price`` simulations."""
    cost = np.asarray(history.cost, float)
    steps = len(cost)
    theta = np.concatenate([np.asarray(a, float).reshape(steps, -1) for a in jax.tree.leaves(history.theta)], axis=1)
    return Trace(price * np.arange(1, steps + 1), _finite(cost), theta)


def lowest(trace: Trace):
    """The point of lowest cost, shape (p,)."""
    return trace.theta[np.argmin(trace.cost)]


def needed(trace: Trace, cost: float) -> float:
    """Simulations spent until the cost was no higher than this; inf if never."""
    reached = trace.cost <= cost
    return float(trace.spent[np.argmax(reached)]) if reached.any() else np.inf


def race(gradient: Trace, baseline: Trace, budget: float, slack: float = 0.0) -> Race:
    """How soon the gradient has what the baseline has in the end.

    slack: share of the baseline's gain over the gradient's start that is given away, to both alike: 0.01 asks for
    99 % of it, which leaves out the polishing of the last digits.
    """
    least = float(baseline.cost.min())
    target = least + slack * max(0.0, float(gradient.cost[0]) - least)
    return Race(target, float(budget), needed(baseline, target), needed(gradient, target))


# baselines


def one_by_one(cost: Callable) -> Callable:
    """``costs`` from a cost of one point, shape (p,).

    A cost that sweeps a batch of scenarios fills the machine by itself; more points at once gain nothing then.
    """
    return lambda points: np.array([float(cost(x)) for x in points])


def random_search(costs: Callable, low, high, budget: int, seed: int, batch: int = 16) -> Trace:
    """Points drawn uniformly between the bounds."""
    rng = np.random.default_rng(seed)
    low, high = np.asarray(low, float), np.asarray(high, float)
    points = rng.uniform(low, high, (budget, low.size))
    cost = [np.asarray(costs(points[i : i + batch])) for i in range(0, budget, batch)]
    return _trace(points, np.concatenate(cost))


def cma_es(costs: Callable, start, low, high, budget: int, seed: int, spread: float = 0.2) -> Trace:
    """CMA-ES by the library `cma` (extra `bench`), from ``start`` and a standard deviation of ``spread`` ranges.

    It starts anew from ``start``, larger by its own rule, where it has converged before the budget is spent.
    """
    try:
        import cma  # pyright: ignore[reportMissingImports]
    except ImportError as missing:
        raise ImportError("`cma_es` needs the library cma: pip install 'jaxatt[bench]'") from missing
    start, low, high = (np.asarray(a, float) for a in (start, low, high))
    points, values = [], []
    population = 4 + int(3 * np.log(start.size))  # the library's own choice
    restarts = 0
    while len(values) < budget:
        options = dict(bounds=[0.0, 1.0], seed=seed + 1 + restarts, verbose=-9, popsize=population * 2**restarts)
        search = cma.CMAEvolutionStrategy((start - low) / (high - low), spread, options)
        while len(values) < budget and not search.stop():
            asked = np.array(search.ask())
            here = low + asked * (high - low)
            cost = _finite(np.asarray(costs(here), float))
            search.tell(list(asked), list(np.where(np.isfinite(cost), cost, 1e300)))
            points.extend(here)
            values.extend(cost)
        restarts += 1
    return _trace(np.array(points[:budget]), np.array(values[:budget]))


def nelder_mead(costs: Callable, start, low, high, budget: int, spread: float = 0.2) -> Trace:
    """Nelder & Mead's simplex by SciPy, from ``start`` and edges of ``spread`` ranges; it ends where it converges."""
    from scipy.optimize import minimize

    start, low, high = (np.asarray(a, float) for a in (start, low, high))
    points, values = [], []

    def cost(unit):
        points.append(low + unit * (high - low))
        values.append(float(_finite(costs(points[-1][None]))[0]))
        return min(values[-1], 1e300)

    first = (start - low) / (high - low)
    inward = np.where(first < 0.5, spread, -spread)
    simplex = np.concatenate([first[None], first + np.diag(inward)])
    options = dict(initial_simplex=simplex, maxfev=budget, maxiter=budget, xatol=1e-4, fatol=0.0)
    minimize(cost, first, method="Nelder-Mead", bounds=[(0.0, 1.0)] * start.size, options=options)
    return _trace(np.array(points[:budget]), np.array(values[:budget]))


def _finite(cost):
    cost = np.asarray(cost, float)
    return np.where(np.isfinite(cost), cost, np.inf)


def _trace(points, cost) -> Trace:
    return Trace(np.arange(1, len(cost) + 1), _finite(cost), points)


def contest(
    report, gradient: Trace, costs: Callable, start, low, high, budget: int, unit: str, dearer: float | None, seeds,
    figure: str = "budget",
):  # fmt: skip
    """All baselines on the cost of a gradient search: a line each, the figure `budget_figure`, and the races.

    Random search and CMA-ES run once for each seed; Nelder-Mead has no chance in it and, like CMA-ES, starts where
    the gradient did. dearer: CPU time of a value and gradient in values, `cpu_ratio`, beside the count of
    `gradient_price`; None: not measured. figure: name of the figure. Returns, for each baseline, its races at no slack
    and at a slack of 1 %, two lists over seeds.
    """
    traces = {
        "gradient": [gradient],
        "random search": [random_search(costs, low, high, budget, seed) for seed in seeds],
        "CMA-ES": [cma_es(costs, start, low, high, budget, seed) for seed in seeds],
        "Nelder-Mead": [nelder_mead(costs, start, low, high, budget)],
    }
    price = gradient.spent[0]
    report.note(
        f"gradient: cost {gradient.cost[0]:.6g} -> {gradient.cost.min():.6g} in {len(gradient.cost)} steps, each "
        f"counted as {price:g} simulations" + (f"; in CPU time it is {dearer:.3g}" if dearer else "")
    )
    races = {}
    for name, several in list(traces.items())[1:]:
        exact, near = ([race(gradient, trace, budget, slack) for trace in several] for slack in (0.0, 0.01))
        races[name] = exact, near
        least = [r.target for r in exact]
        report.note(f"{name}: least cost {np.median(least):.6g} ({min(least):.6g} to {max(least):.6g})")
        for label, some in (("its final cost", exact), ("99 % of its gain", near)):
            its, ours, fewer, less = (
                float(np.median([getattr(r, field) for r in some]))
                for field in ("baseline", "gradient", "fewer", "fewer_than_budget")
            )  # medians over seeds, so that fewer is not its / ours
            line = f"  {label}: after {its:.0f} simulations; gradient "
            if np.isinf(ours):
                report.note(line + f"never in its {gradient.spent[-1]:.0f}")
                continue
            report.note(
                f"{line}after {ours:.0f}: {fewer:.2g} times fewer, {less:.2g} times fewer than the budget of {budget}"
                + (f"; in CPU time {fewer * price / dearer:.2g} times less" if dearer else "")
            )
    report.figure(figure, budget_figure(traces, budget, unit, report.experiment))
    return races


def cpu_ratio(dear: Callable, cheap: Callable, *operands) -> float:
    """CPU time of one call over that of another; the least of five calls each, compiled before."""

    def least(f):
        jax.block_until_ready(f(*operands))
        spent = []
        for _ in range(5):
            started = time.process_time()
            jax.block_until_ready(f(*operands))
            spent.append(time.process_time() - started)
        return min(spent)

    return least(dear) / least(cheap)


# the figure

METHODS = ["gradient", "CMA-ES", "Nelder-Mead", "random search"]
STYLES = dict(zip(METHODS, zip(COLOURS, LINES)))


def budget_figure(traces: dict[str, list[Trace]], budget: float, unit: str, title: str = ""):
    """Lowest cost so far against simulations spent, and how far it is above the lowest that any search found.

    Median and range over the traces of each method.

    traces: for each method of `STYLES` its traces over seeds, that of the gradient first; unit: of the cost, for the
    axis; title: of the figure.
    """
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    spent = np.unique(np.round(np.geomspace(1, budget, 400)))
    least = min(trace.cost.min() for several in traces.values() for trace in several)
    for name, several in traces.items():
        colour, dashes = STYLES[name]
        curves = np.array([best_after(trace, spent) for trace in several])
        known = np.isfinite(curves).all(axis=0)
        seeds = "" if len(several) == 1 else f", {len(several)} seeds"
        for ax, above in ((left, 0.0), (right, least)):
            middle, low, high = (f(curves[:, known], axis=0) - above for f in (np.median, np.min, np.max))
            ax.step(spent[known], middle, where="post", color=colour, ls=dashes, lw=2, label=name + seeds)
            ax.fill_between(spent[known], low, high, step="post", color=colour, alpha=0.15, lw=0)
    for ax in (left, right):
        ax.set(xscale="log", xlim=(1, budget), xlabel="simulations (a gradient of p numbers: 1 + p)")
        ax.grid(alpha=0.3)
    left.set(yscale="log" if least > 0 else "linear", ylabel=f"lowest cost so far [{unit}]")
    right.set(yscale="log", ylabel=f"the same, less the lowest of all [{unit}]")
    gain = next(iter(traces.values()))[0].cost[0] - least
    if np.isfinite(gain) and gain > 0:
        right.set_ylim(1e-4 * gain, 2 * gain)  # no need to see a simplex polish its last digits
    left.legend(fontsize=8, title="median and range", title_fontsize=8)
    if title:
        fig.suptitle(title)
    return fig


def best_after(trace: Trace, spent):
    """Lowest cost known once so many simulations were spent, inf before the first; shape of spent."""
    lowest_yet = np.concatenate([[np.inf], np.minimum.accumulate(trace.cost)])
    return lowest_yet[np.searchsorted(trace.spent, spent, side="right")]
