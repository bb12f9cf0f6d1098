"""Units as loggers write them: which are the same, and by what factor one becomes another.

A unit is a product of powers: "deg/s", "rad s^-1", "m/s²", "°/s", "in-lbf/(rad s)". Angles are a quantity of their own, so
that 1/s is no rad/s. Temperatures with another zero, counts, and whatever is not known here are the same as themselves alone.

May import: nothing of ours.
"""

from __future__ import annotations

import re
from collections import Counter
from functools import lru_cache
from math import pi

# of each: the factor to the units of the second part
_BASE: dict[str, tuple[float, dict[str, int]]] = {
    "rad": (1.0, {"rad": 1}), "deg": (pi / 180, {"rad": 1}), "arcmin": (pi / 10800, {"rad": 1}),
    "arcsec": (pi / 648000, {"rad": 1}), "rev": (2 * pi, {"rad": 1}),
    "s": (1.0, {"s": 1}), "min": (60.0, {"s": 1}), "h": (3600.0, {"s": 1}), "d": (86400.0, {"s": 1}),
    "m": (1.0, {"m": 1}), "kg": (1.0, {"kg": 1}), "g": (1e-3, {"kg": 1}),
    "N": (1.0, {"kg": 1, "m": 1, "s": -2}), "lbf": (4.4482216152605, {"kg": 1, "m": 1, "s": -2}),
    "in": (0.0254, {"m": 1}), "ft": (0.3048, {"m": 1}),
    "T": (1.0, {"T": 1}), "gauss": (1e-4, {"T": 1}), "A": (1.0, {"A": 1}), "V": (1.0, {"V": 1}),
    "Hz": (1.0, {"Hz": 1}), "Pa": (1.0, {"Pa": 1}), "bar": (1e5, {"Pa": 1}), "%": (0.01, {}), "1": (1.0, {}),
    "dps": (pi / 180, {"rad": 1, "s": -1}), "rpm": (pi / 30, {"rad": 1, "s": -1}),
    "Nm": (1.0, {"kg": 1, "m": 2, "s": -2}), "Nms": (1.0, {"kg": 1, "m": 2, "s": -1}),
}  # fmt: skip
_PREFIXED = ("rad", "s", "m", "g", "N", "T", "A", "V", "Hz", "Pa", "gauss", "bar", "dps", "Nm", "Nms")
_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6}
_WORDS = {
    "degree": "deg", "degrees": "deg", "degs": "deg", "radian": "rad", "radians": "rad", "rads": "rad", "sec": "s", "secs": "s", "second": "s",
    "seconds": "s", "msec": "ms", "millisecond": "ms", "milliseconds": "ms", "usec": "us", "microsecond": "us", "microseconds": "us",
    "nsec": "ns", "nanosecond": "ns", "nanoseconds": "ns", "minute": "min", "minutes": "min", "hr": "h", "hour": "h", "hours": "h",
    "day": "d", "days": "d", "as": "arcsec", "meter": "m", "metre": "m",
    "meters": "m", "metres": "m", "tesla": "T", "volt": "V", "volts": "V", "newton": "N", "unitless": "1",
}  # fmt: skip
# how the ends of names say units that no brackets say; what could mean something else is not here
_ENDINGS = {
    "deg_s": "deg/s", "degs": "deg/s", "degps": "deg/s", "dps": "deg/s", "deg_sec": "deg/s", "deg_per_s": "deg/s", "deg_per_sec": "deg/s",
    "rad_s": "rad/s", "rads": "rad/s", "radps": "rad/s", "rad_sec": "rad/s", "rad_per_s": "rad/s", "rad_per_sec": "rad/s", "mdps": "mdps",
    "deg": "deg", "rad": "rad", "mrad": "mrad", "arcsec": "arcsec", "rpm": "rpm", "nt": "nT", "ut": "uT", "m_s2": "m/s^2", "mps2": "m/s^2",
    "ms": "ms", "msec": "ms", "us": "us", "usec": "us", "ns": "ns", "nsec": "ns", "sec": "s", "secs": "s", "seconds": "s",
}  # fmt: skip


