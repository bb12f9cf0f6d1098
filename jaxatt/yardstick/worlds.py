"""Worlds, days and faults as data: what a cell of the catalogue does to a day, and how a day is drawn.

A cell is (kind, size), the size in the unit of `UNIT`; of two faults at once kind is "first+second", size a pair. None is a
day without a fault. A day of number i has the same noise, motion and onset in every cell, so all comparisons are paired.

May import: leo4, check, vec, contract, faults.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.contract import System
from jaxatt.faults import Fault
from jaxatt.vec import Vec3
from jaxatt.yardstick import leo4

WARMUP, WINDOW, LATEST = 300.0, 600.0, 540.0  # [s] without verdicts; with; the last onset
PACKETS = round((WARMUP + WINDOW) / leo4.PACKET)  # of a run
UNITS = {"gyro": 4, "star": 3, "wheel": 4}  # channels
CHANNELS = tuple(f"{unit} {i}" for unit, n in UNITS.items() for i in range(n))  # in the order of `Verdict.blame`


# kind -> sizes, eight in equal ratios from invisible to obvious
SIZED = {
    "gyro_bias": (1.0, 1.75, 3.06, 5.35, 9.35, 16.4, 28.6, 50.0),
    "gyro_drift": (50.0, 96.5, 186.0, 360.0, 695.0, 1341.0, 2590.0, 5000.0),
    "gyro_scale": (0.002, 0.00386, 0.00746, 0.0144, 0.0278, 0.0537, 0.104, 0.2),
    "gyro_noise": (1.2, 1.57, 2.06, 2.71, 3.55, 4.65, 6.10, 8.0),
    "star_bias": (5.0, 7.67, 11.8, 18.1, 27.7, 42.5, 65.2, 100.0),
    "star_noise": (1.2, 1.51, 1.90, 2.39, 3.01, 3.79, 4.77, 6.0),
    "wheel_loss": (0.1, 0.139, 0.193, 0.268, 0.373, 0.518, 0.720, 1.0),
    "wheel_offset": (0.05, 0.0965, 0.186, 0.360, 0.695, 1.34, 2.59, 5.0),
}
PLAIN = {"gyro_stuck": (1.0,), "gyro_dead": (1.0,), "star_frozen": (1.0,)}
PAIRS = {
    f"gyro_bias+{second}": tuple(zip(SIZED["gyro_bias"], SIZED[second])) for second in ("gyro_bias", "wheel_offset")
}
CATALOGUE = {"leo4": SIZED | PLAIN | PAIRS}  # world -> {kind: sizes}
# kinds in no catalogue, for the held-out column: never used to tune
HELD_OUT = {
    "gyro_intermittent": (10.0, 30.0, 100.0),
    "star_misalignment": (0.1, 0.3, 1.0),
    "star_bias+gyro_bias": tuple(zip((18.1, 42.5), (3.06, 9.35))),
}
UNIT = {
    "gyro_bias": "deg/h", "gyro_drift": "deg/h/h", "gyro_scale": "1", "gyro_noise": "1", "star_bias": "arcsec",
    "star_noise": "1", "wheel_loss": "1", "wheel_offset": "mN m", "gyro_stuck": "", "gyro_dead": "", "star_frozen": "",
    "gyro_intermittent": "deg/h", "star_misalignment": "arcsec/s",
}  # fmt: skip


class Effect(NamedTuple):
    """What a fault does to its channel; signed fields take the day's sign."""

    unit: Any = 0.0  # 0 gyro, 1 star, 2 wheel, -1 none
    bias: Any = 0.0  # [unit of the channel] signed
    drift: Any = 0.0  # [unit of the channel] signed, `Fault.drift` at tau = 1e5 s
    ratio: Any = 0.0  # [1] signed change of the factor on the true signal
    loss: Any = 0.0  # [1] its fall, without a sign
    growth: Any = 1.0  # [1] factor on the noise
    stuck: Any = 0.0
    whole: Any = 0.0  # 1: all channels of the unit
    frozen: Any = 0.0  # 1: the star tracker as a whole repeats its last sample
    on: Any = np.inf  # [s] how long it lasts of every 5 s


