"""The loop: what a closed loop is, how one is run. Knows no spacecraft.

Time runs in ticks of ``dt``. A tick happens at its instant: sensors read, on-board code decides, a log is
written. Between ticks the continuous state flows, by RK4. Scenarios lie in lanes, the last axis of everything.

May import: check, vec, scores.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache, partial
from math import prod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax._src import xla_bridge  # the one place that knows whether a computation has run
from jax.dtypes import prng_key
from jax.extend.random import threefry_2x32

from jaxatt import check, scores
from jaxatt.vec import once

BLOCK = 128  # lanes that run together; with the seed it fixes a scenario's noise, so it is no option
CHUNK = 10  # ticks whose noise is drawn together, and between which reverse mode keeps the state


class Now(NamedTuple):
    """The tick under way."""

    k: Any  # () [1] number of the tick, traced
    t: Any  # () [s] k dt
    dt: float  # [s] to the next tick


def _no_check(params, scenario) -> None:
    pass


class System(NamedTuple):
    """A closed loop: functions and plain numbers, hence hashable and static under jit.

    x is the continuous state, moved by ``flow`` and, at jumps, by ``tick``; z is what is held between ticks.
    Both are pytrees (NamedTuples, as a rule). params is what the engineer ships, scenario what the day brings.
    """

    init: Callable  # (params, scenario) -> x, z for one scenario
    tick: Callable  # (params, scenario, now, x, z, noise) -> x, z, log; noise (normals, *lanes), standard normal
    flow: Callable  # (params, scenario, t, x, z) -> dx/dt
    dt: float  # [s] between ticks
    substeps: int = 1  # RK4 steps between ticks
    normals: int = 0  # standard normal numbers that one tick consumes
    check: Callable = _no_check  # (params, scenario) -> lanes of the scenario, or None; ValueError on bad input


@check.door
def rk4(f: Callable, t, x, h):
    """One classical Runge-Kutta step of dx/dt = f(t, x) from t [s] over h [s]; x any pytree.

    Raises ValueError where what f returns cannot be added to x.
    """

    def ahead(k, by):
        return jax.tree.map(lambda a, b: a + by * b, x, k)

    k1 = f(t, x)
    k2 = f(t + h / 2, ahead(k1, h / 2))
    k3 = f(t + h / 2, ahead(k2, h / 2))
    k4 = f(t + h, ahead(k3, h))
    return jax.tree.map(lambda a, b, c, d, e: a + h / 6 * (b + 2 * (c + d) + e), x, k1, k2, k3, k4)


@check.door
def every(k: int, now: Now, run: Callable, held):
    """``run()`` on ticks 0, k, 2k, ..., ``held`` on the others; all lanes share the tick, so only one is computed.

    Raises ValueError for k < 1 and where run does not return the structure, shapes and types of held.
    """
    check.whole("k", k)
    return jax.lax.cond(now.k % k == 0, run, lambda: held)


def like(tree, example, what: str):
    """tree with the shapes and dtypes of example, so that a scan can carry it; what: the function that made it.

    Raises TypeError where its structure, type or shape cannot be those of the example.
    """
    if jax.tree.structure(tree) != jax.tree.structure(example):
        raise TypeError(
            f"`{what}` must return the structure {jax.tree.structure(example)}, but it is {jax.tree.structure(tree)}."
        )

    def fit(a, b):
        if not jnp.can_cast(jnp.result_type(a), b.dtype, "same_kind"):
            raise TypeError(f"`{what}` must return the state's type {b.dtype}, but it is {jnp.result_type(a)}.")
        if jnp.broadcast_shapes(jnp.shape(a), b.shape) != b.shape:
            raise TypeError(f"`{what}` must return shape {b.shape} where the state has it, but it is {jnp.shape(a)}.")
        return jnp.broadcast_to(jnp.asarray(a, b.dtype), b.shape)

    return jax.tree.map(fit, tree, example)


def _start(system: System, params, scenario, lanes: int):
    """x, z at tick 0, in the floating type of the run, every leaf with its lanes."""
    init = partial(system.init, params)
    for _ in range(lanes):
        init = jax.vmap(init, in_axes=-1, out_axes=-1)
    dtype = check.float_type((params, scenario))

    def strong(a):
        a = jnp.asarray(a)
        return a.astype(dtype if jnp.issubdtype(a.dtype, jnp.floating) else a.dtype)

    return jax.tree.map(strong, init(scenario))


def _step(system: System, params, scenario, k, state, noise):
    """One tick and the flow to the next."""
    dtype = check.float_type((params, scenario))
    now = Now(k, k.astype(dtype) * system.dt, system.dt)
    x, z, log = system.tick(params, scenario, now, *state, noise)
    x, z = like((x, z), state, "tick")
    h = system.dt / system.substeps

    def flow(t, x):
        return once(lambda t, x: like(system.flow(params, scenario, t, x, z), x, "flow"), t, x)

    if system.substeps == 1:
        x = rk4(flow, now.t, x, h)
    else:
        times = now.t + h * jnp.arange(system.substeps, dtype=dtype)
        x, _ = jax.lax.scan(lambda x, t: (rk4(flow, t, x, h), None), x, times)
    return now, (x, z), log


def _run(
    system: System, params, scenario, lanes: int, ticks: int, chunk: int, noise: Callable, fold: Callable, tally,
    keep: Callable = lambda tally, outs: outs,
):  # fmt: skip
    """Run the loop for ticks, chunk by chunk; noise(c) gives those of chunk c, shape (chunk, normals, *lanes).

    fold(tally, now, log) -> tally, out is called at every tick, keep(tally, outs) after every chunk. Returns the last
    tally and what was kept, the chunks first; by default the outs, then with two leading axes (chunks, chunk). Outs
    past the last tick are zero.
    """
    chunks = -(-ticks // chunk)

    @jax.checkpoint
    def one(carry, k, n):
        state, tally = carry
        now, state, log = _step(system, params, scenario, k, state, n)
        tally, out = fold(tally, now, log)
        return (state, tally), out

    def guarded(carry, kn):
        if ticks % chunk == 0:
            return one(carry, *kn)
        _, shapes = jax.eval_shape(one, carry, *kn)
        nothing = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
        return jax.lax.cond(kn[0] < ticks, one, lambda carry, k, n: (carry, nothing), carry, *kn)

    @jax.checkpoint
    def many(carry, c):
        carry, outs = jax.lax.scan(guarded, carry, (c * chunk + jnp.arange(chunk), noise(c)))
        return carry, keep(carry[1], outs)

    (_, tally), outs = jax.lax.scan(many, (_start(system, params, scenario, lanes), tally), jnp.arange(chunks))
    return tally, outs


# noise


# Normal quantile as x P(w) / Q(w) with x = 2u - 1 and w = -log(4u(1 - u)): one formula from the centre to the
# tails, within 1e-8 relative of the exact quantile over all 2^23 values of u. Three times as fast as erf_inv on
# JAX 0.10. Fitted by iteratively reweighted least squares; tests/test_engine.py holds it against SciPy.
_P = (1.2533141498490095, 0.4325156793724996, 0.08401840867205965, 0.01094915946460716, 9.086772553634041e-4,
      3.491005456299212e-05)  # fmt: skip
_Q = (1.0, 0.08329848156363834, 0.03219616729462598, 0.001858744245195428, 1.809863938681891e-4,
      1.3188746002534835e-06)  # fmt: skip


def _polynomial(coefficients, w):
    value = coefficients[-1]
    for c in coefficients[-2::-1]:
        value = value * w + c
    return value


def _normal(bits):
    """Standard normal numbers of random 32-bit words, float32, by the inverse distribution."""
    u = ((bits >> 9).astype(jnp.float32) + 0.5) * 2.0**-23  # symmetric, never 0 or 1
    w = -jnp.log(4 * u * (1 - u))
    return (2 * u - 1) * _polynomial(_P, w) / _polynomial(_Q, w)


def _words(key, shape):
    """Random 32-bit words of a raw key: both words of each threefry block are used, twice as fast as random.bits."""
    return threefry_2x32(key, jnp.arange(prod(shape), dtype=jnp.uint32)).reshape(shape)


def _chunk_noise(system: System, key, k0, ticks: int, lanes: tuple, dtype):
    """Noise of the ticks k0 .. k0 + ticks - 1 from a raw key, shape (ticks, normals, *lanes)."""
    shape = (system.normals, *lanes)
    if system.normals == 0:
        return jnp.zeros((ticks, *shape), dtype)
    keys = jax.vmap(lambda k: jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), k)))
    bits = once(lambda k0: jax.vmap(lambda key: _words(key, shape))(keys(k0 + jnp.arange(ticks))), k0)
    return once(_normal, bits).astype(dtype)  # cast outside: within, float64 would halve the width of all of it


def raw_key(key):
    """A key's raw words, shape (*lanes, 2), from a typed key of shape (*lanes) or a raw one.

    Raises TypeError for anything else.
    """
    if hasattr(key, "dtype") and jnp.issubdtype(key.dtype, prng_key):
        key = jax.random.key_data(key)
    if not hasattr(key, "dtype") or key.dtype != jnp.uint32 or key.shape[-1:] != (2,):
        raise TypeError(f"`key` must be a key of jax.random.key(seed), but it is {check.short(key)}.")
    return key


def one_key(key):
    """`raw_key` of what must be a single key; ValueError for several."""
    key = raw_key(key)
    if key.ndim != 1:
        check.refuse("key", "be one key", f"of shape {key.shape[:-1]}")
    return key


def _block_key(key, block):
    return jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), block))


def noise_of(system: System, key, index: int, ticks: int):
    """The noise that scenario ``index`` of a sweep with this key meets, shape (ticks, normals), float32.

    Raises ValueError for ticks < 1, index < 0 and more noise than the free memory holds, TypeError for no key.
    """
    ticks, index = check.whole("ticks", ticks), check.whole("index", index, 0)
    key = one_key(key)
    check.fits_memory(f"`ticks` = {ticks}", 4 * BLOCK * ticks * system.normals, "ask for fewer")
    return compiled(_noise_of, 2, key)(system, ticks, key, index // BLOCK, index % BLOCK)


def _noise_of(system, ticks, key, block, lane):
    return _chunk_noise(system, _block_key(key, block), jnp.asarray(0), ticks, (BLOCK,), jnp.float32)[..., lane]


# running one loop


def simulate(system: System, params, scenario, noise_or_key, *, ticks: int, every: int = 1):
    """Run a closed loop and return its log, time first: every leaf has shape (records, ..., *lanes).

    noise_or_key: standard normal numbers of shape (ticks, normals, *lanes), or keys of shape (*lanes): one key
    for one scenario, ``jax.random.split(key, n)`` for n lanes. With lanes, every leaf of the scenario carries
    them in its last axis. every: keep the log of ticks 0, every, 2 every, ... Pure: jit, grad and vmap it.

    Raises ValueError on input that the system's check refuses, on ticks or every < 1, on noise of the wrong
    shape and on a log that the free memory does not hold; TypeError on what is no number or no key.
    """
    ticks, every = check.whole("ticks", ticks), check.whole("every", every)
    if hasattr(noise_or_key, "dtype") and jnp.issubdtype(noise_or_key.dtype, jnp.floating):
        if noise_or_key.ndim < 2 or noise_or_key.shape[:2] != (ticks, system.normals):
            check.refuse("noise", f"have shape ({ticks}, {system.normals}, *lanes)", noise_or_key.shape)
        keyed = False
    else:
        noise_or_key = raw_key(noise_or_key)
        keyed = True
    lanes = noise_or_key.shape[:-1] if keyed else noise_or_key.shape[2:]
    if 0 in lanes:
        check.refuse("noise_or_key", "hold at least one lane", f"of lanes {lanes}")
    params, scenario = admit(system, params, scenario, lanes)
    for path, leaf in jax.tree_util.tree_leaves_with_path(scenario) if lanes else ():
        if leaf.shape[-len(lanes) :] != lanes:
            name = f"scenario{jax.tree_util.keystr(path)}"
            check.refuse(name, f"carry the lanes {lanes} of the noise in its last axis", f"of shape {leaf.shape}")
    operands = params, scenario, noise_or_key
    run = compiled(_simulate, 4, operands)
    if not traced(operands):
        kept = tree_bytes(run.eval_shape(system, ticks, every, keyed, *operands))
        drawn = 8 * every * system.normals * prod(lanes) * keyed
        check.fits_memory(f"`ticks` = {ticks} with `every` = {every}", kept + drawn, "keep fewer records, by `every`")
    return run(system, ticks, every, keyed, *operands)


def tree_bytes(shapes) -> int:
    """Bytes that a tree of arrays, or of their shapes, takes."""
    return sum(prod(a.shape) * a.dtype.itemsize for a in jax.tree.leaves(shapes))


def _simulate(system, ticks, every, keyed, params, scenario, source):
    chunk = CHUNK if every == 1 else every
    dtype = check.float_type((params, scenario))
    lanes = source.shape[:-1] if keyed else source.shape[2:]
    if keyed:

        def noise(c):  # pyright: ignore[reportRedeclaration]
            draw = partial(_chunk_noise, system, k0=c * chunk, ticks=chunk, lanes=(), dtype=dtype)
            draw_lanes = lambda key: draw(key)
            for _ in lanes:  # the last axis first, behind it come the key's words
                draw_lanes = jax.vmap(draw_lanes, in_axes=-2, out_axes=-1)
            return draw_lanes(source)

    else:
        padded = jnp.pad(source.astype(dtype), [(0, -ticks % chunk)] + [(0, 0)] * (source.ndim - 1))
        chunks = padded.reshape(-1, chunk, *source.shape[1:])

        def noise(c):
            return chunks[c]

    run = partial(_run, system, params, scenario, len(lanes), ticks, chunk, noise)
    if every == 1:
        _, logs = run(lambda none, now, log: (none, log), None)
        return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:ticks], logs)

    def at_start():
        return _step(
            system, params, scenario, jnp.asarray(0), _start(system, params, scenario, len(lanes)), noise(0)[0]
        )[2]

    def hold(held, now, log):  # in the carry, so that what is not kept takes no memory
        return jax.tree.map(partial(jnp.where, now.k % every == 0), log, held), None

    nothing = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(at_start))
    return run(hold, nothing, lambda held, _: held)[1]


def admit(system: System, params, scenario, lanes: tuple | None = None):
    """params and scenario through the door: converted, and checked by the system where they are concrete.

    lanes: those that the scenario must carry, where the caller knows and the system can tell.
    """
    params, scenario = check.converted(params, scenario)
    told = system.check(params, scenario)
    if lanes is not None and told is not None and told != lanes:
        check.refuse("scenario", f"carry the lanes {lanes} of the noise or the key", f"of lanes {told}")
    return params, scenario


def fit_alone(system: System, params, scenario, lanes: tuple) -> None:
    """Refuse, by the system's check, params that do not fit the first scenario alone: such have lanes of their own."""
    if 0 not in lanes:
        system.check(params, jax.tree.map(lambda a: a[(..., *[0] * len(lanes))], scenario))


