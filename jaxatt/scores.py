"""Tallies: what a sweep keeps of a run instead of its trajectory.

A score is one pure function (params, scenario, now, log) -> tree of tallies, of one scenario and one tick. The tally of
a whole run is the sum of those of its ticks, and `values` turns the sum into numbers. The defaults of a tally's fields
are those of a run without ticks. A NaN in the log stays visible: means, extremes and final values become NaN, `always`
False. value, condition: a number of the tick, or an array of any shape, which that of the result is; bools and whole
numbers count as numbers, and what is the same in all scenarios is tallied like the rest. inside: bool, whether the tick
lies in the window. Sums carry what rounding leaves out of them, counts are integers: in float32 a mean, rms or total of
20 million ticks is right to 1e-7, of 2^31 to 1e-6.

May import: check, vec.
"""

from __future__ import annotations

from contextvars import ContextVar
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt.check import short
from jaxatt.vec import safe_sqrt


def plus(total, rest, more, more_rest):
    """Sum of two sums, and what rounding leaves out of it (Kahan, 1965); rest, more_rest: what it left out of the two.

    An infinite sum stays infinite.
    """
    left_out = more + (rest + more_rest)
    ahead = total + left_out
    return ahead, jnp.where(jnp.isfinite(ahead), left_out - (ahead - total), 0)


class Mean(NamedTuple):
    """Mean over the ticks of a window; NaN if it held none."""

    total: Any = 0.0  # [unit of the value] sum so far
    ticks: Any = 0  # [1] number of ticks in it
    rest: Any = 0.0  # [unit of the value] what rounding has left out of the sum

    def __add__(self, later):
        total, rest = plus(self.total, self.rest, later.total, later.rest)
        return Mean(total, self.ticks + later.ticks, rest)

    def value(self):
        total = jnp.asarray(self.total + self.rest)
        ticks = jnp.asarray(self.ticks, total.dtype)
        return jnp.where(ticks == 0, jnp.nan, total / jnp.where(ticks == 0, 1, ticks))


class Rms(NamedTuple):
    """Root mean square over the ticks of a window; NaN if it held none."""

    total: Any = 0.0  # [unit of the value, squared] sum of squares so far
    ticks: Any = 0  # [1] number of ticks in it
    rest: Any = 0.0  # [unit of the value, squared] what rounding has left out of the sum

    def __add__(self, later):
        return Rms(*(Mean(*self) + Mean(*later)))

    def value(self):
        return safe_sqrt(Mean(*self).value())


class Peak(NamedTuple):
    """Largest value in a window; NaN if it held no tick."""

    largest: Any = -jnp.inf  # [unit of the value]

    def __add__(self, later):
        return Peak(jnp.maximum(self.largest, later.largest))

    def value(self):
        return jnp.where(self.largest == -jnp.inf, jnp.nan, self.largest)


class First(NamedTuple):
    """First time [s] at which something held; inf if never."""

    t: Any = jnp.inf  # [s]

    def __add__(self, later):
        return First(jnp.minimum(self.t, later.t))

    def value(self):
        return self.t


class Settling(NamedTuple):
    """Last time [s] outside a band in a window; 0 if never, inf if still outside at its end, NaN if it held no tick."""

    outside: Any = -jnp.inf  # [s] last time outside
    end: Any = -jnp.inf  # [s] last time in the window

    def __add__(self, later):
        return Settling(jnp.maximum(self.outside, later.outside), jnp.maximum(self.end, later.end))

    def value(self):
        settled = jnp.where(self.outside == self.end, jnp.inf, jnp.maximum(self.outside, 0))
        return jnp.where(self.end == -jnp.inf, jnp.nan, settled)


class Always(NamedTuple):
    """Whether something held at every tick."""

    held: Any = True  # bool

    def __add__(self, later):
        return Always(self.held & later.held)

    def value(self):
        return self.held


class Final(NamedTuple):
    """Value at the last tick."""

    last: Any = jnp.nan  # [unit of the value]

    def __add__(self, later):
        return later

    def value(self):
        return self.last


def real(value):
    """value as a floating array: bools and whole numbers in the floating type of JAX."""
    kind = jnp.result_type(value)
    if not jnp.issubdtype(kind, jnp.floating):
        kind = jnp.result_type(float)
    return jax.lax.convert_element_type(value, kind)


