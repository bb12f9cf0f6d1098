"""Rebuild a board from its file and compare: ``python -m jaxatt.yardstick board.json``.

Of detectors or of controllers; the rows must be baselines. Says where the new board differs, and returns 1 if it does.

May import: board, control, controllers, fitting, microsat_rows, ranking, worlds, compiling.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from jaxatt.compiling import configure
from jaxatt.yardstick.board import Board, differences
from jaxatt.yardstick.control import ControlBoard, control
from jaxatt.yardstick.controllers import CONTROLLERS
from jaxatt.yardstick.fitting import NAMES, tune
from jaxatt.yardstick.microsat_rows import MICROSAT_ROWS
from jaxatt.yardstick.ranking import rank
from jaxatt.yardstick.worlds import WORLDS


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m jaxatt.yardstick", description=__doc__)
    parser.add_argument("board", type=Path, help="JSON of a board, as `Board.to_json` writes it")
    args = parser.parse_args(arguments)
    configure()
    before = Board.from_json(args.board)
    h = before.header
    driven = h.get("track") == "control"
    rows = MICROSAT_ROWS if h["world"] == "microsat" else NAMES
    known, names = (CONTROLLERS, h["controllers"]) if driven else (rows, h["detectors"])
    unknown = [name for name in names if name not in known]
    if unknown or h["seed"] is None:
        parser.error(
            f"`board` must hold baselines ranked by their hash, but it is of {', '.join(unknown) or 'a key of its own'}."
        )
    if driven:
        rows = [CONTROLLERS[name] for name in names]
        return told(before, control(rows, WORLDS[h["world"]], n=h["n"], deciles=h["deciles"]))
    cells = None if h["cells"] is None else [(k, tuple(s) if isinstance(s, list) else s) for k, s in h["cells"]]
    how = {"ruleset": h["ruleset"], "days": h["days"], "hours": h["hours"], "cells": cells}
    row = MICROSAT_ROWS.__getitem__ if rows is MICROSAT_ROWS else tune
    return told(before, rank([row(name) for name in names], WORLDS[h["world"]], **how, progress=True))


def told(before: Board, now: Board | ControlBoard) -> int:
    """Print the new board and where it differs; 1 if it does."""
    print(now.table())
    apart = differences(before, now)
    print("\n".join(apart[:20]) or "the same to the bit")
    return 1 if apart else 0


if __name__ == "__main__":
    sys.exit(main())