def block_scores(system: System, score: Callable, ticks: int, params, scenarios, key, block):
    """Scores of one block of `BLOCK` scenarios: a tree of values of shape (..., BLOCK). Pure.

    key: raw key of the sweep; block: number of the block, which with the key fixes its noise.
    """
    dtype = check.float_type((params, scenarios))
    key = _block_key(key, block)
    noise = partial(_block_noise, system, key, dtype)

    def scored(now, log):
        return jax.tree.map(lambda a: _in_lanes(a) if jnp.ndim(a) else a, score(params, scenarios, now, log))

    def fold(tally, now, log):
        return scores.add(tally, scored(now, log)), None

    def at_start():
        state = _start(system, params, scenarios, 1)
        now, _, log = _step(system, params, scenarios, jnp.asarray(0), state, noise(0)[0])
        return jax.tree.map(_in_lanes, scored(now, log))

    shapes = jax.eval_shape(at_start)
    nothing = jax.tree.map(scores.empty, shapes, is_leaf=scores.is_tally)
    tally, _ = _run(system, params, scenarios, 1, ticks, CHUNK, noise, fold, nothing)
    return scores.values(tally)


def _in_lanes(a):
    """What is one number, or one array, for all lanes, in every lane."""
    a = jnp.asarray(a)
    return a if a.shape[-1:] == (BLOCK,) else jnp.broadcast_to(a[..., None], (*a.shape, BLOCK))


