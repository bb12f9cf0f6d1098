"""How a small probability changes with numbers of params: its gradient, from the runs that fail.

P(s > b) changes where runs stand on the edge s = b. With f(b) = -dP/db, the density of the score there,

    dP / dtheta = f(b) E[ds/dtheta | s = b],

so d ln P / dtheta is the slope of -ln P over b, which the exceedance curve gives, times the mean gradient of the score
in the parameter on the edge, which the kept failures give. No chain is run again.

May import: check, compiling, contract, engine, loss, noise, sweeping.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.compiling import compiled
from jaxatt.contract import System
from jaxatt.engine import prepared, validated
from jaxatt.loss import Curve, Loss
from jaxatt.noise import CHUNK
from jaxatt.sweeping import scores_of

REACH = 10.0  # the slope is taken where P is at most this many times that of the event


class Sensitivity(NamedTuple):
    """d ln P / d theta, and how sure it is."""

    gradient: Any  # a tree like theta [1 / unit of theta]
    error: Any  # likewise: standard error, by the repeats; that of ``slope`` is left out
    slope: float  # [1 / unit of the score] -d ln P / db at the threshold
    mean: Any  # likewise [unit of the score / unit of theta]: mean gradient of the score on the edge


def sensitivity(loss: Loss, system: System, params_of: Callable, theta, *, ticks: int, score: Callable) -> Sensitivity:
    """The gradient of the logarithm of a probability in numbers of params, from the failures that were kept.

    It needs a score that is differentiable in them, such as the peak of a smooth log. Failures near the threshold tell
    what happens on it: the gradient of the score is fitted over the score by a line, and taken at the threshold.

    Args:
        loss: what `rare.probability` returned for ``params_of(theta)``.
        system: the loop.
        params_of: theta -> params.
        theta: a tree of numbers, where the loss was found; few of them, for the derivative is forward.
        ticks, score: as of `rare.probability`.

    Returns:
        `Sensitivity`: d ln P / d theta with its standard error.

    Raises:
        TypeError: what is no `Loss`, no function or no number.
        ValueError: a loss without levels or with fewer than 8 failures, and a gradient that is not finite.

    Example:
        >>> params_of = lambda gains: loop.params._replace(k_q=gains[0], k_w0=gains[1])
        >>> told = rare.sensitivity(
        ...     loss, loop.system, params_of, jnp.array([330.0, 125.0]), ticks=400, score=peak
        ... )
    """
    check.kind("loss", loss, Loss)
    check.function("params_of", params_of)
    check.function("score", score)
    ticks = check.whole("ticks", ticks)
    kept = loss.failures
    if not len(loss.levels) or loss.curve is None or len(kept.score) < 8:
        check.refuse("loss", "have levels and at least 8 failures", f"one with {len(kept.score)}: more repeats")
    if ticks != kept.noise.shape[1]:
        check.refuse("ticks", f"be the {kept.noise.shape[1]} of the loss", ticks)
    dtype = kept.noise.dtype
    theta = jax.tree.map(lambda a: jnp.asarray(a, dtype), check.numbers("theta", theta))
    check.finite("theta", theta)
    if not sum(a.size for a in jax.tree.leaves(theta)):
        check.refuse("theta", "hold a number", "an empty tree")
    validated(system, params_of(theta), jax.tree.map(lambda a: a[0], kept.scenario), ticks=ticks)
    last = lambda a: np.moveaxis(np.asarray(a), 0, -1)
    noise = np.pad(last(kept.noise), [(0, -ticks % CHUNK), (0, 0), (0, 0)])
    tree = compiled(score_slopes, 4)(system, score, params_of, ticks, theta, jax.tree.map(last, kept.scenario), noise)
    check.finite("the gradient of `score`", tree)
    weight = kept.weight / np.sum(kept.weight)
    excess = np.asarray(kept.score, float) - loss.curve.b[-1]
    without = [kept.repeat != r for r in np.unique(kept.repeat)]
    at_edge = lambda slopes, use: _at_edge(excess[use], np.asarray(slopes, float)[use], weight[use])
    mean = jax.tree.map(lambda slopes: at_edge(slopes, slice(None)), tree)
    error = jax.tree.map(lambda slopes: _jackknife([at_edge(slopes, use) for use in without]), tree)
    slope = _slope(loss.curve)
    times = lambda tree: jax.tree.map(lambda a: slope * a, tree)
    return Sensitivity(times(mean), times(error), slope, mean)


def score_slopes(system, score: Callable, params_of: Callable, ticks: int, theta, scenarios, noise):
    """Gradients of the scores of runs in theta, a tree like it whose leaves lead with the runs; runs last in the rest."""
    chunk = lambda c: jax.lax.dynamic_slice_in_dim(noise, c * CHUNK, CHUNK)

    def scored(theta):
        params = jax.tree.map(lambda a: _real(a, noise.dtype), params_of(theta))
        params, days = prepared(system, params, scenarios)
        return jax.tree.leaves(scores_of(system, score, noise.shape[-1], ticks, params, days, chunk))[0]

    return jax.jacfwd(scored)(theta)


def _real(a, dtype):
    return jnp.asarray(a, dtype) if jnp.issubdtype(jnp.result_type(a), jnp.floating) else a


def _jackknife(left):
    """Standard error of a mean from what it is without each of its parts."""
    n, left = len(left), np.array(left)
    return np.sqrt((n - 1) / n * np.sum((left - left.mean(axis=0)) ** 2, axis=0))


def _at_edge(excess, slopes, weight):
    """Mean slopes where the excess is zero, by a line fitted with weights."""
    weight = weight / weight.sum()
    mean = weight @ excess
    spread = weight @ (excess - mean) ** 2
    along = lambda weight: np.tensordot(weight, slopes, 1)
    tilt = along(weight * (excess - mean)) / spread if spread > 0 else 0.0
    return along(weight) - tilt * mean


def _slope(curve: Curve) -> float:
    """-d ln P / db at the end of the curve, by a parabola through its last part."""
    b, p = np.asarray(curve.b, float), np.asarray(curve.p, float)
    near = (p > 0) & (p <= REACH * p[-1])
    scale = b[near][0] - b[near][-1]
    fit = np.polynomial.polynomial.polyfit((b[near] - b[-1]) / scale, np.log(p[near]), min(2, near.sum() - 1))
    return float(-fit[1] / scale)
