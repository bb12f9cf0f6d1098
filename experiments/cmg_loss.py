"""Jin & Leeghim (2021): singularities and rate stabilisation after the loss of a control moment gyro."""

from __future__ import annotations

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

from experiments.report import Report, interval
from jaxatt import plot, simulate, sweep, varied
from jaxatt import singularity as sg
from jaxatt.cmg import Steering, cmg_triads, modules
from jaxatt.loops import cmg_loss as cmg
from jaxatt.plot import COLOURS, LINES, MARKS
from jaxatt.torque_matrix import condition
from jaxatt.vec import Vec3, array

KEY = jax.random.key(0)
PAPER, REFERENCE = "Jin & Leeghim (2021)", "reference"
FOUR = {"pyramid": cmg.PYRAMID, "box-90": cmg.BOX}
THREE = {name: modules(axes, [0, 1, 2]) for name, axes in FOUR.items()}
NAMES = np.array(["proper", "lock", "fluctuation"])
CASES = [  # structure, gamma(0) [deg], class of the paper (text and Table 5), class at the printed K_I (docs/loops/cmg_loss.md)
    ("pyramid", (45, 45, 45, 45), 0, 0),
    ("pyramid", (10, 55, 45, -10), 0, 0),
    ("pyramid", (90, 0, -90, 0), 1, None),
    ("pyramid", (90, 0, -90, 5), 0, 0),
    ("pyramid", (-90, 90, 90, 95), 2, 2),
    ("pyramid", (-95, 90, 85, 95), 0, 2),
    ("box-90", (45, 45, 45, 45), 0, 0),
    ("box-90", (10, 55, 45, -10), 0, 2),
    ("box-90", (90, 0, -90, 5), 2, 2),
    ("box-90", (-90, 90, 90, 95), 2, 2),
    ("box-90", (95, -5, -85, 5), 0, 0),
    ("box-90", (-95, 90, 85, 95), 0, 2),
]
PRESETS = {"K_I = 0.02": cmg.params, "K_I = 0": cmg.table5}
TICKS = 6001  # 60 s
LOOKS = tuple(zip(NAMES, (COLOURS[2], COLOURS[3], COLOURS[1]), ("", "///", "xxx")))  # of the classes in bars


def run(report: Report) -> None:
    table_3(report)
    geometry(report)
    table_5(report)
    ties(report)
    monte_carlo(report)
    surfaces(report)
    histories(report)


def stacked(trees):
    """Scenarios of one batch, every leaf (n, ...)."""
    return jax.tree.map(lambda *a: np.stack(np.broadcast_arrays(*a)), *trees)


def lost(case):
    return cmg.lost(FOUR[case[0]], case[1])


def informed(params, scenario):
    """Params and scenario, the computer knowing how the modules are mounted."""
    return params._replace(axes=scenario.axes), scenario


def swept(params, scenarios, system=cmg.system):
    """Scores of scenarios (n, ...) of both structures over `TICKS`."""
    pairs = jax.vmap(lambda scenario: informed(params, scenario))(scenarios)
    return sweep(varied(system), (), pairs, KEY, ticks=TICKS, score=varied(cmg.score), progress=False)


# sections 3.1, 3.2


