"""Columns of a log file: text as loggers and spreadsheets write it, and Parquet, of which neither executes code.

What is read wrong without a word elsewhere is refused here in one line: rows of another length than the header, decimal
commas, stamps of another unit, arrays cut by a separator. `jaxatt.replay.load` is what users call.

May import: check, headers, stamps, units.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

from jaxatt import check, units
from jaxatt.headers import SEPARATORS, Taken, name_and_unit
from jaxatt.stamps import JOINED, STAMPS, reader, zone_of

TEXT = (".csv", ".txt", ".tsv", ".dat", ".log", ".asc")
COMMENTS = ("#", "%", "//")  # what lines that are no rows begin with
FLAGS = {"true": 1.0, "false": 0.0}
MISSING = frozenset((
    "", "nan", "na", "n/a", "#n/a", "#na", "<na>", "null", "none", "-", "--", "---", "-nan", "nan(ind)", "-nan(ind)", "1.#qnan", "-1.#ind",
))  # fmt: skip
# the last word of a column that says which instrument a row is of
INSTRUMENTS = {
    "id", "sensor", "sensorid", "sensor_id", "instrument", "device", "deviceid", "device_id", "imu", "imuid", "imu_id", "source", "channel",
    "topic", "instance", "name", "type", "msg", "message", "msgtype", "msg_type", "signal", "parameter", "variable", "quantity", "axis", "unit",
    "units", "frame_id", "node", "kind",
}  # fmt: skip
# the name of a column of times
CLOCK = re.compile(
    r"(?i:(t|time|timestamp|stamp|clock)([ _.].*)?|.*[ _.](t|time|timestamp|stamp|clock))|time[A-Z].*|.*[a-z](Time|Timestamp|Stamp)"
)
CHUNK = 10_000  # rows that are held as text at a time


class Layout(NamedTuple):
    """What a file's columns are written in: see `jaxatt.replay.load`."""

    separator: str = ","
    decimal: str = "."
    stamps: str | None = None
    zone: str | None = None
    header: Sequence[str] | None = None
    skip: int = 0
    encoding: str = "utf-8"
    where: Mapping[str, Any] | None = None
    missing: Collection | None = None


class Contents(NamedTuple):
    """What was read."""

    header: list[str]
    taken: list[Taken]
    columns: list[np.ndarray]
    marks: dict[str, list[str]]  # cells of the columns that nobody asks for and that tell instruments or clocks apart
    rows: int  # of the file, those that `where` leaves out too
    zoned: bool  # whether its dates name their zone


def checked_layout(layout: Layout) -> Layout:
    """The layout; ValueError or TypeError for what it cannot be."""
    for name, allowed in (("stamps", (None, *STAMPS)), ("separator", SEPARATORS), ("decimal", (".", ","))):
        value = getattr(layout, name)
        if not (value is None or isinstance(value, str)) or value not in allowed:
            check.refuse(name, f"be one of {allowed}", check.short(value))
    if layout.separator == layout.decimal:
        check.refuse("separator", "differ from `decimal`", repr(layout.separator))
    if zone_of(layout.zone) is not None and layout.stamps != "iso":
        check.refuse("zone", "be None, for stamps other than 'iso' have none", repr(layout.zone))
    check.whole("skip", layout.skip, 0)
    known = False
    with suppress(LookupError, TypeError, ValueError):
        known = "".encode(layout.encoding) is not None
    if not known:
        check.refuse("encoding", "be one that Python knows, such as 'utf-8' or 'latin-1'", check.short(layout.encoding))
    header = layout.header
    if header is not None and (
        isinstance(header, str) or not isinstance(header, Sequence) or not all(isinstance(a, str) for a in header)
    ):
        check.refuse("header", "be the names of all columns", check.short(header))
    check.mapping("where", {} if layout.where is None else layout.where)
    missing = layout.missing
    if missing is not None and (isinstance(missing, str) or not isinstance(missing, Collection)):
        check.refuse("missing", "be a list of the marks of missing samples, such as [-9999]", check.short(missing))
    return layout


