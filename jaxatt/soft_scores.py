"""Soft scores: smooth terms that a cost is made of, and their weighted sum. Pure functions and tallies.

Tracking and effort need none of this: ``scores.rms(log.e_q @ log.e_q, inside)`` and the like are smooth already. What is
not smooth, alarms above all, has a smooth stand-in here whose limit for temperature -> 0 is the real thing: tune on the
stand-in, judge by the real thing. As in `scores`, a tally takes the numbers of one tick of one scenario; arrays are
tallied element by element.

May import: check, vec, scores.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check, scores
from jaxatt.vec import safe_sqrt


def weighted(terms, weights: dict):
    """The cost: the sum over the weights of weight times mean of the term. Terms without weight do not count.

    Args:
        terms: a dict, or a NamedTuple such as the scores of a sweep; the mean is over all scenarios.
        weights: [1 / unit of the term] by name.

    Returns:
        A scalar.

    Raises:
        KeyError: a weight without a term.

    Example:
        >>> cost = weighted(found, dict(rms_q=100.0, rms_u=0.02))
    """
    terms = terms._asdict() if hasattr(terms, "_asdict") else terms
    scores.tell("term", {name: terms[name] for name in weights})
    return sum(weight * jnp.mean(terms[name]) for name, weight in weights.items())


def penalty(excess):
    """Price of a constraint excess <= 0: the square of what exceeds it, 0 where it holds; smooth to first order."""
    over = jnp.maximum(excess, 0)
    return over * over


# alarms


def soft_windowed(evaluation, n, longest: int):
    """Sum of an evaluation, (T, ...), over a window of real length n [ticks] in [1, longest]; shape (T, ...).

    `detection.windowed` with a length that has a gradient: the oldest value counts in part. Raises ValueError for
    longest < 1.
    """
    a = jnp.asarray(evaluation)
    longest = min(check.whole("longest", longest), len(a))  # a window holds no more than the run
    weights = jnp.clip(n - jnp.arange(longest), 0, 1)
    padded = jnp.concatenate([jnp.zeros((longest - 1, *a.shape[1:]), a.dtype), a])
    return sum(weights[i] * padded[longest - 1 - i : longest - 1 - i + len(a)] for i in range(longest))


def soft_alarm(evaluation, threshold, temperature):
    """A probability of alarm [1]; for temperature -> 0, in the unit of the evaluation, the step at the threshold."""
    return jax.nn.sigmoid((evaluation - threshold) / temperature)


def soft_delay(probability, dt):
    """Expected time [s] to the first alarm, sum_k prod_{j<k} (1 - p_j) dt; at most T dt.

    probability: p of the ticks, (T, ...); dt: [s] between them. Returns (...).
    """
    silent = jnp.cumprod(1 - probability, axis=0)
    return dt * (1 + jnp.sum(silent[:-1], axis=0))


class Delay(NamedTuple):
    """Expected waiting time [s] for the first alarm in a window; its whole length if none is likely."""

    waited: Any = 0.0  # [s]
    silent: Any = 1.0  # [1] probability of no alarm so far
    rest: Any = 0.0  # [s] what rounding has left out of the time

    def __add__(self, later):
        waited, rest = scores.plus(self.waited, self.rest, self.silent * later.waited, self.silent * later.rest)
        return Delay(waited, self.silent * later.silent, rest)

    def value(self):
        return self.waited + self.rest


class Detection(NamedTuple):
    """Smooth stand-ins of a detector's three numbers: tallies."""

    delay: Annotated[Any, "s"]  # from the onset to the first alarm
    miss: Annotated[Any, "1"]  # share of the faulty time without alarm
    false_alarms: Annotated[Any, "1"]  # share of alarms before the onset


def detection(now, probability, onset, start=0.0) -> Detection:
    """Tally delay, miss and false alarms of the probability of `soft_alarm` around a fault's onset [s].

    start: when false alarms begin to count [s]. The delay is 0 for an alarm at the first tick of the fault; it is one
    tick less than `soft_delay`, and can be had without keeping the run.
    """
    faulty, quiet = now.t >= onset, (now.t < onset) & (now.t >= start)
    silent = jnp.where(faulty, 1 - probability, 1)
    waited = jnp.where(faulty, now.dt * silent, 0)
    return Detection(
        delay=Delay(waited, silent, jnp.zeros_like(waited)),
        miss=scores.mean(1 - probability, faulty),
        false_alarms=scores.mean(probability, quiet),
    )