def table_3(report: Report) -> None:
    """Table 3, and what its fraction is not."""
    printed = {
        5: (0.0246, 0.0609, 2.476), 3: (0.0237, 0.0447, 1.886), 2: (0.0235, 0.0394, 1.677),
        1: (0.0237, 0.0463, 1.954), 0.5: (0.0236, 0.0438, 1.856),
    }  # fmt: skip
    counts = {5: (9168, 22720), 3: (40976, 77312), 2: (137152, 229744), 1: (1104912, 2161632), 0.5: (8808256, 16346560)}
    for step, (*fractions, ratio) in printed.items():
        found = [sg.ill_conditioned(axes, round(360 / step)) for axes in THREE.values()]
        rounded = [round(count / of, 4) for count, of in found]
        report.check(f"Table 3, {step} deg: fractions", fractions, rounded, 1e-9, f"{PAPER}, Table 3")
        report.check(f"Table 3, {step} deg: counts", list(counts[step]), [c for c, _ in found], 0, REFERENCE)
        as_printed = rounded[1] / rounded[0]  # the paper divides rounded fractions
        report.check(f"Table 3, {step} deg: ratio as printed", ratio, as_printed, 5.1e-4, f"{PAPER}, Table 3")
    thresholds = np.array([10, 30, 100, 300, 1000])
    points = 359 if report.quick else 719
    shares = {name: np.divide(*sg.ill_conditioned(axes, points, thresholds)) for name, axes in THREE.items()}
    fig, ax = plt.subplots(figsize=(6, 4))
    for (name, share), colour, mark, line in zip(shares.items(), COLOURS, MARKS, LINES):
        ax.loglog(thresholds, share, mark, ls=line, color=colour, label=name)
    for k, a, b in zip(thresholds, shares["pyramid"], shares["box-90"]):
        ax.annotate(f"ratio {b / a:.2f}", (k, b), textcoords="offset points", xytext=(5, 6))
    ax.set(
        xlabel="threshold on the condition number [1]",
        ylabel="share of gimbal angles above it [1]",
        xlim=(7, 4000),
        ylim=(1.5e-3, 0.6),
    )
    ax.set_title("The ratio of Table 3 grows with the threshold")
    ax.legend()
    ax.grid(alpha=0.3)
    report.figure("fraction_over_threshold", fig)


def geometry(report: Report) -> None:
    """Area of the singular set, envelope, clearance, passability; Table 2 in numbers."""
    area = {name: sg.singular_area(axes) for name, axes in THREE.items()}
    report.check("area of the singular set, box-90 [(2 pi)^2]", 2 + 2 * 2**0.5, area["box-90"], 1e-6, REFERENCE)
    report.check("area of the singular set, pyramid [(2 pi)^2]", 3.89, area["pyramid"], 0.01, REFERENCE)
    ratio = area["box-90"] / area["pyramid"]
    report.note(f"true area ratio box-90 / pyramid {ratio:.3f}; the paper infers 1.8 from Table 3")

    free = {name: sg.clearance(axes, np.zeros(3)) for name, axes in THREE.items()}
    report.check("ball free of singularities, 3 modules, box-90", 1, free["box-90"], 1e-6, REFERENCE)
    report.check("ball free of singularities, 3 modules, pyramid", 0.15419, free["pyramid"], 1e-4, REFERENCE)
    axis = {"pyramid": [2.15572, 2.30991, 2.37880], "box-90": [1, 3**0.5, 3]}
    for name, axes in THREE.items():
        reach = np.asarray(sg.reach(axes, Vec3(*np.eye(3))))
        report.check(f"reach along x, y, z, 3 modules, {name}", axis[name], reach, 1e-5, REFERENCE)
    envelopes = {
        (name, n): sg.envelope(axes, 400) for n, group in ((4, FOUR), (3, THREE)) for name, axes in group.items()
    }
    shrunk = envelopes["pyramid", 4].inscribed / envelopes["pyramid", 3].inscribed
    report.check("pyramid, inscribed radius 4 / 3 modules", 1.607, shrunk, 0.01, f"{PAPER}, 1.2: 1.6 times")
    for (name, n), e in envelopes.items():
        report.note(
            f"envelope, {name}, {n} modules: inscribed {e.inscribed:.4f}, volume {e.volume:.3f}, largest {e.largest:.4f}"
        )
    q = np.abs(sg.passability(FOUR["pyramid"], np.radians([90, 0, -90, 0])))
    report.check("null-space form at [90, 0, -90, 0]: impassable", [0.144655, 0.577858], q, 1e-6, f"{PAPER}, 3.4.3")

    turn = np.radians(np.arange(0, 361, 1.0))
    cuts = (("x", "y", lambda c, s, o: Vec3(c, s, o)), ("x", "z", lambda c, s, o: Vec3(c, o, s)))
    fig, axs = plt.subplots(2, 2, figsize=(9, 9), sharex=True, sharey=True)
    for row, name in zip(axs, FOUR):
        for ax, (a, b, plane) in zip(row, cuts):
            d = plane(np.cos(turn), np.sin(turn), 0 * turn)
            for group, n, colour, dash in ((FOUR, 4, COLOURS[0], "-"), (THREE, 3, COLOURS[1], "--")):
                far = np.asarray(sg.reach(group[name], d))
                ax.plot(far * np.cos(turn), far * np.sin(turn), dash, color=colour, label=f"{n} modules")
            ax.add_patch(
                Circle((0, 0), free[name], color=COLOURS[2], alpha=0.4, label="ball without singularities, 3 modules")
            )
            ax.set(xlabel=f"$h_{a}$ [$h_w$]", ylabel=f"$h_{b}$ [$h_w$]", aspect="equal", title=f"{name}, {a}-{b} plane")
            ax.grid(alpha=0.3)
    axs[1, 0].legend(loc="lower center", fontsize=8)
    fig.tight_layout()
    report.figure("envelope_cuts", fig)


