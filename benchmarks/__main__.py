"""Measure the speed of the loops: ``python -m benchmarks [NAME ...] [--quick] [--out FILE]``."""

from __future__ import annotations

import argparse
import importlib
import json
import platform
from pathlib import Path

import jax

import jaxatt

NAMES = (
    "observer_pd",
    "gyro_ekf",
    "cmg_loss",
    "star_isolation",
    "wheel_mrac",
    "microsat",
    "attitude_filters",
    "parts",
    "campaign",
    "growth",
    "yardstick",
)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; none for all")
    parser.add_argument("--quick", action="store_true", help="fewer rows and repeats")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks.json"), help="table as JSON")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jaxatt.configure()
    rows = []
    for name in args.names or NAMES:
        print(f"\n{name} (Python {platform.python_version()}, JAX {jax.__version__})")
        for row in importlib.import_module(f"benchmarks.{name}").rows(args.quick):
            rows.append({"loop": name, **row})
            print(f"  {row['name']:62} {row['value']:>10.4g} {row['unit']}", flush=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"jax": jax.__version__, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
