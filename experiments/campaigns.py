"""Campaigns of the papers' loops: ``python -m experiments NAME campaign --n 100000 --out runs/x [--resume]``.

Each loop draws its scenarios from the point of a sampling design: `draw` turns a point of the unit cube into
named numbers, `scenario` the numbers into a scenario. The store lies in the folder --out as campaign.zarr.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri

from jaxatt import Fault, Quat, Vec3, on_axes
from jaxatt.campaign import Campaign, designs, extend, run
from jaxatt.campaign.summary import describe, rate_of, sensitivity
from jaxatt.evaluation import quantile_interval
from jaxatt.faults import dead_where
from jaxatt.loops import cmg_loss as cmg
from jaxatt.loops import gyro_ekf as ekf
from jaxatt.loops import microsat as micro
from jaxatt.loops import observer_pd as op
from jaxatt.loops import star_isolation as star
from jaxatt.loops import wheel_mrac as wm
from jaxatt.sweeping import varied

DEG = np.pi / 180


class Plan(NamedTuple):
    """What a loop's campaign draws and runs."""

    system: Any
    params: Any
    score: Any
    ticks: int
    dims: int  # numbers drawn
    draw: Callable  # (u (dims,) in (0, 1)) -> dict of numbers
    scenario: Callable  # (numbers) -> scenario
    units: Mapping[str, str]  # of the numbers drawn
    record: Callable  # (log) -> what --every records
    tell: Callable = describe  # (dataset) -> the summary


def between(u, low, high):
    """u in (0, 1) as a number between low and high."""
    return low + (high - low) * u


def between_logs(u, low, high):
    """u in (0, 1) as a number between low and high, uniform in its logarithm."""
    return jnp.exp(between(u, np.log(low), np.log(high)))


def one_of(u, count):
    """u in (0, 1) as a whole number 0 .. count - 1, as a float."""
    return jnp.floor(u * count)


# observer_pd: random and constant faults of gyro or star sensor


def draw_observer(u):
    return dict(
        sensor=one_of(u[0], 2), kind=one_of(u[1], 2), size=between_logs(u[2], 0.003, 0.1), onset=between(u[3], 30, 40)
    )


def scenario_observer(d):
    def fault(sensor):
        hit = jnp.where(d["sensor"] == sensor, d["size"], 0.0)
        return on_axes(
            Fault(d["onset"], random=jnp.where(d["kind"] == 0, hit, 0.0), bias=jnp.where(d["kind"] == 1, hit, 0.0))
        )

    return op.scenario._replace(gyro=fault(0), star=fault(1))


# gyro_ekf: two gyros dead from a random time on, biases and rates of the day

PAIRS = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])


def draw_ekf(u):
    return dict(
        pair=one_of(u[0], 6), onset=between(u[1], 0, 300),
        rate=between(u[2:5], -0.02, 0.02) * DEG, bias=0.02 * DEG * ndtri(u[5:9]),
    )  # fmt: skip


def scenario_ekf(d):
    hit = jnp.any(jnp.asarray(PAIRS)[d["pair"].astype(int)][:, None] == np.arange(4), axis=0)
    return ekf.scenario._replace(w=Vec3(*d["rate"]), bias=d["bias"], gyro=dead_where(hit, d["onset"]))


# cmg_loss: any gimbal angles, any lost module, both mountings, which the computer knows; its params differ too


def draw_cmg(u):
    return dict(gamma=between(u[:4], 0, 2 * np.pi), module=one_of(u[4], 4), box=one_of(u[5], 2))


def scenario_cmg(d):
    axes = jax.tree.map(lambda a, b: jnp.where(d["box"] == 1, b, a), cmg.PYRAMID, cmg.BOX)
    this, lost = np.arange(4) == d["module"], cmg.lost(cmg.PYRAMID, np.zeros(4))
    failure = lost.failure._replace(onset=jnp.where(this, 0.0, np.inf), brake=jnp.where(this, 1e-6, 0.0))
    return cmg.table5._replace(axes=axes), lost._replace(gamma=d["gamma"], axes=axes, failure=failure)


# star_isolation: size, direction, onset and kind of a fault of either star sensor or the gyro


def draw_star(u):
    return dict(
        cause=one_of(u[0], 4), kind=one_of(u[1], 3), size=between_logs(u[2], 1, 100),
        direction=between(u[3], 0, 2 * np.pi), onset=between(u[4], 50, 200), tau=between_logs(u[5], 5, 100),
        third=ndtri(u[6:9]), start=star.params.std_qv * ndtri(u[9:15]),
    )  # fmt: skip