def surfaces(report: Report) -> None:
    """Figures 3, 4, 13-16: singular surfaces; figure 5: singular gimbal angles."""
    for name in FOUR:
        fig = plt.figure(figsize=(12, 9))
        panels = [(FOUR, 4, (1, 1, 1, 1)), (FOUR, 4, (1, 1, 1, -1)), (FOUR, 4, (1, 1, -1, -1))]
        panels += [(THREE, 3, (1, 1, 1)), (THREE, 3, (1, 1, -1))]
        for i, (group, n, example) in enumerate(panels):
            ax = fig.add_subplot(2, 3, i + 1, projection="3d")
            minus = example.count(-1)
            plot.singular_surface(group[name], minus, ax, fine=40 if report.quick else 80)
            kind = "external" if minus == 0 else f"internal, {minus} of {n} reversed"
            ax.set(xlim=(-4, 4), ylim=(-4, 4), zlim=(-4, 4), title=f"{n} modules, {kind}")  # one scale for all
        fig.suptitle(f"Singular momenta, {name}; circles and discs: gimbal axis along the singular direction")
        fig.tight_layout(w_pad=3, h_pad=4)
        report.figure(f"figures_3_4_13_16_{name}", fig)

    grid = np.radians(3.0) * np.arange(120)
    fig = plt.figure(figsize=(11, 5))
    for i, (name, axes) in enumerate(THREE.items()):
        points = np.stack(np.meshgrid(grid, grid, grid, indexing="ij")).reshape(3, -1)
        at = jax.tree.map(lambda a: a[:, None], axes)
        kappa = np.asarray(jax.jit(lambda g, at=at: condition(cmg_triads(at, g).t))(points))
        shown = np.degrees(points[:, kappa >= 100])
        ax = fig.add_subplot(1, 2, i + 1, projection="3d")
        ax.scatter(*shown, s=1, linewidths=0, c=shown[2], cmap=plot.MAP, rasterized=True)
        ax.set(xlabel="$\\gamma_1$ [deg]", ylabel="$\\gamma_2$ [deg]", zlabel="$\\gamma_3$ [deg]")
        # Room for the label of the vertical axis. The stubs know whole zooms only.
        ax.set_box_aspect(None, zoom=0.88)  # pyright: ignore[reportArgumentType]
        ax.set_title(f"{name}: condition $\\geq$ 100, {shown.shape[1]} of 120$^3$")
    fig.tight_layout(w_pad=4)
    report.figure("figure_5_singular_angles", fig)


# section 3.4