def read(path: Path, pick: Callable, layout: Layout) -> Contents:
    """Columns of a text or .parquet file as float arrays; of the first one the stamps, in seconds.

    pick: (header) -> what is `Taken`, the stamps first; it refuses what is not there. Blank lines, comments and a byte order
    mark are passed over; one empty cell at the end of a row may be too many. See `jaxatt.replay.load`.

    Raises ValueError for what is no such file, and ImportError without pandas or pyarrow.
    """
    try:
        import pandas  # noqa: F401
        import pyarrow.parquet
    except ImportError as error:
        raise ImportError("Reading files needs pandas and pyarrow: pip install 'jaxatt[data]'.") from error
    kind = path.suffix.lower()
    if kind not in (*TEXT, ".parquet"):
        check.refuse("path", f"end in .csv or .parquet, or for text in {', '.join(TEXT[1:])}", repr(path.name))
    cells = _Cells(layout)
    with path.open("rb") as file:  # an open file: nothing is fetched from an address or unpacked
        if kind in TEXT:
            return _text(path.name, file, pick, layout, cells)
        try:
            table = pyarrow.parquet.read_table(file)
            header = [str(name).strip() for name in table.column_names]
        except Exception as error:
            _no_file("parquet", path.name, error)
        return _parquet(path.name, table, header, pick, layout, cells)


def _no_file(kind: str, name: str, error: Exception) -> NoReturn:
    raise ValueError(
        f"`path` must be a {kind} file, but {name} is none: {' '.join(str(error).split())[:200]}"
    ) from None


def _chosen(
    name: str, header: list[str], pick: Callable, layout: Layout
) -> tuple[list[Taken], dict[int, Any], list[int]]:
    """What is taken, what the rows are told to hold, and the columns that tell instruments apart."""
    named = [column for column in header if column]
    if len(set(named)) < len(named):
        check.refuse("path", "name every column once", f"{name} with {check.short(sorted(named))}")
    taken = pick(header)
    where = {}
    for column, value in (layout.where or {}).items():
        if column not in header:
            check.refuse("where", f"name columns of {name}", check.short(column))
        where[header.index(column)] = value
    asked = {i for one in taken for i in one.at} | set(where)
    last = [re.split(r"[./]", column)[-1].strip().lower() for column in header]
    clocks = [CLOCK.fullmatch(name_and_unit(column)[0]) is not None for column in header]
    return taken, where, [i for i, word in enumerate(last) if (word in INSTRUMENTS or clocks[i]) and i not in asked]


def _holds(cell: str, value) -> bool:
    """Whether a cell is what `where` tells, or one of it: the same text, or the same number."""
    if isinstance(value, (list, tuple, set, frozenset)):
        return any(_holds(cell, one) for one in value)
    with suppress(ValueError, TypeError):
        return cell.strip() == str(value) or float(cell) == float(value)
    return False


# text


def _text(name: str, file, pick: Callable, layout: Layout, cells: _Cells) -> Contents:
    header, rows = _headed(name, _rows(name, file, layout), layout)
    (taken, where, marked), wanted = _chosen(name, header, pick, layout), len(header)
    parts: list[list[np.ndarray]] = [[] for _ in taken]
    marks: dict[str, list[str]] = {header[i]: [] for i in marked}
    held: list[tuple[int, list[str]]] = []
    count = 0

    def convert():
        numbers = [number for number, _ in held]
        for n, (one, part) in enumerate(zip(taken, parts)):
            first, *second = one.at
            texts = [row[first] for _, row in held]
            if second:
                between = JOINED[layout.stamps or "iso"]
                texts = [f"{row[first].strip()}{between}{row[second[0]].strip()}" for _, row in held]
            part.append(cells.numbers(header[first], texts, one.part, n == 0, numbers))
        for i in marked:
            marks[header[i]] += [row[i].strip() for _, row in held]
        held.clear()

    for line, row in rows:
        if len(row) == wanted + 1 and not row[-1].strip():
            del row[-1]
        if len(row) != wanted:
            must = f"be a csv file of {wanted} cells in each row, as in its header"
            commas = ": decimal commas need another separator" if layout.separator == "," and len(row) > wanted else ""
            check.refuse("path", must, f"{name} with {len(row)} cells in row {count} (line {line}){commas}")
        for cell in row:
            if cell[:1] == "[" and cell.rstrip()[-1:] != "]":
                check.refuse("path", "have arrays in cells of their own, quoted or with another separator", f"{name} with {check.short(cell)} in line {line}")  # fmt: skip
        if all(_holds(row[i], value) for i, value in where.items()):
            held.append((count, row))
        count += 1
        if len(held) == CHUNK:
            convert()
    convert()
    if where and count and not sum(len(a) for a in parts[0]):
        check.refuse("where", f"hold in some row of {name}", check.short(dict(layout.where or {})))
    return Contents(header, taken, [np.concatenate(part) for part in parts], marks, count, True in cells.zoned)