def scenario_star(d):
    def along(component, std, cause):
        at_fault = d["cause"] == cause
        size = lambda kind: jnp.where(at_fault & (d["kind"] == kind), d["size"], 0.0) * component * std
        growth = jnp.where(at_fault & (d["kind"] == 2), d["size"], 1.0)
        return Fault(jnp.where(at_fault, d["onset"], np.inf), bias=size(0), drift=size(1), tau=d["tau"], growth=growth)

    cos, sin = jnp.cos(d["direction"]), jnp.sin(d["direction"])
    std = star.params.std_star
    roll = Vec3(along(0.0, std, 99), along(cos, std, 1), along(sin, std, 1))
    pitch = Vec3(along(cos, std, 2), along(0.0, std, 99), along(sin, std, 2))
    third = d["third"] / jnp.linalg.norm(d["third"])
    gyro = Vec3(*(along(a, star.params.std_gyro, 3) for a in third))
    q, errors = star.scenario.q, d["start"].reshape(3, 2)
    q_hat = Quat(jnp.full(2, q.w), *(a + e for a, e in zip(q.v, errors)))
    both = jax.tree.map(lambda a, b: jnp.stack([jnp.asarray(a, float), jnp.asarray(b, float)]), roll, pitch)
    return star.scenario._replace(star=both, gyro=gyro, q_hat=q_hat)


# wheel_mrac: inertias, gains, noise, friction and losses of effectiveness; its params differ too


def draw_wheel(u):
    return dict(
        believed_J=between(u[0], 4, 7), K=between_logs(u[1], 0.5, 5), gamma=between_logs(u[2], 1e-8, 3e-6),
        estimating=one_of(u[3], 2), J_z=between(u[4], 4, 7), noise=between(u[5], 0, 0.1),
        friction=between(u[6], 0, 3e4), onset=between(u[7], 12, 80), effectiveness=between(u[8], 0.05, 1),
    )  # fmt: skip


def scenario_wheel(d):
    law = wm.params.law._replace(gamma=d["gamma"])
    params = wm.params._replace(J_hat=d["believed_J"], K=d["K"], law=law, a_r=0.5, a_y=0.0, ope=d["estimating"])
    drive = wm.scenario.drive._replace(onset=d["onset"], scale=d["effectiveness"])
    wheel = wm.scenario.wheel._replace(friction=d["friction"])
    return params, wm.scenario._replace(J_z=d["J_z"], noise=d["noise"], wheel=wheel, drive=drive)


# microsat: one fault of any kind in any unit, on an axis or, axis 3, on all, anywhere on the orbit; half of the
# computers act on their verdicts

UNITS = "none", "wheel", "gyro", "star", "star tracker", "sun sensor", "magnetometer", "tachometer"
KINDS = "bias", "drift", "noise", "dead", "stuck", "missing"
WHEEL_KINDS = "weak", "worn", "seized"
KEPT = 0.1  # [deg] pointing of the last minute within which a run is kept


def draw_microsat(u):
    return dict(
        t0=between(u[0], 0, 5676.98), unit=one_of(u[1], len(UNITS)), kind=one_of(u[2], len(KINDS)), axis=one_of(u[3], 4),
        size=between_logs(u[4], 0.05, 1), onset=between(u[5], 100, 200), turn=ndtri(u[6:9]), bias=ndtri(u[9:12]),
        friction=between(u[12:16], 0.9, 1.1), act=one_of(u[16], 2),
    )  # fmt: skip


def scenario_microsat(d):
    def fault(unit, full, hit: Any = True):
        """Of so large a size; a drift reaches it after 100 s."""
        here = (d["unit"] == UNITS.index(unit)) & hit
        of = lambda kind, value, none=0.0: jnp.where(here & (d["kind"] == KINDS.index(kind)), value, none)
        size = full * d["size"]
        return Fault(
            jnp.where(here, d["onset"], jnp.inf), bias=of("bias", size), drift=of("drift", 1e4 * size), tau=1e6,
            random=of("noise", size), scale=of("dead", 0.0, 1.0), stuck=of("stuck", 1.0), missing=of("missing", 1.0),
        )  # fmt: skip

    def triad(unit, full):
        return Vec3(*(fault(unit, full, (d["axis"] == i) | (d["axis"] == 3)) for i in range(3)))

    this = np.arange(4) == d["axis"]
    hit = (d["unit"] == 1) & this
    of = lambda kind, value, none: jnp.where(hit & (d["kind"] % 3 == kind), value, none)
    wheel = micro.WheelFault(
        jnp.where(hit, d["onset"], jnp.inf), np.full(4, np.inf),
        of(0, 1 - d["size"], 1.0), of(1, 1 + 9 * d["size"], 1.0), of(2, 1.0, 0.0),
    )  # fmt: skip
    return micro.scenario._replace(
        t0=d["t0"], act=d["act"], friction=d["friction"], wheel=wheel, tacho=fault("tachometer", 1e-3, this),
        turn=micro.params.sigma_turn * Vec3(*d["turn"]), bias=micro.params.sigma_bias * Vec3(*d["bias"]),
        gyro=triad("gyro", 0.1 * DEG), star=triad("star", 1 * DEG), box=fault("star tracker", 0.0),
        sun=triad("sun sensor", 0.1), field=triad("magnetometer", 5e-6),
    )  # fmt: skip


