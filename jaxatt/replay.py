"""Recorded readings through on-board code: the functions that a closed loop runs, without the loop.

`replay` hands readings, one set a tick, to a loop's ``decide`` and lets its on-board flow run between the ticks. A closed
loop gives the functions and what the computer knows at the start::

    computer = loop.computer_of(*loop.init(loop.params, loop.scenario))
    computers, logs = replay(loop.decide, loop.params, computer, readings, dt=loop.DT)

Of the computer the scenario decides the start alone: initial estimates and the like. Where an observer or an adaptive law
moves between ticks (`observer_pd`, `wheel_mrac`), ``flow=loop.computer_flow`` and the system's ``substeps`` go along.
`load` reads a file of text or Parquet, which never executes code, `report` says what it understood, `merged` joins the clocks
of several instruments, `unit_quaternions` mends quaternions of few digits, and `resample` brings samples to the ticks.

May import: check, faults, compiling, loading, logfiles, stepping.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.compiling import compiled
from jaxatt.faults import Reading
from jaxatt.loading import DIRECTIONS, Quaternion, Understood, agree, report_of, understood
from jaxatt.logfiles import Layout
from jaxatt.stepping import on_board, timing_of

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
    dt, substeps = timing_of(decide, flow, dt, substeps)
    ticks = _length("readings", readings)
    for name, tree in (("computer", computer), ("readings", readings), ("between", between)):
        check.numbers(name, tree)
    params, (computer, readings, between) = check.converted(params, (computer, readings, between))
    for path, leaf in jax.tree_util.tree_leaves_with_path(between):
        if leaf.shape[:3] != (ticks, substeps, 4):
            name = f"between{jax.tree_util.keystr(path)}"
            check.refuse(name, f"have shape ({ticks}, {substeps}, 4, ...)", leaf.shape)
    operands = params, computer, readings, between
    return compiled(_replay, 4, operands)(decide, flow, dt, substeps, *operands)


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
    @jax.checkpoint
    def tick(computer, told):
        ahead, after, log = on_board(decide, flow, dt, substeps, params, told[0], computer, *told[1:])
        return ahead, (after, log)

    ticks = jnp.arange(len(jax.tree.leaves(readings)[0]))
    return jax.lax.scan(tick, computer, (ticks, readings, between))[1]


# files


def load(
    path,
    units: Mapping[str, str | None],
    *,
    time: Any = "time",
    stamps: str | None = None,
    zone: str | None = None,
    separator: str = ",",
    decimal: str = ".",
    header: Sequence[str] | None = None,
    skip: int = 0,
    encoding: str = "utf-8",
    told: Mapping[str, str] | None = None,
    where: Mapping[str, Any] | None = None,
    missing: Collection | None = None,
    quaternions: Mapping[str, Quaternion] | None = None,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Times and channels of a file of text (``.csv``, ``.txt``, ``.log``, ...) or ``.parquet``.

    A channel is asked for by name and unit: of "gyro [deg/s]" and "gyro [rad/s]", ``{"gyro": "rad/s"}`` is the second;
    "gyro (rad/s)" is the same name. A unit of the same quantity is converted, `report` says by what factor. Or by its whole
    header, whatever it looks like: ``{"q[0]": "1", "gx (deg/s)": "deg/s"}``. Elements of arrays, "[0.1 0.2 0.3]" in one cell
    or lists of Parquet, are ``{"w.0": "rad/s"}``. Columns that nobody asks for are left alone.

    An empty cell and words such as NaN are missing samples, NaN; true and false are 1 and 0. Rows of one time, such as those
    of several instruments, become one where no channel is given twice; `merged` joins clocks. Blank lines and lines that
    begin with #, % or // are passed over; a row of units below the header belongs to it; where the first row is of numbers
    the comment before it is the header. What the file says itself is held against what is told here; nothing is guessed. Keep
    the arguments of a logger in a dict and pass ``**layout``. Needs the extra ``data``.

    Args:
        path: of the file.
        units: the unit of each channel that is asked for; None for a whole header, as it is.
        time: name or whole header of the column of times, or the two of date and time of day, of seconds and nanoseconds.
        stamps: unit of the times: "s", "ms", "us", "ns", "s+ns" in two columns, or "iso" for dates of ISO 8601; None: the
            header says [s].
        zone: of dates that name none, "+01:00" or "Europe/Berlin"; None: UTC.
        separator: what stands between the cells of a text: ",", ";", "|", a tab, or " " for any run of spaces.
        decimal: "." or ",", the decimal sign of a text.
        header: names of all columns of a file that has no header.
        skip: lines before the header.
        encoding: of a text, such as "latin-1" or "utf-16".
        told: units of columns whose headers say none, by whole header.
        where: what a row must hold to be read, by header: ``{"sensor": 1}`` of a file of several instruments.
        missing: numbers or words that mark missing samples; None: likely ones, such as -9999, are refused.
        quaternions: by name, how four columns, or one of arrays, hold an attitude: see `Quaternion`. "att" becomes the unit
            quaternion att.w, att.x, att.y, att.z, body to reference, without jumps of sign (`unit_quaternions`).

    Returns:
        Times (T,) [s], of dates since 1970, and channels (T,) by the keys of ``units``, then those of ``quaternions``.

    Raises:
        ValueError: in one line: a channel that is missing, of another quantity than asked for or not the only one, a header
            twice, a row with more or fewer cells than the header (one empty cell at its end may be too many), a cell that is
            no number or not finite, decimal commas, separators and stamps other than those asked for, times that do not
            increase, rows of several instruments, what is told against what the file says, a file that cannot be read as what
            its name says.
        TypeError: what is no path or no mapping.
        ImportError: without pandas or pyarrow.

    Example:
        >>> t, columns = load("log.csv", {"gyro": "deg/s", "q[0]": "1"}, separator=";", decimal=",", stamps="ms")
    """
    layout = Layout(separator, decimal, stamps, zone, header, skip, encoding, where, missing)
    return _finished(understood(path, units, time, layout, told, quaternions))


