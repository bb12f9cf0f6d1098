"""What a campaign says: rates with intervals, quantiles, first-order sensitivities, in a few lines.

Takes the `xarray.Dataset` of `jaxatt.campaign.dataset`; one variable is in memory at a time.

May import: check, evaluation.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from jaxatt import check
from jaxatt.evaluation import interval, quantile_interval


class Rate(NamedTuple):
    """A share of scenarios, with a confidence interval."""

    successes: int
    trials: int
    low: float
    high: float

    def __str__(self):
        share = self.successes / self.trials if self.trials else np.nan
        return f"{share:.4g} ({self.low:.4g} to {self.high:.4g})"


def rate_of(successes: int, trials: int, level: float = 0.95) -> Rate:
    """The share of successes in trials, with `jaxatt.evaluation.interval` at the confidence ``level``."""
    low, high = interval(successes, trials, level)
    return Rate(int(successes), int(trials), low, high)


def narrowed(counts: Iterable[int], looks, half_width: float, level: float = 0.95) -> Rate:
    """The rate at the first look at which its interval is at most ``half_width`` to a side, or at the last.

    counts: successes among the first looks[0], looks[1], ... trials, asked for one by one. The error 1 - level is
    shared out equally among the looks (Bonferroni) and each interval is that of `rate_of`, so the one returned
    covers the rate of independent trials with probability of at least ``level``, wherever it stopped.
    """
    looks = check.wholes("looks", looks)
    check.positive("half_width", check.number("half_width", half_width))
    check.between("level", check.number("level", level), 0, 1, "a probability")
    if not np.iterable(counts):
        raise TypeError(f"`counts` must be whole numbers, but they are {check.short(counts)}.")
    rate = None
    for successes, n in zip(counts, looks):
        if check.whole("counts", successes, 0) > n:
            check.refuse("counts", f"not exceed the {n} trials", successes)
        rate = rate_of(successes, n, 1 - (1 - level) / len(looks))
        if (rate.high - rate.low) / 2 <= half_width:
            break
    if rate is None:
        check.refuse("counts", "hold at least one number", check.short(counts))
    return rate


def _campaign(dataset):
    if not hasattr(dataset, "data_vars"):
        raise TypeError(f"`dataset` must be an xarray.Dataset, but it is {check.short(dataset)}.")
    if "status" not in dataset or "scenario" not in dataset.coords:
        check.refuse(
            "dataset", "be that of a campaign, with status and scenario", f"one of {', '.join(map(str, dataset))}"
        )
    if dataset.status.dims != ("scenario",) or dataset.status.dtype.kind not in "iu":
        check.refuse("dataset.status", "be a whole number of each scenario", check.short(dataset.status.values))
    return dataset


def columns(dataset, role: str) -> Iterator[tuple[str, np.ndarray]]:
    """The variables of a role, ``score`` or ``input``, one component (n,) at a time, by name: ``caught[2]``."""
    for name, variable in _campaign(dataset).data_vars.items():
        if variable.attrs.get("role") == role:
            values = check.real(f"dataset.{name}", variable.values)
            if variable.dims[-1:] != ("scenario",):
                check.refuse(f"dataset.{name}", "have the scenarios in its last axis", check.short(values))
            for at in np.ndindex(values.shape[:-1]):
                yield f"{name}[{', '.join(map(str, at))}]" if at else str(name), values[at]


def rates(dataset, level: float = 0.95) -> dict[str, Rate]:
    """The share of every yes-or-no score, and of finite values among those that are not NaN, where some are infinite.

    A time of detection is infinite where there was none, so ``delay finite`` is the share detected.
    """
    found = {}
    for name, a in columns(dataset, "score"):
        if a.dtype == bool and a.size:
            found[name] = rate_of(int(a.sum()), a.size, level)
        elif np.isinf(a).any():
            known = ~np.isnan(a)
            found[f"{name} finite"] = rate_of(int(np.isfinite(a).sum()), int(known.sum()), level)
    return found


def quantiles(dataset, levels=(0.05, 0.5, 0.95)) -> dict[str, np.ndarray]:
    """Quantiles at levels of every number among the scores, NaN left out: the inverse of the empirical distribution."""
    found, levels = {}, check.real("levels", levels)
    check.each("levels", "lie in [0, 1]", levels, (levels >= 0) & (levels <= 1))
    for name, a in columns(dataset, "score"):
        a = a[~np.isnan(a)] if a.dtype.kind == "f" else a
        if a.dtype != bool and a.size:
            found[name] = np.quantile(a, levels, method="inverted_cdf")
    return found


def first_order(x, y) -> tuple[float, float]:
    """First-order index Var(E[y | x]) / Var(y) of two samples (n,), and its noise floor.

    x is cut into bins of equally many scenarios (at most 32, of at least 50 each), or into its values where they
    are few; the index is the correlation ratio of y over the bins, corrected for its bias (Kelley's epsilon^2),
    so an input without effect gives 0 on average and may give a negative number. The variation of E[y | x]
    within a bin is lost: of order 1 / 32^2 for a smooth one. The floor is what an input without effect exceeds
    with probability 5 %. Scenarios with y not finite or x NaN are left out; NaN where too few are left (100), or
    x or y does not vary.
    """
    x, y = check.real("x", x).astype(float), check.real("y", y).astype(float)
    for name, sample in (("x", x), ("y", y)):
        if sample.ndim != 1 or len(sample) != len(x):
            check.refuse(name, "be a sample (n,), as long as the other", f"of shape {sample.shape}")
    use = np.isfinite(y) & ~np.isnan(x)
    x, y = x[use], y[use]
    if len(y) < 100 or np.ptp(y) == 0:
        return np.nan, np.nan
    most = int(np.clip(len(y) // 50, 2, 32))
    values = np.unique(x)
    if len(values) > most:
        values = np.unique(np.sort(x)[np.arange(most) * len(x) // most])  # the least of each bin
    group = np.searchsorted(values, x, side="right") - 1
    count = np.bincount(group)
    group, count = np.unique(group, return_inverse=True)[1], count[count > 0]
    n, bins = len(y), len(count)
    if bins < 2:
        return np.nan, np.nan
    y = y - y.mean()
    between = np.sum(np.bincount(group, y) ** 2 / count)
    corrected = lambda ratio: 1 - (1 - ratio) * (n - 1) / (n - bins)
    odds = stats.f.isf(0.05, bins - 1, n - bins) * (bins - 1) / (n - bins)
    return float(corrected(between / np.sum(y * y))), float(corrected(odds / (1 + odds)))


def sensitivity(dataset):
    """`first_order` of every score to every input: an xarray.Dataset with ``index`` and ``floor`` (score, input).

    Where a score has infinities there is a row of its finite values and one, ``... finite``, of whether it is.
    """
    import xarray as xr

    inputs = dict(columns(dataset, "input"))
    rows: dict[str, list] = {}
    for name, a in columns(dataset, "score"):
        kinds: dict[str, Any] = {name: a}
        if a.dtype.kind == "f" and np.isinf(a).any():
            kinds[f"{name} finite"] = np.where(np.isnan(a), np.nan, np.isfinite(a))
        for kind, y in kinds.items():
            rows[kind] = [first_order(x, y) for x in inputs.values()]
    table = np.array(list(rows.values()), float).reshape(len(rows), len(inputs), 2)
    coordinates = {"score": list(rows), "input": list(inputs)}
    pair = {"index": (("score", "input"), table[..., 0]), "floor": (("score", "input"), table[..., 1])}
    return xr.Dataset(pair, coordinates)


def failing(dataset) -> np.ndarray:
    """Indices of the scenarios that failed or were refused; `jaxatt.campaign.rerun` shows any of them."""
    dataset = _campaign(dataset)
    return dataset.scenario.values[dataset.status.values != 0]


def describe(dataset) -> str:
    """A campaign in words: counts, then one line for each score, with the inputs that drive it most."""
    status = _campaign(dataset).status.values
    n = status.size
    if not n:
        return "0 scenarios are done"
    counts = np.bincount(status, minlength=3)
    bad = failing(dataset)
    lines = [f"{n} scenarios done: {counts[0]} good, {counts[1]} failed, {counts[2]} refused"]
    lines[0] += f"; share not good {rate_of(len(bad), n)}"
    if len(bad):
        lines.append(f"not good: {', '.join(map(str, bad[:20]))}{' ...' if len(bad) > 20 else ''}")
    shares, numbers, drivers = rates(dataset), quantiles(dataset), sensitivity(dataset)
    for name, a in columns(dataset, "score"):
        unit = dataset[name.split("[")[0]].attrs.get("units", "")
        text = f"{name}{f' [{unit}]' if unit else ''}:"
        if name in numbers:
            ends = quantile_interval(a[~np.isnan(a)], (0.05, 0.5, 0.95))
            text += " 5 %, 50 %, 95 %: " + ", ".join(
                f"{q:.4g} ({low:.4g} to {high:.4g})" for q, low, high in zip(numbers[name], *ends)
            )
        elif name not in shares:
            text += " NaN in every scenario"
        for kind in (name, f"{name} finite"):
            if kind in shares:
                text += f" share{' finite' if kind != name else ''} {shares[kind]}"
            if kind in drivers.score and drivers.input.size:
                text += _drivers(drivers.sel(score=kind), "" if kind == name else " finite")
        lines.append(text)
    return "\n".join(lines)


def _drivers(row, what: str) -> str:
    """The inputs that explain most of a score's variance, of those above the noise floor."""
    order = np.argsort(-np.nan_to_num(row["index"].values))[:3]
    seen = [i for i in order if row["index"].values[i] > row["floor"].values[i]]
    if not seen:
        return ""
    return f"; {what.strip() + ' ' if what else ''}driven by " + ", ".join(
        f"{row['input'].values[i]} {row['index'].values[i]:.2f}" for i in seen
    )
