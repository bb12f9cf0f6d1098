"""Gyro failures on a geostationary satellite (Park, 2005): Tables 4-7, figures 4-21, and what the paper leaves out.

All sixteen failure subsets, six two-gyro failures in Monte Carlo, gyro faults found and dropped by the loop itself.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax.flatten_util import ravel_pytree

import jaxatt
from experiments.report import interval, quantile
from jaxatt import plot
from jaxatt.attitude import quat_from_euler, quat_rotate
from jaxatt.faults import Fault, dead, dead_where
from jaxatt.linear import growth_rates, observability_rank, sampled
from jaxatt.loops import gyro_ekf
from jaxatt.loops.gyro_ekf import ANGLE, BIAS, DEG, DT, RATE, WHEEL, Scenario, direct, params, system
from jaxatt.plot import COLOURS, GREY, LINES
from jaxatt.vec import Vec3, array, resultant
from jaxatt.wheels import park_pyramid

TABLE_4 = Scenario(
    angle=Vec3(-0.03 * DEG, 0.05 * DEG, 0.05 * DEG),
    w=Vec3(1e-3 * DEG, -2e-3 * DEG, 2e-3 * DEG),
    bias=np.array([5e-5, 1e-5, -1e-5, -5e-5]) * DEG,
)
SUBSETS = ["", "A", "B", "C", "D", "AB", "AC", "AD", "BC", "BD", "CD", "ABC", "ABD", "ACD", "BCD", "ABCD"]
PAIRS = SUBSETS[5:11]
ZERO = [-10595, -3800, -4294, -4384, -10595, 3941, 3938, -6325, 4001, -4085, -4063, 4001, 3951, 3951, 4001, 6285]
PINV = [-10595, -10595, -10595, -10595, -10595, 3958, 3957, 651, 4001, 870, 823, 4001, 3952, 3952, 4001, 6285]
SETTLING = [285, 290, 287, 286, 285, 292, 290, 290, 287, 287, 285, 292, 292, 291, 287, 292]  # [s] with the filter
WHEELS = [-16.190693, -15.386328, 20.436361, 9.631996]  # [in-lbf-s] final, Table 6
QUIET: dict[str, Any] = dict(std_angle=0.0, std_gyro=0.0, std_tacho=0.0)
LOOKS = [dict(color=c, ls=ls) for c, ls in zip(COLOURS, LINES)]  # of components
SIX_LOOKS = [dict(color=c, ls=ls) for ls in LINES[:2] for c in COLOURS[:3]]
SOURCE = "independent NumPy implementation of the paper"


def mask(*subsets: str) -> np.ndarray:
    """Which gyros the subsets name, (len(subsets), 4)."""
    return np.array([[name in subset for name in "ABCD"] for subset in subsets])


def dead_gyros(subset: str, onset: float = 0.0) -> Fault:
    """The gyros of a subset dead from the onset on."""
    return dead_where(mask(subset)[0], onset)


def flown(loop, days: list, ticks: int, key) -> gyro_ekf.Log:
    """Logs of several (params, scenario), one after the other in the first axis, all with the same noise."""
    pairs = jax.tree.map(lambda *a: np.stack(np.broadcast_arrays(*a)), *days)
    return jax.vmap(lambda p, s: jaxatt.simulate(loop, p, s, key, ticks=ticks))(*pairs)


def run(report) -> None:
    """All of it."""
    growth(report)
    healthy = without_filter(report)
    model(report, with_filter(report, healthy))
    monte_carlo(report)
    reconfiguration(report)


# linear analysis


def growth(report) -> None:
    """Growth rates of the 2-Hz loop without a filter, observability of the filter, for every subset."""
    still = Scenario(w=Vec3(0.0, 0.0, 0.0), h=np.zeros(4), bias=np.zeros(4))
    states = ("x.integral", "x.angle", "x.w")

    @jax.jit
    def matrices(scenario):
        period = lambda scenario: sampled(direct, params, scenario, ticks=gyro_ekf.CONTROL, states=states)
        return jax.vmap(lambda dead: period(scenario._replace(gyro=dead_where(dead))))(mask(*SUBSETS))

    slowest = lambda scenario: growth_rates(matrices(scenario), gyro_ekf.CONTROL * DT)[:, 0]
    for mode, told, expected in (("zero", 0.0, ZERO), ("pinv", 1.0, PINV)):
        measured = slowest(still._replace(announced=told))
        report.check(f"growth rates of 16 subsets, `{mode}` [1/s]", np.array(expected) * 1e-6, measured, 1e-6, SOURCE)
    turning = slowest(still._replace(h=np.array(WHEELS), announced=0.0))
    rates = turning[[SUBSETS.index("BD"), SUBSETS.index("CD")]]
    report.check(
        "growth rates, BD and CD, wheels at their final momenta [1/s]", [-0.00467, -0.00341], rates, 5e-6, SOURCE
    )
    rest = np.zeros(17)
    spinning, moving = rest.copy(), rest.copy()
    spinning[WHEEL] = moving[WHEEL] = Scenario().h
    moving[RATE] = 1e-3
    rows = lambda s: np.r_[0:3, 3 + np.flatnonzero(~mask(s)[0]), 7:11]
    report.check("observability rank of 16 subsets", [14 - len(s) for s in SUBSETS],
                 [rank(rest, rows(s)) for s in SUBSETS], 0, SOURCE)  # fmt: skip
    report.check("observability rank without sun sensor, at rest and moving, wheels turning", [13, 14],
                 [rank(spinning, slice(1, 11)), rank(moving, slice(1, 11))], 0, SOURCE)  # fmt: skip


@jax.jit
def linearised(x):
    """A (9, 17), of the states that move, and H (11, 17) of the filter's model at x, without command."""
    f, h = partial(gyro_ekf.drift, params, np.zeros(4)), partial(gyro_ekf.measured, params)
    return jax.jacfwd(in_a_row(f))(x), jax.jacfwd(in_a_row(h))(x)


