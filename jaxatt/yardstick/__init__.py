"""The yardstick: detectors of attitude faults ranked at one rate of false alarms, and controllers that survive them.

`BASELINES` holds the baselines by name, fitted to the public key when it is first asked for.

    board = rank([BASELINES["chi2_10"], BASELINES["glr"], mine])
    print(board.table())

A detector is two functions of one packet of telemetry (`Detector`). `rank` checks it, gives it the threshold of .1 false
alarms an hour in each mode, and meets it with every fault of the catalogue on days that nobody has seen. The rules on one
screen: docs/yardstick.md. ``python -m jaxatt.yardstick board.json`` rebuilds a board and compares it.

The second world is a satellite that unloads its wheels and watches itself; its baselines are `MICROSAT_ROWS`.

    board = rank([MICROSAT_ROWS["cusum"], mine], WORLDS["microsat"])

A controller is two functions too, of one reading (`Controller`). `control` lets each hold an attitude with the same faults of
wheels; `CONTROLLERS` holds the baselines, `CELLS` the faults.

    board = control([CONTROLLERS["pid"], CONTROLLERS["structured"], mine])

Its modules may import: yardstick, check, fields, clock, contract, compiling, vec, attitude, faults, noise, engine,
sweeping, scores, soft_scores, loss, detection, filters, batching, resuming, loops.microsat.
"""

from functools import cache
from importlib import import_module

from jaxatt.yardstick.board import Board
from jaxatt.yardstick.calibration import Calibration, calibrate
from jaxatt.yardstick.control import CELLS, ControlBoard, Controller, control, driven, episodes
from jaxatt.yardstick.controllers import CONTROLLERS
from jaxatt.yardstick.descent import at_fixed_rate
from jaxatt.yardstick.fitting import NAMES, tune
from jaxatt.yardstick.leo4 import Reading, Telemetry
from jaxatt.yardstick.microsat_rows import MICROSAT_ROWS
from jaxatt.yardstick.ranking import rank
from jaxatt.yardstick.telemetry import Detector, Residuals, Verdict, residuals_init, residuals_step
from jaxatt.yardstick.worlds import CATALOGUE, WORLDS, World

__all__ = [
    "CATALOGUE",
    "CELLS",
    "CONTROLLERS",
    "MICROSAT_ROWS",
    "NAMES",
    "WORLDS",
    "Board",
    "Calibration",
    "ControlBoard",
    "Controller",
    "Detector",
    "Reading",
    "Residuals",
    "Telemetry",
    "Verdict",
    "World",
    "at_fixed_rate",
    "calibrate",
    "control",
    "driven",
    "episodes",
    "rank",
    "residuals_init",
    "residuals_step",
    "tune",
]


@cache
def _baselines() -> dict[str, Detector]:
    return {name: tune(name) for name in NAMES}


def __getattr__(name: str):
    """`BASELINES`, name -> Detector, fitted to the public key when it is first asked for: some seconds."""
    if name == "BASELINES":
        return _baselines()
    try:
        return import_module(f"{__name__}.{name}")
    except ModuleNotFoundError:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
