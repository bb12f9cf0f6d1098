"""Reproduce the papers: ``python -m experiments [NAME ...] [--quick] [--out DIR]``.

``python -m experiments NAME campaign --help``: a campaign on disk of one of the loops.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from pathlib import Path

import jax

import jaxatt

NAMES = ("observer_pd", "gyro_ekf", "cmg_loss", "star_isolation", "wheel_mrac")


def main() -> int:
    if sys.argv[2:3] == ["campaign"]:
        jax.config.update("jax_enable_x64", True)
        jaxatt.fast_cpu()  # before the loops are imported
        return importlib.import_module("experiments.campaigns").main(sys.argv[1], sys.argv[3:])
    parser = argparse.ArgumentParser(prog="python -m experiments", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; none for all")
    parser.add_argument("--quick", action="store_true", help="smaller Monte Carlo runs, the same checks")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder for figures and metrics.json")
    args = parser.parse_args()
    unknown = [name for name in args.names if name not in NAMES]
    if unknown:
        parser.error(f"`NAME` must be one of {', '.join(NAMES)}, but it is {unknown[0]}.")
    jax.config.update("jax_enable_x64", True)
    jaxatt.fast_cpu()
    from experiments.report import Report

    report = Report(args.out, args.quick)
    for name in args.names or NAMES:
        started = time.perf_counter()
        report.start(name)
        importlib.import_module(f"experiments.{name}").run(report)
        report.note(f"{name} took {time.perf_counter() - started:.0f} s")
    return 0 if report.write() else 1


if __name__ == "__main__":
    sys.exit(main())
