"""What a machine checks before a detector is ranked, and the key of the test days, which the detectors themselves fix.

May import: telemetry, worlds, check, compiling, noise, sweeping.
"""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.compiling import jitted
from jaxatt.noise import one_key
from jaxatt.sweeping import recorded
from jaxatt.yardstick import worlds
from jaxatt.yardstick.telemetry import Detector
from jaxatt.yardstick.worlds import World

PACKETS, DAYS = 400, 256  # of the records that the checks play
CUTS = 100, 300  # packets after which another day follows
FORBIDDEN = ("callback", "infeed", "outfeed", "axis_index", "psum", "all_gather", "ppermute", "rng_uniform", "print")


class Checks(NamedTuple):
    """What the checks found of one detector; all True of one that may be ranked."""

    causal: bool  # what comes later changes no verdict
    alone: bool  # the order of the days changes none
    repeats: bool  # the same input gives the same bits
    pure: bool  # no callbacks, no effects, no axes of the machine
    runs: bool  # records such as a fault may bring, without a star sample, with zero gyros, give a score or NaN
    nanoseconds: float  # of a packet of one day, one core busy


def state_of(detector: Any):
    """z at the start, floats in float32 as in a run."""
    short = lambda a: a.astype(jnp.float32) if jnp.issubdtype(a.dtype, jnp.floating) else a
    return jax.tree.map(lambda a: short(jnp.asarray(a)), detector.init(detector.params))


def records(world: World):
    """Public healthy telemetry of a world, NumPy: packets and days in front."""
    key = jax.random.key(1)
    drawn = worlds.days(world, key, np.arange(DAYS), None)
    params = jax.tree.map(worlds.short, world.params)
    found = recorded(world.system, _telemetry, PACKETS, 1, params, drawn, one_key(key))
    return jax.tree.map(lambda a: np.moveaxis(a, -1, 1), found)


def _telemetry(log):
    return log.telemetry


def player(detector: Detector):
    """A compiled function: records, packets and days in front, to verdicts of the same axes."""

    def run(params, packets):
        n = jax.tree.leaves(packets)[0].shape[1]
        z = jax.tree.map(lambda a: jnp.broadcast_to(a[..., None], (*a.shape, n)), state_of(detector))
        step = jax.vmap(detector.step, in_axes=(None, -1, -1), out_axes=-1)

        def one(z, packet):
            after, verdict = step(params, z, packet)
            return jax.tree.map(lambda a, b: a.astype(b.dtype), after, z), verdict

        last = jax.tree.map(lambda a: jnp.moveaxis(a, 1, -1), packets)
        return jax.tree.map(lambda a: jnp.moveaxis(a, -1, 1), jax.lax.scan(one, z, last)[1])

    return jitted(run)


def checked(detector: Detector, world: World, whole) -> Checks:
    """Play public records of a world and judge; seconds, most of them to compile. whole: `records` of the world.

    Example:
        >>> all(checked(BASELINES["chi2_10"], WORLDS["leo4"], records(WORLDS["leo4"]))[:5])
        True
    """
    play = player(detector)
    bits = lambda records: [np.asarray(a) for a in jax.tree.leaves(play(detector.params, records))]
    same = lambda a, b: all(np.array_equal(x, y, equal_nan=True) for x, y in zip(a, b, strict=True))
    first = bits(whole)
    spent = []
    for _ in range(3):
        started = time.process_time()
        again = bits(whole)
        spent.append(time.process_time() - started)
    causal = True
    for cut in CUTS:
        other = jax.tree.map(lambda a, cut=cut: np.concatenate([a[:cut], np.roll(a[cut:], 1, axis=1)]), whole)
        causal &= same([a[:cut] for a in first], [a[:cut] for a in bits(other)])
    order = np.random.default_rng(0).permutation(DAYS)
    turned = bits(jax.tree.map(lambda a: a[:, order], whole))
    alone = all(np.allclose(a[:, order], b, rtol=1e-5, atol=1e-6, equal_nan=True) for a, b in zip(first, turned))
    try:
        odd = bits(world.odd(whole))
        runs = not any(np.isinf(a).any() for a in odd[:1])
    except FloatingPointError:
        runs = False
    cost = 1e9 * min(spent) / (PACKETS * DAYS)
    return Checks(causal, alone, same(first, again), pure(detector, world.example()), runs, cost)