def table_5(report: Report) -> None:
    """Table 5: the twelve starts, exactly and moved by 1e-13 rad, in one batch for each K_I."""
    rng = np.random.default_rng(0)
    moved = [
        lost(case)._replace(gamma=np.radians(case[1]) + (1e-13 * rng.normal(size=4) if k else 0))
        for k in range(10)
        for case in CASES
    ]
    for preset, params in PRESETS.items():
        got = swept(params, stacked(moved))
        classes = cmg.classify(got).reshape(10, -1)
        expected = [case[2] if params is cmg.table5 else case[3] for case in CASES]
        source = f"{PAPER}, Table 5" if params is cmg.table5 else REFERENCE
        for i, case in enumerate(CASES):
            name = f"{preset}: {case[0]} {list(case[1])}"
            held = np.mean(classes[1:, i] == classes[0, i])
            if expected[i] is None:
                report.note(f"{name}: {NAMES[classes[0, i]]}; rounding decides (docs/loops/cmg_loss.md)")
            else:
                report.check(f"{name}: {NAMES[expected[i]]}", expected[i], int(classes[0, i]), 0, source)
                if (case[1], params is cmg.table5) not in (((90, 0, -90, 0), True), ((-90, 90, 90, 95), True)) or (
                    case[0] == "box-90"
                ):
                    report.check(f"{name}: class kept at 1e-13 rad", 1, held, 0, REFERENCE)
            report.note(f"    variation {got.variation[i]:.4g} rad/s, settling {got.settling[i]:.4g} s")
    delicate = [((90, 0, -90, 0), "K_I = 0.02"), ((90, 0, -90, 0), "K_I = 0"), ((-90, 90, 90, 95), "K_I = 0")]
    for gamma, preset in delicate:
        batch = [cmg.lost(cmg.PYRAMID, np.array(gamma) + np.degrees(1e-13 * rng.normal(size=4))) for _ in range(100)]
        got = swept(PRESETS[preset], stacked(batch))
        shares = np.bincount(cmg.classify(got), minlength=3)
        words = ", ".join(f"{name} {share}" for name, share in zip(NAMES, shares))
        report.note(f"pyramid {list(gamma)}, {preset}, 100 starts within 1e-13 rad: {words}")


def by_simulation(structure: str, gamma_4: float, params, gamma):
    """Variation of the gimbal rates of a run from each of the angles gamma (k, 3) [rad]: a rank for `rearrange`."""
    batch = [cmg.lost(FOUR[structure], [*np.degrees(g), gamma_4]) for g in gamma]
    return swept(params, stacked(batch), cmg.system._replace(substeps=5)).variation


def ties(report: Report) -> None:
    """Rearrangement within 5 deg: all ties, ranked by simulation."""
    starts = [
        ("pyramid", (-90, 90, 90), 95, 14.04089566, 2), ("box-90", (90, 0, -90), 5, 132.13018304, 4),
        ("box-90", (-90, 90, 90), 95, 11.43005230, 2),
    ]  # fmt: skip
    for name, start, gamma_4, kappa, number in starts:
        ranks = {}

        def rank(gamma, name=name, gamma_4=gamma_4, ranks=ranks):
            values = by_simulation(name, gamma_4, cmg.table5, gamma)
            ranks.update(zip(map(tuple, gamma), values))
            return values

        found = sg.rearrange(THREE[name], np.radians(start), rank=rank)
        head = f"rearranged {name} {list(start)}"
        report.relative(f"{head}: condition", kappa, found.condition[0], 1e-8, REFERENCE)
        report.check(f"{head}: number of ties", number, len(found.gamma), 0, REFERENCE)
        for gamma in found.gamma:
            degrees, variation = np.degrees(gamma).round().astype(int).tolist(), ranks[tuple(gamma)]
            report.note(f"    {degrees}: variation {variation:.4g} rad/s at K_I = 0")
        ends = sg.rearrange_by_gradient(THREE[name], np.radians(start))
        report.within(f"{head}: condition by gradient", 1, kappa * (1 + 1e-6), ends.condition, REFERENCE)


