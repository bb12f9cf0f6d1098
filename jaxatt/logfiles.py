"""Columns of a log file: CSV as loggers and spreadsheets write it, and Parquet, of which neither executes code.

What is read wrong without a word elsewhere is refused here in one line: rows of another length than the header, decimal
commas, stamps of another unit. `jaxatt.replay.load` is what users call.

May import: check.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from jaxatt import check

SEPARATORS = (",", ";", "\t", "|", " ")  # a space stands for any run of spaces and tabs
STAMPS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9, "iso": None}  # units of time, parts of a second
FLAGS = {"true": 1.0, "false": 0.0}
MISSING = frozenset(("", "nan", "na", "n/a", "#n/a", "#na", "<na>", "null", "none", "-", "--", "---"))
CHUNK = 10_000  # rows that are held as text at a time


def read(path: Path, pick: Callable, separator: str, decimal: str, stamps: str) -> list[np.ndarray]:
    """Columns of a .csv or .parquet file as float arrays; of the first one the stamps, in seconds.

    pick: (header) -> indices of the columns, that of the stamps first; it refuses what is not there. Blank lines, lines
    that begin with # and a byte order mark are passed over; one empty cell at the end of a row may be too many. See
    `jaxatt.replay.load`.

    Raises ValueError for what is no such file, and ImportError without pandas or pyarrow.
    """
    try:
        import pandas  # noqa: F401
        import pyarrow.parquet
    except ImportError as error:
        raise ImportError("Reading files needs pandas and pyarrow: pip install 'jaxatt[data]'.") from error
    kind = path.suffix.lower()
    if kind not in (".csv", ".parquet"):
        check.refuse("path", "end in .csv or .parquet", repr(path.name))
    with path.open("rb") as file:  # an open file: nothing is fetched from an address or unpacked
        if kind == ".csv":
            return _csv(path.name, file, pick, separator, decimal, stamps)
        try:
            table = pyarrow.parquet.read_table(file)
            header = [str(name).strip() for name in table.column_names]
        except Exception as error:
            _no_file("parquet", path.name, error)
        chosen = _chosen(path.name, header, pick)
        try:
            columns = [table.column(i).to_numpy() for i in chosen]
        except Exception as error:
            _no_file("parquet", path.name, error)
    names = [header[i] for i in chosen]
    return [_array(name, a, decimal, None if i else stamps) for i, (name, a) in enumerate(zip(names, columns))]


def _no_file(kind: str, name: str, error: Exception) -> NoReturn:
    raise ValueError(
        f"`path` must be a {kind} file, but {name} is none: {' '.join(str(error).split())[:200]}"
    ) from None


def _chosen(name: str, header: list[str], pick: Callable) -> list[int]:
    named = [column for column in header if column]
    if len(set(named)) < len(named):
        check.refuse("path", "name every column once", f"{name} with {check.short(sorted(named))}")
    return pick(header)


def _csv(name: str, file, pick: Callable, separator: str, decimal: str, stamps: str) -> list[np.ndarray]:
    rows = _rows(name, file, separator)
    _, header = next(rows, (0, []))
    if not header:
        check.refuse("path", "be a csv file with a header", f"{name}, which is empty")
    header = [cell.strip() for cell in header]
    chosen, wanted = _chosen(name, header, pick), len(header)
    parts: list[list[np.ndarray]] = [[] for _ in chosen]
    held: list[list[str]] = []
    count = 0

    def convert():
        first = count - len(held)
        for n, (i, part) in enumerate(zip(chosen, parts)):
            part.append(_numbers(header[i], [row[i] for row in held], decimal, None if n else stamps, first))
        held.clear()

    for line, cells in rows:
        if len(cells) == wanted + 1 and not cells[-1].strip():
            del cells[-1]
        if len(cells) != wanted:
            must = f"be a csv file of {wanted} cells in each row, as in its header"
            commas = ": decimal commas need another separator" if separator == "," and len(cells) > wanted else ""
            check.refuse("path", must, f"{name} with {len(cells)} cells in row {count} (line {line}){commas}")
        held.append(cells)
        count += 1
        if len(held) == CHUNK:
            convert()
    convert()
    return [np.concatenate(part) for part in parts]


def _rows(name: str, file, separator: str) -> Iterator[tuple[int, list[str]]]:
    """Number of the line and cells of every row that holds something, the header first."""
    at = 0

    def lines():
        nonlocal at
        for line in io.TextIOWrapper(file, "utf-8-sig", newline=""):
            at += 1
            if not line.startswith("#"):
                yield line

    if separator == " ":
        # a unit in brackets belongs to the name before it
        rows: Iterator[list[str]] = (re.split(r"\s+(?![\[(])", line.strip()) for line in lines())
    else:
        rows = csv.reader(lines(), delimiter=separator, skipinitialspace=separator != "\t", strict=True)
    while True:
        try:
            cells = next(rows)
        except StopIteration:
            return
        except (csv.Error, ValueError) as error:  # of the csv module or the decoder
            _no_file("csv", name, error)
        if any(cell.strip() for cell in cells):
            yield at, cells


def _array(name: str, a: np.ndarray, decimal: str, stamps: str | None) -> np.ndarray:
    """A column of a Parquet file; stamps: their unit, None for a channel."""
    if a.dtype.kind == "M" and stamps is not None:
        if stamps != "iso":
            check.refuse(name, "hold numbers (pass stamps='iso' for dates)", f"of type {a.dtype}")
        a = a.astype("datetime64[ns]")
        return np.where(np.isnat(a), np.nan, _seconds(a.astype(np.int64), STAMPS["ns"]))
    if a.dtype.kind in "biuf" and stamps != "iso":
        return a.astype(float) if stamps in (None, "s") else _seconds(a, STAMPS[stamps])
    if a.dtype.kind != "O":
        check.refuse(name, "hold stamps of ISO 8601" if stamps == "iso" else "hold numbers", f"of type {a.dtype}")
    return _numbers(name, ["" if cell is None else str(cell) for cell in a], decimal, stamps, 0)


def _seconds(a: np.ndarray, parts) -> np.ndarray:
    """a / parts, also of counts since 1970, which have more digits than a float."""
    return a // parts + (a % parts) / parts


def _numbers(name: str, cells: list[str], decimal: str, stamps: str | None, first: int) -> np.ndarray:
    """Cells of a column as numbers, of stamps in seconds; first: number of the first row."""
    number = _stamp(stamps, decimal) if stamps else lambda cell: _number(cell, decimal)
    try:
        return np.array([number(cell) for cell in cells], float)
    except ValueError:
        row, cell = next((row, cell) for row, cell in enumerate(cells) if not _goes(number, cell))
    way_out = ""
    if stamps and re.match(r"\d{4}-?\d\d-?\d\d[T ]", cell.strip()):
        way_out = " (pass stamps='iso' for dates)"
    elif decimal == "." and _goes(lambda cell: _number(cell, ","), cell):
        way_out = " (pass decimal=',' for decimal commas)"
    must = "hold stamps of ISO 8601" if stamps == "iso" else f"hold numbers{way_out}"
    check.refuse(name, must, f"{check.short(cell)} in row {first + row}")


def _goes(f: Callable, cell: str) -> bool:
    with suppress(ValueError):
        f(cell)
        return True
    return False


def _number(cell: str, decimal: str) -> float:
    """What a cell says; NaN for the words of `MISSING`, ValueError for what is no number."""
    cell = cell.strip()
    if decimal == ",":
        if "." in cell:
            raise ValueError
        cell = cell.replace(",", ".")
    try:
        if "_" not in cell and cell.isascii():  # which Python would take
            return float(cell)
    except ValueError:
        pass
    if cell.lower() in MISSING:
        return np.nan
    if cell.lower() in FLAGS:
        return FLAGS[cell.lower()]
    raise ValueError


def _stamp(stamps: str, decimal: str) -> Callable[[str], Any]:
    """What turns a cell into seconds. Whole numbers are divided exactly; dates without an offset are UTC."""
    parts = STAMPS[stamps]
    if parts is None:
        return _seconds_of_date
    if parts == 1:
        return lambda cell: _number(cell, decimal)
    whole = re.compile(r"\s*[+-]?\d+\s*", re.ASCII).fullmatch
    return lambda cell: (int(cell) if whole(cell) else _number(cell, decimal)) / parts


def _seconds_of_date(cell: str) -> float:
    """Seconds since 1970 of a date of ISO 8601."""
    if cell.strip().lower() in MISSING:
        return np.nan
    found = re.fullmatch(
        r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d(?::\d\d(?:\.\d{1,9})?)?)(Z|[+-]\d\d(?::?\d\d)?)?", cell.strip()
    )
    if not found:
        raise ValueError
    date, clock, offset = found.groups()
    ns = int(np.datetime64(f"{date}T{clock}", "ns").astype(np.int64))
    if offset and offset != "Z":
        minutes = int(offset[1:3]) * 60 + int(offset[3:].lstrip(":") or 0)
        ns -= (1 if offset[0] == "+" else -1) * minutes * 60 * 10**9
    return ns / 10**9


# headers


def name_and_unit(header: str) -> tuple[str, str | None]:
    """Name and unit of "gyro [rad/s]" or "gyro (rad/s)"; None where it says none, as in "q[0]" and "w_[x]"."""
    split = re.fullmatch(r"(.*?)(\s*)(?:\[([^][]*)\]|\(([^()]*)\))", header)
    if not split:
        return header, None
    name, gap, square, round_ = split.groups()
    unit = (round_ if square is None else square).strip()
    index = re.fullmatch(r"\d*|[wxyzijk]", unit) and not (gap and unit == "1")  # "share [1]" is a pure number
    return (header, None) if index else (name, unit)


def column(file: str, header: list[str], separator: str, name: str, unit: str | None) -> int:
    """Index of the column of a name and unit, or of a whole header."""
    known = [name_and_unit(column) for column in header]
    found = [i for i, (other, said) in enumerate(known) if other == name and said is not None and said == unit]
    if len(found) > 1:
        check.refuse(name, f"be one column of {file} (ask for one by its whole header)", [header[i] for i in found])
    if found:
        return found[0]
    if name in header:
        i = header.index(name)
        if unit is None or known[i][1] == unit or (known[i][1] is None and (unit == "1" or name.endswith((")", "]")))):
            return i
    others = [given for given, (other, _) in zip(header, known) if name in (given, other)]
    if others:
        must = f"be given in [{unit}] by {file}"
        check.refuse(name, must, f"in the column {' and '.join(map(repr, others))}")
    way_out = ""
    if len(header) == 1:  # then it was split by the wrong sign
        signs = [sign for sign in SEPARATORS if sign != separator and sign in header[0]]
        way_out = f" (pass separator={signs[0]!r}?)" if signs else ""
    there = ", ".join(header)
    there = there if len(there) <= 600 else f"{there[:600]}..."
    check.refuse(name if unit is None else f"{name} [{unit}]", f"be a column of {file}{way_out}", f"not among {there}")


def time_column(file: str, header: list[str], separator: str, time: str, stamps: str | None) -> int:
    """Index of the column of times. Where the unit of the stamps is asked for, the header need not say it."""
    known = [name_and_unit(other) for other in header]
    if stamps is None:
        others = sorted({said for name, said in known if name == time and said in STAMPS})
        if others and "s" not in others:
            must = f"be given in [s] (or pass stamps={others[0]!r})"
            check.refuse(time, must, f"in the column {header[known.index((time, others[0]))]!r}")
        return column(file, header, separator, time, "s")
    for i, (name, said) in enumerate(known):
        if time in (name, header[i]) and (said == stamps or (said not in STAMPS and (said is None or stamps == "iso"))):
            return i
    return column(file, header, separator, time, stamps)
