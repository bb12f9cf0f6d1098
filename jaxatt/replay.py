"""Recorded readings through on-board code: the functions that a closed loop runs, without the loop.

`replay` hands readings, one set a tick, to a loop's ``decide`` and lets its on-board flow run between the ticks. A closed
loop gives the functions and what the computer knows at the start::

    computer = loop.computer_of(*loop.init(loop.params, loop.scenario))
    computers, logs = replay(loop.decide, loop.params, computer, readings, dt=loop.DT)

Of the computer the scenario decides the start alone: initial estimates and the like. Where an observer or an adaptive law
moves between ticks (`observer_pd`, `wheel_mrac`), ``flow=loop.computer_flow`` and the system's ``substeps`` go along.
`load` reads a CSV or Parquet file, which never executes code, and `resample` brings its samples to the ticks.

May import: check, clock, faults, contract, compiling, engine.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.clock import time_of
from jaxatt.compiling import compiled
from jaxatt.contract import Now
from jaxatt.engine import alone, match_state, rk4
from jaxatt.faults import Reading

EXAMPLE = Path(__file__).parent / "data" / "telemetry.csv"  # made by notebooks/telemetry.py, with a hidden fault
SPARSE = 1000  # ticks per sample beyond which the times are taken to be wrong


def replay(
    decide: Callable,
    params,
    computer,
    readings,
    *,
    dt: float,
    flow: Callable | None = None,
    substeps: int = 1,
    between: Any = None,
):
    """Run on-board code on recorded readings.

    Pure: jit, grad and ``jax.vmap`` it over several recordings.

    Args:
        decide: (params, now, computer, readings) -> computer, log, as in a closed loop.
        params: what the engineer ships.
        computer: what the computer knows before the first tick.
        readings: what ``decide`` takes, every leaf with the T ticks in its first axis.
        dt: [s] between ticks; the first tick has t = 0.
        flow: (params, computer, readings) -> rates, a dict by name of those fields of the computer that move between
            ticks. It sees the readings of the tick, held, unless ``between`` has finer ones.
        substeps: RK4 steps of ``flow`` between ticks.
        between: readings at the stages of each step (its start, its middle twice, its end), every leaf of shape
            (T, substeps, 4, ...).

    Returns:
        What the computer knew after each ``decide``, and the logs that it returned, time first.

    Raises:
        ValueError: readings that disagree about T, dt <= 0 or substeps < 1.
        TypeError: what is no number; ``decide`` or ``flow`` that return another structure, type or shape.

    Example:
        >>> computers, logs = replay(loop.decide, loop.params, computer, readings, dt=loop.DT)
    """
    check.function("decide", decide)
    if flow is not None:
        check.function("flow", flow)
    check.positive("dt", check.number("dt", dt))
    substeps = check.whole("substeps", substeps)
    ticks = _length("readings", readings)
    for name, tree in (("computer", computer), ("readings", readings), ("between", between)):
        check.numbers(name, tree)
    params, (computer, readings, between) = check.converted(params, (computer, readings, between))
    for path, leaf in jax.tree_util.tree_leaves_with_path(between):
        if leaf.shape[:3] != (ticks, substeps, 4):
            name = f"between{jax.tree_util.keystr(path)}"
            check.refuse(name, f"have shape ({ticks}, {substeps}, 4, ...)", leaf.shape)
    operands = params, computer, readings, between
    return compiled(_replay, 4, operands)(decide, flow, float(dt), substeps, *operands)


def _length(name: str, tree) -> int:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    if not leaves:
        raise ValueError(f"`{name}` must hold at least one array, but it is empty.")
    first = np.shape(leaves[0][1])[:1]
    for path, leaf in leaves:
        shape = np.shape(leaf)
        if not shape or shape[:1] != first or shape[0] == 0:
            must = "lead with the ticks, at least one and as many as in the others"
            check.refuse(name + jax.tree_util.keystr(path), must, f"of shape {shape}")
    return first[0]


def _replay(decide, flow, dt, substeps, params, computer, readings, between):
    dtype = check.float_type((params, computer, readings))
    h = dt / substeps

    def flown(t, computer, y, stages):
        def one(x, step):
            at, seen = step

            def rate(t, x, now=y):
                return match_state(flow(params, computer._replace(**x), now), x, "flow")

            return rk4(rate, at, x, h, seen), None

        rates = jax.eval_shape(flow, params, computer, y)
        if not isinstance(rates, dict) or not set(rates) <= set(getattr(computer, "_fields", ())):
            raise TypeError(f"`flow` must return a dict by fields of the computer, but it is {check.short(rates)}.")
        moving = {name: getattr(computer, name) for name in rates}
        times = t + h * jnp.arange(substeps, dtype=dtype)
        return computer._replace(**jax.lax.scan(one, moving, (times, stages))[0])

    @jax.checkpoint
    def tick(computer, told):
        k, y, stages = told
        now = Now(k, time_of(k, dt, dtype), dt)

        def one(computer, y):
            out = decide(params, now, computer, y)
            if not isinstance(out, tuple) or len(out) != 2:
                raise TypeError(f"`decide` must return computer, log, but it is {check.short(out)}.")
            return match_state(out[0], computer, "decide"), jax.tree.map(jnp.asarray, out[1])

        after, log = alone(one, computer, y)
        ahead = after if flow is None else flown(now.t, after, y, stages)
        return ahead, (after, log)

    ticks = jnp.arange(len(jax.tree.leaves(readings)[0]))
    return jax.lax.scan(tick, computer, (ticks, readings, between))[1]


# files


def load(path, units: Mapping[str, str], *, time: str = "time") -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Times (T,) [s] and channels (T,) of a ``.csv`` or ``.parquet`` file whose columns are named "gyro_a [rad/s]".

    units: the unit that each channel must have, by name; other columns are left alone. time: name of the column of
    times. Empty cells are missing samples, NaN. Needs the extra ``data``.

    Raises ValueError, in one line, for a missing channel, another unit, a column twice, a cell that is no number or
    not finite, times that do not increase, and a file that cannot be read as what its name says; ImportError without
    pandas or pyarrow.
    """
    path = check.place("path", path)
    check.mapping("units", units)
    table = _table(path)
    there = {}
    for name in map(str, table.columns):
        split = re.fullmatch(r"(.*?)\s*(?:\[([^]]*)\])?", name)
        there[split[1] if split else name] = (name, split[2] if split else None)
    columns = {}
    for name, unit in {time: "s", **units}.items():
        if name not in there:
            check.refuse(
                f"{name} [{unit}]", f"be a column of {path.name}", "not among " + ", ".join(map(str, table.columns))
            )
        given, found = there[name]
        if found != unit:
            check.refuse(name, f"be given in [{unit}] by {path.name}", f"in the column {given!r}")
        columns[name] = _numbers(given, table[given])
    return checked(columns.pop(time), columns)


