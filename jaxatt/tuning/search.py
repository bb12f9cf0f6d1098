"""The search: gradient steps by any optimizer of optax, from one start or many, over parameters or scenarios.

May import: check, compiling, noise, resuming, sweeping, bounds, gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from math import gcd
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, PartitionSpec

from jaxatt import check
from jaxatt.compiling import jitted
from jaxatt.noise import one_key
from jaxatt.resuming import mark_of, replaced
from jaxatt.sweeping import progress_bar
from jaxatt.tuning.bounds import bounded, ends_of
from jaxatt.tuning.gradient import blamed, floats, value_and_gradient

# the search


class History(NamedTuple):
    """What a search met, step by step; every leaf leads with the steps, then the starts where there are several."""

    theta: Any  # (steps, ...) parameters at which the step was taken
    cost: Any  # (steps,) their cost at the search's key
    gradient: Any  # (steps,) norm of the gradient
    step: Any  # (steps,) [1] factor on the optimizer's update: below 1 after a step that ended in NaN


class _Best(NamedTuple):
    cost: Any
    theta: Any
    state: Any


class _Search(NamedTuple):
    """Everything that a search knows between two steps: what `save` writes."""

    theta: Any
    state: Any  # of the optimizer
    factor: Any  # [1] on the optimizer's update
    best: _Best


def tune(
    cost: Callable, theta, optimizer, steps: int, key, *, fresh: bool = False, forward: bool | None = None,
    save: str | Path | None = None, progress: bool | None = None,
) -> tuple[Any, History]:  # fmt: skip
    """Minimise a cost over a tree of numbers.

    A step that ends in a cost or gradient that is not finite is taken back: the search goes on from the best theta with
    updates half as long. Judge what was found on another key.

    Args:
        cost: (theta, key) -> scalar, in pure JAX.
        theta: start, any tree of numbers.
        optimizer: any of optax, schedules and line searches included.
        steps: how many.
        key: of scenarios and noise.
        fresh: False: every step sees the same key: common random numbers, the cost is a smooth function. True: step k
            takes its gradient at ``fold_in(key, k)``: other scenarios and noise at every step, so that the search
            cannot fit a few of them. "Best" means one thing in both cases, the least cost at ``key`` itself, which with
            fresh is a validation that no step was taken on, at one evaluation more per step.
        forward: see `value_and_gradient`.
        save: file (.npz) that holds the search after every step; if it exists, the search goes on from there, and its
            result equals that of an uninterrupted one bit for bit.
        progress: show a bar; None shows it on terminals and in notebooks, after two seconds.

    Returns:
        The best theta met, and the `History`.

    Raises:
        ValueError: the cost is not finite at the start: the message says which term of `soft_scores.weighted`, or which
            score of a sweep, in which scenario; steps < 1 or fewer than the file holds; a file of another search (cost,
            start, optimizer, key or release of JAX).
        TypeError: the cost is no scalar, theta holds no numbers, or the optimizer is none of optax.

    Example:
        >>> best, history = jaxatt.tune(cost, dict(k_q=330.0), optax.adam(0.1), 100, jax.random.key(0))
    """
    _check_search(cost, optimizer)
    steps, key, theta = check.whole("steps", steps), one_key(key), floats("theta", theta)
    check.a_number("theta", theta)
    step = lambda search, key, k: _step(cost, optimizer, forward, fresh, search, key, k)
    why = lambda keys: blamed(cost, theta, *keys)
    best, history = _run(step, _start(optimizer, theta), steps, key, fresh, save, progress, why)
    return best.theta, history


def multi_start(
    cost: Callable, thetas, optimizer, steps: int, key, *, fresh: bool = False, forward: bool | None = None,
    save: str | Path | None = None, progress: bool | None = None,
) -> tuple[Any, History]:  # fmt: skip
    """`tune` from many starts at once.

    One compiled step moves all starts side by side. A start that is not finite stays where it is and costs no other one
    anything. The best of every start: ``best_of(history)``.

    Args:
        cost, optimizer, steps, key, fresh, forward, save, progress: as of `tune`.
        thetas: the starts, the first axis of every leaf.

    Returns:
        The best theta of all, and the `History`.

    Raises:
        ValueError, TypeError: as `tune`, for the start only if no start is finite; leaves of thetas that do not lead
            with the same number of starts.

    Example:
        >>> thetas = dict(k_q=np.geomspace(30.0, 3000.0, 8))
        >>> best, history = multi_start(cost, thetas, optax.adam(0.1), 100, jax.random.key(0))
    """
    _check_search(cost, optimizer)
    steps, key, thetas = check.whole("steps", steps), one_key(key), floats("thetas", thetas)
    sizes = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(thetas)}
    if len(sizes) != 1 or () in sizes or (0,) in sizes:
        check.refuse("thetas", "lead with the same number of starts in every leaf", f"with {sorted(sizes)}")
    one = lambda search, key, k: _step(cost, optimizer, forward, fresh, search, key, k)
    step = jax.vmap(one, in_axes=(0, None, None))
    start = jax.vmap(lambda theta: _start(optimizer, theta))(thetas)
    why = lambda keys: blamed(cost, jax.tree.map(lambda a: a[0], thetas), *keys)
    best, history = _run(step, start, steps, key, fresh, save, progress, why)
    return jax.tree.map(lambda a: a[np.argmin(best.cost)], best.theta), history


def best_of(history: History):
    """The best theta of every start of a `multi_start`.

    Args:
        history: what it returned.

    Returns:
        A tree like theta whose leaves lead with the starts, and the costs, (starts,); inf for a start whose cost was
        never finite.

    Raises:
        TypeError: what is no `History`.
        ValueError: that of `tune`, which has one start.

    Example:
        >>> thetas, costs = best_of(history)
    """
    check.kind("history", history, History)
    if np.ndim(history.cost) != 2:
        check.refuse("history.cost", "have shape (steps, starts), as that of `multi_start`", np.shape(history.cost))
    shape = np.shape(check.real("history.cost", history.cost))
    for name, leaf in (("gradient", history.gradient), *(("theta", leaf) for leaf in jax.tree.leaves(history.theta))):
        found = np.shape(check.real(f"history.{name}", leaf))
        if 0 in shape or found[: len(shape)] != shape or (name == "gradient" and found != shape):
            check.refuse(f"history.{name}", f"lead with steps and starts, as the costs, {shape}", f"of shape {found}")
    finite = np.where(np.isfinite(history.cost) & np.isfinite(history.gradient), history.cost, np.inf)
    at = np.argmin(finite, axis=0), np.arange(finite.shape[1])
    return jax.tree.map(lambda a: a[at], history.theta), finite[at]


def _check_search(cost, optimizer) -> None:
    check.function("cost", cost)
    for name in ("init", "update"):
        check.function(f"optimizer.{name}", getattr(optimizer, name, None))


def _none(kind) -> float:
    """The least cost before there was any: no inf, which jax_debug_infs would stop."""
    return np.finfo(kind).max


def _start(optimizer, theta) -> _Search:
    kind = check.float_type(theta)
    state = optimizer.init(theta)
    return _Search(theta, state, jnp.ones((), kind), _Best(jnp.full((), _none(kind), kind), theta, state))


def _step(cost, optimizer, forward, fresh: bool, search: _Search, key, k):
    """One step of a search, pure: the next search, and the costs and the norm of the gradient where it stood."""
    theta, state, factor, best = search
    seen = jax.random.fold_in(key, k) if fresh else key
    value, gradient = value_and_gradient(cost, theta, seen, forward=forward)
    judged = cost(theta, key) if fresh else value
    line_search = isinstance(optimizer, optax.GradientTransformationExtraArgs)
    more = dict(value=value, grad=gradient, value_fn=lambda theta: cost(theta, seen)) if line_search else {}
    updates, ahead = optimizer.update(gradient, state, theta, **more)
    moved = optax.apply_updates(theta, jax.tree.map(lambda u: factor * u, updates))
    size = jnp.linalg.norm(ravel_pytree(gradient)[0])

    def choose(condition, a, b):
        return jax.tree.map(lambda a, b: jnp.where(condition, a, b), a, b)

    fine = jnp.isfinite(judged) & jnp.isfinite(value) & jnp.isfinite(size)
    judged = judged.astype(factor.dtype)
    best = choose(fine & (judged < best.cost), _Best(judged, theta, state), best)
    theta, state = choose(fine, (moved, ahead), (best.theta, best.state))
    return _Search(theta, state, jnp.where(fine, factor, factor / 2), best), (judged, size)


def _run(
    step: Callable, search: _Search, steps: int, key, fresh, save, progress, why: Callable
) -> tuple[_Best, History]:
    """All steps, one compiled call each, so that a bar can move and a file can follow.

    why: (keys) -> which parts of the cost are not finite at the (first) start.
    """
    key = jax.random.wrap_key_data(jnp.asarray(key))
    search = jax.device_get(search)
    step = jitted(step)
    trail: list[History] = []
    if save is not None:
        path = check.place("save", save)
        mark = mark_of([step.lower(search, key, np.int32(0))], (jax.random.key_data(key), search))
        search, trail = _resumed(path, mark, search, steps)
    with progress_bar(progress, steps, " steps") as bar:
        bar.update(len(trail))
        for k in range(len(trail), steps):
            at = search
            search, (value, size) = jax.device_get(step(search, key, np.int32(k)))
            trail.append(History(at.theta, value, size, at.factor))
            if (search.best.cost == _none(search.best.cost.dtype)).all():
                met = f"{np.ravel(value)[0]}, with a gradient of {np.ravel(size)[0]}"
                seen = why([key, jax.random.fold_in(key, k)] if fresh else [key])
                check.refuse("cost", "be finite, with a finite gradient, at the start", met + seen)
            if save is not None:
                _saved(path, mark, search, trail)
            bar.set_postfix(cost=f"{np.min(search.best.cost):.4g}", refresh=False)
            bar.update()
    return search.best, _stacked(trail)


def _stacked(trail: list[History]) -> History:
    return jax.tree.map(lambda *a: np.stack(a), *trail)


def _saved(path: Path, mark: str, search: _Search, trail: list[History]) -> None:
    """Write the search, one whole file whenever the power fails."""
    leaves = {f"search{i}": leaf for i, leaf in enumerate(jax.tree.leaves(search))}
    leaves |= {f"history{i}": leaf for i, leaf in enumerate(jax.tree.leaves(_stacked(trail)))}
    replaced(path, dict(mark=np.array(mark), **leaves))


def _resumed(path: Path, mark: str, search: _Search, steps: int) -> tuple[_Search, list[History]]:
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        return search, []
    read = lambda held, name, like: jax.tree.unflatten(
        jax.tree.structure(like), [held[f"{name}{i}"] for i in range(len(jax.tree.leaves(like)))]
    )
    one = History(search.theta, search.factor, search.factor, search.factor)
    try:
        with np.load(path, allow_pickle=False) as held:
            same = str(held["mark"]) == mark
            was, history = read(held, "search", search), read(held, "history", one)
        done = len(history.cost)
        same &= all(jax.tree.leaves(jax.tree.map(lambda a, b: a.dtype == b.dtype and a.shape == b.shape, was, search)))
        same &= all(jax.tree.leaves(jax.tree.map(lambda a, b: a.shape == (done, *np.shape(b)), history, one)))
    except Exception:  # whatever NumPy says of another or a broken file
        same, done = False, 0
    if not same:
        check.refuse("save", "hold a search of the same cost, start, optimizer, key and JAX", f"`{path}`")
    if steps < done:
        check.refuse("steps", f"not be fewer than the {done} that `{path}` holds", steps)
    return was, [jax.tree.map(lambda a, k=k: a[k], history) for k in range(done)]


# costs over many scenarios


def averaged(cost: Callable, draws: int) -> Callable:
    """A cost averaged over several keys made of the given one, dealt evenly to the local devices.

    A cost that draws 128 scenarios from its key becomes one of ``draws`` times as many, in as much memory. The number
    of devices that share the work is the largest that divides both; it changes the result by rounding only.

    Args:
        cost: (theta, key) -> scalar.
        draws: how many keys.

    Returns:
        The averaged cost, (theta, key) -> scalar.

    Raises:
        ValueError: draws < 1.

    Example:
        >>> best, history = jaxatt.tune(averaged(cost, 8), start, optax.adam(0.1), 100, jax.random.key(0))
    """
    check.function("cost", cost)
    draws = check.whole("draws", draws)
    devices = jax.local_devices()
    devices = devices[: gcd(draws, len(devices))]

    def mean(theta, key):
        one_key(key)
        one = lambda theta, keys: jax.lax.map(lambda key: cost(theta, key), keys)
        keys = jax.random.split(key, draws)
        if len(devices) > 1:
            everywhere, dealt = PartitionSpec(), PartitionSpec("draws")
            mesh = Mesh(np.array(devices), ("draws",))
            one = jax.shard_map(one, mesh=mesh, in_specs=(everywhere, dealt), out_specs=dealt, check_vma=False)
        return jnp.mean(one(theta, keys))

    return mean


# the scenario as the unknown


def worst_case(
    harm: Callable, low, high, optimizer, steps: int, key, *, starts: int = 8, progress: bool | None = None
) -> tuple[Any, History]:
    """Numbers of a scenario, within bounds, that do the most harm.

    Several starts, drawn evenly in the terms of `bounded`, climb at once. An ascent finds a worst case of its
    neighbourhood; only several starts that agree make it credible. What must hold meanwhile enters harm as a penalty:
    the most harmful fault that escapes detection is ``damage - weight * penalty(peak_residual - threshold)``, the
    smallest one that does a given damage ``-size - weight * penalty(limit - damage)``.

    Args:
        harm: (theta, key) -> scalar, smooth.
        low, high: bounds, trees like theta of finite numbers, for instance the sizes and the onset of a fault.
        optimizer, steps, key, progress: as of `tune`.
        starts: how many.

    Returns:
        The worst theta, and the `History` of the ascent, its theta within the bounds and its cost the harm.

    Raises:
        ValueError, TypeError: as `multi_start`; starts < 1; bounds that are not finite, or low not below high.

    Example:
        >>> worst, history = worst_case(harm, dict(size=0.0, onset=5.0), dict(size=0.1, onset=50.0), optax.adam(0.1), 60, key)
    """
    check.function("harm", harm)
    _check_search(harm, optimizer)
    starts, steps, key = check.whole("starts", starts), check.whole("steps", steps), one_key(key)
    check.finite("low", low)
    check.finite("high", high)
    ends_of(floats("low", low), low, high)
    key = jax.random.wrap_key_data(jnp.asarray(key))
    bounds = bounded(low, high)
    flat, unravel = ravel_pytree(floats("low", low))
    shares = jax.random.uniform(jax.random.fold_in(key, starts), (starts, flat.size), flat.dtype, 0.05, 0.95)
    thetas = jax.vmap(unravel)(jnp.log(shares / (1 - shares)))
    cost = lambda free, key: -harm(bounds.within(free), key)
    best, history = multi_start(cost, thetas, optimizer, steps, key, progress=progress)
    return bounds.within(best), history._replace(theta=bounds.within(history.theta), cost=-history.cost)
