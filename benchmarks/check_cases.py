"""jaxatt on check cases that others made: ``python -m benchmarks.check_cases [--json FILE] [--nesc FOLDER]``.

Rotational cases of NASA's JEOD (repository nasa/jeod at 6550cf4, verif/SIM_dyncomp, runs 8A to 10D), which are the orbital
cases of NESC's comparison of six-degree-of-freedom simulations (2015), and NESC's tumbling brick (Atmos_02). Inputs and
logged states are quoted as a few numbers; no file of theirs is here. In double precision it prints every case beside
its reference, SciPy's DOP853 on equations of its own beside both, the laws that the runs must keep, and NESC's tools one
by one. It fails where anything lies outside its tolerance.

JEOD's run 8B is a sphere, NESC's the space station: another motion, both are run. Neither 8B nor 10B has a printed log: their
references are DOP853's alone. Runs 9C and 9D add a force to 9A and 9B; their logged attitudes are those of 9A and 9B.
The force is not among the inputs that we could read, so any force stands for it. Trajectories of the orbital cases by NESC's
tools were not to be had: how far these differ among themselves is not known here. Where Basilisk is installed, the cases
of `benchmarks.validate` follow.
"""

from __future__ import annotations

import argparse
import csv
import json
import platform
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxatt
from benchmarks.check_plant import (
    BRICK_LIMITS,
    BRICKS,
    LIMITS,
    MRP,
    QUATERNION,
    Scenario,
    X,
    against,
    angle,
    brick,
    by_scipy,
    euler,
    far,
    logs,
    lvlh,
    plain,
    quaternion,
    scenario_of,
    stacked,
    start_of,
    system_of,
    tumble,
    turn,
    within,
)
from benchmarks.check_references import BRICK, CASES, DEG, EARTH_RATE, NAMES, RECORDED, STARTS
from jaxatt import scores, simulate, sweep
from jaxatt.attitude import quat_rotate
from jaxatt.vec import Mat3, Quat, Vec3, array

# tables


def orbital(found: dict, by_mrp: dict):
    """A row for each of `CASES`; found, by_mrp: `logs` at every minute."""
    minute = lambda t: round(t / 60)
    for i, case in enumerate(CASES):
        of = lambda runs, i=i: {name: a[i] for name, a in runs.items()}
        here, mrp = against(case, of(found), minute), against(case, of(by_mrp), minute)
        ok = within(here, LIMITS) and within(mrp, LIMITS)
        if any(case.push):
            tools = f"JEOD, as its {case.name.translate({67: 65, 68: 66})}"
        else:
            times = [row.t for row in case.rows]
            theirs = against(case, by_scipy(plain(case), times), times.index)
            tools = (
                "JEOD, " * (case.source == "JEOD")
                + f"DOP853 run here to {theirs['attitude']:.0e} deg, {theirs['rate']:.0e} rad/s"
            )
            ok = ok and within(theirs, LIMITS)
        at = ", ".join(f"{row.t:g}" for row in case.rows)
        yield {
            "case": f"{case.name}, {at} s",
            "reference": case.source,
            **here,
            "mrp": mrp["attitude"],
            "tools": tools,
            "ok": ok,
        }


def tumbling(runs):
    """The row of NESC's brick; runs: `logs` at every 0.1 s by quaternion and by MRP."""
    out = []
    for found in runs:
        w, q = found["w"][0] / DEG, found["q"][0]
        rows = {10 * t: (rate, quaternion(euler(deg))) for t, (rate, deg) in BRICK.items()}
        rate = far(w[list(rows)], [a for a, _ in rows.values()])
        out.append({"attitude": float(angle(q[list(rows)], [b for _, b in rows.values()]).max()), "rate": rate * DEG})
    ok = all(within(a, BRICK_LIMITS) for a in out)
    agree = [tool for tool, (rate, attitude, _) in RECORDED.items() if max(rate, attitude) < 1e-8]
    at = ", ".join(map(str, BRICK))
    yield {"case": f"Atmos_02 brick, {at} s", "reference": "DOP853", **out[0], "mrp": out[1]["attitude"],
           "tools": f"{', '.join(agree)}, DOP853 run here", "ok": ok}  # fmt: skip