def report(path, units: Mapping[str, str | None], *, time: Any = "time", told=None, quaternions=None, **layout) -> str:
    """What `load` understands of a file, in words, before anything runs: read it once for every logger.

    Args:
        path: of the file.
        units: as of `load`.
        time: as of `load`.
        told: as of `load`.
        quaternions: as of `load`.
        layout: the other arguments of `load`.

    Returns:
        Lines: the file and how it is written; the time base; each channel with its column, unit, factor and range; rate and gaps
        of the channels that are sampled together, an instrument; the columns that are left alone.

    Raises:
        ValueError: what `load` raises.
        TypeError: what `load` raises, and arguments that it has not.

    Example:
        >>> print(report("log.csv", {"gyro": "rad/s"}, separator=";", stamps="ms"))
    """
    if other := set(layout) - set(Layout._fields):
        raise TypeError(f"`layout` must be arguments of load, but it is {', '.join(sorted(other))}.")
    found = understood(path, units, time, Layout(**layout), told, quaternions)
    return report_of(found, *_finished(found))


def _finished(found: Understood) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Times and channels as they are handed on: checked, rows of one time joined, attitudes as quaternions of ours."""
    t, columns = checked(found.t, found.columns)
    for name, q in found.quaternions.items():
        four = found.parts[name]
        unit = list(unit_quaternions(columns, four).values())
        if q.direction != DIRECTIONS[0]:
            unit[1:] = [-part for part in unit[1:]]
        columns = {other: a for other, a in columns.items() if other not in four}
        if twice := [f"{name}.{part}" for part in "wxyz" if f"{name}.{part}" in columns]:
            check.refuse("quaternions", "have names that no channel has", repr(twice[0]))
        columns |= {f"{name}.{part}": a for part, a in zip("wxyz", unit)}
    return t, columns


def merged(
    recordings: Mapping[str, tuple], offsets: Mapping[str, float] | None = None
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Recordings of instruments with clocks of their own as one: all times in order, NaN where a channel has no sample.

    Args:
        recordings: by instrument, times [s] and channels, as `load` returns them.
        offsets: [s] to be added to the times of an instrument, 0 where none is told.

    Returns:
        Times and channels, for `resample`.

    Raises:
        ValueError: two channels of one name, an offset of no instrument, clocks that have no time in common.
        TypeError: what is no mapping.

    Example:
        >>> t, columns = merged({"imu": load("imu.csv", gyro), "star": load("star.csv", q)}, offsets={"star": -0.25})
    """
    check.mapping("recordings", recordings)
    offsets = {} if offsets is None else offsets
    check.mapping("offsets", offsets)
    for name in offsets:
        if name not in recordings:
            check.refuse("offsets", f"name recordings ({', '.join(map(str, recordings))})", check.short(name))
    parts = {}
    for name, one in recordings.items():
        if not isinstance(one, tuple) or len(one) != 2:
            check.refuse(f"recordings[{name!r}]", "be times and channels", check.short(one))
        t, columns = checked(*one)
        shift = check.number(f"offsets[{name!r}]", offsets.get(name, 0.0))
        check.finite(f"offsets[{name!r}]", shift)
        parts[name] = t + shift, columns
    if not parts:
        check.refuse("recordings", "hold at least one", "empty")
    seen: dict[str, Any] = {}
    for name, (t, columns) in parts.items():
        for other, (u, _) in parts.items():
            if t[0] > u[-1]:
                must = f"have a time in common with {other!r} (see offsets)"
                check.refuse(f"recordings[{name!r}]", must, f"from {t[0]:.9g} s on, after its end at {u[-1]:.9g} s")
        for channel in columns:
            if channel in seen:
                check.refuse(
                    "recordings",
                    "have channels of different names",
                    f"of {channel!r} in {seen[channel]!r} and {name!r}",
                )
            seen[channel] = name
    every = np.unique(np.concatenate([t for t, _ in parts.values()]))
    out = {}
    for t, columns in parts.values():
        at = np.searchsorted(every, t)
        for channel, a in columns.items():
            out[channel] = np.full(len(every), np.nan)
            out[channel][at] = a
    return every, out