def _headed(name: str, rows: Iterator, layout: Layout) -> tuple[list[str], Iterator]:
    """The header, with the units of a row of units, and the rows after it.

    A first row that begins with a number is no header: that is told, or the comment before it, if it has as many cells.
    """
    line, first, comment = next(rows, (0, [], ""))
    if not first:
        check.refuse("path", "be a csv file with a header", f"{name}, which is empty")
    first = [cell.strip() for cell in first]
    bare = re.match(r"[+-]?[.,]?\d", first[0]) is not None
    plain = ((line, row) for line, row, _ in rows)
    if layout.header is not None:
        if not bare:
            check.refuse("header", f"be None, for {name} has one", check.short(first))
        return [column.strip() for column in layout.header], chain([(line, first)], plain)
    if bare:
        said = next(iter(_split([comment.lstrip("#%/ \t").strip()], layout)), []) if comment else []
        said = [cell.strip() for cell in said]
        while len(said) > len(first) and not said[-1]:
            said.pop()
        if len(said) != len([*first[:-1], *([first[-1]] if first[-1] else [])]) and len(said) != len(first):
            must = "be a csv file with a header (pass header=[...] with the names of its columns)"
            check.refuse("path", must, f"{name}, which begins with {check.short(first)}")
        return said, chain([(line, first)], plain)
    after = next(plain, None)
    if after is None:
        return first, iter(())
    words = [re.sub(r"^[\[(](.*)[\])]$", r"\1", cell.strip()).strip() for cell in after[1]]
    if len(words) == len(first) and any(units.known(word) for word in words) and all(units.known(a) or a in ("", "-", "1") for a in words):  # fmt: skip
        return [_with_unit(column, word) for column, word in zip(first, words)], plain
    return first, chain([after], plain)


def _with_unit(column: str, word: str) -> str:
    """A header with the unit of the row of units; refuses two units."""
    if not word:
        return column
    said = name_and_unit(column)[1]
    if said is None:
        return f"{column} [{'1' if word == '-' else word}]"
    if units.factor(said, word) != 1.0:
        check.refuse(column, "have one unit", f"in [{word}] by the row of units")
    return column


def _rows(name: str, file, layout: Layout) -> Iterator[tuple[int, list[str], str]]:
    """Number of the line and cells of every row that holds something, and the last comment before it."""
    at, comment = 0, ""
    encoding = "utf-8-sig" if layout.encoding.lower().replace("_", "-") in ("utf-8", "utf8") else layout.encoding

    def lines():
        nonlocal at, comment
        for line in io.TextIOWrapper(file, encoding, newline=""):
            at += 1
            if at <= layout.skip:
                continue
            if line.startswith(COMMENTS):
                comment = line
            else:
                yield line

    rows = _split(lines(), layout)
    while True:
        try:
            row = next(rows)
        except StopIteration:
            return
        except (csv.Error, ValueError) as error:  # of the csv module or the decoder
            _no_file("csv", name, error)
        if any(cell.strip() for cell in row):
            yield at, row, comment


def _split(lines, layout: Layout) -> Iterator[list[str]]:
    if layout.separator == " ":
        # a unit in brackets belongs to the name before it
        return (re.split(r"\s+(?![\[(])", line.strip()) for line in lines)
    return csv.reader(lines, delimiter=layout.separator, skipinitialspace=layout.separator != "\t", strict=True)


# Parquet


