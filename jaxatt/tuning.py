"""Tuning: the numbers of a closed loop, found by gradient of a cost over sampled scenarios.

A cost is a function (theta, key) -> scalar: theta is any pytree of numbers, and everything random, scenarios and
noise, comes from the key. Fixed scenarios are a cost that does not draw any. What a cost is made of is in
`objectives`; numbers that must stay positive or within bounds are tuned through `bounded`.

May import: check, engine, study.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from itertools import zip_longest
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
from jaxatt.check import door
from jaxatt.engine import compiled, one_key
from jaxatt.study import _bar

FEW = 6  # numbers up to which forward mode is the cheaper


@door
def value_and_gradient(cost: Callable, theta, key, *, forward: bool | None = None):
    """cost(theta, key), a scalar, and its gradient, a tree like theta. Pure.

    forward: whether by forward mode; None: for up to `FEW` numbers. It then costs less than reverse mode, compiles
    in a quarter of the time and keeps no history. Reverse mode keeps one state per chunk of ticks and repeats the
    rest. A loop with a covariance in it is the exception: there forward mode is the cheaper up to some 20 numbers.

    Raises TypeError if the cost is no scalar.
    """
    flat, unravel = ravel_pytree(check.numbers("theta", theta))
    _scalar(cost, theta, key)
    if not (flat.size <= FEW if forward is None else forward):
        return jax.value_and_grad(cost)(theta, key)
    along = lambda direction: jax.jvp(lambda a: cost(unravel(a), key), (flat,), (direction,))
    value, slopes = jax.vmap(along, out_axes=(None, 0))(jnp.eye(flat.size, dtype=flat.dtype))
    return value, unravel(slopes)


def _scalar(cost: Callable, theta, key) -> None:
    value = jax.eval_shape(cost, theta, key)
    if not hasattr(value, "shape"):
        raise TypeError(f"`cost` must be a scalar, but it is {check.short(value)}.")
    if value.shape != ():
        raise TypeError(f"`cost` must be a scalar, but its shape is {value.shape}.")


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
    """Minimise cost(theta, key), a scalar, over a pytree theta; returns the best theta met and the `History`.

    optimizer: any of optax, schedules and line searches included. A step that ends in a cost or gradient that is
    not finite is taken back: the search goes on from the best theta with updates half as long.

    fresh: False: every step sees the same key: common random numbers, the cost is a smooth function. True: step k
    takes its gradient at ``fold_in(key, k)``: other scenarios and noise at every step, so that the search cannot fit
    a few of them. "Best" means one thing in both cases, the least cost at ``key`` itself, which with fresh is a
    validation that no step was taken on, at one evaluation more per step. Either way judge what was found on another
    key.

    forward: see `value_and_gradient`. save: file (.npz) that holds the search after every step; if it exists, the
    search goes on from there, and its result equals that of an uninterrupted one bit for bit. progress: show a bar;
    None shows it on terminals and in notebooks, after two seconds.

    Raises ValueError if the cost is not finite at the start, for steps < 1 or fewer than the file holds, and for a
    file of another search (cost, start, optimizer, key or release of JAX); TypeError if the cost is no scalar.
    """
    _check_search(cost, optimizer)
    steps, key, theta = check.whole("steps", steps), one_key(key), _floats("theta", theta)
    check.a_number("theta", theta)
    step = lambda search, key, k: _step(cost, optimizer, forward, fresh, search, key, k)
    best, history = _run(step, _start(optimizer, theta), steps, key, save, progress)
    return best.theta, history


def multi_start(
    cost: Callable, thetas, optimizer, steps: int, key, *, fresh: bool = False, forward: bool | None = None,
    save: str | Path | None = None, progress: bool | None = None,
) -> tuple[Any, History]:  # fmt: skip
    """`tune` from many starts at once, the first axis of every leaf of thetas; returns the best theta of all.

    One compiled step moves all starts side by side; fresh and the other words as for `tune`. A start that is not
    finite stays where it is and costs no other one anything. The best of every start: ``best_of(history)``.

    Raises what `tune` raises, for the start only if no start is finite.
    """
    _check_search(cost, optimizer)
    steps, key, thetas = check.whole("steps", steps), one_key(key), _floats("thetas", thetas)
    sizes = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(thetas)}
    if len(sizes) != 1 or () in sizes or (0,) in sizes:
        check.refuse("thetas", "lead with the same number of starts in every leaf", f"with {sorted(sizes)}")
    one = lambda search, key, k: _step(cost, optimizer, forward, fresh, search, key, k)
    step = jax.vmap(one, in_axes=(0, None, None))
    start = jax.vmap(lambda theta: _start(optimizer, theta))(thetas)
    best, history = _run(step, start, steps, key, save, progress)
    return jax.tree.map(lambda a: a[np.argmin(best.cost)], best.theta), history


@door
def best_of(history: History):
    """The best theta of every start of a `multi_start`, a tree whose leaves lead with the starts; and their costs."""
    finite = np.where(np.isfinite(history.cost) & np.isfinite(history.gradient), history.cost, np.inf)
    at = np.argmin(finite, axis=0), np.arange(finite.shape[1])
    return jax.tree.map(lambda a: a[at], history.theta), finite[at]


def _check_search(cost, optimizer) -> None:
    check.function("cost", cost)
    for name in ("init", "update"):
        check.function(f"optimizer.{name}", getattr(optimizer, name, None))


def _floats(name: str, theta):
    if not jax.tree.leaves(check.numbers(name, theta)):
        raise TypeError(f"`{name}` must hold at least one number, but it is {check.short(theta)}.")

    def convert(a):  # by NumPy where it will do: it compiles nothing
        kind = jnp.result_type(a, float)
        return jnp.asarray(a if isinstance(a, jax.Array) else np.asarray(a, kind), kind)

    return jax.tree.map(convert, theta)


def _start(optimizer, theta) -> _Search:
    kind = check.float_type(theta)
    state = optimizer.init(theta)
    return _Search(theta, state, jnp.ones((), kind), _Best(jnp.full((), jnp.inf, kind), theta, state))


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


def _run(step: Callable, search: _Search, steps: int, key, save, progress) -> tuple[_Best, History]:
    """All steps, one compiled call each, so that a bar can move and a file can follow."""
    steps = check.whole("steps", steps)
    key = jax.random.wrap_key_data(jnp.asarray(one_key(key)))
    search = jax.device_get(search)
    lowered = compiled(step, 0).lower(search, key, np.int32(0))
    trail: list[History] = []
    if save is not None:
        path, mark = check.place("save", save), _mark(lowered, search, key)
        search, trail = _resumed(path, mark, search, steps)
    step = lowered.compile()
    with _bar(progress, steps, " steps") as bar:
        bar.update(len(trail))
        for k in range(len(trail), steps):
            at = search
            search, (value, size) = jax.device_get(step(search, key, np.int32(k)))
            trail.append(History(at.theta, value, size, at.factor))
            if not np.isfinite(search.best.cost).any():
                check.refuse("cost", "be finite, with a finite gradient, at the start", value)
            if save is not None:
                _saved(path, mark, search, trail)
            bar.set_postfix(cost=f"{np.min(search.best.cost):.4g}", refresh=False)
            bar.update()
    return search.best, _stacked(trail)


def _stacked(trail: list[History]) -> History:
    return jax.tree.map(lambda *a: np.stack(a), *trail)


def _mark(lowered, search: _Search, key) -> str:
    """What tells one search from another: its compiled program, constants included, its start and its key."""
    mark = hashlib.sha256(lowered.as_text().encode())
    for leaf in (jax.random.key_data(key), *jax.tree.leaves(search)):
        mark.update(np.asarray(leaf).tobytes())
    return mark.hexdigest()


def _saved(path: Path, mark: str, search: _Search, trail: list[History]) -> None:
    """Write the search beside the file, then rename it: whenever the power fails, one whole file is there."""
    leaves = {f"search{i}": leaf for i, leaf in enumerate(jax.tree.leaves(search))}
    leaves |= {f"history{i}": leaf for i, leaf in enumerate(jax.tree.leaves(_stacked(trail)))}
    beside = path.with_name(path.name + f".{os.getpid()}")
    with beside.open("wb") as file:
        np.savez(file, mark=np.array(mark), **leaves)
        file.flush()
        os.fsync(file.fileno())
    os.replace(beside, path)


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
    """The cost averaged over ``draws`` keys made of the given one, dealt evenly to the local devices.

    A cost that draws 128 scenarios from its key becomes one of ``draws`` times as many, in as much memory. The
    number of devices that share the work is the largest that divides both; it changes the result by rounding only.

    Raises ValueError for draws < 1.
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


