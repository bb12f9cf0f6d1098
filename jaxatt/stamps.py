"""Stamps of recorded files as seconds: counts of s, ms, us or ns, dates of ISO 8601 with their zones.

Dates: "2024-03-01T12:00:00.25Z", "2024-03-01 13:00:00,25+01:00", "20240301T120000Z", and with the day of the year,
"2024-061T12:00:00". Seconds are those since 1970 in UTC, without leap seconds.

May import: check.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from zoneinfo import ZoneInfo

import numpy as np

from jaxatt import check

# units of time, parts of a second; "s+ns": seconds and nanoseconds in columns of their own
STAMPS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9, "iso": None, "s+ns": None}
JOINED = {"iso": "T", "s+ns": "+"}  # between the cells of two columns
LATEST = 1e11  # [s] since any zero: year 5138, which a count of ms since 1970 taken as seconds passes
CLOSEST = 1e-6  # [s] median step below which the unit of the stamps is another
_DATE = re.compile(
    r"(\d{4})(?:-(\d\d)-(\d\d)|(\d\d)(\d\d)|-(\d{3})|(\d{3}))[Tt ](\d\d)(?::(\d\d)(?::(\d\d))?|(\d\d)(\d\d))?(?:[.,](\d{1,9}))?"
    r"(?: ?([Zz]|UTC|GMT|[+-]\d\d(?::?\d\d)?))?",
    re.ASCII,
)


def zone_of(zone) -> tzinfo | None:
    """The zone of a name: "UTC", "+01:00", "Europe/Berlin"; ValueError for what is none."""
    if zone is None:
        return None
    if isinstance(zone, str):
        try:
            return _offset(zone) if re.fullmatch(r"[Zz]|UTC|GMT|[+-]\d\d(:?\d\d)?", zone, re.ASCII) else ZoneInfo(zone)
        except (ValueError, KeyError, OSError):
            pass
    check.refuse(
        "zone", "be an offset such as '+01:00' or the name of a zone such as 'Europe/Berlin'", check.short(zone)
    )


def _offset(text: str) -> timezone:
    if text[0] not in "+-":
        return UTC
    digits = text[1:].replace(":", "").ljust(4, "0")
    hours, minutes = int(digits[:2]), int(digits[2:])
    if hours > 14 or minutes > 59:
        raise ValueError
    return timezone((1 if text[0] == "+" else -1) * timedelta(hours=hours, minutes=minutes))


def reader(
    stamps: str, number: Callable[[str], float], missing: Callable[[str], bool], zone: tzinfo | None, named: set[bool]
) -> Callable:
    """What turns a cell into seconds; whole numbers are divided exactly, and ValueError is raised for what is no stamp.

    number: (cell) -> float; missing: whether a cell says that there is nothing, which becomes NaN; zone: that of dates which
    name none, UTC for None; named: filled with whether they do. Dates with and without a zone in one column are refused, and
    dates of another zone than told.
    """
    whole = re.compile(r"\s*[+-]?\d+\s*", re.ASCII).fullmatch
    if stamps == "iso":

        def date(cell: str) -> float:
            if missing(cell.strip("T ")):
                return np.nan
            seconds, says = _seconds_of_date(cell.strip(), zone)
            named.add(says)
            if len(named) > 1:
                raise ValueError("some dates name a zone and some do not")
            return seconds

        return date
    if stamps == "s+ns":

        def pair(cell: str) -> float:
            first, _, rest = cell.partition("+")
            if missing(first) and missing(rest):
                return np.nan
            if not (whole(first) and whole(rest) and 0 <= int(rest) < 10**9):
                raise ValueError
            return int(first) + int(rest) / 10**9

        return pair
    parts = STAMPS[stamps]
    if parts == 1:
        return number
    return lambda cell: (int(cell) if whole(cell) else number(cell)) / parts


def _seconds_of_date(cell: str, zone: tzinfo | None) -> tuple[float, bool]:
    """Seconds since 1970 of a date, and whether it names a zone."""
    found = _DATE.fullmatch(cell)
    if not found or not (found[9] or found[11]):
        raise ValueError
    year, month, day, month_, day_, of_year, of_year_, hour, minute, second, minute_, second_, fraction, offset = (
        found.groups()
    )
    if fraction and not (second or second_):  # of a minute, which nobody writes
        raise ValueError
    clock = timedelta(hours=int(hour), minutes=int(minute or minute_), seconds=int(second or second_ or 0))
    if int(hour) > 23 or int(minute or minute_) > 59 or int(second or second_ or 0) > 59:
        raise ValueError
    if of_year := of_year or of_year_:
        at = datetime(int(year), 1, 1) + timedelta(days=int(of_year) - 1)
        if at.year != int(year):
            raise ValueError
    else:
        at = datetime(int(year), int(month or month_), int(day or day_))
    at += clock
    own = _offset(offset) if offset else None
    for place in (own, zone):
        if (
            place is not None
            and at.replace(tzinfo=place, fold=0).utcoffset() != at.replace(tzinfo=place, fold=1).utcoffset()
        ):
            raise ValueError("the zone has this time twice or not at all")
    if own and zone and at.replace(tzinfo=own) != at.replace(tzinfo=zone):
        raise ValueError("the date names another zone than `zone`")
    since = at.replace(tzinfo=own or zone or UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    ns = (since.days * 86400 + since.seconds) * 10**9 + int((fraction or "").ljust(9, "0"))
    return ns / 10**9, offset is not None


def plausible(name: str, stamps: str, t: np.ndarray) -> None:
    """Refuse times [s] that say that the stamps have another unit: see `LATEST` and `CLOSEST`."""
    known = t[np.isfinite(t)]
    if stamps != "iso" and len(known) and np.abs(known).max() > LATEST:
        check.refuse(name, f"be stamps in [{stamps}] before the year 5138", f"up to {known.max():.4g} s")
    steps = np.diff(np.unique(known))
    if stamps != "iso" and len(steps) and np.median(steps) < CLOSEST:
        check.refuse(name, f"be stamps in [{stamps}] that are a microsecond apart", f"{np.median(steps):.3g} s apart")


def agrees(header: str, zone: str | None) -> None:
    """Refuse a header of dates without zones that says another zone than is told: "time (UTC)", "LocalTime", "t [UTC+1]"."""
    plain = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", header)
    found = re.search(r"(?<![A-Za-z])(UTC|GMT)?\s*([+-])(\d{1,2})(?::?(\d\d))?(?!\d)", plain, re.I)
    inside = re.search(r"[\[(]([A-Z]{2,5})[\])]\s*$", header)
    if found and (found[1] or re.search(r"[\[(][+-]", header)):
        said = f"{found[2]}{int(found[3]):02d}:{found[4] or '00'}"
        told = zone_of(zone)
        if told is None or (isinstance(told, timezone) and told != zone_of(said)):
            check.refuse("zone", f"be {said!r}, as the header {header!r} says", repr(zone))
    elif re.search(r"(?<![A-Za-z])(UTC|GMT|Zulu)(?![A-Za-z])", plain, re.I):
        if zone_of(zone) not in (None, UTC):
            check.refuse("zone", f"be 'UTC', as the header {header!r} says", repr(zone))
    elif zone is None and (inside or re.search(r"(?<![A-Za-z])local(?![A-Za-z])", plain, re.I)):
        check.refuse("zone", f"be told, such as '+01:00', for the header is {header!r}", "None")