def truth(condition):
    """condition as an array of bool; NaN is false."""
    condition = jnp.asarray(condition)
    return condition if condition.dtype == bool else (condition != 0) & (condition == condition)


def _where(inside, value, otherwise):
    return value if inside is True else jnp.where(truth(inside), value, otherwise)


def mean(value, inside: Any = True) -> Mean:
    """Tally the mean of value (a bool gives a share) over the ticks where ``inside`` holds."""
    kept = _where(inside, real(value), 0)
    return Mean(kept, jnp.broadcast_to(truth(inside).astype(np.int32), kept.shape), jnp.zeros_like(kept))


def rms(square, inside: Any = True) -> Rms:
    """Tally a root mean square where ``inside`` holds; takes the square, for instance ``log.q @ log.q``."""
    return Rms(*mean(square, inside))


def peak(value, inside: Any = True) -> Peak:
    """Tally the largest value over the ticks where ``inside`` holds."""
    return Peak(_where(inside, real(value), -jnp.inf))


def first(now, condition, since: Any = 0.0) -> First:
    """Tally the first time [s], counted from ``since``, at which the condition holds."""
    t = real(now.t)
    return First(jnp.where(truth(condition), t - jnp.asarray(since, t.dtype), jnp.inf))


def settling(now, outside, inside: Any = True) -> Settling:
    """Tally the settling time [s]: the last time at which ``outside`` holds, in the window ``inside``."""
    outside = truth(outside)
    end = _where(inside, jnp.broadcast_to(real(now.t), outside.shape), -jnp.inf)
    return Settling(
        jnp.where(outside, end, -jnp.inf), jnp.broadcast_to(end, jnp.broadcast_shapes(end.shape, outside.shape))
    )


def always(condition) -> Always:
    """Tally whether the condition holds at every tick."""
    return Always(truth(condition))


def final(value) -> Final:
    """Tally the value at the last tick."""
    return Final(value)


