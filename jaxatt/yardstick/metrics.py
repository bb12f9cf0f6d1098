"""From delays to numbers with intervals: NumPy, off line.

first: (days, detectors) [s] from onset to alarm, inf for never; punctual: whether there was no alarm before the onset.

May import: kinds.
"""

from __future__ import annotations

from math import erfc, exp, pi, sqrt

import numpy as np

from jaxatt.yardstick.kinds import unit_of

HORIZON = 60.0  # [s] after which a delay counts no further
ISOLATION_FLOOR = 0.01


def restricted(first):
    """min(delay, 60 s), the restricted delay."""
    return np.minimum(np.asarray(first, float), HORIZON)


def mean_where(values, mask, axis: int = 0):
    """Mean of the values where the mask holds; NaN without any."""
    mask = np.asarray(mask, bool)
    n = mask.sum(axis)
    with np.errstate(invalid="ignore"):
        return np.where(mask, values, 0).sum(axis) / np.where(n > 0, n, np.nan)


def rmd(first, punctual):
    """Restricted mean delay RMD60 [s] and its standard error."""
    values = restricted(first)
    mean = mean_where(values, punctual)
    n = np.asarray(punctual).sum(0)
    spread = np.sqrt(mean_where((values - mean) ** 2, punctual))
    return mean, spread / np.sqrt(np.maximum(n - 1, 1))


def share_within(first, punctual, seconds: float):
    """Share of delays of at most so many seconds: how many, of how many."""
    hit = (np.asarray(first) <= seconds) & punctual
    return hit.sum(0), np.asarray(punctual).sum(0)


def isotonic(values, weights):
    """The nearest rising sequence in weighted least squares, by pooling adjacent violators."""
    blocks: list[list[float]] = []
    for value, weight in zip(values, weights, strict=True):
        blocks.append([float(value), float(weight), 1])
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            b, a = blocks.pop(), blocks.pop()
            total = a[1] + b[1]
            mean = (a[0] * a[1] + b[0] * b[1]) / total if total else max(a[0], b[0])
            blocks.append([mean, total, a[2] + b[2]])
    return np.concatenate([np.full(int(count), value) for value, _, count in blocks])


def detectable(sizes, shares, weights, level: float = 0.95) -> float:
    """The smallest size found with probability ``level``: first crossing of the isotonic shares, linear in log size.

    inf if there is none.
    """
    fitted, logs = isotonic(shares, weights), np.log(np.asarray(sizes, float))
    above = np.flatnonzero(fitted >= level)
    if not len(above):
        return np.inf
    i = above[0]
    if i == 0:
        return float(sizes[0])
    part = (level - fitted[i - 1]) / (fitted[i] - fitted[i - 1])
    return float(np.exp(logs[i - 1] + part * (logs[i] - logs[i - 1])))


def log_score(blame, truth):
    """ln of the probability given to the true channels, (days, detectors); p = .99 blame / sum + .01 / n.

    blame: (days, detectors, n channels); truth: (days, n) bool.
    """
    blame = np.asarray(blame, float)
    total = blame.sum(-1, keepdims=True)
    n = blame.shape[-1]
    even = np.full_like(blame, 1 / n)
    p = (1 - ISOLATION_FLOOR) * np.divide(blame, total, out=even, where=total > 0) + ISOLATION_FLOOR / n
    return np.log(np.sum(p * np.asarray(truth)[:, None, :], axis=-1))


def weights_of(cells, sized) -> np.ndarray:
    """Weight of each cell in the macro: the mean over units, kinds and sizes in turn; 0 outside the sized kinds."""
    kinds = [kind for kind, _ in cells]
    units = {
        unit_of(k): {other for other in kinds if other in sized and unit_of(other) == unit_of(k)}
        for k in kinds
        if k in sized
    }
    found = np.zeros(len(cells))
    for i, kind in enumerate(kinds):
        if kind in sized:
            found[i] = 1 / (len(units) * len(units[unit_of(kind)]) * kinds.count(kind))
    return found


def paired(first, punctual, weights, resamples: int = 1000, seed: int = 0):
    """Differences of the macro between detectors, A - B, on common days, and standard errors by bootstrap over days.

    first, punctual: (cells, days, detectors); weights: (cells,). Returns two arrays (detectors, detectors).
    """
    value, mask = restricted(first), np.asarray(punctual, float)
    _, days, n = value.shape
    used = np.flatnonzero(weights)
    draws = np.random.default_rng(seed).multinomial(days, np.full(days, 1 / days), resamples).astype(float)
    difference, error = np.zeros((n, n)), np.zeros((n, n))
    for a in range(n):
        for b in range(a):
            both = mask[used, :, a] * mask[used, :, b]
            gap = both * (value[used, :, a] - value[used, :, b])
            mean = gap.sum(1) / np.maximum(both.sum(1), 1)
            again = (draws @ gap.T) / np.maximum(draws @ both.T, 1)
            difference[a, b] = weights[used] @ mean
            error[a, b] = np.std(again @ weights[used], ddof=1)
            difference[b, a], error[b, a] = -difference[a, b], error[a, b]
    return difference, error


def ranks(difference, error, level: float = 0.05) -> np.ndarray:
    """1 + number of rows that are better after Holm's correction over all pairs; equal ranks are ties."""
    n = len(difference)
    pairs = [(a, b) for a in range(n) for b in range(a)]
    z = [abs(difference[p]) / error[p] if error[p] > 0 else (np.inf if difference[p] else 0.0) for p in pairs]
    p_values = np.array([erfc(value / np.sqrt(2)) for value in z])
    better = np.zeros((n, n), bool)
    for place, i in enumerate(np.argsort(p_values, kind="stable")):
        if p_values[i] > level / (len(pairs) - place):
            break
        a, b = pairs[i]
        better[(a, b) if difference[a, b] < 0 else (b, a)] = True
    return 1 + better.sum(0)


def time_dependent(sixths) -> float:
    """Probability of sixths of the window as unequal as these if the score knew no time; sixths: (windows, 6) counts.

    Chi-square of five degrees with the window as the unit: counts within one are correlated.
    """
    counts = np.asarray(sixths, float)
    apart = counts[:, :5] - counts.mean(1, keepdims=True)
    spread = np.cov(apart.T) / len(apart)
    if not np.all(np.isfinite(spread)) or np.linalg.matrix_rank(spread) < 5:
        return 1.0
    mean = apart.mean(0)
    statistic = float(mean @ np.linalg.solve(spread, mean))
    x = statistic  # survival of chi-square of five degrees, in closed form
    return erfc(sqrt(x / 2)) + sqrt(2 * x / pi) * exp(-x / 2) * (1 + x / 3)
