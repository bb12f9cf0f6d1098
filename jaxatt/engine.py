"""One run of a closed loop. Knows no spacecraft.

The functions of a `System` see one scenario. Inside the engine the scenarios of a block lie side by side in the last
axis of everything, the lanes: `jax.vmap` with the last axis takes each function over them, a single run being one lane.

May import: check, clock, fields, contract, compiling, noise, one_loop.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check, fields, one_loop
from jaxatt.clock import at_tick, time_of
from jaxatt.compiling import compiled, shared, traced, zeros
from jaxatt.contract import Now, System
from jaxatt.noise import CHUNK, chunk_noise, one_key

# parts of a loop's own functions


def rk4(f: Callable, t, x, h, stages: Any = ()):
    """One classical Runge-Kutta step of dx/dt = f(t, x) from t [s] over h [s]; x any pytree.

    stages: what f gets as a third argument, if anything: a tree whose leaves lead with the four stages of the step (its
    start, its middle twice, its end). The stages are one loop, so that f is compiled once and not four times.
    """
    x = jax.tree.map(jnp.asarray, x)
    ahead = lambda by, k: jax.tree.map(lambda a, b: a + by.astype(a.dtype) * b, x, k)
    third = bool(jax.tree.leaves(stages))

    def stage(carry, given):
        k, total = carry
        at, weight, seen = given
        k = f(t + at * h, ahead(at * h, k), *([seen] if third else []))
        return (k, jax.tree.map(lambda a, b: a + weight.astype(a.dtype) * b, total, k)), None

    dtype = check.float_type((x, t))
    at, weight = jnp.array([0, 0.5, 0.5, 1], dtype), jnp.array([1, 2, 2, 1], dtype) / 6
    nothing = jax.tree.map(jnp.zeros_like, x)
    (_, total), _ = jax.lax.scan(stage, (nothing, nothing), (at, weight, stages))
    return ahead(jnp.asarray(h, dtype), total)


def every(k: int, now: Now, run: Callable, held):
    """``run()`` on ticks 0, k, 2k, ..., ``held`` on the others: code that runs at a lower rate.

    Raises ValueError for k < 1 and TypeError where run does not return the structure, shapes and types of held.
    """
    check.whole("k", k)
    return jax.lax.cond(now.k % k == 0, lambda: match_state(run(), held, "run"), lambda: held)


def match_state(tree, example, what: str, name: str = ""):
    """tree with the types of example, so that it can take the place of it.

    what: the function that made it; name: what messages call the tree. Raises TypeError where structure, type or
    shape of a leaf differ, by the leaf's name.
    """
    there, wanted = (jax.tree_util.tree_leaves_with_path(a) for a in (tree, example))
    if jax.tree.structure(tree) != jax.tree.structure(example):
        names = [{name + jax.tree_util.keystr(path) for path, _ in leaves} for leaves in (wanted, there)]
        differ = [f"{word} {', '.join(sorted(some))}" for word, some in (("without", names[0] - names[1]),
                                                                        ("with", names[1] - names[0])) if some]  # fmt: skip
        found = " and ".join(differ) or str(jax.tree.structure(tree))
        raise TypeError(f"`{what}` must return the structure {jax.tree.structure(example)}, but it is {found}.")

    def fit(path, a, b):
        a, must = jnp.asarray(a), f"`{what}` must return {name}{jax.tree_util.keystr(path)}"
        if not jnp.can_cast(a.dtype, b.dtype, "same_kind"):
            raise TypeError(f"{must} of type {b.dtype}, but it is {a.dtype}.")
        if a.shape != jnp.shape(b):
            raise TypeError(f"{must} of shape {jnp.shape(b)}, but it is {a.shape}.")
        return a.astype(b.dtype)

    matched = [fit(path, a, jnp.asarray(b)) for (path, a), (_, b) in zip(there, wanted)]
    return jax.tree.unflatten(jax.tree.structure(example), matched)


# the loop over lanes


def over_lanes(f: Callable, n: int) -> Callable:
    """f of one scenario over n lanes, the last axis of every argument and result."""
    return jax.vmap(f, in_axes=-1, out_axes=-1, axis_size=n)


def alone(f: Callable, *operands):
    """f(*operands) of one scenario as the engine runs it: in one lane, without which filters have no reverse mode."""
    lane = jax.tree.map(lambda a: jnp.asarray(a)[..., None], operands)
    return jax.tree.map(lambda a: a[..., 0], over_lanes(f, 1)(*lane))


def start(system: System, params, scenario, n: int):
    """x, z at tick 0 in n lanes, in the floating type of the run: all of x, which flows, and what is floating of z."""
    dtype = check.float_type((params, scenario))

    def one(scenario):
        state = system.init(params, scenario)
        if not isinstance(state, tuple) or len(state) != 2:
            raise TypeError(f"`init` must return x, z, but it is {check.short(state)}.")
        x, z = jax.tree.map(jnp.asarray, state)
        held = lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a
        return jax.tree.map(lambda a: a.astype(dtype), x), jax.tree.map(held, z)

    return over_lanes(one, n)(scenario)


def times(system: System, params, scenario, k):
    """Number and time of the ticks k, (ticks,) of integers: of many at once, lest every use of a time works it out."""
    return k, time_of(k, system.dt, check.float_type((params, scenario)))


def step(system: System, params, scenario, n: int, at, state, noise, one_way: bool = False):
    """One tick in n lanes and the flow to the next: the instant, the state ahead and the log.

    at: number and time of the tick, one of `times`. one_way: nothing is differentiated, so that the flow may be one loop.
    """
    dtype = check.float_type((params, scenario))
    k, t = at
    now = Now(k, t, system.dt)

    def tick(scenario, x, z, noise):
        out = system.tick(params, scenario, now, x, z, noise)
        if not isinstance(out, tuple) or len(out) != 3:
            raise TypeError(f"`tick` must return x, z, log, but it is {check.short(out)}.")
        x, z = match_state(out[0], x, "tick", "x"), match_state(out[1], z, "tick", "z")
        return x, z, jax.tree.map(jnp.asarray, out[2])

    x, z, log = over_lanes(tick, n)(scenario, *state, noise)

    def flow(t, x):
        one = lambda scenario, x, z: match_state(system.flow(params, scenario, t, x, z), x, "flow", "x")
        return over_lanes(one, n)(scenario, x, z)

    h = system.dt / system.substeps
    if system.substeps == 1:
        return now, (rk4(lambda t, x: shared(flow, t, x), now.t, x, h), z), log
    times = now.t + h * jnp.arange(system.substeps, dtype=dtype)

    def substep(params, held, x, t):
        scenario, z = held
        return rk4(lambda t, x: match_state(system.flow(params, scenario, t, x, z), x, "flow", "x"), t, x, h)

    quick = one_way and one_loop.available()  # one step alone compiles longer so than it runs faster
    ahead = one_loop.advanced(substep, n, params, (scenario, z), x, times) if quick else None
    if ahead is None:
        one = lambda x, t: (rk4(lambda t, x: shared(flow, t, x), t, x, h), None)
        ahead, _ = jax.lax.scan(one, x, times)
    return now, (ahead, z), log


def run(
    system: System, params, scenario, n: int, ticks: int, chunk: int, noise: Callable, fold: Callable, tally,
    keep: Callable = lambda tally, outs: outs, one_way: bool = False,
):  # fmt: skip
    """Run n lanes for ticks, chunk by chunk; noise(c) gives those of chunk c, shape (chunk, normals, n).

    fold(tally, now, log) -> tally, out is called at every tick, keep(tally, outs) after every chunk. Returns the last
    tally and what was kept, the chunks first; by default the outs, then with two leading axes (chunks, chunk). Outs
    past the last tick are zero. Differentiable, unless one_way: see `step`.
    """

    @jax.checkpoint
    def one(carry, at, n_k):
        state, tally = carry
        now, state, log = step(system, params, scenario, n, at, state, n_k, one_way)
        tally, out = fold(tally, now, log)
        return (state, tally), out

    if ticks % chunk:
        one = jax.jit(one, inline=True)  # traced once for its shapes and its values

    def guarded(carry, told):
        if ticks % chunk == 0:
            return one(carry, *told)
        _, shapes = jax.eval_shape(one, carry, *told)
        return jax.lax.cond(told[0][0] < ticks, one, lambda carry, at, n: (carry, zeros(shapes)), carry, *told)

    @jax.checkpoint
    def many(carry, c):
        at = times(system, params, scenario, c * chunk + jnp.arange(chunk))
        carry, outs = jax.lax.scan(guarded, carry, (at, noise(c)))
        return carry, keep(carry[1], outs)

    chunks = -(-ticks // chunk)
    (_, tally), outs = jax.lax.scan(many, (start(system, params, scenario, n), tally), jnp.arange(chunks))
    return tally, outs


# one run

SHORT = 10_000  # records up to which nobody asks whether a log fits in memory: the question takes as long as 1000 ticks


def simulate(system: System, params, scenario, noise_or_key, *, ticks: int, every: int = 1):
    """Run one scenario of a closed loop.

    Pure: jit, grad and ``jax.vmap`` it like any function of JAX; for the scores of many scenarios `sweep` is faster.

    Args:
        system: the loop.
        params: what the engineer ships.
        scenario: what the day brings.
        noise_or_key: a key, or standard normal numbers (ticks, normals).
        ticks: how many ticks to run.
        every: keep the log of ticks 0, every, 2 every, ...

    Returns:
        The log that ``tick`` returns, time first: every leaf has shape (records, ...).

    Raises:
        ValueError: numbers outside their domain, ticks or every < 1, noise of the wrong shape, or a log that the
            free memory does not hold.
        TypeError: what is no number or no key; a function of the loop that returns the wrong structure or shape.

    Example:
        >>> from jaxatt.loops import observer_pd as loop
        >>> log = jaxatt.simulate(loop.system, loop.params, loop.scenario, jax.random.key(0), ticks=600)
    """
    check.kind("system", system, System)
    ticks, every = check.whole("ticks", ticks), check.whole("every", every)
    keyed = not (hasattr(noise_or_key, "dtype") and jnp.issubdtype(noise_or_key.dtype, jnp.floating))
    if keyed:
        source = one_key(noise_or_key)
    else:
        source = noise_or_key
        if source.shape != (ticks, system.normals):
            check.refuse("noise", f"have shape ({ticks}, {system.normals})", source.shape)
    params, scenario = validated(system, params, scenario, ticks=ticks)
    operands = params, scenario, source
    run = compiled(_simulate, 4, operands)
    if ticks > every * SHORT and not traced(operands):
        kept = tree_bytes(run.eval_shape(system, ticks, every, keyed, *operands))
        drawn = 8 * every * system.normals * keyed
        check.fits_memory(f"`ticks` = {ticks} with `every` = {every}", kept + drawn, "keep fewer records, by `every`")
    return run(system, ticks, every, keyed, *operands)


def _simulate(system, ticks, every, keyed, params, scenario, source):
    chunk = CHUNK if every == 1 else every
    dtype = check.float_type((params, scenario))
    scenario = jax.tree.map(lambda a: jnp.asarray(a)[..., None], scenario)
    if keyed:

        def noise(c):  # pyright: ignore[reportRedeclaration]
            return chunk_noise(system, source, c * chunk, chunk, (), dtype)[..., None]

    else:
        padded = jnp.pad(source.astype(dtype), [(0, -ticks % chunk), (0, 0)])
        chunks = padded.reshape(padded.shape[0] // chunk, chunk, system.normals, 1)

        def noise(c):
            return chunks[c]

    loop = partial(run, system, params, scenario, 1, ticks, chunk, noise)
    alone = lambda log: jax.tree.map(lambda a: a[..., 0], log)
    if every == 1:
        _, logs = loop(lambda none, now, log: (none, alone(log)), None)
        return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:ticks], logs)

    def at_start():
        at, none = jax.tree.map(lambda a: a[0], (times(system, params, scenario, jnp.arange(1)), noise(0)))
        return alone(step(system, params, scenario, 1, at, start(system, params, scenario, 1), none)[2])

    def hold(held, now, log):  # in the carry, so that what is not kept takes no memory
        return jax.tree.map(partial(jnp.where, now.k % every == 0), alone(log), held), None

    return loop(hold, zeros(jax.eval_shape(at_start)), lambda held, _: held)[1]


def tree_bytes(shapes) -> int:
    """Bytes that a tree of arrays, or of their shapes, takes."""
    return sum(prod(a.shape) * a.dtype.itemsize for a in jax.tree.leaves(shapes))


def prepared(system: System, params, scenario) -> tuple[Any, Any]:
    """params and scenario as arrays of one floating type, their instants put right: see `clock.at_tick`."""
    put = partial(at_tick, dt=system.dt)
    params, scenario = check.converted(params, scenario)
    return fields.instants(params, put), fields.instants(scenario, put)


def validated(system: System, params, scenario, n: int | None = None, ticks: int = 1) -> tuple[Any, Any]:
    """params and scenario converted to arrays of one floating type and, where they are concrete, checked.

    n: number of scenarios in the first axis of every leaf of scenario; None for a single one. ticks: of the run.
    """
    params, scenario = prepared(system, params, scenario)
    last = scenario if n is None else jax.tree.map(_batch_last, scenario)
    fields.validate("params", params)
    with check.scenarios(n, params, (ticks - 1) * system.dt):
        fields.validate("scenario", last, n)
        if check.concrete((params, scenario)):
            system.check(params, last)
    return params, scenario


def _batch_last(a):
    if a.ndim == 1:
        return a
    return np.moveaxis(np.asarray(a), 0, -1) if check.concrete(a) else jnp.moveaxis(a, 0, -1)
