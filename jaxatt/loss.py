"""What an estimate of a small probability says: `Loss`, its intervals, and the failures that were kept.

May import: check.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxatt import check

FLAGS = {
    "stuck": "the repeats differ by more than twice what chains that mix would give: believe the interval, not cv_au_beck",
    "lost": "some repeat lost all of its chains and counts as 0: more chains",
    "plateau": "the score ties or saturates, so that a level keeps fewer than 3 % or more than 30 % of its states",
    "frozen": "fewer than 10 % of the moves of a level were accepted, or they hardly moved",
    "few roots": "the failures of a repeat descend from fewer than 3 independent runs: more chains",
    "nan": "the score was NaN in some run, which counts as a failure",
    "unreached": "no chain came to `above`: a score with a bound below it, or an event too rare",
    "unchecked": "importance sampling sees only what lies near its points: hand it the result of `probability`",
    "contradicts": "the interval does not overlap that of `probability`: the points are not the way it fails",
    "few effective": "fewer than 10 effective samples fail",
}  # what each means

DISTINCT = 0.7  # silhouette of groups that are distinct


class Curve(NamedTuple):
    """Exceedance: P(score > b), every field of shape (points,), b ascending to ``above``."""

    b: Any  # [unit of the score]
    p: Any  # [1] probability of exceeding b
    low: Any  # [1] end of its 95 % interval
    high: Any  # [1] end of its 95 % interval


class Failures(NamedTuple):
    """Runs that failed, up to 8 of each repeat; every leaf leads with them."""

    scenario: Any  # a tree, every leaf (failures, ...)
    noise: Any  # (failures, ticks, system.normals) [1]
    u: Any  # (failures, normals) [1] numbers of the scenario
    score: Any  # (failures,) [unit of the score]
    repeat: Any  # (failures,) the repeat that met it
    root: Any  # (failures,) the independent run of the repeat that it descends from
    weight: Any  # (failures,) [1] share of its repeat's failures that it stands for


class Loss(NamedTuple):
    """A probability, how sure it is, and how it was found; in words by ``str``."""

    p: float  # [1] the mean of by_repeat
    low: float  # [1] end of the 95 % interval
    high: float  # [1] end of the 95 % interval
    cv: float  # [1] coefficient of variation of p, from the repeats
    cv_au_beck: float  # [1] what it were if chains mixed (Au and Beck, 2001); a diagnostic
    by_repeat: Any  # (repeats,) [1] independent estimates, each unbiased
    levels: Any  # (levels,) [unit of the score] that the pilot chose
    rhos: Any  # (levels,) [1] correlation of a move with where it starts
    acceptance: Any  # (levels,) [1] share of moves accepted
    curve: Any  # `Curve`; None by importance sampling
    runs: int  # simulated scenarios, the pilot's too
    flags: tuple  # of str, each a key of `FLAGS`
    failures: Any  # `Failures`
    seconds: float  # [s] of this call
    modes: Any  # (repeats,) shares of the failures by label, a dict; None without ``label``
    roots: float  # [1] independent runs, or effective samples, that the failures of a repeat stand for, in the mean
    looks: int  # how often the file had been brought to its end; 1 without one
    event: str  # in words

    def __str__(self):
        flags = f"flags: {', '.join(self.flags)}" if self.flags else "no flags"
        looks = f", look {self.looks}" if self.looks > 1 else ""
        runs = f"{self.runs:,}".replace(",", " ")
        ends = f"95 %: {_short(self.low)} to {_short(self.high)}"
        return f"P({self.event}) = {_short(self.p)} ({ends}), {runs} runs{looks}, {flags}"


def _short(p: float) -> str:
    mantissa, _, exponent = f"{p:.1e}".partition("e")
    return f"{p:.2g}" if p == 0 or p >= 1e-3 else f"{mantissa}e{int(exponent)}"


def failure(loss: Loss, i: int):
    """A failure that was kept, for `simulate`.

    Args:
        loss: what `probability` or `importance` returned.
        i: number of the failure, from 0; ``loss.failures`` says the scores and repeats of all.

    Returns:
        Its scenario, and its noise (ticks, normals). In `simulate` they give the score kept to rounding, 1e-6 or so
        relative: one run and many are different programs.

    Raises:
        TypeError: what is no `Loss`.
        ValueError: an i that is none of the failures.

    Example:
        >>> scenario, noise = failure(loss, 0)
        >>> log = jaxatt.simulate(loop.system, loop.params, scenario, noise, ticks=300)
    """
    check.kind("loss", loss, Loss)
    kept = len(loss.failures.score)
    i = check.whole("i", i, 0)
    if i >= kept:
        check.refuse("i", f"be less than the {kept} failures kept", i)
    return jax.tree.map(lambda a: a[i], (loss.failures.scenario, loss.failures.noise))


class Groups(NamedTuple):
    """Failures that resemble each other, the most likely group first."""

    index: Any  # (groups,) the failure in the middle of each group, for `failure`
    member: Any  # (failures,) the group of each failure
    share: Any  # (groups,) [1] of the probability, as far as the kept failures tell
    low: Any  # (groups,) [1] end of its 95 % interval, from the repeats
    high: Any  # (groups,) [1] end of its 95 % interval


def groups(loss: Loss, features, *, most: int = 5) -> Groups:
    """Sort the failures kept into groups that look alike, and name one that stands for each.

    Partition around medoids (Kaufman and Rousseeuw, 1987) of the features, each over its standard deviation. There are as
    many groups as part the failures best, by the mean silhouette; one where none exceeds 0.7, for even one normal number,
    cut in two, reaches 0.57.

    Args:
        loss: what `probability` returned.
        features: (failures, numbers), what is told of each failure, such as the time of its peak and the axis it is on.
        most: groups at most.

    Returns:
        `Groups`.

    Raises:
        TypeError: what is no `Loss`, no numbers.
        ValueError: features of another number of failures, or not finite; no failure.

    Example:
        >>> run = lambda scenario, noise: peak_of(simulate(system, params, scenario, noise, ticks=300))
        >>> found = groups(loss, jax.vmap(run)(loss.failures.scenario, loss.failures.noise))
        >>> scenario, noise = failure(loss, found.index[0])
    """
    check.kind("loss", loss, Loss)
    x, most = check.real("features", features), check.whole("most", most)
    n = len(loss.failures.score)
    if x.ndim != 2 or len(x) != n or n == 0:
        check.refuse("features", f"have shape ({n}, numbers), and there must be a failure", x.shape)
    check.finite("features", x)
    spread = x.std(axis=0)
    x = (x - x.mean(axis=0)) / np.where(spread > 0, spread, 1)
    apart = np.linalg.norm(x[:, None] - x[None], axis=-1)
    best, middles = DISTINCT, np.array([np.argmin(apart.sum(axis=0))])
    for k in range(2, min(most, n - 1) + 1):
        tried = _medoids(apart, k)
        score = _silhouette(apart, np.argmin(apart[:, tried], axis=1))
        if score > best:
            best, middles = score, tried
    member = np.argmin(apart[:, middles], axis=1)
    repeat, weight = loss.failures.repeat, loss.failures.weight
    rows = np.array([
        np.bincount(member[repeat == r], weight[repeat == r], len(middles)) / weight[repeat == r].sum()
        for r in np.unique(repeat)
    ])  # fmt: skip
    share = rows.mean(axis=0)
    order = np.argsort(-share)
    low, high = _t_interval(rows[:, order])
    return Groups(middles[order], np.argsort(order)[member], share[order], low, high)


def _medoids(apart, k: int):
    """k of the points whose distances to all others, each to the nearest of them, sum up to least: greedy, then swaps."""
    chosen = [int(np.argmin(apart.sum(axis=0)))]
    cost = lambda some: apart[:, some].min(axis=1).sum()
    while len(chosen) < k:
        chosen.append(min((i for i in range(len(apart)) if i not in chosen), key=lambda i: cost([*chosen, i])))
    while True:
        swaps = [[*chosen[:j], i, *chosen[j + 1 :]] for j in range(k) for i in range(len(apart)) if i not in chosen]
        better = min(swaps, key=cost)
        if cost(better) >= cost(chosen) - 1e-12:
            return np.array(chosen)
        chosen = better


def _silhouette(apart, member) -> float:
    """Mean silhouette (Rousseeuw, 1987): 1 where groups lie far apart, 0 where they touch."""
    groups = np.unique(member)
    if len(groups) < 2:
        return 0.0
    sums = np.stack([apart[:, member == g].sum(axis=1) for g in groups], axis=1)
    sizes = np.array([np.sum(member == g) for g in groups])
    own = np.searchsorted(groups, member)
    rows = np.arange(len(member))
    alone = sizes[own] == 1
    within = sums[rows, own] / np.maximum(sizes[own] - 1, 1)
    means = sums / sizes
    means[rows, own] = np.inf
    beside = means.min(axis=1)
    return float(np.mean(np.where(alone, 0, (beside - within) / np.maximum(np.maximum(within, beside), 1e-300))))


def _t_interval(rows):
    """95 % interval of the mean share of repeats (repeats, groups), within [0, 1]."""
    from scipy.stats import t

    n = len(rows)
    reach = t.ppf(0.975, n - 1) * rows.std(axis=0, ddof=1) / np.sqrt(n) if n > 1 else np.ones(rows.shape[1])
    return np.clip(rows.mean(axis=0) - reach, 0, 1), np.clip(rows.mean(axis=0) + reach, 0, 1)


def said(flags: list[str]) -> tuple:
    """The flags, after a warning that says what they mean."""
    if flags:
        check.warn("The estimate has flags: " + "; ".join(f"{flag}: {FLAGS[flag]}" for flag in flags) + ".")
    return tuple(flags)


# intervals


def log_t(estimates) -> tuple:
    """Mean of independent estimates (repeats, ...), ends of its 95 % interval, its coefficient of variation.

    The interval is Student's on the scale of the logarithm, so that it holds no number below zero.
    """
    from scipy.stats import t

    estimates = np.asarray(estimates, float)
    repeats = len(estimates)
    p = estimates.mean(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        cv = estimates.std(axis=0, ddof=1) / p / np.sqrt(repeats)
    reach = np.exp(t.ppf(0.975, repeats - 1) * cv)
    return p, p / reach, np.minimum(p * reach, 1.0), cv


def wilson(successes, trials):
    """Low and high end of Wilson's 95 % interval of a share, for shares that are not rare; arrays or numbers, NaN of no trial."""
    k, n, z = np.asarray(successes, float), np.asarray(trials, float), 1.959963984540054
    n, square = np.where(n > 0, n, np.nan), z * z
    middle, reach = k + square / 2, z * np.sqrt(np.maximum(k * (n - k) / n + square / 4, 0))
    return np.maximum(middle - reach, 0) / (n + square), np.minimum((middle + reach) / (n + square), 1)