def compared(dataset) -> str:
    """`describe`, and the pointing of the last minute of microsat's runs, fault by fault, with and without reconfiguration."""
    unit, kind, act = (dataset[name].values for name in ("unit", "kind", "act"))
    last = np.where(dataset.status.values == 0, dataset["last"].values / DEG, np.inf)
    lines = [
        describe(dataset), "",
        f"with (act) and without reconfiguration: runs; last minute [deg], median; share of runs above {KEPT:g} deg; 95 %",
    ]  # fmt: skip
    for i, name in enumerate(UNITS):
        kinds = {"none": ("",), "wheel": WHEEL_KINDS}.get(name, KINDS)
        for j, what in enumerate(kinds):
            here = (unit == i) & (kind % len(kinds) == j)
            for acts in (1, 0):
                values = last[here & (act == acts)]
                if len(values):
                    (low,), (high,) = quantile_interval(values, [0.5])
                    middle = np.quantile(values, 0.5, method="inverted_cdf")
                    told = f"{f'{name} {what}':22} {'act' if acts else 'not'} {len(values):5} {middle:9.4f}"
                    share = rate_of(int((values > KEPT).sum()), len(values))
                    lines.append(f"{told} {f'({low:.4f} to {high:.4f})':24} {share}")
    return "\n".join(lines)


PLANS = {
    "observer_pd": Plan(
        op.system, op.params, op.score, 700, 4, draw_observer, scenario_observer, dict(size="MRP or rad/s", onset="s"),
        lambda log: dict(xi=log.xi, e_q=log.e_q),
    ),
    "gyro_ekf": Plan(
        ekf.system, ekf.params, ekf.score, 4800, 9, draw_ekf, scenario_ekf,
        dict(onset="s", rate="rad/s", bias="rad/s"), lambda log: dict(angle=log.angle, w=log.w),
    ),
    "cmg_loss": Plan(
        varied(cmg.system._replace(substeps=1)), (), varied(cmg.score), 6001, 6, draw_cmg, scenario_cmg,
        dict(gamma="rad"), lambda log: dict(w=log.w, gamma=log.gamma),
    ),
    "star_isolation": Plan(
        star.system, star.params, star.score, 3000, 15, draw_star, scenario_star,
        dict(size="std of the sensor", direction="rad", onset="s", tau="s"), lambda log: dict(error=log.error),
    ),
    "wheel_mrac": Plan(
        varied(wm.system_of(substeps=8)), (), varied(wm.score), 4501, 9, draw_wheel, scenario_wheel,
        dict(believed_J="kg m^2", K="1/s", gamma="s/deg^2", J_z="kg m^2", noise="deg", friction="deg/s^2", onset="s"),
        lambda log: dict(error=log.error),
    ),
    "microsat": Plan(
        micro.system, micro.params, micro.score, 5000, 17, draw_microsat, scenario_microsat,
        dict(t0="s", size="1", onset="s", turn="sigma", bias="sigma", friction="1"),
        lambda log: dict(pointing=log.pointing), compared,
    ),
}  # fmt: skip


def sample(plan: Plan, point: Callable, key, index):
    """Scenario ``index`` of a plan."""
    return plan.scenario(plan.draw(point(key, index)))


def inputs(plan: Plan, point: Callable, key, index):
    """The numbers drawn for scenario ``index`` of a plan."""
    return plan.draw(point(key, index))


DESIGNS = ("iid", "sobol", "latin")