def _parquet(name: str, table, header: list[str], pick: Callable, layout: Layout, cells: _Cells) -> Contents:
    taken, where, marked = _chosen(name, header, pick, layout)
    try:
        columns = {i: table.column(i).to_numpy() for one in taken for i in one.at}
        marks = {i: [str(cell) for cell in table.column(i).to_pylist()] for i in (*marked, *where)}
    except Exception as error:
        _no_file("parquet", name, error)
    kept = np.ones(table.num_rows, bool)
    for i, value in where.items():
        kept &= np.array([_holds(cell, value) for cell in marks[i]], bool)
    if where and not kept.any():
        check.refuse("where", f"hold in some row of {name}", check.short(dict(layout.where or {})))
    rows = np.flatnonzero(kept).tolist()
    found = []
    for n, one in enumerate(taken):
        given = [columns[i][kept] for i in one.at]
        aware = getattr(table.column(one.at[0]).type, "tz", None) is not None
        if len(given) > 1:
            texts = [JOINED[layout.stamps or "iso"].join(map(str, row)) for row in zip(*given)]
            found.append(cells.numbers(header[one.at[0]], texts, "", True, rows))
        else:
            found.append(cells.array(header[one.at[0]], given[0], one.part, n == 0, rows, aware))
    return Contents(
        header,
        taken,
        found,
        {header[i]: [marks[i][row] for row in rows] for i in marked},
        table.num_rows,
        True in cells.zoned,
    )


# cells


class _Cells:
    """What cells of a layout say."""

    def __init__(self, layout: Layout):
        self.decimal, self.stamps, self.zone = layout.decimal, layout.stamps or "s", layout.zone
        marks = [str(mark).strip().lower() for mark in layout.missing or ()]
        self.words = MISSING | set(marks)
        self.marks = [float(mark) for mark in marks if _goes(float, mark)]
        self.zoned: set[bool] = set()  # whether dates name a zone
        self.stamp = reader(self.stamps, self.number, self.missing, zone_of(layout.zone), self.zoned)

    def missing(self, cell: str) -> bool:
        return cell.strip().lower() in self.words

    def number(self, cell: str, decimal: str | None = None) -> float:
        """What a cell says; NaN for the words of `MISSING`, ValueError for what is no number."""
        cell = cell.strip()
        if cell.lower() in self.words:
            return np.nan
        if (decimal or self.decimal) == ",":
            if "." in cell:
                raise ValueError
            cell = cell.replace(",", ".")
        if "_" in cell or not cell.isascii():  # which Python would take
            raise ValueError
        with suppress(ValueError):
            value = float(cell)
            return np.nan if value in self.marks else value
        if re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)[dD][+-]?\d+", cell):  # of Fortran
            return float(cell.lower().replace("d", "e"))
        if cell.lower() in FLAGS:
            return FLAGS[cell.lower()]
        raise ValueError

    def numbers(self, name: str, cells: list[str], part: str, stamp: bool, rows: Sequence[int]) -> np.ndarray:
        """Cells of a column as numbers, of stamps in seconds; rows: their numbers."""
        if part:
            return self._elements(name, [_elements_of(cell, self.decimal) for cell in cells], part, rows)
        number = self.stamp if stamp else self.number
        row, cell, why = 0, "", ""
        out = np.empty(len(cells))
        for n, cell in enumerate(cells):
            try:
                out[n] = number(cell)
            except ValueError as error:
                row, why = rows[n], str(error)
                break
        else:
            return out
        way_out = ""
        if stamp and self.stamps != "iso" and re.match(r"\d{4}-?\d\d-?\d\d[T ]", cell.strip()):
            way_out = " (pass stamps='iso' for dates)"
        elif not stamp and cell.strip()[:1] in "[(" and _elements_of(cell, self.decimal):
            way_out = f" (ask for an element, '{name_and_unit(name)[0]}.0')"
        elif self.decimal == "." and _goes(lambda cell: self.number(cell, ","), cell):
            way_out = " (pass decimal=',' for decimal commas)"
        must = "hold stamps of ISO 8601" if stamp and self.stamps == "iso" else f"hold numbers{way_out}"
        why = f" ({why})" if stamp and self.stamps == "iso" and " zone" in why else ""
        check.refuse(name, must + why, f"{check.short(cell)} in row {row}")

    def _elements(self, name: str, cells: list, part: str, rows: Sequence[int]) -> np.ndarray:
        """One element of the arrays of a column; None for no array, refused where they differ in length."""
        sizes = {len(cell): n for n, cell in reversed(list(enumerate(cells))) if cell}
        if len(sizes) > 1:
            row = max(sizes.values())
            check.refuse(name, "hold arrays of one length", f"of {len(cells[row])} elements in row {rows[row]}")
        out = np.full(len(cells), np.nan)
        for n, cell in enumerate(cells):
            if cell is None:
                check.refuse(name, "hold arrays, to ask for an element of", f"without one in row {rows[n]}")
            if not cell:
                continue
            named = cell if isinstance(cell, dict) else dict(zip(map(str, range(len(cell))), cell))
            if part not in named:
                check.refuse(name, f"hold arrays with an element {part}", f"of {', '.join(named)} in row {rows[n]}")
            one = named[part]
            out[n : n + 1] = self.numbers(name, ["" if one is None else str(one)], "", False, rows[n : n + 1])
        return out

    def array(self, name: str, a: np.ndarray, part: str, stamp: bool, rows: Sequence[int], aware: bool) -> np.ndarray:
        """A column of a Parquet file; aware: its dates name a zone."""
        if part:
            given = [{} if cell is None else cell if isinstance(cell, dict) else None if isinstance(cell, (str, float, int)) else list(cell) for cell in a.tolist()]  # fmt: skip
            if not all(isinstance(cell, (list, dict)) for cell in given):
                return self.numbers(name, ["" if cell is None else str(cell) for cell in a], part, stamp, rows)
            return self._elements(name, given, part, rows)
        if a.dtype.kind == "M" and stamp:
            if self.stamps != "iso":
                check.refuse(name, "hold numbers (pass stamps='iso' for dates)", f"of type {a.dtype}")
            if self.zone and not aware:
                return self.numbers(
                    name, ["" if np.isnat(cell) else str(cell) for cell in a.astype("datetime64[ns]")], "", True, rows
                )
            if self.zone:
                check.refuse("zone", "be None, for the dates name theirs", repr(self.zone))
            self.zoned.add(aware)
            a = a.astype("datetime64[ns]")
            return np.where(np.isnat(a), np.nan, _seconds(a.astype(np.int64), STAMPS["ns"]))
        if a.dtype.kind in "biuf" and not (stamp and self.stamps == "iso"):
            plain = a.astype(float) if not stamp or self.stamps == "s" else _seconds(a, STAMPS[self.stamps])
            return np.where(np.isin(plain, self.marks), np.nan, plain) if self.marks and not stamp else plain
        if a.dtype.kind != "O":
            dates = stamp and self.stamps == "iso"
            check.refuse(name, "hold stamps of ISO 8601" if dates else "hold numbers", f"of type {a.dtype}")
        return self.numbers(name, ["" if cell is None else str(cell) for cell in a], "", stamp, rows)