def in_a_row(f):
    """f with the numbers of its tree as one array."""
    return lambda x: ravel_pytree(f(x))[0]


def rank(x, rows) -> int:
    """Observability rank of the filter's model at the state x (17,) from some of its measurements."""
    A, H = linearised(x)
    A = np.concatenate([A, np.zeros((8, 17))])
    return observability_rank(A, H[rows], np.repeat([1.0, 1e-2, 1e-4, 1.0, 1e-4], [3, 3, 3, 4, 4]), duration=100.0)


# cases 1 and 2: no filter


def without_filter(report) -> np.ndarray:
    """Figures 12-15, the ends of all sixteen subsets; returns the angles (3, ticks) [deg] of no failure, no bias."""
    base = Scenario(**QUIET)
    no_bias = base._replace(bias=np.zeros(4))
    dead_b = dict(gyro=dead_gyros("B"))
    cases = [no_bias._replace(gyro=dead_gyros(s), announced=told) for told in (0.0, 1.0) for s in SUBSETS]
    cases += [base, base._replace(**dead_b, announced=0.0), base._replace(**dead_b, announced=1.0)]
    ticks = 12001
    log = flown(direct, [(params, case) for case in cases], ticks, jax.random.key(0))
    t = np.arange(ticks) * DT
    angle, integral = (np.asarray(array(a)) / DEG for a in (log.angle, log.integral))  # (3, cases, ticks)
    h = np.asarray(log.h)
    at_1000 = angle[..., 8000]
    size = np.linalg.norm(at_1000, axis=0)
    mixed = np.array([5, 6, 7, 8, 9, 10])
    digit = f"{SOURCE}, to its last printed digit"
    report.check("end, four single failures, `zero` [deg]", [5.0e-3, 4.5e-4, 1.8e-3, 6e-6], size[1:5],
                 [1e-4, 1e-5, 1e-4, 1e-6], digit)  # fmt: skip
    report.check("end, six pairs, `zero` [deg]", [10.5, 16.5, 8.3e-4, 6.9, 3.7e-3, 2.0e-2], size[mixed],
                 [0.1, 0.1, 1e-5, 0.1, 1e-4, 1e-3], digit)  # fmt: skip
    report.check("end, six pairs, `pinv` [deg]", [10.4, 16.9, 0.47, 7.0, 0.36, 1.29], size[16 + mixed],
                 [0.1, 0.1, 0.01, 0.1, 0.01, 0.01], digit)  # fmt: skip
    settling = [settled(t[:8001], angle[:, i, :8001]) for i in range(5)]
    report.check("settling, none and single failures, `zero` [s]", [281, 897, 595, 854, 281], settling, 1, SOURCE)
    settling = [settled(t[:8001], angle[:, 16 + i, :8001]) for i in range(5)]
    report.check("settling, none and single failures, `pinv` [s]", [281] * 5, settling, 1, SOURCE)
    report.check("final wheels at 1500 s, Table 6 [in-lbf-s]", WHEELS, h[0, -1], 1e-3, SOURCE)
    report.check(
        "integral with bias, 1000 s (fig. 14) [deg s]", [58.521, 67.575, 30.790], integral[:, 32, 8000], 1e-2, SOURCE
    )
    report.check(
        "peak angle with bias (fig. 14) [deg]", [0.403, 0.486, 0.310], np.abs(angle[:, 32]).max(1), 5e-4, SOURCE
    )
    report.check("peak angle without bias [deg]", [0.091, 0.195, 0.104], np.abs(angle[:, 0]).max(1), 1.5e-3, SOURCE)
    report.check(
        "integral, B dead, `zero` (fig. 15) [deg s]", [29.261, 50.681, 36.428], integral[:, 33, -1], 2e-2, SOURCE
    )
    report.check("integral, B dead, `pinv` [deg s]", [15.592, 42.789, 39.061], integral[:, 34, -1], 1e-2, SOURCE)

    fig, axes = plt.subplots(2, 4, figsize=(15, 6), sharex=True)
    for ax, s in zip(axes.flat, ["A", "B", "C", "D", "AC", "AD", "BC", "BD"]):
        lines3(ax, t[:8001:8], angle[:, SUBSETS.index(s), :8001:8], "xyz")
        ax.set_title(f"{'gyro' if len(s) == 1 else 'gyros'} {' and '.join(s)} dead, no filter")
    label(axes, "angle [deg]")
    report.figure("fig12_13_without_filter", fig)
    fig, axes = plt.subplots(2, 3, figsize=(13, 6), sharex=True)
    for column, (i, title) in enumerate(
        ((0, "no bias (fig. 14)"), (32, "bias (fig. 14)"), (33, "bias, gyro B dead (fig. 15)"))
    ):
        lines3(axes[0, column], t[:8001:8], angle[:, i, :8001:8], "xyz")
        lines3(axes[1, column], t[:8001:8], integral[:, i, :8001:8], "xyz")
        axes[0, column].set_title(title)
    label(axes[:1], "angle [deg]", "")
    label(axes[1:], "integral of the angle [deg s]")
    report.figure("fig14_15_bias_without_filter", fig)
    return angle[:, 0]