def checked(t, columns: Mapping[str, Any]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Times and channels of one length as float arrays; NaN in a channel is a missing sample.

    Rows of one time, as several instruments write them, become one, where no channel has two samples. An array (T, k), as a
    recorder of another simulator keeps a vector, is k channels: ``name.0``, ``name.1``, ...

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
    first = np.append(True, np.diff(t) > 0)  # of the rows of one time
    group = np.cumsum(first) - 1

    def unordered(row):
        check.refuse("time", "increase from row to row", f"{t[row]:.9g} after {t[row - 1]:.9g} in row {row}")

    if (np.diff(t) < 0).any():
        unordered(int(np.flatnonzero(np.diff(t) < 0)[0]) + 1)
    vectors = {name: a for name, a in columns.items() if np.ndim(a) == 2 and np.shape(a)[0] == len(t)}
    columns = {name: a for name, a in columns.items() if name not in vectors} | {
        f"{name}.{i}": part for name, a in vectors.items() for i, part in enumerate(check.real(str(name), a).T)
    }
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
        rows = np.flatnonzero(~np.isnan(a))
        if (twice := np.diff(group[rows]) == 0).any():
            unordered(int(rows[1:][twice][0]))
        out[name] = merged = np.full(first.sum(), np.nan)
        merged[group[rows]] = a[rows]
    return t[first], out


def unit_quaternions(columns: Mapping[str, Any], names) -> dict[str, np.ndarray]:
    """Four channels (T,) of quaternions as they are logged, made unit quaternions without jumps of sign.

    Logs hold three digits or counts of 16 bits: a common scale, and lengths within 5 % of it, are taken. q and -q are
    one attitude: each quaternion has the sign that is nearest to the one before. A sample with a part missing is missing.

    Args:
        columns: channels by name, as `load` gives them.
        names: of the four, w first: that is where a log says whether its scalar is first or last.

    Returns:
        The four channels by name, for ``columns | unit_quaternions(columns, names)``.

    Raises:
        ValueError: names that are not four different channels, or say themselves that w is not the first, no complete sample, a length of zero or more than 5 % off the median.
    """
    check.mapping("columns", columns)
    names = list(names) if np.iterable(names) and not isinstance(names, str) else []
    if len(names) != 4 or not all(name in list(columns) and names.count(name) == 1 for name in names):
        check.refuse("names", f"be four different channels ({', '.join(map(str, columns))})", check.short(names))
    agree("names", [str(name) for name in names], "wxyz")
    parts = [np.asarray(check.real(str(name), columns[name]), float) for name in names]
    if len({part.shape for part in parts}) > 1 or parts[0].ndim != 1:
        check.refuse("names", "be channels of one shape (T,)", f"of shapes {[part.shape for part in parts]}")
    q = np.stack(parts)
    known = np.isfinite(q).all(axis=0)
    length = np.sqrt(np.sum(q**2, axis=0))
    if not known.any():
        check.refuse(str(names[0]), "belong to one complete quaternion at least", "missing in every row")
    scale = np.median(length[known])
    off = known & ~(np.abs(length - scale) <= 0.05 * scale) | known & (length == 0)
    if off.any():
        row = int(np.flatnonzero(off)[0])
        must = f"belong to quaternions of one length (median {scale:.4g}, within 5 %)"
        check.refuse(str(names[0]), must, f"of length {length[row]:.4g} in row {row}")
    unit = q[:, known] / length[known]
    turns = np.sign(np.sum(unit[:, 1:] * unit[:, :-1], axis=0))
    unit[:, 1:] *= np.cumprod(np.where(turns < 0, -1.0, 1.0))
    out = np.full_like(q, np.nan)
    out[:, known] = unit
    return dict(zip(names, out))


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