def pure(detector: Any, record: Any) -> bool:
    """Whether init and step are free of callbacks, effects and axes of the machine.

    record: what a step gets beside params and z, such as `World.example`.
    """
    programs = _programs(detector, record)
    names = {name for program in programs for name in _primitives(program.jaxpr)}
    return not any(program.effects for program in programs) and not any(word in name for name in names for word in FORBIDDEN)  # fmt: skip


def _programs(detector, record):
    z = state_of(detector)
    return jax.make_jaxpr(detector.init)(detector.params), jax.make_jaxpr(detector.step)(detector.params, z, record)


def _primitives(jaxpr):
    """Names of all primitives of a program, those within others too."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for part in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda a: hasattr(a, "eqns") or hasattr(a, "jaxpr")
        ):
            inner = getattr(part, "jaxpr", part)
            if hasattr(inner, "eqns"):
                yield from _primitives(inner)


def digest(detector: Any, record: Any) -> str:
    """Hash of what a detector computes: programs of init and step without addresses, their constants, and the params.

    record: as of `pure`.
    """
    found = hashlib.sha256()
    for program in _programs(detector, record):
        found.update(re.sub(r"0x[0-9a-f]+", "", str(program)).encode())
        for a in program.consts:
            found.update(np.asarray(a).tobytes())
    for a in jax.tree.leaves(detector.params):
        found.update(f"{np.shape(a)} {np.asarray(a).dtype}".encode() + np.asarray(a).tobytes())
    return found.hexdigest()


def seed_of(world: World, detectors: Sequence[Any], board: str, record: Any) -> int:
    """The test key's seed, 64 bits of a hash of the board, the world and all detectors: who adds a row draws fresh days.

    record: as of `pure`.
    """
    order = sorted(detectors, key=lambda d: d.name)
    text = "".join([board, world.name, world.version, *(d.name + digest(d, record) for d in order)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


def key_of(seed: int):
    """The key of 64 bits."""
    return jax.random.wrap_key_data(jnp.array([seed >> 32, seed & 0xFFFFFFFF], jnp.uint32))


def validated(detectors: Sequence[Detector], world: World) -> tuple[Detector, ...]:
    """The detectors, if they are some, of different names, and each gives a score and a blame of the world's channels."""
    return named("detectors", detectors, Detector, partial(_shapes, world))


def named(name: str, entries: Sequence[Any], kind: type, shapes: Callable) -> tuple:
    """The entries of a board, a sequence of ``kind`` called ``name``, if they are some, of different names and shapes(entry) raises nothing."""
    entries = tuple(entries) if isinstance(entries, Sequence) else ()
    if not entries:
        check.refuse(name, f"hold at least one {kind.__name__}", "empty")
    names = []
    for i, d in enumerate(entries):
        check.kind(f"{name}[{i}]", d, kind)
        if d.name in names:
            check.refuse(name, "have names that differ", f"{d.name!r} twice")
        names.append(d.name)
        shapes(d)
    return entries


def stepped(d: Any, record: Any, told: str):
    """Shapes of what a step gives beside z; raises TypeError where it does not give z, ``told``, with z as it got it."""
    z = state_of(d)
    out = jax.eval_shape(d.step, d.params, z, record)
    if not (isinstance(out, tuple) and len(out) == 2):
        raise TypeError(f"`{d.name}.step` must return z, {told}, but it is {check.short(out)}.")
    after, found = out
    if jax.tree.structure(after) != jax.tree.structure(z):
        raise TypeError(f"`{d.name}.step` must return z as it got it, but it is {jax.tree.structure(after)}.")
    for path, a in jax.tree_util.tree_leaves_with_path(after):
        b = dict(jax.tree_util.tree_leaves_with_path(z))[path]
        if np.shape(a) != np.shape(b):
            raise TypeError(f"`{d.name}.step` must return z{jax.tree_util.keystr(path)} of shape {np.shape(b)}, but it is {np.shape(a)}.")  # fmt: skip
    return found


def _shapes(world: World, d: Detector) -> None:
    """Raise where a step does not give back the structure of z, and a score () and a blame (channels,)."""
    verdict = stepped(d, world.example(), "Verdict")
    if not (hasattr(verdict, "score") and hasattr(verdict, "blame")):
        raise TypeError(f"`{d.name}.step` must return z, Verdict, but it is {check.short(verdict)}.")
    for name, shape in (("score", ()), ("blame", (world.channels,))):
        if getattr(verdict, name).shape != shape:
            raise TypeError(f"`{d.name}.step` must return a {name} of shape {shape}, but it is {getattr(verdict, name).shape}.")  # fmt: skip