def _elements_of(cell: str, decimal: str = ".") -> list[str] | None:
    """The elements of a cell such as "[0.1 0.2 0.3]"; empty for an empty one, None for what is no array.

    One sign stands between all of them: what could be decimal commas is no array unless they are told, and then commas
    stand between no elements that no space parts.
    """
    cell = cell.strip()
    if cell.lower() in MISSING:
        return []
    found = re.fullmatch(r"(?:array)?\s*([\[({]+)([^\[\](){}]*)([\])}]+)", cell)
    if not found or len(found[1]) != len(found[3]):
        return None
    text = found[2].strip()
    if not text:
        return []
    between = {re.sub(r"\s+", " ", sign) for sign in re.findall(r"\s*[,;]\s*|\s+", text)}
    if decimal == ",":
        between = {re.sub(r"\s+", " ", sign) for sign in re.findall(r"\s*;\s*|,?\s+", text)}
        if len(between) > 1 or (not between and "," in text):
            return None
        return re.split(r"\s*;\s*|,?\s+", text)
    return re.split(r"\s*[,;]\s*|\s+", text) if len(between) <= 1 else None


def _seconds(a: np.ndarray, parts) -> np.ndarray:
    """a / parts, also of counts since 1970, which have more digits than a float."""
    return a // parts + (a % parts) / parts


def _goes(f: Callable, cell: str) -> bool:
    with suppress(ValueError):
        f(cell)
        return True
    return False
