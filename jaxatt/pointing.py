"""Pointing errors by the indices and the statistics of ECSS-E-ST-60-10C (2008) and its handbook ESSB-HB-E-003 (2011).

A requirement reads "index |.| stays below a limit with probability ``level``, at a confidence". `indices` cuts the error
of a run into windows, `interpret` says what the probability counts (runs, time, or both), and `upper_bound` adds the
confidence that a finite number of runs allows, without an assumption on the distribution. NumPy in gives NumPy out,
JAX in gives JAX out, under transformations too.

A quantile is always a sample value, the inverse of the empirical distribution: interpolated ones would let the mixed
interpretation exceed the other two. A run that holds NaN counts as above every limit.

May import: check.
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from math import ceil
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check


class Indices(NamedTuple):
    """Errors of a run by index, unit of the error; time or windows first. `interpret` takes each of them."""

    ape: Any  # (T, ...) absolute performance error: the error itself
    mpe: Any  # (windows, ...) mean performance error: its mean over a window
    rpe: Any  # (windows * samples, ...) relative performance error: the error less the mean over its window
    pde: Any  # (pairs, ...) performance drift error: the mean over a later window less the one ``apart`` earlier; or None


class Bound(NamedTuple):
    """An upper confidence bound of a quantile."""

    value: Any  # [unit of the values] the rank-th largest of them
    rank: int  # [1] from 1, the largest
    confidence: float  # [1] probability that such a value is not below the quantile; at least what was asked for
    n: int  # [1] number of runs


def indices(error, dt: float, window: float, apart: float | None = None) -> Indices:
    """Absolute, mean, relative and drift error of one run or many.

    Windows follow each other from the first sample on; samples after the last whole window count in ``ape`` alone. Of a
    knowledge error (estimate less truth) the same numbers are AKE, MKE, RKE.

    Args:
        error: samples of one axis, or of any number of axes and runs, shape (T, ...), time first.
        dt: [s] between samples.
        window: [s] length D of a window, a whole number of dt and at least two.
        apart: [s] from the start of a window to the start of the one that it is compared with, a whole number of dt;
            None for no drift error.

    Returns:
        `Indices`. NaN in the error makes its window NaN.

    Raises:
        ValueError: a window that holds no two samples or no whole number of them, an error too short for one window, or
            for two apart.

    Example:
        >>> indices(np.array([1.0, 3.0, 2.0, 6.0]), dt=0.5, window=1.0, apart=1.0).rpe
        array([-1.,  1., -2.,  2.])
    """
    error, xp = _numbers("error", error)
    if error.ndim == 0:
        check.refuse("error", "lead with time, shape (T, ...)", "one number")
    each = _samples("window", window, dt, 2)
    windows = lambda a: a[: len(a) // each * each].reshape(-1, each, *a.shape[1:])
    if len(error) < each:
        check.refuse("error", f"hold at least one window of {each} samples", f"of {len(error)}")
    cut = windows(error)
    mpe = cut.mean(1)
    rpe = (cut - mpe[:, None]).reshape(-1, *error.shape[1:])
    if apart is None:
        return Indices(error, mpe, rpe, None)
    later = _samples("apart", apart, dt, 1)
    if len(error) < later + each:
        check.refuse("error", f"hold two windows {later} samples apart, {later + each} samples", f"of {len(error)}")
    ahead = windows(error[later:]).mean(1)
    return Indices(error, mpe, rpe, xp.asarray(ahead - mpe[: len(ahead)]))


def interpret(values, level: float, how: str):
    """The smallest limit that the values of an index keep with probability ``level``, in one of three interpretations.

    ========  ============================================  =================================================
    ensemble  a share ``level`` of runs never exceeds it    quantile over runs of the largest value in time
    temporal  every run is below it for that share of time  largest over runs of the quantile over time
    mixed     that share of all instants of all runs        quantile of all values together
    ========  ============================================  =================================================

    Ensemble and temporal are never below mixed. Temporal is about the n runs alone: the worst of more runs is
    worse; `upper_bound` of the quantiles over time says what holds of runs to come.

    Args:
        values: of an index, shape (T, ..., n): time first, runs last, axes or components between; (T,) is one run.
            Magnitudes count.
        level: probability, in (0, 1).
        how: "ensemble", "temporal" or "mixed".

    Returns:
        The limit, shape (...), in the unit of the values; inf where too many runs hold NaN, which is warned of.

    Raises:
        ValueError: no value, a level outside (0, 1), or no such interpretation.

    Example:
        >>> interpret(np.array([[1.0, -3.0], [2.0, 0.5]]), 0.5, "mixed")
        1.0
    """
    kinds = ("ensemble", "temporal", "mixed")
    if not isinstance(how, str) or how not in kinds:
        check.refuse("how", f"be one of {', '.join(kinds)}", check.short(how))
    level = _probability("level", level, "the probability of the requirement")
    values, xp = _numbers("values", values)
    if values.ndim == 0 or not values.size:
        check.refuse(
            "values", "hold numbers of shape (T, ..., n), time first and runs last", f"of shape {values.shape}"
        )
    values = xp.abs(values[:, None] if values.ndim == 1 else values)
    values = xp.where(xp.isnan(values).any(0), np.inf, values)
    _report(values[0])
    match how:
        case "ensemble":
            limit = _least(values.max(0), level, xp)
        case "temporal":
            limit = _least(xp.moveaxis(values, 0, -1), level, xp).max(-1)
        case _:
            limit = _least(xp.moveaxis(values, 0, -1).reshape(*values.shape[1:-1], -1), level, xp)
    return limit if limit.shape or xp is jnp else float(limit)


def runs_needed(level: float, confidence: float, rank: int = 1) -> int:
    """The smallest number of runs whose rank-th largest bounds the ``level`` quantile with that confidence.

    Of n independent values at least ``rank`` lie above the quantile with probability
    1 - sum_{i < rank} C(n, i) (1 - level)^i level^(n - i), whatever their distribution (Wilks, 1941).

    level: probability of the requirement. confidence: that the bound holds. rank: 1 for the largest; a higher one takes
    more runs and gives a tighter bound. Raises ValueError for numbers outside (0, 1) and rank < 1.

    >>> runs_needed(0.9973, 0.90)
    852
    """
    level = _probability("level", level, "the probability of the requirement")
    confidence = _probability("confidence", confidence, "the confidence of the bound")
    rank = check.whole("rank", rank)
    few, many = rank - 1, rank
    while _confidence(many, rank, level) < confidence:
        few, many = many, 2 * many
    return _first(lambda n: _confidence(n, rank, level) >= confidence, few, many)


def upper_bound(values, level: float, confidence: float) -> Bound:
    """An upper bound of the ``level`` quantile of a number that every run has one of, at a confidence.

    The lowest value of which order statistics promise the confidence, whatever the distribution: the r-th largest, with
    the greatest r that `runs_needed` allows. Runs must be independent. The instants of a run are not, so that pooled
    instants would claim more than they know; take one number a run: its largest value (ensemble), its quantile over
    time (temporal), or its value at an instant drawn at random (mixed).

    Args:
        values: one of each run, shape (n,). NaN counts as inf, which is warned of.
        level: probability of the requirement, in (0, 1).
        confidence: probability that the bound holds, in (0, 1).

    Returns:
        `Bound`.

    Raises:
        ValueError: values of another shape, fewer runs than `runs_needed`, or numbers outside (0, 1).

    Example:
        >>> upper_bound(np.arange(1000.0), 0.99, 0.90)
        Bound(value=994.0, rank=6, confidence=0.9338604883927486, n=1000)
    """
    level = _probability("level", level, "the probability of the requirement")
    confidence = _probability("confidence", confidence, "the confidence of the bound")
    values, xp = _numbers("values", values)
    if values.ndim != 1:
        check.refuse("values", "hold one number a run, shape (n,)", f"of shape {values.shape}")
    n = len(values)
    rank = _greatest_rank(n, level, confidence)
    if not rank:
        least = runs_needed(level, confidence)
        check.refuse(
            "values", f"be of at least {least} runs for the level {level} at confidence {confidence}", f"of {n}"
        )
    values = xp.where(xp.isnan(values), np.inf, values)
    _report(values)
    value = xp.sort(values)[n - rank]
    return Bound(value if xp is jnp else float(value), rank, _confidence(n, rank, level), n)


def _confidence(n: int, rank: int, level: float) -> float:
    """Probability that at least ``rank`` of n independent values lie above the ``level`` quantile."""
    from scipy.special import betainc

    return float(betainc(rank, n - rank + 1, float(1 - _exact(level))))


@lru_cache
def _greatest_rank(n: int, level: float, confidence: float) -> int:
    """The greatest rank of n values that bounds the ``level`` quantile with the confidence; 0 if none does."""
    return _first(lambda r: r > n or _confidence(n, r, level) < confidence, 0, n + 1) - 1


def _first(holds, low: int, high: int) -> int:
    """The first whole number above low at which a condition holds, which stays true from there on; it holds at high."""
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


def _least(values, level: float, xp):
    """The least of the values in the last axis that at least a share ``level`` of them does not exceed."""
    n = values.shape[-1]
    k = ceil(_exact(level) * n) - 1
    return xp.sort(values)[..., k] if xp is jnp else np.partition(values, k)[..., k]


def _exact(level: float) -> Fraction:
    """The probability as it is written: of 10 000 values 0.9973 counts 9973, which its binary rounding would not."""
    return Fraction(repr(level))


def _probability(name: str, value, reason: str) -> float:
    value = check.number(name, value)
    check.between(name, value, 0, 1, reason)
    return value


def _samples(name: str, time, dt, least: int) -> int:
    """How many steps of dt a time is."""
    dt, time = check.number("dt", dt), check.number(name, time)
    check.positive("dt", dt)
    check.positive(name, time)
    steps = round(min(time / dt, 2.0**62))
    if steps < least or abs(time / dt - steps) > 1e-6 * steps:
        check.refuse(name, f"be a whole number of `dt` = {dt:g} s, at least {least}", f"{time:g}")
    return steps


def _numbers(name: str, values):
    """The values as floating numbers, and the library whose they are."""
    if isinstance(values, jax.Array):
        if check.is_key(values) or values.dtype.kind not in "biuf":
            check.real(name, values)
        return values.astype(jnp.result_type(values, 1.0)), jnp
    values = check.real(name, values)
    return (values if values.dtype.kind == "f" else values.astype(float)), np


def _report(values) -> None:
    """Warn of runs, in the last axis, that were found to be inf for NaN that they hold."""
    if check.concrete(values):
        bad = np.isinf(np.asarray(values)).any(axis=tuple(range(values.ndim - 1)))
        if bad.any():
            check.warn(f"{bad.sum()} of {bad.size} runs hold NaN or inf: they count as above every limit.")