def by_tool(found, truth, folder: Path | None):
    """Rows of the brick tool by tool: largest differences from DOP853 over 30 s, measured or recorded."""
    ours = {"rate": far(found["w"][0], truth["w"]) / DEG, "attitude": float(angle(found["q"][0], truth["q"]).max())}
    yield {
        "tool": "jaxatt",
        "how": "measured",
        **ours,
        "remark": "",
        "ok": ours["rate"] <= 1e-9 and ours["attitude"] <= 1e-8,
    }
    for tool, (rate, attitude, remark) in RECORDED.items():
        how = "recorded" if folder is None else "measured"
        if folder is not None:
            rate, attitude = nesc(folder / f"Atmos_02_{tool}.csv")
        yield {"tool": tool, "how": how, "rate": rate, "attitude": attitude, "remark": remark, "ok": True}


def nesc(path: Path) -> tuple[float, float]:
    """Largest differences [deg/s], [deg] of a tool's log from DOP853; its angles are against the frame below the body."""
    with path.open() as file:
        rows = [row for row in csv.DictReader(file) if float(row["time"]) <= 30]
    pick = lambda *names: np.array([[float(row[name]) for name in names] for row in rows])
    t = pick("time")[:, 0]
    w = pick(*(f"bodyAngularRateWrtEi_deg_s_{axis}" for axis in ("Roll", "Pitch", "Yaw")))
    angles = pick(*(f"eulerAngle_deg_{axis}" for axis in ("Yaw", "Pitch", "Roll")))
    truth = by_scipy(tumble(), t)
    attitudes = []
    for deg, (lon, lat), now in zip(angles, pick("longitude_deg", "latitude_deg"), t):
        below = turn("y", -lat) @ turn(
            "z", lon + EARTH_RATE * now / DEG
        )  # axes up, east, north; then north, east, down
        frame = turn("y", -90) @ below @ turn("y", 90)
        attitudes.append(quaternion(frame.T @ euler(deg)))
    return far(w, truth["w"] / DEG), float(angle(attitudes, truth["q"]).max())


# laws that the runs must keep


def law(name: str, value, low: float, high: float) -> dict:
    return {"law": name, "value": float(value), "low": low, "high": high, "ok": bool(low <= value <= high)}


def laws(found: dict, by_mrp: dict):
    """Rows of what is known without a reference."""
    index = NAMES.index
    starts = [(start_of(CASES[index(name)]), ref) for name, ref in STARTS.items()]
    yield law(
        "starts against JEOD's printed ones, attitude [deg]", max(angle(s[2], ref.q) for s, ref in starts), 0, 1e-12
    )
    yield law("starts against JEOD's printed ones, rate [rad/s]", max(far(s[3], ref.w) for s, ref in starts), 0, 1e-18)
    yield law("quaternion against MRP, attitude [deg]", angle(found["q"], by_mrp["q"]).max(), 0, 1e-9)
    bits = all(
        np.array_equal(found[k][index(a)], found[k][index(b)]) for a, b in (("9A", "9C"), ("9B", "9D")) for k in "qw"
    )
    yield law("9C, 9D turn as 9A, 9B bit for bit [1 if so]", bits, 1, 1)
    axial = found["w"][[index(name) for name in ("10A", "10B", "10C", "10D")], :, 0]
    yield law("axial rate of 10A-10D, change [rad/s]", np.ptp(axial, axis=1).max(), 0, 1e-18)
    yield law("inertial momentum of 8A-9D without torque, relative change", drift(found), 0, 1e-12)
    yield law("order: error of 10D by steps of 8 s over that of 4 s", order(), 12, 20)
    yield law(
        "period of 10A's libration in the plane [s], linear theory 3257.94",
        libration(found),
        *np.array([0.99, 1.01]) * 3257.94,
    )
    yield law("eight cases in one batch against each alone, bit for bit [1 if so]", same_bits(), 1, 1)
    yield law("gradient of 10A's attitude at 5400 s against differences, relative", gradient(), 0, 1e-6)