def settled(t, angle) -> float:
    """Last time at which any angle, (3, ticks), is outside 0.01 deg."""
    outside = np.abs(angle).max(0) > 0.01
    return float(t[outside].max()) if outside.any() else 0.0


# cases 3 and 4: the filter


def with_filter(report, healthy) -> gyro_ekf.Log:
    """Figures 4-11 and 16-21, the sixteen subsets with the filter; returns the log of Table 6 without noise."""
    quiet = Scenario(**QUIET)
    cases = {s: quiet._replace(gyro=dead_gyros(s)) for s in SUBSETS}
    cases |= {f"predict {s}": quiet._replace(gyro=dead_gyros(s)) for s in SUBSETS}
    cases |= {f"undetected {s}": quiet._replace(gyro=dead_gyros(s), announced=0.0) for s in SUBSETS}
    cases["table 4"] = TABLE_4._replace(**QUIET)
    cases["fig 16"] = quiet._replace(bias=np.zeros(4))
    cases["fig 19"] = Scenario()
    cases["fig 20"] = Scenario(gyro=dead_gyros("AC"))
    cases["fig 21"] = Scenario(gyro=dead_gyros("ABCD"))
    cases["orbit"] = quiet._replace(orbit_rate=gyro_ekf.SIDEREAL)
    cases["torque"] = quiet._replace(disturbance=Vec3(1e-3, 0.0, 0.0))
    cases["one wheel dead"] = Scenario(wheel=dead_gyros("A", 100.0), gyro=dead_gyros("AC"))
    cases["no sun"] = Scenario(sun=Fault(onset=300.0, end=420.0))
    cases["no earth"] = Scenario(earth=Fault(onset=300.0, end=420.0))
    cases["weak wheels"] = Scenario(torque_max=0.5)
    names, ticks = list(cases), 4801
    fill = lambda name: params._replace(fill=float(name.startswith("predict")))
    log = flown(system, [(fill(name), case) for name, case in cases.items()], ticks, jax.random.key(1))
    t = np.arange(ticks) * DT
    angle, w, integral = (np.asarray(array(a)) / DEG for a in (log.angle, log.w, log.integral))  # (3, cases, ticks)
    h, f = np.asarray(log.h), jax.tree.map(np.asarray, log.filter)
    error, mean = f.error, f.mean  # (cases, ticks, 17)
    at = names.index

    drop = slice(0, 16)
    for mode, part in (("drop", drop), ("predict", slice(16, 32)), ("undetected_zero", slice(32, 48))):
        end = np.linalg.norm(angle[:, part, 4800], axis=0)
        report.within(f"angle at 600 s, 16 subsets, filter, `{mode}` [deg]", None, 5e-4, end, SOURCE)
    report.check(
        "settling with the filter, 16 subsets [s]", SETTLING, [settled(t, angle[:, i]) for i in range(16)], 3, SOURCE
    )
    report.check("final wheels at 600 s, filter [in-lbf-s]", WHEELS, h[0, 4800], 5e-3, SOURCE)
    i = at("table 4")
    report.check("wheel estimation error at 1 and 10 s, Table 4 [in-lbf-s]", [-1.11111, -0.1234566],
                 error[i, [8, 80], 9], [1e-5, 1e-6], SOURCE)  # fmt: skip
    report.check("angle errors at 1, 10, 100 s, Table 4 [1e-4 deg]",
                 [-6.12, 48.61, 68.40, 7.18, -22.78, -21.98, 0.747, -2.557, -2.386],
                 (error[i, [8, 80, 800], ANGLE] / DEG * 1e4).ravel(),
                 [0.01] * 6 + [0.001] * 3, SOURCE)  # fmt: skip
    for case, tolerance, expected in (("table 4", 1.0, [472, 508, 176, 392]), ("", 0.25, [7.25, 8.5, 10.5, 9.0])):
        i = at(case)
        wrong = np.abs(error[i, :, BIAS]) > 0.01 * np.abs(cases[case].bias)
        within = [float(t[wrong[:, j]].max() + DT) for j in range(4)]
        report.check(f"bias within 1 %, Table {4 if case else 6} [s]", expected, within, tolerance, SOURCE)
    overshoot = np.abs(error[at("table 4"), :, BIAS]).max(0) / DEG
    report.check(
        "largest bias error at start-up, Table 4 [1e-3 deg/s]", [12.9, 3.5, 4.5, 7.5], overshoot * 1e3, 0.06, SOURCE
    )
    h_f = final_wheels(TABLE_4)
    report.check(
        "final wheels from momentum, Table 4 [in-lbf-s]", [-10.62404, 2.95934, 11.06121, -12.52216], h_f, 1e-5, SOURCE
    )

    # figures 16 to 21 in words
    gap = np.abs(angle[:, at("fig 16")] - healthy[:, :ticks]).max(0)
    report.check("filter less no filter, angle (fig. 16) [deg]", 0.0177, gap.max(), 5e-5, SOURCE)
    report.within("filter less no filter, angle, > 300 s (fig. 16) [deg]", None, 7.8e-4, gap[t > 300].max(), SOURCE)
    gap = np.abs(angle[:, at("")] - angle[:, at("fig 16")]).max()
    report.check("filter, angle, bias on less off (fig. 17) [deg]", 0.0151, gap, 5e-5, SOURCE)
    gap = np.abs(integral[:, at("")] - integral[:, at("fig 16")]).max()
    report.note(f"filter, integral, bias on less off (fig. 17): at most {gap:.3f} deg s; 67.6 without the filter")
    rms = np.sqrt(np.mean(error[at("fig 19"), t > 300, ANGLE] ** 2, axis=0)) / DEG
    report.within(
        "RMS angle estimation error, noise (fig. 18) [1e-4 deg]",
        0.5,
        4.0,
        rms * 1e4,
        f"{SOURCE}: 1.2, 2.2, 1.9, one seed",
    )
    gap = np.abs(w[:, at("fig 20")] - w[:, at("fig 19")]).max(0)
    report.relative("rate, A&C dead less none, all and > 100 s (fig. 20) [deg/s]", [8.3e-4, 6.4e-5],
                    [gap.max(), gap[t > 100].max()], 0.1, f"{SOURCE}, other noise")  # fmt: skip
    gap = np.abs(angle[:, at("fig 21")] - angle[:, at("fig 19")]).max(0)
    report.relative("angle, all dead less none, all and > 100 s (fig. 21) [deg]", [0.0145, 5.2e-3],
                    [gap.max(), gap[t > 100].max()], 0.1, f"{SOURCE}, other noise")  # fmt: skip
    peaks = [np.abs(angle[:, at(c)]).max() for c in ("fig 21", "fig 19")]
    report.check("peak angle, all dead and none (fig. 21) [deg]", [0.218, 0.204], peaks, 5.7e-3,
                 f"{SOURCE}, other noise; tolerance: sigma of the angle sensors")  # fmt: skip

    # beyond the paper
    nis = float(np.mean(f.nis[at("fig 19"), 2400:] / f.rows[at("fig 19"), 2400:]))
    report.check("mean NIS per degree of freedom, Table 5 as printed", 4e-6, nis, 2e-6, SOURCE)
    i = at("orbit")
    report.note(f"orbital rate in the truth only: angle estimation error at 600 s {error[i, -1, ANGLE] / DEG} deg")
    change = np.abs(angle[:, i] - angle[:, 0]).max()
    report.check("pointing changed by an orbital rate the filter ignores [deg]", 0.029, change, 5e-4, SOURCE)
    absorbed = np.abs(error[i, -1, BIAS]) / DEG
    report.check("orbital rate taken for bias [deg/s]", [2.4e-3, 2.4e-3, 2.4e-3, 4.2e-3], absorbed, 5e-5, SOURCE)
    i = at("torque")
    off = [np.abs(a).max() for a in (error[i, -1, ANGLE] / DEG, angle[:, i, -1])]
    report.note(
        f"unmodelled torque of 1e-3 in-lbf, 600 s: estimate off by {off[0]:.4f} deg, pointing by {off[1]:.1e} deg"
    )
    for case in ("one wheel dead", "no sun", "no earth", "weak wheels"):
        i = at(case)
        report.within(f"angle at 600 s, {case} [deg]", None, 0.01, np.abs(angle[:, i, -1]).max(), "pointing band")
        peak, momentum = np.abs(angle[:, i]).max(), np.abs(h[i]).max()
        report.note(f"  peak angle {peak:.3f} deg, largest wheel momentum {momentum:.2f} in-lbf-s")

    estimation_figure(report, t, error[at("table 4")])
    filter_figure(report, "fig08_11_estimates", t, {"Table 4": mean[at("table 4")]})
    filter_figure(report, "fig16_17_19_estimates", t, {
        "no bias, no noise (fig. 16)": mean[at("fig 16")], "bias (fig. 17)": mean[at("")],
        "bias and noise (fig. 19)": mean[at("fig 19")]})  # fmt: skip
    filter_figure(report, "fig20_21_gyros_dead", t, {
        "none dead (fig. 19)": mean[at("fig 19")], "A and C dead (fig. 20)": mean[at("fig 20")],
        "all dead (fig. 21)": mean[at("fig 21")]})  # fmt: skip
    fig, axes = plt.subplots(1, 2, figsize=(11, 3.6), sharey=True)
    for ax, case, title in zip(axes, ("", "fig 19"), ("bias, no noise", "bias and noise")):
        lines3(ax, t, error[at(case), :, ANGLE].T / DEG * 1e3, "xyz")
        ax.set(title=f"{title} (fig. 18)", ylim=(-5, 5))
    label(axes[None], "angle estimation error [1e-3 deg]")
    report.figure("fig18_angle_error", fig)
    table_figure(report, angle[:, drop], t)
    return jax.tree.map(lambda a: a[0], log)