def rearranged(structure: str, lost_module: int, gamma):
    """The gimbal angles (4, m) [rad] of least condition within a 5 deg grid step of gamma, the lost module left."""
    healthy = [i for i in range(4) if i != lost_module]
    axes = jax.tree.map(lambda a: a[:, None, None], modules(FOUR[structure], healthy))
    steps = np.radians(5) * np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij")).reshape(3, 27, 1)
    options = gamma[healthy][:, None] + steps
    kappa = np.asarray(condition(cmg_triads(axes, options).t))
    best = gamma.copy()
    best[healthy] = np.take_along_axis(options, kappa.argmin(0)[None, None], axis=1)[:, 0]
    return best, kappa[13], kappa.min(0)


def monte_carlo(report: Report) -> None:
    """Shares of the classes over gimbal starts, lost module, structure and steering law; does rearranging help?"""
    n = 256 if report.quick else 2048
    rng = np.random.default_rng(1)
    scenarios, better, close = [], [], []
    for name, axes in FOUR.items():
        for module in range(4):
            gamma = rng.uniform(0, 2 * np.pi, (4, 40 * n))
            best, kappa, _ = rearranged(name, module, gamma)
            wanted = n // 16
            pick = np.concatenate([np.arange(wanted), wanted + np.flatnonzero(kappa[wanted:] >= 50)[:wanted]])
            close.append(np.repeat([False, True], wanted))
            day = cmg.lost(axes, np.zeros(4), module=module)
            for angles, batches in ((gamma, scenarios), (best, better)):
                batches.append(jax.vmap(lambda g, day=day: day._replace(gamma=g))(angles[:, pick].T))
    close = np.concatenate(close)
    box = np.arange(len(close)) >= len(close) // 2
    joined = lambda batches: jax.tree.map(lambda *a: np.concatenate(a), *batches)
    batches = {"as drawn": joined(scenarios), "rearranged": joined(better)}
    laws = {
        "pseudo-inverse": Steering(),
        "robust": Steering(lam0=0.01),
        "robust, dither": Steering(lam0=0.01, dither=0.1),
    }
    system = cmg.system._replace(substeps=1)
    classes = {}
    for law, steering in laws.items():
        params = cmg.table5._replace(steering=steering)
        for how, batch in batches.items():
            got = swept(params, batch, system)
            report.within(f"Monte Carlo, {law}, {how}: finite runs", 1, 1, np.mean(got.ok), REFERENCE)
            classes[law, how] = cmg.classify(got)
    report.note(f"{len(close) * len(classes)} runs, K_I = 0, 10 ms plant step; 95 % intervals")
    groups = {
        "pyramid, any start": ~box & ~close, "box-90, any start": box & ~close,
        "pyramid, condition >= 50": ~box & close, "box-90, condition >= 50": box & close,
    }  # fmt: skip
    fig, axs = plt.subplots(2, 2, figsize=(11, 7), sharey=True)
    for ax, (group, inside) in zip(axs.flat, groups.items()):
        labels, total = [], int(inside.sum())
        for x, ((law, how), cls) in enumerate(classes.items()):
            shares = [int((cls[inside] == k).sum()) for k in range(3)]
            words = []
            bottom = 0.0
            for share, (name, colour, hatch) in zip(np.array(shares) / total, LOOKS):
                low, high = interval(round(share * total), total)
                words.append(f"{name} {share:.3f} ({low:.3f} to {high:.3f})")
                ax.bar(x, share, bottom=bottom, color=colour, hatch=hatch, edgecolor="white", label=name)
                bottom += share
            report.note(f"{group}, {law}, {how}: {', '.join(words)}")
            labels.append(f"{law}\n{how}")
        ax.set_xticks(range(len(labels)), labels, fontsize=7, rotation=30)
        ax.set(title=f"{group} ({total} starts)", ylabel="share of runs [1]")
    handles, names = axs[0, 0].get_legend_handles_labels()
    fig.legend(handles[:3], names[:3], loc="upper center", ncols=3)
    fig.tight_layout(rect=(0, 0, 1, 0.95))
    report.figure("monte_carlo", fig)
    if not report.quick:
        fine = cmg.classify(swept(cmg.table5, jax.tree.map(lambda a: a[::8], batches["as drawn"])))
        coarse = classes["pseudo-inverse", "as drawn"][::8]
        shares = [[np.mean(c == k) for k in range(3)] for c in (fine, coarse)]
        # two standard deviations of a share of 256 runs: 0.0625
        report.check("Monte Carlo: shares at 10 ms equal those at 1 ms", shares[0], shares[1], 0.0625, REFERENCE)


