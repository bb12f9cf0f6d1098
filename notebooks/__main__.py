"""Execute the notebooks: ``python -m notebooks [NAME ...] [--quick] [--out DIR]``."""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

HERE = Path(__file__).parent
NAMES = sorted(path.stem for path in HERE.glob("*.ipynb"))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m notebooks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; none for all")
    parser.add_argument("--quick", action="store_true", help="smaller sweeps, the same cells")
    parser.add_argument("--out", type=Path, help="folder for the executed notebooks")
    args = parser.parse_args()
    unknown = [name for name in args.names if name not in NAMES]
    if unknown:
        parser.error(f"`NAME` must be one of {', '.join(NAMES)}, but it is {unknown[0]}.")
    if args.quick:
        os.environ["JAXATT_QUICK"] = "1"
    root = str(HERE.parent)  # so that the kernels find the package in a clone that is not installed
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
    failed = 0
    for name in args.names or NAMES:
        started = time.perf_counter()
        notebook = nbformat.read(HERE / f"{name}.ipynb", as_version=4)
        try:
            NotebookClient(notebook, timeout=900, resources={"metadata": {"path": HERE}}).execute()
            verdict = "ok"
        except CellExecutionError as error:
            failed, verdict = failed + 1, f"failed\n{error}"
        print(f"{name:20} {time.perf_counter() - started:5.0f} s  {verdict}", flush=True)
        if args.out:
            args.out.mkdir(parents=True, exist_ok=True)
            nbformat.write(notebook, args.out / f"{name}.ipynb")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
