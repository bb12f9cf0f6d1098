"""What single precision costs: ``python -m benchmarks.precision [NAME ...] [--quick] [--out FILE]``.

Every loop runs twice on the same scenario and the same noise, in float32 and in float64. The table shows for every
number of the log, the worst component of each, the largest deviation over the run, in the number's own unit and as a
share of the largest value that float64 reaches there. A deviation of a millionth is rounding; where noise enters a
decision (an alarm, a steering law at a singularity) one bit may put a decision off, and the deviation is as large as
what hangs on it.
"""

from __future__ import annotations

import argparse
import json
import warnings
from pathlib import Path

import jax
import numpy as np

import jaxatt
from jaxatt import simulate
from jaxatt.loops import cmg_loss, gyro_ekf, microsat, observer_pd, star_isolation, wheel_mrac

NAMES = (
    "observer_pd",
    "gyro_ekf",
    "gyro_ekf_consistent",
    "gyro_ekf_direct",
    "cmg_loss",
    "star_isolation",
    "wheel_mrac",
    "microsat",
)


def case(name: str):
    """System, params, scenario, seconds and ticks between records of a case."""
    match name:
        case "observer_pd":
            return observer_pd.system, observer_pd.params, observer_pd.scenario, 300.0, 1
        case "gyro_ekf":  # R of Table 5
            return gyro_ekf.system, gyro_ekf.params, gyro_ekf.scenario, 600.0, 4
        case "gyro_ekf_consistent":  # R = sigma^2
            return gyro_ekf.system, gyro_ekf.consistent(gyro_ekf.params), gyro_ekf.scenario, 600.0, 4
        case "gyro_ekf_direct":
            return gyro_ekf.direct, gyro_ekf.params, gyro_ekf.scenario, 600.0, 4
        case "cmg_loss":
            return cmg_loss.system, cmg_loss.table5, cmg_loss.scenario, 60.0, 10
        case "star_isolation":
            return star_isolation.system, star_isolation.params, star_isolation.scenario, 200.0, 1
        case "wheel_mrac":
            return wheel_mrac.system, wheel_mrac.params, wheel_mrac.scenario, 90.0, 1
        case "microsat":
            return microsat.system, microsat.params, microsat.scenario, 200.0, 10
    raise SystemExit(f"`name` must be one of {NAMES}, but it is {name}.")


def deviations(name: str, share: float = 1.0):
    """Rows of a case: the name of a number of the log, its largest deviation and its largest value."""
    system, params, scenario, seconds, every = case(name)
    ticks = max(every, round(share * seconds / system.dt))
    logs = []
    for real in (np.float32, np.float64):
        p, s = jax.tree.map(lambda a, real=real: np.asarray(a, real), (params, scenario))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what the warnings say of float32 is measured here
            logs.append(simulate(system, p, s, jax.random.key(3), ticks=ticks, every=every))
    single, double = (jax.tree_util.tree_leaves_with_path(log) for log in logs)
    worst: dict[str, list[float]] = {}
    for (path, a), (_, b) in zip(single, double):
        a, b = np.asarray(a, float), np.asarray(b, float)
        both = np.isfinite(a) & np.isfinite(b)
        odd = np.mean(np.isfinite(a) != np.isfinite(b))
        off = float(np.max(np.abs(a - b), where=both, initial=0.0)) if odd == 0 else float("inf")
        size = float(np.max(np.abs(b), where=both, initial=0.0))
        field = "".join(f".{key.name}" for key in path if hasattr(key, "name"))[1:]
        field = field.removesuffix(".x").removesuffix(".y").removesuffix(".z").removesuffix(".w") or "w"
        row = worst.setdefault(field, [0.0, 0.0])
        row[0], row[1] = max(row[0], off), max(row[1], size)
    for field, (off, size) in worst.items():
        yield {"case": name, "number": field, "deviation": off, "largest": size, "share": off / size if size else off}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.precision", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; none for all")
    parser.add_argument("--quick", action="store_true", help="a tenth of every run")
    parser.add_argument("--out", type=Path, default=Path("results/precision.json"), help="table as JSON")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jaxatt.configure()
    rows = []
    for name in args.names or NAMES:
        print(f"\n{name}\n  {'number of the log':28}{'deviation':>12}{'largest value':>16}{'share':>10}")
        for row in deviations(name, 0.1 if args.quick else 1.0):
            rows.append(row)
            print(f"  {row['number']:28}{row['deviation']:12.2e}{row['largest']:16.4g}{row['share']:10.1e}", flush=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
