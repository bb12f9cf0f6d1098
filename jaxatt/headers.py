"""Headers of recorded files: names, units, and which column is meant by what a user asks for.

May import: check, stamps, units.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jaxatt import check, units
from jaxatt.stamps import JOINED, STAMPS

SEPARATORS = (",", ";", "\t", "|", " ")  # a space stands for any run of spaces and tabs


class Taken(NamedTuple):
    """A column that is asked for."""

    at: tuple[int, ...]  # its index; two, where date and time of day or seconds and nanoseconds stand apart
    part: str = ""  # which element of its arrays
    said: str | None = None  # unit in the file; None where neither the header nor the user says one
    factor: float = 1.0  # to the unit that is asked for


def name_and_unit(header: str) -> tuple[str, str | None]:
    """Name and unit of "gyro [rad/s]" or "gyro (rad/s)"; None where it says none, as in "q[0]" and "w_[x]"."""
    split = re.fullmatch(r"(.*?)(\s*)(?:\[([^][]*)\]|\(([^()]*)\))", header)
    if not split:
        return header, None
    name, gap, square, round_ = split.groups()
    unit = (round_ if square is None else square).strip()
    if gap and unit in ("", "-"):  # "q_w []" is a pure number
        return name, "1"
    index = re.fullmatch(r"\d*|[wxyzijk]", unit) and not (gap and unit == "1")  # "share [1]" is a pure number
    return (header, None) if index else (name, unit)


def column(file: str, header: list[str], separator: str, name: str, unit: str | None, told: Mapping[str, str]) -> Taken:
    """The column of a name and unit, of a whole header, or the element ``w.0`` of a column of arrays.

    told: units of columns whose headers say none, by header.
    """
    known = [name_and_unit(column) for column in header]
    found = [i for i, (other, said) in enumerate(known) if other == name and said is not None and said == unit]
    others = [i for i, (other, said) in enumerate(known) if name in (other, header[i]) and header[i]]
    whole = [i for i in others if header[i] == name]
    if not found and len(others) > 1 and whole:
        others = whole
    if not found:
        found = (
            [i for i in others if units.factor(_said(header[i], known[i][1], told), unit) is not None]
            if unit is not None
            else whole
        )
    if len(found) > 1:
        check.refuse(name, f"be one column of {file} (ask for one by its whole header)", [header[i] for i in found])
    if found:
        i = found[0]
        said = _said(header[i], known[i][1], told)
        return Taken((i,), "", said, (1.0 if unit is None else units.factor(said, unit)) or 1.0)
    for i in whole:  # a whole header tells that its brackets hold no unit
        if known[i][1] is None and (unit == "1" or name.endswith((")", "]"))):
            if (ending := units.of_name(name)) and units.factor(ending, unit) != 1.0:
                check.refuse(
                    name,
                    f"be given in [{unit}] by {file}",
                    f"in [{ending}] by its name (pass told={{{name!r}: {ending!r}}})",
                )
            return Taken((i,), "", unit)
    if others:
        ending = units.of_name(header[others[0]]) if known[others[0]][1] is None else None
        way_out = f" (pass told={{{header[others[0]]!r}: {ending!r}}})" if ending else ""
        must = f"be given in [{unit}] by {file}{way_out}"
        check.refuse(name, must, f"in the column {' and '.join(repr(header[i]) for i in others)}")
    element = re.fullmatch(r"(.+?)(?:\.(\w+)|\[(\d+)\])", name)
    if element and any(element[1] in (other, header[i]) for i, (other, _) in enumerate(known)):
        return column(file, header, separator, element[1], unit, told)._replace(part=element[2] or element[3])
    way_out = ""
    if len(header) == 1:  # then it was split by the wrong sign
        signs = [sign for sign in SEPARATORS if sign != separator and sign in header[0]]
        way_out = f" (pass separator={signs[0]!r}?)" if signs else ""
    there = ", ".join(header)
    there = there if len(there) <= 600 else f"{there[:600]}..."
    check.refuse(name if unit is None else f"{name} [{unit}]", f"be a column of {file}{way_out}", f"not among {there}")


def _said(header: str, said: str | None, told: Mapping[str, str]) -> str | None:
    """The unit of a column by its header, or as told; refuses what contradicts the header or the end of its name."""
    if header not in told:
        return said
    other = said or units.of_name(header)
    if other and units.factor(other, told[header]) != 1.0:
        check.refuse(f"told[{header!r}]", f"be [{other}], as the header says", repr(told[header]))
    return told[header]


def time_column(file: str, header: list[str], separator: str, time, stamps: str | None) -> Taken:
    """The column of times. Where the unit of the stamps is asked for, the header need not say it.

    time: a name, or the two of date and time of day ("iso") or of seconds and nanoseconds ("s+ns").
    """
    if not isinstance(time, str) and isinstance(time, Sequence) and len(time) == 2:
        return _pair(file, header, time, stamps)
    if stamps == "s+ns" or not str(time):
        check.refuse(
            "time", "name the columns of seconds and of nanoseconds" if time else "name a column", check.short(time)
        )
    time = str(time)
    known = [name_and_unit(other) for other in header]
    sort = lambda said: next((one for one in ("s", "ms", "us", "ns") if said and units.factor(said, one) == 1.0), said)
    mine = [i for i, (name, _) in enumerate(known) if time in (name, header[i]) and header[i]]
    if stamps is None:
        others = sorted({str(sort(known[i][1])) for i in mine if sort(known[i][1]) in STAMPS})
        if others and "s" not in others:
            must = f"be given in [s] (or pass stamps={others[0]!r})"
            i = next(i for i in mine if sort(known[i][1]) == others[0])
            check.refuse(time, must, f"in the column {header[i]!r}")
        seconds = [i for i in mine if sort(known[i][1]) == "s"]
        if len(seconds) == 1:
            return Taken((seconds[0],), "", "s")
    for i in mine if stamps else ():
        said = sort(known[i][1])
        if said == stamps or (said not in STAMPS and (said is None or stamps == "iso")):
            ending = units.of_name(header[i])
            if ending in ("s", "ms", "us", "ns") and stamps != ending:
                check.refuse(time, f"be given in [{stamps}]", f"in [{ending}] by its name, {header[i]!r}")
            return Taken((i,), "", stamps)
    found = column(file, header, separator, time, stamps or "s", {})
    if found.factor != 1 or found.part:
        check.refuse(time, f"be given in [{stamps or 's'}] by {file}", f"in the column {header[found.at[0]]!r}")
    return found


def _pair(file: str, header: list[str], time, stamps: str | None) -> Taken:
    """The two columns of times that are written in two; what their names say is held against what they are told to be."""
    if stamps not in JOINED:
        check.refuse("stamps", f"be one of {tuple(JOINED)} for times in two columns", repr(stamps))
    at = []
    for one, wanted in zip(map(str, time), ("s", "ns") if stamps == "s+ns" else (None, None)):
        here = [i for i, other in enumerate(header) if other and one in (other, name_and_unit(other)[0])]
        if len(here) != 1:
            check.refuse("time", f"name columns of {file}", repr(one))
        said = name_and_unit(header[here[0]])[1] or units.of_name(header[here[0]])
        if wanted and said and units.factor(said, wanted) != 1.0:
            check.refuse("time", f"name the columns of seconds and of nanoseconds of {file}", f"{one!r} in [{said}]")
        at += here
    return Taken(tuple(at), "", stamps)