# bounds


class Bounds(NamedTuple):
    """Two functions, inverse to each other, on trees of numbers."""

    free: Callable  # numbers within the bounds -> numbers without bounds, which an optimizer may move at will
    within: Callable  # back


def bounded(low, high) -> Bounds:
    """Bounds as a change of variables: any step of an optimizer on ``free(theta)`` stays in (low, high).

    low, high: trees like theta, or single numbers for all of it; -inf and inf leave a side open, a leaf's at once. A positive number
    is ``bounded(0, inf)``: the logarithm. Between two positive bounds a number moves in ratios, between others in
    differences; in both cases 0 is the middle.

    >>> gains = bounded(1e-3, 1e3)
    >>> best, _ = tune(lambda free, key: cost(gains.within(free), key), gains.free(start), optimizer, steps, key)
    >>> gains.within(best)

    Raises ValueError where low is not below high, and in ``free`` for concrete numbers outside.
    """

    def over(f, theta):
        leaves, structure, ends, paths = _bounds_of(theta, low, high)
        return jax.tree.unflatten(structure, [f(*end, leaf, path) for end, leaf, path in zip(ends, leaves, paths)])

    return Bounds(lambda theta: over(_free, theta), lambda free: over(_within, free))


def _bounds_of(theta, low, high):
    """The leaves of theta, their structure, low and high of each, checked, and their paths."""
    leaves, structure = jax.tree.flatten(_floats("theta", theta))
    spread = lambda b: jax.tree.leaves(b) if jax.tree.structure(b) == structure else [b] * len(leaves)
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(theta)]
    ends = list(zip(spread(low), spread(high)))
    for path, leaf, (a, b) in zip(paths, leaves, ends):
        for name, end in (("low", a), ("high", b)):
            shape = check.real(name + path, end).shape
            if not all(a in (1, b) for a, b in zip_longest(shape[::-1], leaf.shape[::-1], fillvalue=1)):
                check.refuse(name + path, f"broadcast to the shape {leaf.shape} of theta", shape)
        check.each(f"low{path}", f"be less than high, {check.short(b)}", a, np.asarray(a) < b)
    return leaves, structure, ends, paths