def campaign(name: str, n: int, seed: int = 0, design: str = "iid", every: int = 0, block: int = 1024) -> Campaign:
    """The campaign of a loop; every > 0: record its main quantities every so many ticks."""
    plan = PLANS[name]
    points = designs.latin(n, plan.dims) if design == "latin" else getattr(designs, design)(plan.dims)
    return Campaign(
        plan.system, plan.params, partial(sample, plan, points.point), jax.random.key(seed), plan.ticks, plan.score,
        inputs=partial(inputs, plan, points.point), record=plan.record if every else None, every=every or 1,
        block=block, size=points.size, units=plan.units,
    )  # fmt: skip


# the command


def shard_of(text: str) -> tuple[int, int]:
    k, m = text.split("/")
    if not 0 <= int(k) < int(m):
        raise ValueError
    return int(k), int(m)


def main(name: str, words: list[str]) -> int:
    """The command line of ``NAME campaign``; the exit status: 0, 1 after a refusal, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments {name} campaign", description="A campaign on disk: killed and resumed at will."
    )
    if name not in PLANS:
        parser.error(f"`NAME` must be one of {', '.join(PLANS)}, but it is {name}.")
    parser.add_argument("--n", type=int, default=None, help="scenarios (100000; with --quick 2048)")
    parser.add_argument("--quick", action="store_true", help="a small one")
    parser.add_argument("--out", type=Path, default=None, help="folder of campaign.zarr (runs/NAME)")
    parser.add_argument("--resume", action="store_true", help="go on with what is there; a larger --n extends it")
    parser.add_argument("--shard", type=shard_of, default=(0, 1), metavar="K/M", help="the K-th of M parts, from 0")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--design", choices=DESIGNS, default="iid", help="how the scenarios are spread")
    parser.add_argument("--every", type=int, default=0, help="record trajectories every so many ticks, too")
    parser.add_argument("--block", type=int, default=1024, help="scenarios written together")
    args = parser.parse_args(words)
    n = args.n or (2048 if args.quick else 100_000)
    out = args.out or Path("runs") / name
    path = out / "campaign.zarr"
    if path.exists() and not args.resume and args.shard[1] == 1:
        parser.error(f"{path} is there already: give --resume to go on with it, or another --out.")
    again = " ".join([parser.prog, *words, *([] if args.resume else ["--resume"])])
    started = time.perf_counter()
    try:
        this = campaign(name, n, args.seed, args.design, args.every, args.block)
        grown = path.exists() and args.resume
        dataset = (extend if grown else run)(path, this, n, shard=args.shard, progress=True)
    except KeyboardInterrupt:
        print(f"\nstopped; every block written is kept. To go on: {again}", file=sys.stderr)
        return 130
    except (ValueError, RuntimeError, OSError) as error:
        print(f"{error}\nevery block written is kept. To go on: {again}", file=sys.stderr)
        return 1
    text = PLANS[name].tell(dataset)
    print(f"{text}\n{dataset.sizes['scenario']} of {n} scenarios in {path}, {time.perf_counter() - started:.0f} s")
    if dataset.sizes["scenario"] == n:
        (out / "summary.txt").write_text(text + "\n")
        draw_sensitivity(dataset, f"{name}, {n} scenarios", out / "sensitivity.png")
    return 0


def draw_sensitivity(dataset, title: str, file: Path) -> None:
    """Figure of which input drives which score."""
    from experiments.report import plt  # sets the backend

    found = sensitivity(dataset)
    index, floor = found["index"].values, found["floor"].values
    rows = np.isfinite(index).any(1)
    index, floor = index[rows], floor[rows]
    names = [str(s) for s in found.score.values[rows]]
    fig, ax = plt.subplots(figsize=(2.5 + 0.6 * index.shape[1], 1.5 + 0.28 * len(names)), layout="constrained")
    shown = np.where(index > np.maximum(floor, 0.005), index, np.nan)
    image = ax.imshow(shown, cmap="viridis_r", vmin=0, vmax=1, aspect="auto")
    for i, j in np.argwhere(shown > 0):
        ax.text(
            j, i, f"{shown[i, j]:.2f}", ha="center", va="center", fontsize=7, color="w" if shown[i, j] > 0.5 else "k"
        )
    ax.set_xticks(range(index.shape[1]), [str(a) for a in found.input.values], rotation=60, ha="right")
    ax.set_yticks(range(len(names)), names)
    ax.set(xlabel="input", ylabel="score")
    ax.set_title(f"{title}\nblank: below the noise floor or 0.5 %", fontsize="medium")
    fig.colorbar(image, ax=ax, label="first-order share of the variance [1]")
    fig.savefig(file, dpi=150)
    plt.close(fig)