# settling


class SoftSettling(NamedTuple):
    """Expected last time [s] outside a band, counted from the start of a window; 0 if it was never left."""

    time: Any = 0.0  # [s]
    inside: Any = 1.0  # [1] probability of not having been outside
    length: Any = 0.0  # [s] of the window so far
    rest: Any = 0.0  # [s] what rounding has left out of the length

    def __add__(self, later):
        length, rest = scores.plus(self.length, self.rest, later.length, later.rest)
        back = (1 - later.inside) * (self.length + self.rest - self.time)
        return SoftSettling(self.time + back + later.time, self.inside * later.inside, length, rest)

    def value(self):
        return self.time


def soft_settling(now, outside, inside: Any = True) -> SoftSettling:
    """Tally a smooth settling time [s]; outside: probability of being outside the band, `soft_alarm` of the error.

    The plain sum of ``outside`` would not see that an overshoot leaves the band once more, late but briefly.
    """
    inside = scores.truth(inside)
    out = jnp.where(inside, scores.real(outside), 0)
    length = jnp.where(inside, now.dt * jnp.ones_like(out), 0)
    return SoftSettling(length * out, 1 - out, length, jnp.zeros_like(length))


# chatter


class Chatter(NamedTuple):
    """Root mean square change from tick to tick in a window; NaN if it held fewer than two ticks.

    All fields have the shape of the value that is tallied, and but for ``ticks`` its unit, squared in ``total``.
    """

    total: Any = 0.0  # sum of squares of the changes
    ticks: Any = 0  # [1] number of ticks in it
    first: Any = 0.0  # first value
    last: Any = 0.0  # last value
    rest: Any = 0.0  # what rounding has left out of the sum

    def __add__(self, later):
        jump = jnp.where((self.ticks > 0) & (later.ticks > 0), later.first - self.last, 0)
        total, rest = scores.plus(self.total, self.rest, jump * jump + later.total, later.rest)
        return Chatter(
            total,
            self.ticks + later.ticks,
            jnp.where(self.ticks > 0, self.first, later.first),
            jnp.where(later.ticks > 0, later.last, self.last),
            rest,
        )

    def value(self):
        total = jnp.asarray(self.total + self.rest)
        jumps = jnp.asarray(self.ticks, total.dtype) - 1
        return jnp.where(jumps > 0, safe_sqrt(total / jnp.where(jumps > 0, jumps, 1)), jnp.nan)


def chatter(value, inside: Any = True) -> Chatter:
    """Tally how much ``value``, a command, jumps from tick to tick in one window: the wear of an actuator."""
    value, inside = scores.real(value), scores.truth(inside)
    kept = jnp.where(inside, value, 0)
    nothing = jnp.zeros_like(kept)
    return Chatter(nothing, jnp.broadcast_to(inside.astype(np.int32), kept.shape), kept, kept, nothing)


# estimators


def innovation_cost(innovation, variance, valid: Any = True):
    """Negative log likelihood of a scalar innovation that a filter believes to be N(0, variance); 0 where not valid.

    Its mean over a run is least where the filter's noise levels are the true ones: the way to tune Q and R without
    knowing the truth. Vector measurements: add those of sequential scalar updates.
    """
    S = jnp.where(valid, variance, 1)
    r = jnp.where(valid, innovation, 0)
    return jnp.where(valid, 0.5 * (r * r / S + jnp.log(2 * jnp.pi * S)), 0)


# stability


def growth_rate(matrix, period, sharpness):
    """Smooth largest growth rate [1/s] of a sampled loop: log-sum-exp of those of `linear.growth_rates`.

    matrix: (..., n, n) over one period [s], of `linear.sampled`; sharpness: [s], the larger the closer: the result is
    above the largest rate by at most log(n) / sharpness. Where two modes cross, the maximum has a corner and this has
    none. A stable loop with margin m is ``penalty(growth_rate(...) + m)``. Differentiable but where eigenvalues
    coincide; LAPACK, so never in a scan.
    """
    z = jnp.linalg.eigvals(matrix)
    square = jnp.real(z) ** 2 + jnp.imag(z) ** 2
    rates = jnp.log(jnp.maximum(square, 1e-300 if square.dtype == jnp.float64 else 1e-37)) / (2 * period)
    return jax.nn.logsumexp(sharpness * rates, axis=-1) / sharpness