def final_wheels(scenario: Scenario) -> np.ndarray:
    """Wheel momenta at rest, (4,): W^+ H and the part of h that gives no momentum; H in body axes at zero angles."""
    wheels = park_pyramid(params.gamma)
    H0 = gyro_ekf.INERTIA @ scenario.w + resultant(wheels, scenario.h)
    H = quat_rotate(quat_from_euler(scenario.angle), H0)
    W = np.array([list(map(float, a)) for a in wheels]).T
    null = np.array([1.0, -1.0, 1.0, -1.0]) / 2
    return np.linalg.pinv(W) @ np.asarray(array(H)) + null * (null @ scenario.h)


def model(report, log) -> None:
    """Momentum, the Jacobian, float32, honest covariances."""
    quiet = Scenario(**QUIET)
    key = jax.random.key(0)
    wheels = park_pyramid(params.gamma)
    attitude = quat_from_euler(log.angle)
    body = gyro_ekf.INERTIA @ log.w + resultant(wheels, log.h.T)
    H = np.asarray(array(quat_rotate(attitude, body)))
    report.check("inertial momentum drift over 600 s [in-lbf-s]", 0, np.abs(H - H[:, :1]).max(), 1e-9, "conservation")
    single, calm = jax.tree.map(np.float32, (params, quiet))
    log32 = jaxatt.simulate(system, single, calm, key, ticks=4801)
    gap = max(np.abs(np.asarray(a, float) - np.asarray(b)).max() for a, b in zip(log32.angle, log.angle)) / DEG
    report.check("float32 less float64, angle, 600 s [deg]", 0, gap, 1e-5, SOURCE)
    rng = np.random.default_rng(0)
    x = rng.normal(size=17) * np.repeat([1.0, 0.3, 1e-2, 10.0, 1e-4], [3, 3, 3, 4, 4])
    u = rng.normal(size=4)
    f = jax.jit(in_a_row(partial(gyro_ekf.drift, params, u)))
    step = np.repeat([1e-4, 1e-5, 1e-5, 1e-3, 1e-4], [3, 3, 3, 4, 4])
    central = np.stack([(f(x + e) - f(x - e)) / (2 * e.sum()) for e in np.diag(step)], axis=1)
    report.check(
        "Jacobian less finite difference", 0, np.abs(jax.jacfwd(f)(x) - central).max(), 1e-8, "central difference"
    )


