"""What a recorded file holds, as it was told and as it says itself, in channels and in words.

`jaxatt.replay.load` and `jaxatt.replay.report` are what users call.

May import: check, headers, logfiles, stamps.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np

from jaxatt import check
from jaxatt.headers import column, name_and_unit, time_column
from jaxatt.logfiles import CLOCK, INSTRUMENTS, Contents, Layout, checked_layout, read
from jaxatt.stamps import agrees, plausible

ORDERS, DIRECTIONS = ("wxyz", "xyzw"), ("body to reference", "reference to body")
# numbers that loggers write where there is no sample; taken for that where all others are ten times smaller, or there are none
MARKS = np.array([999, 999.9, 999.99, 9999, 9999.9, 9999.99, 99999, 99999.9, 99999.99, 999999, 32767, 32768, 65535, 2147483647,
                  2147483648, 1e20, 1e30, 9.9692099683868690e36])  # fmt: skip
GAP = 1.5  # median steps that are a gap
LISTED = 5  # gaps that a report lists


class Quaternion(NamedTuple):
    """How a file holds an attitude: told once, checked against the names of the columns, never guessed."""

    columns: Any  # headers (4,), or the name of a column of arrays
    order: str  # "wxyz": the scalar comes first, "xyzw": last
    direction: str  # "body to reference": its matrix takes body components to reference components, or the other way


class Understood(NamedTuple):
    """A file as it was understood."""

    name: str
    contents: Contents
    layout: Layout
    time: str
    channels: dict[str, str]  # by name: the header that it was read from
    t: np.ndarray  # [s] as stamped, one a row
    columns: dict[str, np.ndarray]  # one a row
    quaternions: dict[str, Quaternion]
    parts: dict[str, list[str]]  # names of the four channels of each, w first


def understood(path, wanted: Mapping, time, layout: Layout, told, quaternions) -> Understood:
    """Stamps and channels of a file, row by row; the refusals are those of `jaxatt.replay.load`."""
    path = check.place("path", path)
    check.mapping("units", wanted)
    told, quaternions = {} if told is None else told, {} if quaternions is None else quaternions
    check.mapping("told", told)
    check.mapping("quaternions", quaternions)
    if not all(isinstance(unit, str) for unit in told.values()):
        check.refuse("told", "give the unit of each header as a string", check.short(told))
    layout = checked_layout(layout)
    asked: dict[str, str | None] = {str(name): unit for name, unit in wanted.items()}
    parts = {}
    for name, q in quaternions.items():
        four = components(str(name), q)
        if twice := [one for one in four if one in asked]:
            check.refuse("units", "name no column of a quaternion", repr(twice[0]))
        asked |= dict.fromkeys(four)
        parts[str(name)] = four

    def pick(header: list[str]):
        for one in told:
            if one not in header:
                check.refuse("told", f"name columns of {path.name} by their whole headers", check.short(one))
        at = time_column(path.name, header, layout.separator, time, layout.stamps)
        known = {one for four in parts.values() for one in four}
        return [
            at,
            *(_column(path.name, header, layout, name, unit, told, name in known) for name, unit in asked.items()),
        ]

    contents = read(path, pick, layout)
    t, *values = contents.columns
    if layout.missing is None:
        for name, a in zip(asked, values):
            _no_marks(name, a)
    columns = {
        name: one.factor * a if one.factor != 1 else a for name, one, a in zip(asked, contents.taken[1:], values)
    }
    headers = [contents.header[one.at[0]] for one in contents.taken]
    if columns:  # rows that hold nothing, such as those below the shorter of two instruments side by side
        kept = ~(np.isnan(t) & np.all([np.isnan(a) for a in columns.values()], axis=0))
        marks = {name: [cell for cell, keep in zip(cells, kept) if keep] for name, cells in contents.marks.items()}
        t, columns, contents = t[kept], {name: a[kept] for name, a in columns.items()}, contents._replace(marks=marks)
    plausible(headers[0], layout.stamps or "s", t)
    if layout.stamps == "iso" and not contents.zoned:
        agrees(headers[0], layout.zone)
    found = Understood(
        path.name, contents, layout, headers[0], dict(zip(asked, headers[1:])), t, columns, dict(quaternions), parts
    )
    _one_instrument(found)
    _one_clock(found)
    return found


def _column(file: str, header, layout: Layout, name: str, unit, told, pure: bool):
    """The column of a channel; pure: of a quaternion, whose header says no unit or [1]."""
    if not pure:
        return column(file, header, layout.separator, name, unit, told)
    said = {name_and_unit(one)[1] for one in header if name in (one, name_and_unit(one)[0])} - {None}
    return column(file, header, layout.separator, name, "1" if said or name not in header else None, told)


def components(name: str, q) -> list[str]:
    """The headers of a quaternion, w first; refuses what the headers themselves say otherwise."""
    check.kind(f"quaternions[{name!r}]", q, Quaternion)
    for field, allowed in (("order", ORDERS), ("direction", DIRECTIONS)):
        value = getattr(q, field)
        if not isinstance(value, str) or value not in allowed:
            check.refuse(f"quaternions[{name!r}].{field}", f"be one of {allowed}", check.short(value))
    four = [f"{q.columns}.{i}" for i in range(4)] if isinstance(q.columns, str) else q.columns
    if not isinstance(four, Sequence) or len(four) != 4 or len({str(one) for one in four}) != 4:
        check.refuse(
            f"quaternions[{name!r}].columns", "be four different headers, or a column of arrays", check.short(q.columns)
        )
    four = [str(one) for one in four]
    agree(f"quaternions[{name!r}].order", four, q.order)
    return [four[q.order.index(part)] for part in "wxyz"]


def agree(name: str, four: Sequence[str], order: str) -> None:
    """Refuse names of the four parts of a quaternion that say another order."""
    says = [part_of(one) for one in four]
    for one, said, part in zip(four, says, order):
        if isinstance(said, str) and said != part:
            check.refuse(name, f"be that of the names, in which {one!r} is {said}", repr(order))
    numbers = [said for said in says if isinstance(said, int)]
    if len(numbers) == 4:
        scalar = numbers[order.index("w")]
        vector = [number for number, part in zip(numbers, order) if part != "w"]
        if sorted(vector) != vector or scalar not in (min(numbers), max(numbers)):
            check.refuse(name, f"fit the numbers of the names, {', '.join(four)}", repr(order))


def part_of(header: str) -> str | int | None:
    """What a name says that a part of a quaternion is: "w", "x", "y", "z", its number, or nothing."""
    name = name_and_unit(header)[0].strip()
    if camel := re.search(r"[a-z0-9]([WXYZ])$", name):
        return camel[1].lower()
    name = name.lower()
    if found := re.search(r"(?:^|[^a-z0-9]|q|quat|quaternion)(w|x|y|z|i|j|k|s|scalar|real)[\])]?$", name):
        return {"i": "x", "j": "y", "k": "z", "s": "w", "scalar": "w", "real": "w"}.get(found[1], found[1])
    if found := re.search(r"(?<!\d)(\d)[\])]?$", name):
        return int(found[1])
    return None


def _one_instrument(found: Understood) -> None:
    """Refuse a channel whose samples are of several instruments."""
    for header, cells in found.contents.marks.items():
        if re.split(r"[./]", header)[-1].strip().lower() not in INSTRUMENTS:
            continue
        for name, a in found.columns.items():
            here = np.array(cells)[~np.isnan(a)] if len(cells) else np.array([])
            kinds = np.unique(here)
            if 1 < len(kinds) < len(here) or (len(kinds) > 1 and len(kinds) == len(here) and not _counts(kinds)):
                must = f"be of one instrument: say which, where={{{header!r}: {str(kinds[0])!r}}}"
                check.refuse(name, must, f"of {len(kinds)} by the column {header!r}: {', '.join(kinds[:4])}")


def _one_clock(found: Understood) -> None:
    """Refuse a channel that stands behind the times of another clock, which do not go with those that were asked for."""
    header, taken = found.contents.header, found.contents.taken
    clocks = {header.index(name) for name in found.contents.marks if CLOCK.fullmatch(name_and_unit(name)[0])} | set(
        taken[0].at
    )
    for name, one in zip(found.columns, taken[1:]):
        nearest = max((i for i in clocks if i < one.at[0]), default=taken[0].at[0])
        if nearest in taken[0].at:
            continue
        other = np.array([_instant(cell, found.layout.decimal) for cell in found.contents.marks[header[nearest]]])
        both = np.isfinite(other) & np.isfinite(found.t)
        if both.sum() < 2 or np.ptp(found.t[both]) == 0:
            continue
        pace = np.ptp(other[both]) / np.ptp(found.t[both])
        if not any(abs(pace / unit - 1) < 0.01 for unit in (1, 1e3, 1e6, 1e9, 1e-3, 1e-6, 1e-9)):
            must = f"be stamped by its own clock: load it with time={header[nearest]!r} and join both by `merged`"
            check.refuse(name, must, f"behind that column, which goes {pace:.4g} times as fast as {found.time!r}")


def _instant(cell: str, decimal: str) -> float:
    """A stamp of any kind as a number; NaN for what is none."""
    for number in (
        lambda: float(cell.replace(",", ".") if decimal == "," else cell),
        lambda: datetime.fromisoformat(cell).timestamp(),
    ):
        with suppress(ValueError):
            return number()
    return np.nan


def _counts(kinds) -> bool:
    return all(re.fullmatch(r"\d+", kind) for kind in kinds)


def _no_marks(name: str, a: np.ndarray) -> None:
    """Refuse numbers that likely mark missing samples."""
    size = np.abs(a)
    near = (np.abs(size[:, None] - MARKS) <= 1e-6 * MARKS).any(axis=1)
    others = size[np.isfinite(size) & ~near]
    if near.any() and (len(others) == 0 or 10 * others.max() < size[near].min()):
        row = int(np.flatnonzero(near)[0])
        mark = f"{a[row]:.9g}"
        must = f"hold samples (pass missing=[{mark}] where that marks missing ones, missing=[] where it is a sample)"
        check.refuse(name, must, f"{mark} in row {row}")


# words


def report_of(found: Understood, t: np.ndarray, columns: Mapping[str, np.ndarray]) -> str:
    """What was understood, in lines. t, columns: as they are handed on."""
    contents, layout = found.contents, found.layout
    kind = (
        ""
        if found.name.lower().endswith(".parquet")
        else f"; separator {layout.separator!r}, decimal sign {layout.decimal!r}"
    )
    lines = [f"{found.name}: {contents.rows} rows, {len(contents.header)} columns{kind}"]
    if layout.where:
        held = ", ".join(f"{name} = {value}" for name, value in layout.where.items())
        lines.append(f"rows: {len(found.t)} of them, where {held}")
    stamps = layout.stamps or "s"
    span = f"{t[0]:.13g} to {t[-1]:.13g} s"
    if stamps == "iso":
        first, last = (datetime.fromtimestamp(float(one), UTC).isoformat(timespec="milliseconds") for one in t[[0, -1]])
        span = f"{first} to {last}, {f'zone {layout.zone}' if layout.zone else 'UTC where the dates name no zone'}"
    lines.append(f"time: {found.time!r} in {stamps}, {span}, {t[-1] - t[0]:.9g} s in {len(t)} instants")
    sources = {name: (header, one) for (name, header), one in zip(found.channels.items(), contents.taken[1:])}
    for name, (header, one) in sources.items():
        unit = one.said or "no unit said"
        part = f", element {one.part}" if one.part else ""
        by = f" x {one.factor:.9g}" if one.factor != 1 else ""
        if name in columns:
            lines.append(f"{name}: from {header!r}{part} [{unit}]{by}; {_range(columns[name])}")
    for name, q in found.quaternions.items():
        turned = ", conjugated" if q.direction == DIRECTIONS[1] else ""
        whole = "wxyz".replace("w", f"w from {found.parts[name][0]!r}, ", 1)[:-3]
        lines.append(
            f"{name}: quaternion {q.order}, {whole}{q.direction}{turned}, made of unit length: {name}.w to {name}.z body to reference"
        )
    for names, rows in _instruments(columns).items():
        lines.append(f"{', '.join(names)}: {_rate(t[rows])}")
    left = [
        header for i, header in enumerate(contents.header) if header and not any(i in one.at for one in contents.taken)
    ]
    if left:
        lines.append(f"left alone: {', '.join(left)}")
    return "\n".join(lines)


def _range(a: np.ndarray) -> str:
    missing = int(np.isnan(a).sum())
    words = f"{np.nanmin(a):.6g} to {np.nanmax(a):.6g}"
    return f"{words}, {len(a) - missing} samples" if missing else f"{words}, no sample missing"


def _instruments(columns: Mapping[str, np.ndarray]) -> dict[tuple[str, ...], np.ndarray]:
    """Channels that have their samples in the same rows, and the rows."""
    groups: dict[bytes, list[str]] = {}
    for name, a in columns.items():
        groups.setdefault(np.isnan(a).tobytes(), []).append(name)
    return {tuple(names): np.flatnonzero(~np.isnan(columns[names[0]])) for names in groups.values()}


def _rate(t: np.ndarray) -> str:
    """Rate and gaps of the instants of one instrument."""
    if len(t) < 2:
        return "one sample"
    steps = np.diff(t)
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > GAP * usual)
    words = f"{1 / usual:.6g} Hz, steps of {steps.min():.6g} to {steps.max():.6g} s"
    if not len(gaps):
        return f"{words}, no gap"
    listed = ", ".join(f"{steps[i]:.6g} s after {t[i]:.13g} s" for i in gaps[:LISTED])
    return f"{words}, {len(gaps)} gap{'s' if len(gaps) > 1 else ''}: {listed}{', ...' if len(gaps) > LISTED else ''}"