def drift(found: dict) -> float:
    """Largest relative change of the momentum in inertial axes, outside 1000 to 2000 s."""
    worst = 0.0
    for i, case in enumerate(CASES):
        if case.gradient:
            continue
        q, w = (Quat.of(found["q"][i].T), Vec3.of(found["w"][i].T))
        h = np.asarray(array(quat_rotate(q, Mat3.of(case.J) @ w))).T
        for part in (h[: 1000 // 60 + 1], h[-(-2000 // 60) :]):
            size = float(np.linalg.norm(part[-1]))
            worst = max(worst, far(part, part[-1]) / size if size else far(part, part[-1]))
    return worst


def order() -> float:
    """Error of 10D at 28 800 s with steps of 8 s over the one of 4 s."""
    case = CASES[NAMES.index("10D")]
    ends = [logs(system_of(dt), stacked([scenario_of(case)]), 28800, 14400)["q"][0, -1] for dt in (8.0, 4.0)]
    coarse, fine = (float(angle(q, case.rows[-1].q)) for q in ends)
    return coarse / fine


def libration(found: dict) -> float:
    """Mean time [s] between upward crossings of zero by the angle of 10A's long axis from the vertical, in the orbit's plane."""
    i, above = NAMES.index("10A"), []
    for r, v, q in zip(found["r"][i], found["v"][i], found["q"][i]):
        frame, _ = lvlh(r, v)
        long = frame @ np.array(quat_rotate(Quat.of(q), Vec3(1.0, 0.0, 0.0)), float)
        above.append(np.arctan2(long[0], -long[2]))
    above = np.array(above)
    k = np.flatnonzero((above[:-1] < 0) & (above[1:] >= 0))
    crossings = 60 * (k - above[k] / (above[k + 1] - above[k]))
    return float(np.diff(crossings).mean())


def last(params, s: Scenario, now, log: X):
    """The score of `same_bits`: the last state."""
    return jax.tree.map(scores.final, log)


def same_bits() -> bool:
    """Whether the cases side by side end as each alone."""
    chosen = [scenario_of(c) for c in CASES if not any(c.push) and c.name != "8B sphere"]
    run = lambda s: sweep(QUATERNION, (), s, jax.random.key(0), ticks=7201, score=last, progress=False)
    together = jax.tree.leaves(run(stacked(chosen)))
    return all(
        np.array_equal(a[i : i + 1], b)
        for i, s in enumerate(chosen)
        for a, b in zip(together, jax.tree.leaves(run(stacked([s]))))
    )


def gradient() -> float:
    """Largest relative error, column by column, of the derivatives of 10A's attitude (4,) at 5400 s.

    With respect to Jyy, Jzz and the initial rate, by forward mode, against central differences of two steps,
    extrapolated to zero.
    """
    start = scenario_of(CASES[NAMES.index("10A")])
    steps = np.array([1.0, 1.0, 1e-7, 1e-7, 1e-7])  # [kg m^2], [rad/s]

    def attitude(x):
        by = x * steps
        J = Mat3(start.J.x, start.J.y._replace(y=start.J.y.y + by[0]), start.J.z._replace(z=start.J.z.z + by[1]))
        s = start._replace(J=J, w=start.w + Vec3(*by[2:]))
        return array(
            jax.tree.map(lambda a: a[-1], simulate(QUATERNION, (), s, jax.random.key(0), ticks=5401, every=5400).q)
        )

    exact = jax.jit(jax.jacfwd(attitude))(jnp.zeros(5))
    many = jax.jit(jax.vmap(attitude))(np.concatenate([h * np.eye(5) for h in (1, -1, 2, -2)]))
    near, far = (
        (a - b) / (2 * h) for h, a, b in zip((1, 2), many.reshape(2, 2, 5, 4)[:, 0], many.reshape(2, 2, 5, 4)[:, 1])
    )
    rough = (4 * near - far) / 3
    return float((np.linalg.norm(exact.T - rough, axis=1) / np.linalg.norm(rough, axis=1)).max())


def basilisk():
    """Rows of `benchmarks.validate` where Basilisk is installed."""
    if find_spec("Basilisk") is None:
        return
    from benchmarks import validate

    rows: dict[str, dict] = {}
    for row in validate.differences(validate.SECONDS):
        rows.setdefault(row["case"], {})[row["field"]] = row["difference"]
    for name, row in rows.items():
        ok = max(row["attitude"], row["rate"]) <= validate.LIMIT
        attitude = 4 * row["attitude"] / DEG  # an MRP is a quarter of a small angle
        yield {"case": f"{name}, {validate.SECONDS} s", "reference": "Basilisk", "attitude": attitude, "rate": row["rate"],
               "tools": "Basilisk, run here", "ok": ok}  # fmt: skip


WIDTHS = {"attitude": 13, "mrp": 9, "rate": 12, "position": 12}


def mark(row: dict) -> str:
    return "" if row["ok"] else "  NOT WITHIN"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.check_cases", description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the tables as JSON")
    parser.add_argument(
        "--nesc", type=Path, metavar="FOLDER", help="NESC's logs Atmos_02_sim_01.csv ...: measure the tools too"
    )
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jaxatt.configure()
    print(f"Python {platform.python_version()}, JAX {jax.__version__}, float64; RK4, step 1 s (brick 0.005 s)")
    cases = stacked([scenario_of(case) for case in CASES])
    found, by_mrp = (logs(system, cases, 28800, 60) for system in (QUATERNION, MRP))
    bricks = [logs(system, stacked([brick()]), 30, 0.1) for system in BRICKS]
    truth = by_scipy(tumble(), np.arange(301) / 10)
    table, tools, kept = [], [], []
    print(
        f"\n{'case':32}{'reference':11}{'attitude deg':>13}{'by MRP':>9}{'rate rad/s':>12}{'position m':>12}  tools that agree to that"
    )
    for part in (orbital(found, by_mrp), tumbling(bricks), basilisk()):
        for row in part:
            table.append(row)
            cells = "".join(f"{f'{row[k]:.1e}' if k in row else '':>{n}}" for k, n in WIDTHS.items())
            print(f"{row['case']:32}{row['reference']:11}{cells}  {row['tools']}{mark(row)}", flush=True)
    if find_spec("Basilisk") is None:
        print("Basilisk is not installed: its cases are left out (extra `bench`)")
    print(f"\n{'brick, largest difference from DOP853 over 30 s':50}{'rate deg/s':>12}{'attitude deg':>14}")
    for row in by_tool(bricks[0], truth, args.nesc):
        tools.append(row)
        print(
            f"{row['tool'] + ', ' + row['how']:50}{row['rate']:12.1e}{row['attitude']:14.1e}  {row['remark']}{mark(row)}"
        )
    print(f"\n{'law':82}{'value':>10}  allowed")
    for row in laws(found, by_mrp):
        kept.append(row)
        print(f"{row['law']:82}{row['value']:10.4g}  {row['low']:g} to {row['high']:g}{mark(row)}", flush=True)
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(
            json.dumps({"jax": jax.__version__, "cases": table, "tools": tools, "laws": kept}, indent=1) + "\n"
        )
    bad = sum(not row["ok"] for row in table + tools + kept)
    print(
        f"\n{len(table) + len(tools) + len(kept) - bad} of {len(table) + len(tools) + len(kept)} rows within tolerance"
    )
    if bad:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