def _table(path: Path):
    try:
        import pandas
        import pyarrow.parquet
    except ImportError as error:
        raise ImportError("Reading files needs pandas and pyarrow: pip install 'jaxatt[data]'.") from error
    kind = path.suffix.lower()
    if kind not in (".csv", ".parquet"):
        check.refuse("path", "end in .csv or .parquet", repr(path.name))
    with path.open("rb") as file:  # an open file: pandas fetches no address and unpacks nothing
        try:
            if kind == ".parquet":
                return pyarrow.parquet.read_table(file).to_pandas(ignore_metadata=True)
            header = next(csv.reader([file.readline().decode("utf-8-sig").strip()]), [])
            names = [name.strip() for name in header]
            if len(set(names)) == len(names):
                since = tuple(map(int, pandas.__version__.split(".")[:2]))  # from 3.1 on every number is read exactly
                exact: dict[str, Any] = {} if since >= (3, 1) else {"float_precision": "round_trip"}
                return pandas.read_csv(file, header=None, names=names, index_col=False, **exact)
        except Exception as error:  # of pandas, PyArrow, the csv module or the decoder
            reason = " ".join(str(error).split())[:200]
            raise ValueError(f"`path` must be a {kind[1:]} file, but {path.name} is none: {reason}") from None
        check.refuse("path", "name every column once", f"{path.name} with {sorted(header)}")


def _numbers(name: str, column) -> np.ndarray:
    with suppress(TypeError, ValueError):
        return np.asarray(column, float)
    row = next(row for row, cell in enumerate(column) if not _is_number(cell))
    check.refuse(name, "hold numbers", f"{column[row]!r} in row {row}")


def _is_number(cell) -> bool:
    try:
        float(cell)
    except (TypeError, ValueError):
        return False
    return True