_SLOPE = 1e5  # [s] tau of a drift: .3 % curved after 600 s, and float32 keeps its digits
_EFFECTS: dict[str, Callable[[Any], Effect]] = {
    "gyro_bias": lambda s: Effect(0, bias=s * leo4.SECOND),
    "gyro_drift": lambda s: Effect(0, drift=s * (leo4.SECOND / 3600 * _SLOPE)),
    "gyro_scale": lambda s: Effect(0, ratio=s),
    "gyro_noise": lambda s: Effect(0, growth=s),
    "gyro_stuck": lambda s: Effect(0, stuck=s),
    "gyro_dead": lambda s: Effect(0, loss=s, growth=1 - s),
    "gyro_intermittent": lambda s: Effect(0, bias=s * leo4.SECOND, on=1.0),
    "star_bias": lambda s: Effect(1, bias=s * leo4.SECOND),
    "star_noise": lambda s: Effect(1, growth=s, whole=1),
    "star_frozen": lambda s: Effect(1, frozen=s, whole=1),
    "star_misalignment": lambda s: Effect(1, drift=s * (leo4.SECOND * _SLOPE)),
    "wheel_loss": lambda s: Effect(2, loss=s),
    "wheel_offset": lambda s: Effect(2, bias=s * 1e-3),
}
NO_EFFECT = Effect(-1)


def effects(cell) -> tuple[Effect, Effect]:
    """The two faults of a cell as numbers, which a batch may vary and which are a cell too; ValueError for no cell."""
    if cell is None:
        return NO_EFFECT, NO_EFFECT
    if isinstance(cell, tuple) and len(cell) == 2 and all(isinstance(part, Effect) for part in cell):
        return cell
    wanted = "be None or (kind, size), the kinds " + ", ".join(_EFFECTS) + ", two joined by + with a pair of sizes"
    if not (isinstance(cell, tuple) and len(cell) == 2 and isinstance(cell[0], str)):
        check.refuse("cell", wanted, check.short(cell))
    kinds = cell[0].split("+")
    sizes = cell[1] if len(kinds) > 1 else (cell[1],)
    given = len(sizes) if isinstance(sizes, (tuple, list)) else 0
    if not 1 <= len(kinds) <= 2 or not set(kinds) <= set(_EFFECTS) or given != len(kinds):
        check.refuse("cell", wanted, check.short(cell))
    for size in sizes:
        check.positive("cell", check.number("cell", size))
    found = [_EFFECTS[kind](size) for kind, size in zip(kinds, sizes)]
    return found[0], found[1] if len(found) > 1 else NO_EFFECT


def single(kind: str) -> bool:
    """Whether a kind is one fault of one unit."""
    return "+" not in kind


def unit_of(kind: str) -> str:
    """The unit of a kind of fault."""
    return kind.split("_")[0]


class Spread(NamedTuple):
    """How the days of a world differ."""

    swing: float = 10.0  # [deg] of the slew
    inertia: float = 0.03  # [1] of J about each axis
    disturbance: float = 1.0  # [1] factor on all disturbances
    scale: float = 3e-4  # [1] of the gyros' scale factors
    noise: float = 1.0  # [1] factor on the gyros' noise
    star: float = 1.0  # [1] on the star tracker's


class World(NamedTuple):
    """A closed loop with the law of its days."""

    name: str
    version: str
    system: System  # a tick is one packet
    params: Any  # `leo4.Params`
    sample: Callable  # (key, index, cell) -> Scenario; cell None: without a fault
    modes: tuple[str, ...]  # known on board
    units: dict[str, int]  # channels of each unit, in the order of the blame