def _block_noise(system, key, dtype, c):
    return _chunk_noise(system, key, c * CHUNK, CHUNK, (BLOCK,), dtype)


def block_log(system: System, ticks: int, params, scenarios, key, block, lane):
    """The log, time first, of one lane of a block: the same computation as `block_scores`."""
    noise = partial(_block_noise, system, _block_key(key, block), check.float_type((params, scenarios)))

    def fold(none, now, log):
        return none, jax.tree.map(lambda a: _in_lanes(a)[..., lane], log)

    _, logs = _run(system, params, scenarios, 1, ticks, CHUNK, noise, fold, None)
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:ticks], logs)


def block_records(system: System, record: Callable, ticks: int, every: int, params, scenarios, key, block):
    """record(log) of the ticks 0, every, 2 every, ... of a block: a tree of shape (records, ..., BLOCK)."""
    noise = partial(_block_noise, system, _block_key(key, block), check.float_type((params, scenarios)))

    def fold(none, now, log):
        return none, jax.tree.map(_in_lanes, record(log))

    _, logs = _run(system, params, scenarios, 1, ticks, CHUNK, noise, fold, None)
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:ticks:every], logs)


class _Lanes(NamedTuple):
    """z of a `vmapped` system: the user's, and a number whose axes are the lanes."""

    z: Any
    lanes: Any