# Monte Carlo


def drawn(n: int, seed: int, real) -> Scenario:
    """n days: random biases, initial rates; the rest as in Table 6."""
    rng = np.random.default_rng(seed)
    w = rng.uniform(-0.02, 0.02, (3, n)).astype(real).T * DEG
    bias = (rng.normal(0, 0.02, (4, n)) * DEG).astype(real).T
    table_6 = jax.tree.map(lambda a: np.asarray(a, real), Scenario())
    return jax.vmap(lambda w, bias: table_6._replace(w=Vec3.of(w), bias=bias))(w, bias)


def monte_carlo(report) -> None:
    """Six two-gyro failures at random times, with the filter and without, in one sweep each."""
    each, ticks, real = (64 if report.quick else 1000), 4800, np.float32
    n = 6 * each
    rng = np.random.default_rng(10)
    pair = np.repeat(np.arange(6), each)
    fault = jax.vmap(dead_where)(mask(*PAIRS)[pair], rng.uniform(0, 300, n))
    scenarios = drawn(n, 11, real)._replace(gyro=jax.tree.map(lambda a: a.astype(real), fault))
    single = jax.tree.map(real, params)
    sets = {
        "filter": (system, gyro_ekf.score, scenarios),
        "zero": (direct, gyro_ekf.score, scenarios._replace(announced=np.zeros(n, real))),
        "pinv": (direct, gyro_ekf.score, scenarios),
    }
    results = {}
    for name, (loop, score, here) in sets.items():
        start = time.process_time()
        values = jaxatt.sweep(loop, single, here, jax.random.key(12), ticks=ticks, score=score, progress=False)
        spent = time.process_time() - start
        report.note(f"{n} scenarios of 600 s, {name}: {spent:.1f} s CPU, compilation included")
        results[name] = values
    fig, axes = plt.subplots(1, 2, figsize=(12, 4), sharey=True)
    for i, name in enumerate(PAIRS):
        here = pair == i
        for how, loop in results.items():
            good = loop.ok[here] & (loop.settling[here] <= 550)
            low, high = interval(int(good.sum()), each)
            text = f"{name} dead, {how}: {good.sum()} of {each} converge, share {low:.3f} to {high:.3f}"
            final = loop.final_error[here] / DEG
            text += (
                f"; median settling {quantile(loop.settling[here], 0.5)} s, angle at the end {quantile(final, 0.5, 2)}"
            )
            report.note(f"{text}, largest {final.max():.1e} deg")
            if how == "filter":
                report.within(f"share that converges, {name} dead, filter", 1, None, good.mean(), "required: all")
            if how == "filter":
                curve(axes[0], loop.settling[here], label=name, **SIX_LOOKS[i])
            if how != "pinv":
                curve(axes[1], final, lw=1 if how == "zero" else 2, **SIX_LOOKS[i])
    axes[0].set(
        xlabel="settling time to 0.01 deg [s]", ylabel="share of scenarios [1]", title="with the filter", xlim=(0, 400)
    )
    axes[0].legend(title="dead")
    axes[1].set(xlabel="largest angle at 600 s [deg]", xscale="log")
    axes[1].set_title("with the filter (left) and without it, dead gyros reading zero (right)")
    axes[1].axvline(0.01, color=GREY, lw=1, label="pointing band")
    axes[1].legend(loc="lower right")
    fig.suptitle(f"two gyros dead from a random time within 300 s on, {each} scenarios a pair")
    fig.tight_layout()
    report.figure("monte_carlo", fig)