def draw(name, spread: Spread, key, index, cell=None) -> leo4.Scenario:
    """The scenario of one day of a world.

    name: crc32 of the world's name; cell: (kind, size), its `effects`, or None without a fault.
    """
    both = effects(cell)
    key = jax.random.fold_in(jax.random.fold_in(key, name), index)
    gauss, even = jax.random.split(key)  # in float32 whatever the precision of the process
    normal = jnp.split(jax.random.normal(gauss, (26,), jnp.float32), np.cumsum([3, 4, 4, 3, 3, 3]))
    uniform = jax.random.uniform(even, (9,), jnp.float32)
    axis = Vec3.of(normal[0])
    axis = axis / jnp.sqrt(axis @ axis)
    bias, scale, stretch = (
        0.5 * leo4.SECOND * normal[1],
        spread.scale * normal[2],
        jnp.sqrt(1 + spread.inertia * normal[3]),
    )
    constant, wave, e0 = 5e-5 * spread.disturbance * normal[4], 1e-4 * spread.disturbance * normal[5], normal[6]
    psi, phi = 2 * np.pi * uniform[0], 2 * np.pi * uniform[1:4]
    onset, where, sign, second, sign2 = uniform[4:]
    (a, _), (b, c) = np.linalg.cholesky(leo4.FILTER.prior)
    faulty = _faults(both, WARMUP + LATEST * onset, (where, second), (sign, sign2))
    return leo4.Scenario(
        mode=1.0 * (index % 2), axis=axis, psi=psi, swing=spread.swing * np.pi / 180, bias=bias, scale=scale,
        stretch=Vec3.of(stretch), constant=Vec3.of(constant), wave=Vec3.of(wave), phi=Vec3.of(phi),
        turn=Vec3.of(a * e0[:3]), bias_error=Vec3.of(b * e0[:3] + c * e0[3:]),
        std_gyro=spread.noise * leo4.STD_GYRO, std_star=spread.star * leo4.STD_STAR, **faulty,
    )  # fmt: skip


def _faults(both: tuple[Effect, Effect], onset, where, sign) -> dict:
    """The fault fields of a scenario, from uniform numbers for channels and signs."""
    first, second = both
    signs = [jnp.where(u < 0.5, -1.0, 1.0) for u in sign]
    fields = {}
    for number, (unit, n) in enumerate(UNITS.items()):
        at = jnp.floor(n * where[0]).astype(int)
        other = jnp.floor(n * where[1]).astype(int)
        distinct = (at + 1 + jnp.floor((n - 1) * where[1]).astype(int)) % n  # of two in one unit
        places = at, jnp.where(jnp.equal(first.unit, second.unit), distinct, other)
        here = [
            jnp.where((jnp.arange(n) == place) | (jnp.asarray(e.whole) > 0), 1.0, 0.0) * (jnp.asarray(e.unit) == number)
            for e, place in zip(both, places)
        ]
        summed = lambda of, here=here: sum(of(e, s) * h for e, s, h in zip(both, signs, here))
        fields[unit] = Fault(
            onset=jnp.where(sum(here) > 0, onset, jnp.inf),
            end=jnp.full(n, jnp.inf),
            bias=summed(lambda e, s: s * e.bias),
            drift=summed(lambda e, s: s * e.drift),
            tau=jnp.full(n, _SLOPE),
            random=jnp.zeros(n),
            scale=1 + summed(lambda e, s: s * e.ratio - e.loss),
            growth=1 + summed(lambda e, s: e.growth - 1),
            stuck=summed(lambda e, s: e.stuck),
            missing=jnp.zeros(n),
        )
    frozen = sum(e.frozen for e in both)
    fields["box"] = Fault(onset=jnp.where(jnp.asarray(frozen) > 0, onset, jnp.inf), stuck=1.0 * frozen)
    on = jnp.minimum(*(jnp.asarray(e.on, float) for e in both))
    return fields | {"on": on, "period": jnp.where(jnp.isfinite(on), 5.0, 1e6)}