def checked(t, columns: Mapping[str, Any]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Times and channels of one length as float arrays; NaN in a channel is a missing sample.

    Raises ValueError for times that are not finite or do not increase, infinite samples, a channel without any
    sample, and lengths that differ. Rows are counted from 0.
    """
    t = np.asarray(check.real("time", t), float)
    check.mapping("columns", columns)
    if t.ndim != 1 or not len(t):
        check.refuse("time", "have shape (T,) with at least one sample", f"of shape {t.shape}")
    if not np.isfinite(t).all():
        row = int(np.flatnonzero(~np.isfinite(t))[0])
        check.refuse("time", "be finite", f"{t[row]:g} in row {row}")
    if (np.diff(t) <= 0).any():
        row = int(np.flatnonzero(np.diff(t) <= 0)[0]) + 1
        check.refuse("time", "increase from row to row", f"{t[row]:.9g} after {t[row - 1]:.9g} in row {row}")
    out = {}
    for name, values in columns.items():
        out[name] = a = np.asarray(check.real(name, values), float)
        if a.shape != t.shape:
            check.refuse(name, f"have the shape {t.shape} of the times", a.shape)
        if np.isinf(a).any():
            row = int(np.flatnonzero(np.isinf(a))[0])
            check.refuse(name, "be finite, or NaN where a sample is missing", f"{a[row]:g} in row {row}")
        if np.isnan(a).all():
            check.refuse(name, "hold at least one sample", "missing in every row")
    return t, out


def resample(t, columns: Mapping[str, Any], *, dt: float, ticks: int | None = None) -> dict[str, Reading]:
    """Irregular samples brought to ticks: a `Reading` of shape (ticks,) for each channel.

    Tick k stands for the time t[0] + k dt. It takes the sample nearest to it and at most dt / 2 away; where there is
    none, or it is NaN, the reading is not valid and repeats the last valid one (before the first, it gives the first):
    what on-board code sees that takes values without validity.
    ticks: how many; None: up to the last sample.

    Raises what `checked` raises, and ValueError for dt <= 0, ticks < 1 and times that span more than `SPARSE` ticks
    for each sample.
    """
    check.positive("dt", check.number("dt", dt))
    t, columns = checked(t, columns)
    span = (t[-1] - t[0]) / dt
    if span > SPARSE * len(t):
        check.refuse(
            "time", f"span at most {SPARSE} ticks of {dt:g} s for each sample", f"{len(t)} samples in {span:.3g} ticks"
        )
    n = round(span) + 1 if ticks is None else check.whole("ticks", ticks)
    takes = n * (40 + 10 * len(columns))  # bytes on the way, and those of the readings
    check.fits_memory(f"`ticks` = {n} of {len(columns)} channels", takes, "ask for fewer")
    out = {}
    for name, a in columns.items():
        known = np.isfinite(a)
        place = (t[known] - t[0]) / dt
        tick = np.floor(place + 0.5).astype(int)
        order = np.argsort(-np.abs(place - tick), kind="stable")  # the nearest is written last
        order = order[tick[order] < n]
        sample = np.full(n, -1)
        sample[tick[order]] = order
        valid = sample >= 0
        last = np.maximum.accumulate(np.where(valid, np.arange(n), -1))
        held = np.where(last >= 0, sample[last], 0)
        out[name] = Reading(a[known][held], valid)
    return out


def together(readings: Mapping[str, Reading], names) -> Reading:
    """Channels as one reading of shape (ticks, channels), in the order of the names.

    Raises ValueError for a name that is no channel and channels of different lengths; TypeError for what is no mapping
    of names to `Reading`.
    """
    check.mapping("readings", readings)
    names = list(names) if np.iterable(names) else []
    if not names:
        check.refuse("names", "be at least one channel", check.short(names))
    for name in names:
        if name not in list(readings):
            check.refuse("names", f"be channels ({', '.join(map(str, readings))})", check.short(name))
        check.kind(f"readings[{name!r}]", readings[name], Reading)
        shapes = {
            np.shape(leaf)
            for other in (names[0], name)
            for leaf in check.numbers(f"readings[{other!r}]", readings[other])
        }
        if len(shapes) > 1 or len(next(iter(shapes))) != 1:
            check.refuse(
                f"readings[{name!r}]", "have shape (ticks,), that of the others", f"of shapes {sorted(shapes)}"
            )
    return jax.tree.map(lambda *a: np.stack(a, axis=1), *(readings[name] for name in names))
