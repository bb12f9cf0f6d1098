"""Kinds of faults as data: what a cell of a catalogue does to a channel, whatever the world.

A cell is (kind, size), the size in the unit of `UNIT`; of two faults at once kind is "first+second", size a pair. None is a
day without a fault.

May import: leo4, check, faults.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.faults import Fault
from jaxatt.yardstick.leo4 import SECOND

UNIT = {
    "gyro_bias": "deg/h", "gyro_drift": "deg/h/h", "gyro_scale": "1", "gyro_noise": "1", "gyro_stuck": "", "gyro_dead": "",
    "gyro_intermittent": "deg/h", "star_bias": "arcsec", "star_noise": "1", "star_frozen": "",
    "star_misalignment": "arcsec/s", "wheel_loss": "1", "wheel_offset": "mN m", "wheel_friction": "1", "wheel_seized": "",
    "sun_bias": "deg", "sun_noise": "1", "field_bias": "nT", "field_noise": "1",
}  # fmt: skip


class Effect(NamedTuple):
    """What a fault does to its channel; signed fields take the day's sign."""

    unit: Any = 0.0  # 0 gyro, 1 star, 2 wheel, 3 sun, 4 field, -1 none
    bias: Any = 0.0  # [unit of the channel] signed
    drift: Any = 0.0  # [unit of the channel] signed, `Fault.drift` at tau = 1e5 s
    ratio: Any = 0.0  # [1] signed change of the factor on the true signal
    loss: Any = 0.0  # [1] its fall, without a sign
    growth: Any = 1.0  # [1] factor on the noise, of a wheel on its friction
    stuck: Any = 0.0
    whole: Any = 0.0  # 1: all channels of the unit
    frozen: Any = 0.0  # 1: the star tracker as a whole repeats its last sample
    on: Any = np.inf  # [s] how long it lasts of every 5 s


_SLOPE = 1e5  # [s] tau of a drift: .3 % curved after 600 s, and float32 keeps its digits
_EFFECTS: dict[str, Callable[[Any], Effect]] = {
    "gyro_bias": lambda s: Effect(0, bias=s * SECOND),
    "gyro_drift": lambda s: Effect(0, drift=s * (SECOND / 3600 * _SLOPE)),
    "gyro_scale": lambda s: Effect(0, ratio=s),
    "gyro_noise": lambda s: Effect(0, growth=s),
    "gyro_stuck": lambda s: Effect(0, stuck=s),
    "gyro_dead": lambda s: Effect(0, loss=s, growth=1 - s),
    "gyro_intermittent": lambda s: Effect(0, bias=s * SECOND, on=1.0),
    "star_bias": lambda s: Effect(1, bias=s * SECOND),
    "star_noise": lambda s: Effect(1, growth=s, whole=1),
    "star_frozen": lambda s: Effect(1, frozen=s, whole=1),
    "star_misalignment": lambda s: Effect(1, drift=s * (SECOND * _SLOPE)),
    "wheel_loss": lambda s: Effect(2, loss=s),
    "wheel_offset": lambda s: Effect(2, bias=s * 1e-3),
    "wheel_friction": lambda s: Effect(2, growth=1 + s),
    "wheel_seized": lambda s: Effect(2, stuck=s),
    "sun_bias": lambda s: Effect(3, bias=s * np.pi / 180),
    "sun_noise": lambda s: Effect(3, growth=s, whole=1),
    "field_bias": lambda s: Effect(4, bias=s * 1e-9),
    "field_noise": lambda s: Effect(4, growth=s, whole=1),
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


def placed(units: dict[str, int], both: tuple[Effect, Effect], onset, where, sign) -> dict[str, Fault]:
    """The faults of the channels of each unit, fields (channels,), and "box", that of the star tracker as a whole.

    units: of the world, in the order of `Effect.unit`; both: what `effects` gives; onset [s]; where, sign: two uniform
    numbers each, for the channels and the signs.
    """
    first, second = both
    signs = [jnp.where(u < 0.5, -1.0, 1.0) for u in sign]
    fields = {}
    for number, (unit, n) in enumerate(units.items()):
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
    return fields | {"box": Fault(onset=jnp.where(jnp.asarray(frozen) > 0, onset, jnp.inf), stuck=1.0 * frozen)}
