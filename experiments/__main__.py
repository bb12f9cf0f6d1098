"""Reproduce the papers: ``python -m experiments [NAME ...] [tune] [--quick] [--out DIR] [--jobs N]``.

Several loops run side by side, each in a process of its own. With ``tune`` as the last word the named loops' gains are
tuned instead, and judged against the papers'. ``python -m experiments NAME campaign --help``: a campaign on disk of one of
the loops.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from pathlib import Path

from experiments.report import written
from experiments.running import EXPERIMENTS, LOOPS, NAMES, STUDIES, prepare, run, side_by_side


def main() -> int:
    if sys.argv[2:3] == ["campaign"]:
        prepare()
        return importlib.import_module("experiments.campaigns").main(sys.argv[1], sys.argv[3:])
    parser = argparse.ArgumentParser(prog="python -m experiments", description=__doc__)
    words = f"of {', '.join(NAMES)}, none for all; then perhaps {', '.join(STUDIES)}"
    parser.add_argument("names", nargs="*", metavar="NAME", help=words)
    parser.add_argument("--quick", action="store_true", help="smaller Monte Carlo runs, the same checks")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder for figures and metrics.json")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, help="processes side by side; default: all cores"
    )
    args = parser.parse_args()
    study = args.names.pop() if args.names and args.names[-1] in STUDIES else ""
    allowed = LOOPS if study else NAMES
    unknown = [name for name in args.names if name not in allowed]
    if unknown:
        parser.error(f"`NAME` must be one of {', '.join(allowed)}, but it is {unknown[0]}.")
    if args.jobs < 1:
        parser.error(f"`--jobs` must be at least 1, but it is {args.jobs}.")
    names = args.names or list(allowed)
    jobs = min(args.jobs, len(names))
    how = study, args.quick, args.out
    if jobs == 1:
        parts = [run(name, *how) for name in names]
    else:
        parts = side_by_side(names, jobs, *how)
    ok = written(args.out, parts)
    shown = [args.out / name / f"{EXPERIMENTS[name].figure}.png" for name in names]
    figures = [str(path) for path in shown if not study and path.exists()]
    if figures:
        print("figures to open first: " + " ".join(figures))
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main())