def _free(low, high, a, path):
    if check.concrete(a):
        check.each(
            f"theta{path}",
            f"lie in ({check.short(low)}, {check.short(high)})",
            a,
            (np.asarray(a) > low) & (np.asarray(a) < high),
        )
    no_low, no_high = _absent("low", low, path), _absent("high", high, path)
    if no_high:
        return jnp.asarray(a) if no_low else jnp.log(a - low)
    if no_low:
        return -jnp.log(high - a)
    if np.all(np.asarray(low) > 0):
        low, high, a = np.log(low), np.log(high), jnp.log(a)
    return jnp.log((a - low) / (high - a))


def _within(low, high, a, path):
    no_low, no_high = _absent("low", low, path), _absent("high", high, path)
    if no_high:
        return jnp.asarray(a) if no_low else low + jnp.exp(a)
    if no_low:
        return high - jnp.exp(-a)
    share = jax.nn.sigmoid(a)
    if np.all(np.asarray(low) > 0):
        return jnp.exp(np.log(low) + (np.log(high) - np.log(low)) * share)
    return low + (high - low) * share


def _absent(name: str, bound, path: str) -> bool:
    """Whether a leaf's bound is infinite: all of its numbers or none."""
    infinite = np.isinf(bound)
    if infinite.any() and not infinite.all():
        check.refuse(f"{name}{path}", "be finite or infinite throughout", bound)
    return bool(infinite.all())


# the scenario as the unknown