def factor(said: str | None, wanted: str | None) -> float | None:
    """By what a number in the unit said is multiplied to be in the unit wanted; None where it cannot be."""
    if said is None or wanted is None:
        return 1.0 if said == wanted else None
    if said == wanted:
        return 1.0
    one, other = _parsed(said), _parsed(wanted)
    return one[0] / other[0] if one and other and one[1] == other[1] else None


def known(text: str) -> bool:
    """Whether a text is a unit, and no number."""
    return not re.fullmatch(r"[\d.,+\-\s]*", text) and _parsed(text) is not None


def of_name(name: str) -> str | None:
    """The unit that a header says in other ways than in brackets at its end; None where it says none.

    As in "gyro_x_deg_s", "gyroXDegPerSec", "gyro:deg/s", "gyro, deg/s", "gyro / (deg/s)", "gyro <deg/s>", "gyro [deg/s] (x)".
    """
    inside = [*re.findall(r"[\[(<{]([^\[\](){}<>]*)[\])>}]", name), *re.findall(r"(?:[:,|]|\s/)\s*([^:,|]+)$", name)]
    if found := [word.strip() for word in inside if known(word.strip())]:
        return found[0]
    plain = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", re.sub(r"[\[(<{].*", "", name).strip())
    for words in (re.split(r"[_ .]+", re.sub(r"[\[(<{].*", "", name).strip()), re.split(r"[_ .]+", plain)):
        endings = ("_".join(words[-n:]).lower() for n in (3, 2, 1) if len(words) > n)
        if said := next((_ENDINGS[ending] for ending in endings if ending in _ENDINGS), None):
            return said
    return None


@lru_cache(1000)
def _parsed(text: str) -> tuple[float, frozenset] | None:
    """The factor to base units, and their powers; None for what is no unit."""
    text = text.strip()
    if text in ("", "-", "[]"):
        text = "1"
    for sign, plain in (("°", "deg"), ("º", "deg"), ("µ", "u"), ("μ", "u"), ("·", " "), ("*", " "), ("−", "-"), ("²", "^2"), ("³", "^3"),
                        ("⁻", "^-"), ("¹", "1"), ("″", "arcsec"), ("′", "arcmin")):  # fmt: skip
        text = text.replace("**", "^").replace(sign, plain)
    text = text.replace("^-^", "^-")
    scale, powers = 1.0, Counter()
    tokens = re.findall(
        r"per\b|[A-Za-z%]+|\^?[+-]?\d+(?:\.\d+)?|[/()\-]|\S", re.sub(r"(?<=[A-Za-z])-(?=[A-Za-z])", " ", text)
    )
    sign, depth, last = 1, [1], None  # of the powers to come; of the brackets around; unit to which a power belongs
    for token in tokens:
        if token in ("/", "per"):
            sign, last = -1, None
        elif token == "(":
            depth.append(depth[-1] * sign)
            sign = 1
        elif token == ")" and len(depth) > 1:
            depth.pop()
            sign, last = 1, None
        elif re.fullmatch(r"\^?[+-]?\d+(\.\d+)?", token):
            if last is None:
                if token.startswith("^") or float(token) <= 0:
                    return None
                scale *= float(token) ** (sign * depth[-1])
                sign = 1
            elif "." in token or int(token.lstrip("^")) == 0:
                return None
            else:
                unit, power = last
                more = power * (int(token.lstrip("^")) - 1)
                scale *= unit[0] ** more
                powers.update({name: n * more for name, n in unit[1].items()})
            last = None
        else:
            unit = _one(token)
            if unit is None:
                return None
            power = sign * depth[-1]
            scale *= unit[0] ** power
            powers.update({name: n * power for name, n in unit[1].items()})
            last, sign = (unit, power), 1
    if len(depth) > 1 or sign < 0:
        return None
    return scale, frozenset((name, n) for name, n in powers.items() if n)


def _one(word: str) -> tuple[float, dict[str, int]] | None:
    """A single unit: of the table, with a prefix, or a word for it."""
    if word in _BASE:
        return _BASE[word]
    lower = word.lower() if len(word) > 2 else word
    plain = _WORDS.get(lower, lower if lower in _BASE else word)
    if plain in _BASE:
        return _BASE[plain]
    if plain[:1] in _PREFIXES and plain[1:] in _PREFIXED:
        scale, powers = _BASE[plain[1:]]
        return _PREFIXES[plain[0]] * scale, powers
    return None