def vmapped(system: System) -> System:
    """The system of a loop written for one scenario on plain arrays, (3,) and the like, made to carry lanes.

    Components of plain arrays lead too: noise has shape (normals,), and lanes are added behind. It costs speed,
    not correctness: covariances and other matrices run several times slower than in the lanes-last form.
    """

    def over(f, lanes, *operands):
        for _ in range(lanes.ndim):
            f = jax.vmap(f, in_axes=-1, out_axes=-1)
        return f(*operands)

    def init(params, scenario):
        x, z = system.init(params, scenario)
        return x, _Lanes(z, jnp.zeros(()))

    def tick(params, scenario, now, x, z, noise):
        one = lambda scenario, x, z, noise: system.tick(params, scenario, now, x, z, noise)
        x, inner, log = over(one, z.lanes, scenario, x, z.z, noise)
        return x, _Lanes(inner, z.lanes), log

    def flow(params, scenario, t, x, z):
        return over(lambda scenario, x, z: system.flow(params, scenario, t, x, z), z.lanes, scenario, x, z.z)

    def refuse(params, scenario):
        lanes = system.check(params, scenario)
        if lanes:
            fit_alone(system, params, scenario, lanes)
        return lanes

    return system._replace(init=init, tick=tick, flow=flow, check=refuse)