def worst_case(
    harm: Callable, low, high, optimizer, steps: int, key, *, starts: int = 8, progress: bool | None = None
) -> tuple[Any, History]:
    """The numbers of a scenario in (low, high) that do the most harm, and the `History` of the ascent.

    harm(theta, key) is a smooth scalar; theta, low and high are like trees of finite numbers, for instance the sizes
    and the onset of a fault. Several starts, drawn evenly in the terms of `bounded`, climb at once; the history's
    theta and cost are in the terms of the user: numbers within the bounds, and harm. What must hold meanwhile enters
    harm as a penalty: the most harmful fault that escapes detection is
    ``damage - weight * penalty(peak_residual - threshold)``, the smallest one that does a given damage
    ``-size - weight * penalty(limit - damage)``.

    An ascent finds a worst case of its neighbourhood; only several starts that agree make it credible.

    Raises ValueError as `multi_start` does, and for starts < 1.
    """
    check.function("harm", harm)
    _check_search(harm, optimizer)
    starts, steps, key = check.whole("starts", starts), check.whole("steps", steps), one_key(key)
    check.finite("low", low)
    check.finite("high", high)
    _bounds_of(_floats("low", low), low, high)
    key = jax.random.wrap_key_data(jnp.asarray(key))
    bounds = bounded(low, high)
    flat, unravel = ravel_pytree(_floats("low", low))
    shares = jax.random.uniform(jax.random.fold_in(key, starts), (starts, flat.size), flat.dtype, 0.05, 0.95)
    thetas = jax.vmap(unravel)(jnp.log(shares / (1 - shares)))
    cost = lambda free, key: -harm(bounds.within(free), key)
    best, history = multi_start(cost, thetas, optimizer, steps, key, progress=progress)
    return bounds.within(best), history._replace(theta=bounds.within(history.theta), cost=-history.cost)


# whether to believe a gradient


class GradientCheck(NamedTuple):
    """A gradient beside central differences; every field has shape (n,), the numbers of theta in a row."""

    gradient: Any  # by forward or reverse mode
    central: Any  # central difference of fourth order
    doubt: Any  # the difference's own uncertainty: by how much it changes when its step is halved
    relative: Any  # [1] |gradient - central| over the larger of the two; 0 where both are 0


def gradient_check(cost: Callable, theta, key, *, step: float | None = None, forward: bool | None = None):
    """Compare the gradient of cost(theta, key) with central differences: a `GradientCheck`.

    step: of the differences, relative to max(1, |theta|); None: the fifth root of the rounding unit, 7e-4 in float64.
    Where ``doubt`` is large beside ``central`` the cost is not smooth on that scale, and the gradient, however exact,
    says little about what a step of that size would do.

    Raises TypeError if the cost is no scalar.
    """
    check.function("cost", cost)
    one_key(key)
    if step is not None:
        check.positive("step", check.number("step", step))
    flat, unravel = ravel_pytree(_floats("theta", theta))
    at = lambda flat, key: cost(unravel(flat), key)
    if flat.size <= FEW if forward is None else forward:  # one compilation, the directions one by one
        along = lambda flat, way, key: jax.jvp(lambda a: at(a, key), (flat,), (way,))
        run = compiled(along, 0)
        _scalar(at, flat, key)
        gradient = np.array([run(flat, way, key)[1] for way in jnp.eye(flat.size, dtype=flat.dtype)])
        value = lambda flat: float(run(flat, jnp.zeros_like(flat), key)[0])
    else:
        both = compiled(lambda flat, key: value_and_gradient(at, flat, key, forward=False), 0)
        gradient = np.asarray(both(flat, key)[1])
        value = lambda flat: float(both(flat, key)[0])
    h = np.finfo(flat.dtype).eps ** 0.2 if step is None else step
    central, doubt = np.zeros((2, flat.size))
    for i in range(flat.size):
        size = h * max(1.0, abs(float(flat[i])))
        d = lambda by, i=i, size=size: value(flat.at[i].add(by * size))
        inner, middle, outer = d(0.5) - d(-0.5), (d(1) - d(-1)) / 2, (d(2) - d(-2)) / 4
        central[i] = (4 * inner - middle) / 3 / size
        doubt[i] = abs(central[i] - (4 * middle - outer) / 3 / size)
    larger = np.maximum(np.abs(gradient), np.abs(central))
    relative = np.abs(gradient - central) / np.where(larger > 0, larger, 1)
    return GradientCheck(gradient, central, doubt, relative)