def curve(ax, values, **look) -> None:
    """Share of the values that lie below."""
    ax.step(np.sort(values), np.arange(1, len(values) + 1) / len(values), **look)
    ax.grid(alpha=0.3)


# faults that nobody announces


def reconfiguration(report) -> None:
    """Gyro faults found and dropped on board: threshold on other seeds, delay, isolation, false alarms, parity."""
    n, ticks = (128 if report.quick else 1024), 3200
    honest = gyro_ekf.consistent(params)
    sweep = lambda p, scenarios, seed: jaxatt.sweep(
        system, p, scenarios, jax.random.key(seed), ticks=ticks, score=gyro_ekf.score, progress=False)  # fmt: skip
    healthy = lambda seed: drawn(n, seed, np.float64)._replace(gyro=faults(Fault(), n), announced=np.zeros(n))
    days = n * ticks * DT / 86400

    calm = sweep(honest, healthy(20), 21)
    report.check("mean NIS per degree of freedom, R = sigma^2", 1, calm.filter.nis.mean(), 0.05, "chi-square")
    highest = float(calm.filter.statistic.max())
    threshold = 1.4 * max(highest, 25.0)  # a standard normal number exceeds 5.9 once in 3e8
    report.note(f"largest chi-square of a gyro in {days:.2f} healthy days: {highest:.1f}; threshold {threshold:.1f}")
    alert = honest._replace(threshold=threshold)
    guarded = sweep(alert, healthy(22), 23)
    false = int(np.isfinite(guarded.filter.caught).sum())
    report.within(f"false alarms per day, {days:.2f} days on other seeds", None, 1, false / days, "required")
    report.note(
        f"false alarms per hour {false / days / 24:.4f}; at most {3 / days:.2f} a day with 95 % confidence if none"
    )

    rng = np.random.default_rng(24)
    who, onset = rng.integers(0, 4, n), rng.uniform(100, 250, n)
    slewing = alert._replace(slew=Vec3(0.0, 0.0, 0.05 * DEG), slew_start=200.0, slew_end=260.0)
    slew_onset = rng.uniform(205, 255, n)
    jump = lambda size: Fault(bias=size * 1e-6)
    still = dict(w=Vec3(*np.zeros((3, n))), bias=np.zeros((n, 4)))
    cases = [(f"jump {s} sigma", alert, jump(s), onset, {}) for s in (3, 5, 10, 30, 350)]
    cases += [
        ("dead, no bias, slew", slewing, dead(), slew_onset, dict(bias=np.zeros((n, 4)))),
        ("dead, bias as drawn", alert, dead(), onset, {}),
        ("dead, no bias, at rest", alert, dead(), onset, still),
    ]
    shares, delays, confusion = {}, {}, np.zeros((4, 5), int)
    for name, p, fault, begin, change in cases:
        scenarios = drawn(n, 25, np.float64)._replace(
            **change, gyro=faults(fault, n, who, begin), announced=np.zeros(n)
        )
        v = sweep(p, scenarios, 26)
        when, which = v.filter.caught.min(1), v.filter.caught.argmin(1)
        found = np.isfinite(when) & (when >= begin)
        right = found & (which == who)
        also = float(np.mean(np.isfinite(v.filter.caught).sum(1) > 1))
        low, high = interval(int(right.sum()), n)
        shares[name], delays[name] = (right.mean(), low, high), (when - begin)[right]
        late = "none"
        if right.any():
            late = f"{quantile(delays[name], 0.5)} s, 95 % below {quantile(delays[name], 0.95)} s"
        end = v.final_error.max() / DEG
        report.note(f"{name}: isolated {right.sum()} of {n} ({low:.3f} to {high:.3f}), delay {late}")
        report.note(f"  a healthy gyro dropped too: {also:.3f}; largest pointing error at 400 s {end:.1e} deg")
        # one number does not tell whose: the smallest jump that explains it is always one of D
        seen = np.isfinite(v.filter.parity) & (v.filter.parity >= begin)
        guess = seen & (who == 3)
        report.note(f"  parity alone: seen {seen.mean():.3f}; isolated {guess.mean():.3f} by naming D, chance 0.25")
        if name in ("jump 30 sigma", "jump 350 sigma", "dead, no bias, slew"):
            report.within(f"share isolated, {name}", 0.95, None, right.mean(), "required")
        if name == "jump 3 sigma":
            np.add.at(confusion, (who, np.where(found, which, 4)), 1)
    report.note("confusion at 3 sigma, rows the gyro at fault A-D, columns the gyro dropped A-D and none:")
    for row in confusion:
        report.note("  " + " ".join(f"{a:5d}" for a in row))
    fig, (left, right) = plt.subplots(1, 2, figsize=(13, 4.4))
    names = list(shares)
    middle, low, high = (np.array([shares[k][j] for k in names]) for j in range(3))
    bars = [np.maximum(middle - low, 0), np.maximum(high - middle, 0)]
    left.barh(names, middle, xerr=bars, color=COLOURS[0], ecolor="0.3", capsize=3)
    left.axvline(0.25, color=COLOURS[1], ls="--", label="chance")
    left.set(xlabel="share isolated [1], 95 % interval", xlim=(0, 1.05))
    left.invert_yaxis()
    left.legend(loc="lower right")
    shown = [k for k in names if len(delays[k]) > n / 2]
    right.boxplot([delays[k] for k in shown], orientation="horizontal", tick_labels=shown, whis=(0, 100),
                  medianprops=dict(color=COLOURS[1]))  # fmt: skip
    right.invert_yaxis()
    right.set(xlabel="delay from fault to drop [s]; whiskers to the extremes", xlim=(0, None))
    fig.suptitle(f"faults of one gyro that nobody announces, {n} runs each")
    fig.tight_layout()
    report.figure("reconfiguration", fig)


