"""The surroundings of an orbiting body: a table made once, off line, that the loop interpolates.

Everything is in one inertial frame, the mean equator and equinox of date (that of SGP4 and of Greenwich mean sidereal
time; J2000 is .37 deg away in 2026). `jaxatt.orbit` makes the columns.

May import: check, vec, compiling.
"""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.check import finite, not_negative, positive, share
from jaxatt.compiling import shared
from jaxatt.vec import Vec3, norm


class Table(NamedTuple):
    """Surroundings at equal steps of time; one row lies before the time span that `at` serves, one behind it."""

    start: Annotated[Any, "s", finite]  # time of the first row
    step: Annotated[
        Any, "s", positive
    ]  # between rows; in a low orbit 10 s keep a dipole's field to .006 nT, IGRF's to .03 nT
    field: Annotated[Vec3, "T", finite, ("rows",)]  # Earth's magnetic field
    sun: Annotated[Vec3, "1", finite, ("rows",)]  # unit vector to the Sun
    lit: Annotated[Any, "1", share, ("rows",)]  # share of the Sun's disc that is seen
    r: Annotated[Vec3, "m", finite, ("rows",)]  # position
    v: Annotated[Vec3, "m/s", finite, ("rows",)]  # velocity
    density: Annotated[Any, "kg/m^3", not_negative, ("rows",)]  # of the air

    def check(self, name: str) -> None:
        """Refuse, with ValueError, a table of fewer than four rows, and directions that are no unit vectors."""
        rows = np.shape(self.lit)[0]
        if rows < 4:
            check.refuse(name, "have four rows or more", f"one of {rows}")
        check.unit(f"{name}.sun", self.sun)


class Surroundings(NamedTuple):
    """The surroundings at one instant, in inertial axes."""

    field: Vec3  # [T]
    sun: Vec3  # unit vector
    lit: Any  # [1]
    r: Vec3  # [m]
    v: Vec3  # [m/s]
    density: Any  # [kg/m^3]


def span(table: Table) -> tuple[float, float]:
    """First and last time [s] that `at` interpolates: from the second row to the last but one."""
    rows = np.shape(table.lit)[0]
    return float(table.start + table.step), float(table.start + (rows - 2) * table.step)


def refuse_short(name: str, table: Table, first, last) -> None:
    """Refuse, with ValueError, a table that does not reach from first to last [s], numbers or arrays.

    name: what the message calls the table. For the ``check`` of a loop, with `check.last_tick`: `at` itself stays at the
    ends.
    """
    begin, end = span(table)
    slack = 1e-6 * (end - begin)
    if np.min(first) < begin - slack or np.max(last) > end + slack:
        must = f"reach from {np.min(first):g} s to {np.max(last):g} s (one row before, one behind)"
        check.refuse(name, must, f"good from {begin:g} s to {end:g} s")


def at(table: Table, t) -> Surroundings:
    """The surroundings at t [s]: by Catmull-Rom's cubic, lit and density by straight lines, the Sun made a unit vector.

    Before and after the span of the table the values at its ends.
    """
    columns = [*table.field, *table.sun, *table.r, *table.v, table.lit, table.density]
    rows = jnp.stack(columns, axis=-1)  # here, lest every tick does it: what does not change leaves the loop over ticks
    return shared(_between, table.start, table.step, rows, t)


def _between(start, step, rows, t) -> Surroundings:
    """`at`, of the columns side by side (rows, 14), so that four rows are one piece of memory."""
    u = (t - start) / step
    i = jnp.clip(jnp.floor(u), 1, len(rows) - 3)
    s = jnp.clip(u - i, 0, 1)
    four = jax.lax.dynamic_slice_in_dim(rows, i.astype(int) - 1, 4)
    weights = -s + s * s * (2 - s), 2 - s * s * (5 - 3 * s), s + s * s * (4 - 3 * s), s * s * (s - 1)
    cubic = 0.5 * reduce(add, (w * row for w, row in zip(weights, four)))
    lit, density = four[1, 12:] + s * (four[2, 12:] - four[1, 12:])
    field, sun, r, v = (Vec3(*cubic[k : k + 3]) for k in (0, 3, 6, 9))
    return Surroundings(field, sun / norm(sun), lit, r, v, density)