# compilation


def traced(*operands) -> bool:
    """Whether the caller, or one of the operands, is being traced by jit, grad or vmap."""
    return not check.concrete((operands, jnp.zeros(()) + 0))  # inside jit even 0 + 0 is a tracer


def compiled(f: Callable, static: int, *operands) -> Callable:
    """f jitted, its first ``static`` arguments static, with the CPU settings that a single jit can carry.

    An inner jit may carry none, hence the look at the operands.
    """
    return _jitted(f, static, traced(*operands) or jax.default_backend() != "cpu")


@cache
def _jitted(f: Callable, static: int, plain: bool):
    options = None if plain else {"xla_cpu_prefer_vector_width": 512}
    return jax.jit(f, static_argnums=tuple(range(static)), compiler_options=options)


_FLAGS = {
    "--xla_cpu_prefer_vector_width": "512",
    # loops of up to 10 MB become one compiled function; larger ones, of gradients, would take minutes to compile
    "--xla_backend_extra_options": "xla_cpu_small_while_loop_byte_threshold=10000000",
}


def fast_cpu() -> None:
    """Set the CPU compiler's process-wide flags for jaxatt's loops; call it before the first computation.

    Before JAX 0.12 it makes sweeps two to three times as fast; from there on the engine gives each jit what it
    needs, and this does nothing. It adds to the environment variable XLA_FLAGS, which the compiler reads once;
    flags already set there stay. Elsewhere than on CPU it does no harm. Raises RuntimeError if a computation has
    run already.
    """
    if xla_bridge.backends_are_initialized():
        raise RuntimeError("`fast_cpu` must be called before the first computation of JAX, but one has run.")
    if jax.__version_info__ < (0, 12):
        present = os.environ.get("XLA_FLAGS", "")
        wanted = [f"{name}={value}" for name, value in _FLAGS.items() if name not in present]
        os.environ["XLA_FLAGS"] = " ".join([present, *wanted]).strip()
