"""The likelihood of a flight by the innovations of on-board code, and numbers of params by name.

A Kalman filter states at every tick how far it expects each measurement to lie off: nu ~ N(0, S). The product of these densities over a
flight is the likelihood of all measurements (Schweppe, 1965), and so of every number that the filter believes.

May import: check, clock, contract, engine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from math import log, pi
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.clock import time_of
from jaxatt.contract import Now
from jaxatt.engine import match_state


class Model(NamedTuple):
    """On-board code, and where it tells its innovations.

    A filter that predicts with the command of its own ``decide`` must be given the command that flew, not that of other
    params: record it and put it into the computer (docs/guides/identify.md).
    """

    decide: Callable  # (params, now, computer, readings) -> computer, log, as in a closed loop
    innovations: Callable  # of a log: an `Innovation`, a pair of value (k,) and covariance (k, k), or a list of these
    dt: float  # [s] between ticks


class Flights(NamedTuple):
    """Recordings of n flights, every leaf leading with them."""

    computer: Any  # what the computer knows before the first tick, (n, ...)
    readings: Any  # what ``decide`` takes, (n, T, ...)


def put(params: Any, numbers: Mapping[str, Any]) -> Any:
    """params with some numbers replaced by name, ``{"wheel.friction.viscous": v, "J.x.x": j}``.

    Args:
        params: NamedTuples, nested; "axes.0" is the first element of a tuple.
        numbers: new values by dotted name; a whole branch may be replaced by one like it.

    Returns:
        params of the same structure.

    Raises:
        ValueError: a name that params does not have.
        TypeError: what is no mapping.

    Example:
        >>> put(loop.params, {"R": jnp.exp(theta["log_R"])})
    """
    check.mapping("numbers", numbers)
    for name, value in numbers.items():
        params = _put(params, str(name).split("."), value, str(name))
    return params


def _put(tree: Any, path: list[str], value, name: str) -> Any:
    here, *rest = path
    of_tuple = map(str, range(len(tree))) if isinstance(tree, tuple) else ()
    known = list(getattr(tree, "_fields", of_tuple))
    if here not in known:
        near = ", ".join(get_close_matches(here, known, 3) or known)
        check.refuse("numbers", f"name fields of params (here: {near or 'none, it is a number'})", repr(name))
    i = known.index(here)
    new = _put(tree[i], rest, value, name) if rest else value
    parts = [*tree[:i], new, *tree[i + 1 :]]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def likelihood(model: Model, params, computer, readings):
    """Negative log-likelihood of the innovations of one flight, tick by tick, and how many measurements there were. Pure.

    Args:
        model: `Model`.
        params: what the engineer ships.
        computer: what the computer knows before the first tick.
        readings: what ``decide`` takes, every leaf with the T ticks in its first axis.

    Returns:
        nll (T,) [nats] and number of measurements (T,).

    Raises:
        TypeError: innovations that are none; ``decide`` that returns another structure.

    Example:
        >>> nll, rows = likelihood(model, loop.params, computer, readings)
    """
    params, (computer, readings) = check.converted(params, (computer, readings))
    dtype = check.float_type((params, computer, readings))

    def tick(computer, told):
        k, y = told
        out = model.decide(params, Now(k, time_of(k, model.dt, dtype), model.dt), computer, y)
        if not isinstance(out, tuple) or len(out) != 2:
            raise TypeError(f"`decide` must return computer, log, but it is {check.short(out)}.")
        nll, rows = surprise(model.innovations(out[1]))
        return match_state(out[0], computer, "decide"), (nll.astype(dtype), rows.astype(dtype))

    ticks = jnp.arange(len(jax.tree.leaves(readings)[0]))
    return jax.lax.scan(tick, jax.tree.map(jnp.asarray, computer), (ticks, readings))[1]


def surprise(told) -> tuple[Any, Any]:
    """nll [nats] and number of measurements of what a `Model` calls innovations, both ().

    Of a pair (value, covariance): (rows log 2 pi + log det S + nu' S^-1 nu) / 2 over the measurements that are finite.

    Raises TypeError for what is no innovation.
    """
    if hasattr(told, "nll") and hasattr(told, "rows"):
        return jnp.asarray(told.nll), jnp.asarray(told.rows)
    pair = isinstance(told, tuple) and len(told) == 2
    if pair and np.ndim(told[0]) == 1 and np.shape(told[1]) == np.shape(told[0]) * 2:
        return _gaussian(*told)
    if isinstance(told, (list, tuple)) and told:
        nll, rows = zip(*map(surprise, told))
        return sum(nll), sum(rows)
    must = "`innovations` must return an Innovation, a pair of value (k,) and covariance (k, k), or a list of them"
    raise TypeError(f"{must}, but it is {check.short(told)}.")


def _gaussian(value, S):
    """nll and number of measurements of value (k,) ~ N(0, S), by elimination of one measurement after the other."""
    dtype = jnp.promote_types(jnp.result_type(value, S), jnp.float32)  # readings may be counts
    value, S = (jnp.asarray(a, dtype) for a in (value, S))
    there = jnp.isfinite(value)

    def one(i, carry):
        value, S, nll = carry
        s = jnp.where(there[i], S[i, i], 1)
        told = log(2 * pi) + jnp.log(s) + value[i] ** 2 / s
        gain = jnp.where(there[i], S[i] / s, 0)
        return value - gain * value[i], S - gain[:, None] * S[i], nll + 0.5 * jnp.where(there[i], told, 0)

    known = jnp.where(there[:, None] & there, S, 0)
    start = jnp.where(there, value, 0), known, jnp.zeros((), dtype)
    return jax.lax.fori_loop(0, len(value), one, start)[2], jnp.sum(there, dtype=dtype)