def _world(name: str, spread: Spread, version: str = "1") -> World:
    sample = partial(draw, np.uint32(crc32(name.encode())), spread)
    return World(name, version, leo4.system, leo4.params, sample, ("hold", "slew"), UNITS)


NOMINAL = Spread()
_SPREADS = {
    "leo4": NOMINAL,
    "leo4 star noise x1.15": NOMINAL._replace(star=1.15),
    "leo4 slew 25 deg": NOMINAL._replace(swing=25.0),
    "leo4 inertia 10 %": NOMINAL._replace(inertia=0.1),
    "leo4 disturbance x2": NOMINAL._replace(disturbance=2.0),
    "leo4 gyro scale 1000 ppm": NOMINAL._replace(scale=1e-3),
    "leo4 both noises x1.1": NOMINAL._replace(noise=1.1, star=1.1),
}
WORLDS = {"leo4": _world("leo4", NOMINAL)}
MISMATCH = {name: _world(name, spread) for name, spread in _SPREADS.items() if name != "leo4"}


def days(world: World, key, numbers, cells) -> Any:
    """Scenarios of the days ``numbers``, float32 NumPy arrays with n in front.

    cells: one cell, or `effects` of shape (n,).
    """
    numbers = np.asarray(numbers, np.int32)
    return drawn(world.sample, key, numbers, jax.tree.map(lambda a: np.broadcast_to(a, numbers.shape), effects(cells)))


def short(a) -> np.ndarray:
    """A number in float32, the type of all runs of the yardstick."""
    a = np.asarray(a)
    return a.astype(np.float32) if a.dtype.kind == "f" else a


def drawn(sample: Callable, key, numbers, cells) -> Any:
    """sample(key, number, cell) of all numbers, float32 NumPy arrays with n in front.

    sample: a function, or a partial whose arguments are numbers and may differ without a new program; cells: a tree of
    arrays with n in front.
    """
    numbers, full = np.asarray(numbers, np.int32), -(-len(numbers) // DRAWN) * DRAWN
    wide = lambda a: np.resize(np.asarray(a, np.float32), (full, *np.shape(a)[1:]))
    cells, places = jax.tree.map(wide, cells), np.resize(numbers, full)
    function, of_world = (sample.func, sample.args) if isinstance(sample, partial) else (sample, ())
    parts = [
        _many(function)(of_world, key, places[i : i + DRAWN], jax.tree.map(lambda a, i=i: a[i : i + DRAWN], cells))
        for i in range(0, full, DRAWN)
    ]
    return jax.tree.map(lambda *a: np.concatenate(a)[: len(numbers)], *parts)


DRAWN = 256  # days that are drawn at once: one program for all worlds, cells and numbers of days


@lru_cache
def _many(sample: Callable):
    """Days of a world, whose numbers are operands, compiled once."""

    def run(of_world, key, numbers, both):
        drawn = jax.vmap(partial(sample, *of_world), in_axes=(None, 0, 0))(key, numbers, both)
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (DRAWN, *a.shape[1:])).astype(jnp.float32), drawn)

    return jax.jit(run)


def true_channels(scenario: leo4.Scenario):
    """Which of the eleven channels are faulty, bool (11,) behind the days."""
    box = np.isfinite(np.asarray(scenario.box.onset))[..., None]
    parts = [np.isfinite(np.asarray(getattr(scenario, unit).onset)) for unit in UNITS]
    parts[1] = parts[1] | box
    return np.concatenate(parts, axis=-1)


def onset_of(scenario: leo4.Scenario):
    """Onset [s] in the window, (n,); inf without a fault."""
    onsets = [np.asarray(getattr(scenario, unit).onset).min(-1) for unit in UNITS]
    return np.minimum.reduce([*onsets, np.asarray(scenario.box.onset)]) - WARMUP