def histories(report: Report) -> None:
    """Figures 7-12 as the paper draws them, for both K_I."""
    figures = {"7": 0, "8": 2, "9": 3, "10": 4, "11a": 8, "11b": 9, "12a": 5, "12b": 10, "12c": 11}
    order = list(figures.values())
    batch = stacked([lost(CASES[i]) for i in order])
    keys = jax.random.split(KEY, len(order))
    logs = {}
    for preset, params in PRESETS.items():
        run = lambda s, key, params=params: simulate(cmg.system, *informed(params, s), key, ticks=TICKS, every=5)
        logs[preset] = jax.tree.map(np.asarray, jax.vmap(run)(batch, keys))
    peaks = {"K_I = 0.02": (52.18, 4.7, 30.4), "K_I = 0": (31.56, 6.3, 14.6)}
    for preset, log in logs.items():
        t, kappa, w = log.t[0], log.condition[0, ::2], np.linalg.norm(array(log.w), axis=0)[0]
        height, at, settling = peaks[preset]
        report.check(f"figure 7, {preset}: peak condition", height, kappa.max(), 0.05, REFERENCE)
        report.check(f"figure 7, {preset}: its time [s]", at, 0.1 * kappa.argmax(), 0.1, REFERENCE)
        last = t[np.flatnonzero(w > 0.05 * w[0])[-1]]
        report.check(f"figure 7, {preset}: 5 % settling [s]", settling, last, 0.1, REFERENCE)
    for i, number in enumerate(figures):
        name, gamma, *_ = CASES[order[i]]
        start = f"{name}, $\\gamma(0)$ = {list(gamma)} deg"
        history(report, number, start, {preset: jax.tree.map(lambda a, i=i: a[i], log) for preset, log in logs.items()})


def history(report: Report, number: str, start: str, logs: dict) -> None:
    """One figure: body rate, gimbal angles and rates, and condition over time, a column for each K_I."""
    fig, axs = plt.subplots(4, 2, figsize=(11, 9), sharex=True, sharey="row")
    for column, (preset, log) in zip(axs.T, logs.items()):
        for i, look in enumerate(dict(color=c, ls=line) for c, line in zip(COLOURS[:3], LINES)):
            column[0].plot(log.t, log.w[i], label=f"$w_{'xyz'[i]}$", **look)
            column[1].plot(log.t, np.degrees(log.gamma[:, i]), label=f"module {i + 1}", **look)
            column[2].plot(log.t, log.rate[:, i], linewidth=0.7, **look)
        column[3].semilogy(log.t, np.minimum(log.condition, 1e6), color=COLOURS[3], linewidth=0.8)
        column[0].set_title(f"${preset}$ 1/s$^2$")
        column[3].set(xlabel="time [s]", ylim=(1, 2e6))
    words = ("body rate [rad/s]", "gimbal angle [deg]", "gimbal rate [rad/s]", "condition, cut at $10^6$ [1]")
    for ax, word in zip(axs[:, 0], words):
        ax.set_ylabel(word)
    for ax in axs[:2, 1]:  # the gimbal rates have the colours of the angles
        ax.legend(ncols=3, fontsize=8)
    for ax in axs.flat:
        ax.grid(alpha=0.3)
    fig.suptitle(f"Figure {number}: {start}, module 4 lost")
    fig.tight_layout()
    report.figure(f"figure_{number}", fig)
