"""Reproduce the papers: ``python -m experiments [NAME ...] [tune] [--quick] [--out DIR]``.

With ``tune`` as the last word the named loops' gains are tuned instead, and judged against the papers'.
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
STUDIES = {"tune": "experiments.tuning"}  # words that may follow the names, and where the studies lie


def main() -> int:
    if sys.argv[2:3] == ["campaign"]:
        jax.config.update("jax_enable_x64", True)
        jaxatt.fast_cpu()
        return importlib.import_module("experiments.campaigns").main(sys.argv[1], sys.argv[3:])
    parser = argparse.ArgumentParser(prog="python -m experiments", description=__doc__)
    words = f"of {', '.join(NAMES)}, none for all; then perhaps {', '.join(STUDIES)}"
    parser.add_argument("names", nargs="*", metavar="NAME", help=words)
    parser.add_argument("--quick", action="store_true", help="smaller Monte Carlo runs, the same checks")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder for figures and metrics.json")
    args = parser.parse_args()
    study = args.names.pop() if args.names and args.names[-1] in STUDIES else ""
    package = STUDIES.get(study, "experiments")
    unknown = [name for name in args.names if name not in NAMES]
    if unknown:
        parser.error(f"`NAME` must be one of {', '.join(NAMES)}, but it is {unknown[0]}.")
    jax.config.update("jax_enable_x64", True)
    jaxatt.fast_cpu()
    from experiments.report import Report

    report = Report(args.out, args.quick)
    for name in args.names or NAMES:
        started = time.perf_counter()
        title = f"{name} {study}".strip()
        report.start(title.replace(" ", "_"))
        importlib.import_module(f"{package}.{name}").run(report)
        report.note(f"{title} took {time.perf_counter() - started:.0f} s")
    return 0 if report.write() else 1


if __name__ == "__main__":
    sys.exit(main())