def faults(fault: Fault, n: int, who: Any = -1, onset: Any = 0.0) -> Fault:
    """The fault on gyro who (n,) from onset (n,) on, none on the others; by default none at all."""

    def one(who, onset):
        here = fault._replace(onset=jnp.where(jnp.arange(4) == who, onset, jnp.inf))
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (4,)), here)

    return jax.vmap(one)(np.broadcast_to(who, n), np.broadcast_to(onset, n))


# figures


def lines3(ax, t, values, names) -> None:
    """One line per component of values (k, ticks)."""
    for look, name, v in zip(LOOKS, names, values):
        ax.plot(t, v, lw=1.3, label=name, **look)
    ax.grid(alpha=0.3)


def label(axes, y: str, x: str = "time [s]") -> None:
    """Axis labels at the rim of a grid of axes, a legend in its first."""
    for ax in axes[:, 0]:
        ax.set_ylabel(y)
    for ax in axes[-1]:
        ax.set_xlabel(x)
    axes[0, 0].legend()


def states(x) -> list:
    """(title, names, values (k, ticks)) of the four panels of a state (ticks, 17)."""
    return [
        ("angle [deg]", "xyz", x[:, ANGLE].T / DEG),
        ("body rate [deg/s]", "xyz", x[:, RATE].T / DEG),
        ("wheel momentum [in-lbf-s]", "1234", x[:, WHEEL].T),
        ("gyro bias [deg/s]", "ABCD", x[:, BIAS].T / DEG),
    ]