def finite(tree):
    """Whether every number of a tree is finite."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)]
    kind = np.result_type(np.float32, *(jnp.result_type(leaf) for leaf in leaves))
    total = sum(jnp.sum(leaf).astype(kind) for leaf in leaves)  # one inf or NaN makes the sum inf or NaN
    return jnp.isfinite(total)


def is_tally(node) -> bool:
    """Whether a node of a score tree is a tally: anything with ``+`` and ``value()``."""
    return hasattr(node, "value") and callable(node.value)


def empty(tally):
    """The tally of no tick, with the shapes and dtypes of the given one."""
    if not is_tally(tally):
        raise TypeError(f"`score` must return a tree of tallies, such as scores.rms(x), but it holds {short(tally)}.")
    start = lambda a, d: d if jnp.issubdtype(a.dtype, jnp.floating) or np.isfinite(d) else 0
    return type(tally)(*(jnp.full(a.shape, start(a, d), a.dtype) for a, d in zip(tally, type(tally)())))


def add(a, b):
    """Sum of two trees of tallies, b later than a."""
    return jax.tree.map(lambda x, y: x + y, a, b, is_leaf=is_tally)


def values(tree):
    """The numbers of a tree of tallies."""
    return jax.tree.map(lambda tally: tally.value(), tree, is_leaf=is_tally)


# more tallies


class Span(NamedTuple):
    """Largest minus smallest value in a window; NaN if it held no tick."""

    largest: Any = -jnp.inf  # [unit of the value]
    smallest: Any = jnp.inf  # [unit of the value]

    def __add__(self, later):
        return Span(jnp.maximum(self.largest, later.largest), jnp.minimum(self.smallest, later.smallest))

    def value(self):
        return jnp.where(self.largest == -jnp.inf, jnp.nan, self.largest - self.smallest)


def span(value, inside: Any = True) -> Span:
    """Tally how far apart the extremes of value lie over the ticks where ``inside`` holds."""
    value = real(value)
    return Span(_where(inside, value, -jnp.inf), _where(inside, value, jnp.inf))


# sums, and when a peak came


class Total(NamedTuple):
    """Sum over the ticks of a window; 0 if it held none."""

    total: Any = 0.0  # [unit of the value] sum so far
    rest: Any = 0.0  # [unit of the value] what rounding has left out of it

    def __add__(self, later):
        return Total(*plus(*self, *later))

    def value(self):
        return self.total + self.rest


class PeakTime(NamedTuple):
    """Time [s] of the first largest value; NaN if there was no tick."""

    largest: Any = -jnp.inf  # [unit of the value]
    t: Any = jnp.nan  # [s]

    def __add__(self, later):
        higher = later.largest > self.largest
        return PeakTime(jnp.maximum(self.largest, later.largest), jnp.where(higher, later.t, self.t))

    def value(self):
        return self.t


def total(value, inside: Any = True) -> Total:
    """Tally the sum of value over the ticks where ``inside`` holds."""
    kept = _where(inside, real(value), 0)
    return Total(kept, jnp.zeros_like(kept))


def peak_time(now, value) -> PeakTime:
    """Tally the time [s] of the largest value."""
    value = real(value)
    return PeakTime(value, jnp.broadcast_to(real(now.t), value.shape))


# yes or no as a number that can be climbed


class Margin(NamedTuple):
    """How far the largest value in a window stayed below a threshold; negative beyond it, NaN if it held no tick."""

    least: Any = jnp.inf  # [unit of the value]

    def __add__(self, later):
        return Margin(jnp.minimum(self.least, later.least))

    def value(self):
        return jnp.where(self.least == jnp.inf, jnp.nan, self.least)


class Crossing(NamedTuple):
    """Time [s] at which a value first exceeds a threshold, interpolated between ticks; inf if never."""

    t: Any = jnp.inf  # [s]
    first: Any = jnp.nan  # [unit of the value] excess at the first tick
    first_t: Any = jnp.nan  # [s] of that tick
    last: Any = jnp.nan  # [unit of the value] excess at the last tick
    last_t: Any = jnp.nan  # [s] of that tick

    def __add__(self, later):
        share = self.last / (self.last - jnp.where(later.first > 0, later.first, 1))  # the last excess is not positive
        between = self.last_t + share * (later.first_t - self.last_t)
        begun = ~jnp.isnan(self.first_t)
        met = jnp.where((later.first > 0) & begun, between, later.t)
        first, first_t = (jnp.where(begun, a, b) for a, b in zip(self[1:3], later[1:3]))
        ended = ~jnp.isnan(later.last_t)
        last, last_t = (jnp.where(ended, b, a) for a, b in zip(self[3:], later[3:]))
        return Crossing(jnp.where(self.t < jnp.inf, self.t, met), first, first_t, last, last_t)

    def value(self):
        return self.t


def margin(value, threshold, inside: Any = True) -> Margin:
    """Tally how far value stays below a threshold over the ticks where ``inside`` holds: a miss is a margin above 0."""
    return Margin(_where(inside, threshold - real(value), jnp.inf))


def alarm_time(now, value, threshold, since: Any = 0.0) -> Crossing:
    """Tally the time [s] from ``since`` to the first value above a threshold after it, interpolated between ticks.

    Continuous where `first` moves by whole ticks, so that its tail can be climbed.
    """
    t = real(now.t)
    excess = (real(value) - threshold).astype(t.dtype)
    excess, t = jnp.broadcast_arrays(excess, t - jnp.asarray(since, t.dtype))
    excess, t = (jnp.where(t >= 0, a, jnp.nan) for a in (excess, t))
    return Crossing(jnp.where(excess > 0, t, jnp.inf), excess, t, excess, t)


# the value at an event


class Held(NamedTuple):
    """Value at the first tick at which something held; NaN if it never did."""

    seen: Any = False  # bool
    kept: Any = jnp.nan  # [unit of the value]

    def __add__(self, later):
        return Held(self.seen | later.seen, jnp.where(self.seen, self.kept, later.kept))

    def value(self):
        return jnp.where(self.seen, self.kept, jnp.nan)


def held(value, condition) -> Held:
    """Tally the value at the first tick at which the condition holds."""
    value = real(value)
    seen = jnp.broadcast_to(truth(condition), value.shape)
    return Held(seen, jnp.where(seen, value, jnp.nan))


# what a cost that is not finite is made of

listening: ContextVar[bool] = ContextVar("whether somebody asks what a cost is made of", default=False)
told: list[tuple[str, dict]] = []  # what was told meanwhile


def tell(kind: str, parts: dict) -> None:
    """Keep the parts of a cost, by name, in ``told`` when the cost is computed; nothing where nobody is listening.

    kind: what messages call a part, such as "term".
    """
    if listening.get():
        jax.debug.callback(lambda parts: told.append((kind, parts)), parts)
