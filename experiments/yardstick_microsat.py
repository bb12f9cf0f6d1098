"""The second world of the yardstick: packets against the loop, its residuals, its board, and what each row must see.

Quick: fewer windows and days, seven cells, no packets against the loop. No independent implementation of this board exists: what is checked are the
loop itself, closed forms and what follows from the rules.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import simulate
from jaxatt.yardstick import MICROSAT_ROWS, WORLDS, microsat, microsat_rows, rank, rules, worlds

WORLD, KEY = WORLDS["microsat"], jax.random.key(21)
CELLS = [
    ("gyro_bias", 71.7), ("star_bias", 518.0), ("wheel_loss", 1.0), ("sun_bias", 0.5), ("field_bias", 2000.0),
    ("star_frozen", 1.0), ("gyro_stuck", 1.0),
]  # fmt: skip


def run(report) -> None:
    """All checks and the board."""
    healthy(report)
    board(report)
    if not report.quick:
        packets(report)


def packets(report) -> None:
    """Forty packets are two hundred ticks of the loop, in float64."""
    loop, n = microsat.loop, 40
    day = jax.tree.map(lambda a: np.asarray(a[0], float), worlds.days(WORLD, KEY, np.array([4]), ("gyro_bias", 300.0)))
    day = day._replace(gyro=jax.tree.map(lambda a: np.where(np.isfinite(a), a, np.inf), day.gyro))
    noise = np.random.default_rng(0).normal(size=(n, microsat.system.normals))
    told = simulate(microsat.system, microsat.params, day, jnp.asarray(noise), ticks=n)
    ticks = simulate(loop.system, microsat.params, day, jnp.asarray(noise.reshape(5 * n, -1)), ticks=5 * n)
    seen, own = told.telemetry, ticks.statistics
    five = lambda a: np.asarray(a).reshape(n, 5, *np.shape(a)[1:])
    largest = lambda a: five(a).max(1)
    pairs = {
        "torques": (seen.torque, five(ticks.torque)), "pointing": (told.pointing, five(ticks.pointing)),
        "NIS": (seen.nis, five(own.nis)[:, list(microsat.ARRIVALS)]), "CUSUM of wheels": (seen.wheel_cusum, largest(own.wheel)),
        "cross-check": (seen.cross, largest(own.cross)), "sum of NIS": (seen.nis_sum, largest(own.nis_sum)),
    }  # fmt: skip
    for name, (a, b) in pairs.items():
        off = np.abs(np.asarray(a) - b).max() / np.abs(b).max()
        report.check(
            f"microsat: {name} of packets less those of the loop, of the largest", 0, float(off), 1e-9, "the loop"
        )


def healthy(report) -> None:
    """NIS and residuals of fault-free days, 200 s of 256 days."""
    told = rules.records(WORLD)
    nis = told.nis[10:][told.star_valid[10:]]
    errors = 3 * np.sqrt(2 / 3 / nis.size)
    report.check("microsat: NIS per degree of freedom", 1.0, float(nis.mean() / 3), max(errors, 0.005), "specification")

    def one(state, packet):
        return jax.vmap(microsat_rows.residuals_step, in_axes=-1, out_axes=-1)(state, packet)

    lanes = jax.tree.map(lambda a: np.moveaxis(a, 1, -1), told)
    start = jax.tree.map(
        lambda a: jnp.zeros((*a.shape, told.mode.shape[1]), jnp.float32), microsat_rows.residuals_init()
    )
    r = np.asarray(jax.jit(lambda s, t: jax.lax.scan(one, s, t)[1])(start, lanes))[100:]  # (packets, 16, days)
    std = r.std((0, 2))
    # star tracker, field and the Sun where it shines are white; about a mean over k packets, 100 < k < 200
    lit = told.mode[0] == 0
    white = [std[microsat_rows.STAR], std[microsat_rows.FIELD], r[:, microsat_rows.SUN][..., lit].std((0, 2))]
    report.check("microsat: deviation of innovations, field and Sun over theory", [1.0] * 9, np.concatenate(white).tolist(), 0.03, "closed form")  # fmt: skip
    report.note(f"microsat: deviation of gyro less momentum {np.round(std[microsat_rows.GYRO], 2)}, of wheels {np.round(std[microsat_rows.WHEEL], 2)}")  # fmt: skip


def board(report) -> None:
    """The board: rates, the clock, and that each unit is found by a row that looks at it."""
    names = ("chi2_10", "momentum", "cusum", "fdir") if report.quick else tuple(MICROSAT_ROWS)
    how: dict = {"days": 16, "hours": 100, "cells": CELLS} if report.quick else {"days": 128, "hours": 1000}
    found = rank([MICROSAT_ROWS[name] for name in names], WORLD, **how, progress=not report.quick)
    for line in found.table().splitlines():
        report.note(line)
    report.out.mkdir(parents=True, exist_ok=True)
    found.to_json(report.out / "yardstick_microsat_board.json")
    # of n windows a mode, to calibrate and to validate: alarms are counts in both
    expected = 0.1 * how["hours"] / 2
    wide = 0.1 * 3 * np.sqrt(2 / expected)
    for name in names:
        rates = [found.row(name)["rate"][mode][0] for mode in WORLD.modes]
        report.check(
            f"microsat: false alarms of {name} on fresh windows [1/h]", [0.1, 0.1], rates, wide, "specification"
        )
    delay = lambda cell, name: found.cells[cell][name][0]
    report.within("microsat: RMD60 of cusum on a large fault of gyro, star tracker, wheel and field [s]", None, 5.0,
                  [delay(cell, "cusum") for cell in ("gyro_bias 71.7", "star_bias 518", "wheel_loss 1", "field_bias 2000")], "specification")  # fmt: skip
    report.within("microsat: RMD60 of momentum on a gyro's bias of 72 deg/h [s]", None, 5.0, delay("gyro_bias 71.7", "momentum"), "specification")  # fmt: skip
    report.within("microsat: RMD60 of the flatline row on a frozen star tracker and a stuck gyro [s]", None, 3.0,
                  [delay(cell, "flatline") for cell in ("star_frozen", "gyro_stuck")], "specification")  # fmt: skip
    if report.quick:
        return
    report.within("microsat: the clock gains nothing [s]", found.row("chi2_10")["macro"], None, found.row("clock")["macro"], "specification")  # fmt: skip
    report.check("microsat: random, RMD60 [s]", 60.0 - 0.05, found.row("random")["macro"], 0.1, "closed form")
    rising = []
    for kind, sizes in WORLD.sized.items():
        for name in names:
            v, se = np.array([found.cells[f"{kind} {size:g}"][name][:2] for size in sizes]).T
            rising.append(np.max(np.diff(v) - 3 * np.hypot(se[1:], se[:-1]) - 0.5))
    report.within("microsat: RMD60 falls with size, within 3 standard errors and a packet [s]", None, 0.0, max(rising), "specification")  # fmt: skip
    report.figure("microsat_board", found.figure())
