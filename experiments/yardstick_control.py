"""The control track of the yardstick: its board, and the success of three laws against an independent reference.

The reference drew whole ranges and 10 240 episodes a cell, with white attitude and rate noise in place of the MEKF: hence
three points on gain2, gain4 and pid, and one elsewhere. Quick: 256 episodes of two laws, and what they add to a tolerance.
"""

from __future__ import annotations

import jax
import numpy as np

from jaxatt.yardstick import CELLS, CONTROLLERS, control

REFERENCE = "independent implementation"
# success [%] of pd, pid, structured
SUCCESS = {
    "none": (100.0, 100.0, 100.0), "gain": (100.0, 96.3, 100.0), "gain2": (93.3, 63.7, 99.5), "gain4": (93.0, 43.1, 100.0),
    "sign": (0.1, 0.0, 100.0), "sign2": (0.0, 0.0, 100.0), "bias": (0.0, 100.0, 100.0), "all": (0.0, 95.1, 100.0),
    "wild": (0.0, 3.5, 78.5), "dead_flip": (0.0, 0.0, 100.0),
}  # fmt: skip
ROWS = ("pd", "pid", "structured")
WIDE = ("gain2", "gain4")  # cells of three points


def run(report) -> None:
    """Success against the reference, and the board of all five."""
    names, n = (("pd", "structured"), 256) if report.quick else (ROWS, 10_240)
    found = control([CONTROLLERS[name] for name in names], n=n, key=jax.random.key(7), deciles="all")
    for name in names:
        wanted = np.array([SUCCESS[cell][ROWS.index(name)] for cell in SUCCESS])
        got = [100 * found.row(name)["success"][cell] for cell in SUCCESS]
        allowed = np.array([3.0 if name == "pid" or cell in WIDE else 1.0 for cell in SUCCESS])
        if report.quick:
            allowed = np.hypot(allowed, 3 * np.sqrt(wanted * (100 - wanted) / n))
        report.check(
            f"success of {name} in ten cells of whole ranges [%]", wanted.tolist(), got, allowed.tolist(), REFERENCE
        )
    report.check("commands that are no numbers", 0, sum(row["lost"] for row in found.rows), 0, "specification")
    if not report.quick:
        found = control(list(CONTROLLERS.values()))
        widest = max(
            high - low for cell in CELLS for _, low, high in (c["success"] for c in found.cells[cell].values())
        )
        report.within("half width of the widest interval [points]", None, 0.7, 50 * widest, "closed form")
    pairs = found.pairs()
    first = pairs.names.index("structured")
    ahead = [pairs.difference[first, i] - 3 * pairs.error[first, i] for i in range(len(pairs.names)) if i != first]
    report.within("structured leads in wild by more than 3 standard errors", 0, None, min(ahead), REFERENCE)
    for line in found.table().splitlines():
        report.note(line)
    report.out.mkdir(parents=True, exist_ok=True)
    found.to_json(report.out / "yardstick_control_board.json")
    report.figure("controllers", found.figure())
