"""The board: what a ranking found, as a table, a figure and plain values that go to JSON and back.

May import: check.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxatt import check

VERSION = "1"
MACHINE = ("seconds", "machine", "nanoseconds")  # fields of a card that another machine changes


class Pairs(NamedTuple):
    """Differences between ranked rows, row - column, and their standard errors: of the macro [s], of success [1]."""

    names: tuple[str, ...]
    difference: np.ndarray  # (n, n)
    error: np.ndarray  # (n, n)


class Board(NamedTuple):
    """A ranking in plain values: numbers, words, lists and dicts; None where there is no number."""

    header: dict  # versions, ruleset, test key, days, seconds
    rows: list  # one dict a row, the best first
    cells: dict  # "kind size" -> row name -> [RMD60 s, its standard error, P10, P60]
    matrix: dict  # names, difference, error

    @property
    def pairs(self) -> Pairs:
        """Paired differences with standard errors."""
        return Pairs(
            tuple(self.matrix["names"]), *(np.array(self.matrix[name], float) for name in ("difference", "error"))
        )

    def row(self, name: str) -> dict:
        """The row of that name; KeyError where there is none."""
        return row_of(self.rows, name)

    def table(self) -> str:
        """The board as text: one line a row, the reference rows last."""
        of, modes = self.units(), " ".join(dict.fromkeys(mode for row in self.rows for mode in row["rate"]))
        names, rate = " ".join(f"{unit:>6}" for unit in of), f"alarms/h {modes}"
        head = f"{'':3} {'row':12} {'macro s':>13} {names} {'P10 %':>6} {'P60 %':>6} {rate:>19} {'mismatch/h':>22} {'isolation':>9} {'held out':>8} {'ns':>6}  notes"  # fmt: skip
        lines = [self._title(), head]
        for row in self.rows:
            rank = f"{row['rank']}{'=' if row['tied'] else ''}" if row["rank"] else "-"
            units = " ".join(fixed(row["units"].get(unit), 6, 1) for unit in of)
            rates = " ".join(fixed(r[0], 9, 3) for r in row["rate"].values()) or f"{'':19}"
            worst = row["robustness"]
            robust = (
                f"{fixed(worst.get('rate'), 6, 1)} {worst.get('world', '').removeprefix(self.header['world'] + ' ')[:15]:15}"
                if worst
                else f"{'':22}"
            )
            macro = f"{fixed(row['macro'], 6, 2)} +-{fixed(row['macro_se'], 5, 2)}"
            lines.append(
                f"{rank:3} {row['name']:12} {macro:>13} {units} {fixed(row['p10'], 6, 1)} {fixed(row['p60'], 6, 1)} {rates:>{len(rate)}} "
                f"{robust:22} {fixed(row['isolation'].get('at_alarm'), 9, 2)} {fixed(row['held_out'], 8, 1)} "
                f"{fixed(row['nanoseconds'], 6, 0)}  {', '.join(row['notes'])}".rstrip()
            )
        return "\n".join(lines)

    def units(self) -> list[str]:
        """The units whose sized kinds are on the board."""
        return list(dict.fromkeys(unit for row in self.rows for unit in row["units"]))

    def _title(self) -> str:
        h = self.header
        return f"yardstick {h['board']}, world {h['world']} {h['world_version']}, {h['ruleset']} rules, {h['days']} days a cell, test key {h['seed']}"  # fmt: skip

    def figure(self):
        """RMD60 of each row by unit, and the profile: share of cells within a factor of the best row. Needs matplotlib."""
        import matplotlib.pyplot as plt

        ranked = [row for row in self.rows if row["rank"]]
        fig, (left, right) = plt.subplots(1, 2, figsize=(11, 0.42 * len(ranked) + 2.2), layout="constrained")
        y = np.arange(len(ranked))
        for i, (unit, colour, mark) in enumerate(
            zip(self.units(), ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00"), "os^Dv")
        ):
            values = [row["units"].get(unit) for row in ranked]
            left.plot(values, y, mark, color=colour, label=unit, markersize=6, alpha=0.9, zorder=3 + i)
        left.barh(y, [row["macro"] for row in ranked], color="0.85", label="macro", zorder=1)
        left.errorbar([row["macro"] for row in ranked], y, xerr=[1.96 * (row["macro_se"] or 0) for row in ranked],
                      fmt="none", ecolor="0.4", capsize=2, zorder=2)  # fmt: skip
        left.set_yticks(y, [f"{row['rank']}  {row['name']}" for row in ranked])
        left.invert_yaxis()
        left.set_xlim(0, 62)
        left.set_xlabel("restricted mean delay, RMD60 [s]")
        left.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=len(self.units()) + 1, frameon=False, fontsize=8)
        names = [row["name"] for row in ranked]
        values = np.array([[cell[name][0] if name in cell else np.nan for name in names] for cell in self.cells.values()], float)  # fmt: skip
        factors = np.geomspace(1, 60, 200)
        if len(values):
            ratio = values / np.nanmin(values, axis=1, keepdims=True)
            styles = ["-", "--", "-.", ":"]
            for i, name in enumerate(names[:10]):
                share = [100 * np.mean(ratio[:, i] <= f + 1e-9) for f in factors]
                right.plot(factors, share, styles[i % 4], color=plt.get_cmap("tab10")(i), label=name, linewidth=1.6)
        right.set_xscale("log")
        right.set_xlim(1, 60)
        right.set_ylim(0, 101)
        right.set_xlabel("factor of the best row's RMD60")
        right.set_ylabel("share of cells within it [%]")
        right.legend(fontsize=8, loc="lower right")
        fig.suptitle(f"world {self.header['world']}, false alarms {self.header['rate']:g}/h in each mode", fontsize=10)
        return fig

    def cards(self) -> dict:
        """What each row needs to be rebuilt and all that was found of it: name -> plain values."""
        keep = lambda name: {cell: found[name] for cell, found in self.cells.items() if name in found}
        return {row["name"]: {"header": self.header, "row": row, "cells": keep(row["name"])} for row in self.rows}

    def to_json(self, path) -> None:
        """Write the board, sorted keys."""
        stored(self, path)

    @classmethod
    def from_json(cls, path) -> Board:
        """The board of a file; ValueError for what is none."""
        return cls(*opened(cls._fields, path))


def stored(board: Any, path) -> None:
    """Write a board as JSON, sorted keys."""
    text = json.dumps(plain(board._asdict()), indent=1, sort_keys=True, allow_nan=False)
    check.place("path", path).write_text(text + "\n")


def opened(fields: tuple[str, ...], path) -> list:
    """The fields of the board in a file; ValueError for what is none."""
    found = json.loads(check.place("path", path).read_text())
    if not isinstance(found, dict) or not set(fields) <= set(found):
        check.refuse("path", f"hold a board, with {', '.join(fields)}", check.short(found))
    return [found[name] for name in fields]


def row_of(rows: list, name: str) -> dict:
    """The row of that name; KeyError where there is none."""
    found = [row for row in rows if row["name"] == name]
    if not found:
        raise KeyError(name)
    return found[0]


def differences(a: Any, b: Any) -> list[str]:
    """Where two boards differ beyond machine and time, as lines; none for a board that was rebuilt to the bit."""
    found: list[str] = []

    def walk(path, x, y):
        if path.rpartition(".")[2] in MACHINE:
            return
        if isinstance(x, dict) and isinstance(y, dict):
            for name in sorted(set(x) | set(y)):
                walk(f"{path}.{name}", x.get(name), y.get(name))
        elif isinstance(x, list) and isinstance(y, list) and len(x) == len(y):
            for i, (one, other) in enumerate(zip(x, y)):
                walk(f"{path}[{i}]", one, other)
        elif x != y:
            found.append(f"{path}: {x} is now {y}")

    walk("board", plain(a._asdict()), plain(b._asdict()))
    return found


def plain(a) -> Any:
    """a as JSON's values; None for what is not finite."""
    if isinstance(a, dict):
        return {str(name): plain(value) for name, value in a.items()}
    if isinstance(a, (list, tuple)):
        return [plain(value) for value in a]
    if isinstance(a, np.ndarray):
        return plain(a.tolist())
    if isinstance(a, np.generic):
        a = a.item()
    if isinstance(a, float):
        return a if np.isfinite(a) else None
    return str(a) if isinstance(a, Path) else a


def fixed(value, width: int, digits: int) -> str:
    """A number so wide, with so many digits behind the point; a dash for None."""
    return f"{'-' if value is None else format(value, f'.{digits}f'):>{width}}"