def estimation_figure(report, t, error) -> None:
    """Figures 4-7: estimation errors, Table 4."""
    fig, axes = plt.subplots(2, 2, figsize=(11, 6.4), sharex=True)
    limits = ((-0.01, 0.01), (-2e-3, 3e-3), (-2, 2), (-1.5e-2, 1.5e-2))
    for ax, (title, names, values), limit, number in zip(axes.flat, states(error), limits, (4, 5, 6, 7)):
        lines3(ax, t[:801], values[:, :801], names)
        ax.set(title=f"fig. {number}: truth less estimate", ylabel=title, ylim=limit)
        ax.legend(loc="upper right")
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    fig.tight_layout()
    report.figure("fig04_07_estimation_errors", fig)


def filter_figure(report, name: str, t, runs: dict) -> None:
    """Estimates of a few runs: a row per state, a column per run."""
    fig, axes = plt.subplots(
        4, len(runs), figsize=(max(5 * len(runs), 7), 10), sharex=True, sharey="row", squeeze=False
    )
    for column, (title, x) in enumerate(runs.items()):
        for row, (what, names, values) in enumerate(states(x)):
            ax = axes[row, column]
            lines3(ax, t[::8], values[:, ::8], names)
            if column == len(runs) - 1:
                low, high = ax.get_ylim()
                ax.set_ylim(low, high + 0.25 * (high - low))  # room for the legend
            if column == 0:
                ax.set_ylabel(what)
                ax.legend(loc="upper right", ncols=4, fontsize=8)
        axes[0, column].set_title(title)
        axes[-1, column].set_xlabel("time [s]")
    fig.suptitle("estimates of the filter")
    fig.tight_layout()
    report.figure(name, fig)


def table_figure(report, angle, t) -> None:
    """The sixteen subsets: growth rates without the filter (positive ones diverge), settling with it."""
    how = {"dead gyro reads zero": ZERO, "dead gyro left out": PINV}
    growth = {name: np.array(rates) * 1e-3 for name, rates in how.items()}
    settling = [settled(t, angle[:, i]) for i in range(16)]
    axes = plot.subsets(mask(*SUBSETS), {"growth, no filter [1e-3/s]": growth, "settling, filter [s]": settling})
    plt.setp(axes[1].patches, color=COLOURS[2])  # the colours of the loops without a filter are above
    report.figure("sixteen_subsets", axes[0].figure)
