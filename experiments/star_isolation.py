"""Star-sensor isolation with LMMSE filters (Yuan, He, Xing & Xiong): figures 2 to 5, what the filters can and cannot.

The paper gives no numbers of its own that survive; references are those of an independent implementation (reference).
"""

from __future__ import annotations

import resource
import time
import warnings
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.report import Report, interval, plt
from jaxatt import Fault, Quat, Reading, Vec3, detection, evaluation, plot, scores, simulate, soft_scores, sweep, tune
from jaxatt.attitude import quat_to_body
from jaxatt.loops.star_isolation import (
    ARCSEC,
    DEG,
    DT,
    HEALTHY,
    PITCH,
    ROLL,
    Scenario,
    decide,
    init,
    on_sensor,
    params,
    scenario,
    score,
    system,
    system_of,
    tangential,
)
from jaxatt.replay import replay
from jaxatt.star_filters import (
    LMMSE,
    MEKF,
    WITH_BIAS,
    diagonal,
    lmmse_predict,
    lmmse_start,
    lmmse_update,
    orbit_rate,
    quaternion_error,
    quaternion_step,
    star_map,
)

NAMES = ("roll star", "pitch star")
GREY = plot.GREY
COLOUR, LINE = dict(enumerate(plot.COLOURS[:2])), dict(enumerate(plot.LINES[:2]))  # by star sensor, in every figure
ONSET, END = 1000, 3000  # [ticks] fault at 100 s, run of 300 s
SECOND = round(1 / DT)  # [ticks]
STD = params.std_star
healthy = scenario._replace(star=HEALTHY)


def run(report: Report) -> None:
    """All of it; report.quick shrinks Monte Carlo sizes only."""
    figures_2_to_5(report)
    response(report)
    consistency(report)
    detection_table(report)
    limits(report)
    options(report)
    multiplicative_noise(report)
    observability(report)
    identification(report)
    tuning(report)
    campaign(report)


# scenarios


def drawn(n: int, seed: int, one: Scenario = healthy) -> Scenario:
    """n scenarios whose initial estimates err as the prior says, but for the scalar part, which is the true one."""
    errors = params.std_qv * np.random.default_rng(seed).standard_normal((3, 2, n))
    guess = lambda e: Quat(jnp.broadcast_to(one.q.w, 2), *(a + b for a, b in zip(one.q.v, e)))
    return jax.vmap(lambda e: one._replace(q_hat=guess(e)))(np.moveaxis(errors, -1, 0))


def equal(tree, n: int):
    """n times the same, every leaf (n, ...)."""
    return jax.vmap(lambda _: tree)(np.arange(n))


def evaluated(scenarios: Scenario, seed: int, ticks: int = END):
    """r' M^-1 r of every tick, shape (ticks, n, 2): nothing else is kept."""
    keys = jax.random.split(jax.random.key(seed), len(scenarios.std_star))
    return np.asarray(_evaluated(ticks, scenarios, keys))


@partial(jax.jit, static_argnums=0)
def _evaluated(ticks, scenarios, keys):
    one = lambda scenario, key: simulate(system, params, scenario, key, ticks=ticks).verdict.innovation.nis
    return jax.vmap(one, out_axes=1)(scenarios, keys)


def extended(p, s, now, log):
    """The system's scores and those that only this experiment asks for; one function, so that it compiles once."""
    nis = log.verdict.innovation.nis
    return dict(
        main=score(p, s, now, log),
        nees_q=scores.final(log.nees_q),
        settled_nis=scores.mean(nis, now.t >= 100),
        bias_error=jax.tree.map(lambda b, c: scores.final(b - c), log.bias, s.bias),
        angle=scores.mean(log.verdict.angle),
        rms=scores.rms(log.error @ log.error / 4),
    )


def swept(scenarios: Scenario, seed: int, loop=system, p=params, ticks: int = END):
    """The `extended` scores of scenarios."""
    return sweep(loop, p, scenarios, jax.random.key(seed), ticks=ticks, score=extended, progress=False)


def mean_interval(values) -> tuple[float, float]:
    """Mean and half width of its 95 % confidence interval."""
    values = np.asarray(values, float)
    return float(values.mean()), float(1.959964 * values.std(ddof=1) / np.sqrt(values.size))


# figures 2 to 5


def figures_2_to_5(report: Report) -> None:
    """A fault in one sensor raises its own filter's evaluation and leaves the other one alone."""
    constant, incipient = Fault(onset=100.0, bias=100 * ARCSEC), Fault(onset=100.0, drift=600 * ARCSEC, tau=50.0)
    cases = (
        (2, ROLL, "constant 100 arcsec", constant),
        (3, ROLL, "incipient 600 arcsec", incipient),
        (4, PITCH, "constant 100 arcsec", constant),
        (5, PITCH, "incipient 600 arcsec", incipient),
    )
    references = {2: (250, 19.7), 3: (279, 198), 4: (233, 25.6), 5: (360, 156)}
    t = DT * np.arange(END) - 100
    fig, axes = plt.subplots(2, 2, figsize=(11, 6.5), sharex=True, sharey=True, layout="constrained")
    for (number, own, kind, fault), ax in zip(cases, axes.T.flat):
        log = simulate(system, params, with_fault(own, fault), jax.random.key(1), ticks=END)
        J, alarms = np.asarray(log.verdict.J), np.asarray(log.verdict.alarm)
        peak, last = J[ONSET:, own].max(), t[alarms[:, own]].max()
        name = f"Fig. {number}: {NAMES[own]}, {kind}"
        report.check(f"{name}, other filter's alarms", 0, int(alarms[:, 1 - own].sum()), 0, "fig. 2 to 5; reference")
        report.within(f"{name}, own alarms", 1, None, int(alarms[ONSET:, own].sum()), "fig. 2 to 5; reference")
        if kind.startswith("constant"):
            report.check(f"{name}, first alarm [s]", 0.0, float(t[alarms[:, own]].min()), 1e-9, "fig. 2, 4; reference")
        report.check(f"{name}, latched cause", own + 1, int(log.verdict.latched_cause[-1]), 0, "eq. (20)")
        report.note(
            f"{name}: peak {peak:.0f} (reference {references[number][0]}), first alarm {t[alarms[:, own]].min():.1f} s, "
            f"last {last:.1f} s (reference {references[number][1]}); other filter at most {J[ONSET:, 1 - own].max():.1f}; "
            "one noise seed, so not comparable closer"
        )
        for i in (ROLL, PITCH):
            largest = J[:, i].reshape(-1, SECOND).max(axis=1)  # of each second: 3000 points would be a grey band
            ax.semilogy(t[::SECOND], largest, LINE[i], color=COLOUR[i], lw=1, label=f"filter of the {NAMES[i]}")
        ax.axhline(27, color="black", ls=":", lw=1.2, label="threshold 27 (n = 3)")
        ax.axvspan(0, 200, color=GREY, alpha=0.15, lw=0, label="fault on")
        ax.set(title=name, ylim=(1, 1e3), xlim=(-100, 200))
    for ax in axes[-1]:
        ax.set_xlabel("time after the fault [s]")
    for ax in axes[:, 0]:
        ax.set_ylabel("largest J = r' M$^{-1}$ r of each second [1]")
    fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    report.figure("figures_2_to_5", fig)

    n = 512
    lone = float(evaluation.chance(5.9e-6, END))  # a filter's own chance of an alarm in 300 s
    allowed = 3 * np.sqrt(lone * (1 - lone) / n) + 1 / n
    for number, own, kind, fault in cases:
        out = swept(drawn(n, number, with_fault(own, fault)), number)["main"]
        other = np.isfinite(out.delay[:, 1 - own]).mean()
        name = f"Fig. {number}, {n} runs"
        report.check(
            f"{name}: own filter alarms", 1.0, np.isfinite(out.delay[:, own]).mean(), 0.0, "fig. 2 to 5; reference"
        )
        report.check(f"{name}: other filter alarms in 200 s", lone * 2 / 3, other, allowed, "chance level; reference")
        if kind.startswith("constant"):
            report.check(
                f"{name}: first alarm, worst [s]", 0.0, out.delay[:, own].max(), 1e-9, "reference: at the first sample"
            )
    out = swept(drawn(n, 6, with_fault(ROLL, Fault(onset=100.0, growth=5.0))), 6)["main"]
    report.within(
        "noise of the roll star x 5: share of samples missed", 0, 0.7, out.miss[:, ROLL].mean(), "reference: stays"
    )
    report.check(
        "noise x 5: alarms last to the end, runs", 1.0, np.mean(out.alarm_end[:, ROLL] > 195), 0.0, "reference: stays"
    )
    bad = Vec3(Fault(onset=100.0, bias=0.01), Fault(), Fault(onset=100.0, scale=0.5))
    out = swept(drawn(n, 7, healthy._replace(actuator=bad)), 7)["main"]
    some = np.isfinite(out.delay).mean(axis=0)
    report.check(
        "actuator fault (0.01 N m roll, yaw halved): runs with an alarm",
        [lone * 2 / 3] * 2,
        some,
        allowed,
        "chance level; reference",
    )
    report.note(
        f"chance of an alarm in 200 s without a fault: {lone * 2 / 3:.4f} per filter; actuator fault {_list(some)}"
    )


def with_fault(sensor: int, fault: Fault) -> Scenario:
    """The paper's day with one star sensor's tangential axes faulty."""
    return scenario._replace(star=on_sensor(sensor, tangential(sensor, fault)))


# fault response


def response(report: Report) -> None:
    """What a fault alone does to the residual: the difference of two runs, and the linear error equations."""
    size = 100 * ARCSEC

    def residual_of(star):
        log = simulate(system, params, scenario._replace(star=star), jax.random.key(1), ticks=END)
        return np.stack([np.asarray(a) for a in log.verdict.innovation.value])

    reference = residual_of(HEALTHY)

    def difference(star, own):
        return (residual_of(star) - reference)[..., own]

    t = DT * np.arange(101)
    expected = {(ROLL, "y"): 12.28, (ROLL, "z"): 16.15, (PITCH, "x"): 16.03, (PITCH, "z"): 16.25}
    fig, ax = plt.subplots(figsize=(7, 4.2))
    for own in (ROLL, PITCH):
        r = difference(on_sensor(own, tangential(own, Fault(onset=100.0, bias=size))), own) / size
        for (sensor, axis), seconds in expected.items():
            if sensor == own:
                residual = r["xyz".index(axis), ONSET:]
                fitted = -1 / np.polyfit(t, np.log(residual[: len(t)]), 1)[0]
                report.relative(f"time constant of r, {NAMES[own]}, {axis} [s]", seconds, fitted, 0.02, "reference")
                style = plot.LINES["zxy".index(axis)]
                ax.plot(
                    DT * np.arange(len(residual)),
                    residual,
                    style,
                    color=COLOUR[own],
                    label=f"{NAMES[own]}, {axis} axis",
                )
        if own == ROLL:
            report.check("r_y / f of the roll star 200 s on", -0.058, r[1, -1], 1e-3, "reference: not settled")
    ax.set(xlabel="time after a constant fault [s]", ylabel="residual / fault [1]", xlim=(0, 200))
    ax.axhline(0, color=GREY, lw=0.8, zorder=0)
    ax.legend()
    report.figure("response", fig)

    peaks = {10.0: (0.4602, 0.4126), 50.0: (0.1890, 0.1549), 200.0: (0.0650, 0.0492)}
    for tau, (along_z, along_y) in peaks.items():
        star = on_sensor(ROLL, tangential(ROLL, Fault(onset=100.0, drift=size, tau=tau)))
        r = difference(star, ROLL).max(axis=1) / size
        report.relative(
            f"peak r_z, r_y of an incipient fault, T = {tau:g} s", [along_z, along_y], r[[2, 1]], 0.02, "reference"
        )


# consistency


def consistency(report: Report) -> None:
    """Do the filters know how well they know? Monte Carlo without faults."""
    n = 600
    p = params._replace(threshold=float(detection.threshold_moment(3, 3)))
    result = swept(drawn(n, 0), 5, p=p)
    out = result["main"]
    band = 1.959964 * np.sqrt(6 / n)
    for i, name in enumerate(NAMES):
        nis, half = mean_interval(out.nis[:, i])
        report.check(f"NIS, {name} ({n} runs, +-{half:.4f})", 3.0, nis, 0.01, "reference")
        nees, half = mean_interval(out.nees[:, i])
        report.check(f"3-state NEES at 300 s, {name} (+-{half:.2f})", 3.0, nees, band, "reference: 95 % band")
    rate, half = mean_interval(out.false_alarms.mean(axis=1))
    report.relative(f"false alarms per sample at 10.35 (+-{half:.1e})", 1.58e-2, rate, 0.05, "reference")
    report.check("scenarios that stayed finite", n, int(out.ok.sum()), 0, "all of them")

    low, high = 4 - 1.96 * np.sqrt(8 / n), 4 + 1.96 * np.sqrt(8 / n)
    report.note(
        f"4-state NEES at 300 s: {_list(result['nees_q'].mean(axis=0))} (reference 3.67, 3.60; its own band {low:.2f} to "
        f"{high:.2f}): P is conservative on q0, of which no initial error is drawn here"
    )
    more = 4 * n
    with_q0 = drawn(more, 0)
    scalar = params.std_q0 * np.random.default_rng(1).standard_normal((2, more)).T
    with_q0 = with_q0._replace(q_hat=with_q0.q_hat._replace(w=with_q0.q_hat.w + scalar))
    for i, name in enumerate(NAMES):
        nees, half = mean_interval(swept(with_q0, 5)["nees_q"][:, i])
        report.note(f"4-state NEES with an initial q0 error drawn, {name} ({more} runs): {nees:.2f} +- {half:.2f}")

    unit = swept(drawn(n, 2), 6, p=params._replace(unit=1.0, threshold=18.0))["main"]
    report.check(f"NIS of unit-normalised stars ({n} runs)", [2.0, 2.0], unit.nis.mean(axis=0), 0.01, "reference")


# detection


def detection_table(report: Report) -> None:
    """How often a constant fault is seen within 10 s, beside the chance level; ROC curves over windows."""
    n, window = (400 if report.quick else 1600), slice(ONSET, ONSET + 100)
    sizes = (0, 2, 3, 4, 5)  # [std of the star sensor] in all, shared by the two tangential axes
    evaluations = {}
    for b in sizes:
        star = on_sensor(ROLL, tangential(ROLL, Fault(onset=100.0, bias=b * STD / np.sqrt(2))))
        evaluations[b] = evaluated(drawn(n, 10 + b, healthy._replace(star=star)), 20 + b, ONSET + 100)[..., ROLL]
    rules = (
        ("nsigma 3, N = 1", 1, detection.threshold_nsigma(3, 3), (0.0, 0.037, 0.427, 0.970, 1.0)),
        ("moment 5, N = 1", 1, detection.threshold_moment(5, 3), (0.172, 0.922, 1.0, 1.0, 1.0)),
        ("moment 5, N = 10", 10, detection.threshold_moment(5, 30), (0.005, 0.935, 1.0, 1.0, 1.0)),
    )
    for name, length, threshold, expected in rules:
        seen_in_time = []
        for b in sizes:
            J = np.asarray(detection.windowed(evaluations[b], length))[window]
            seen_in_time.append(float(detection.alarm(J, float(threshold)).any(axis=0).mean()))
        share = (400 * np.array(expected) + n * np.array(seen_in_time) + 1) / (400 + n + 2)
        allowed = (3 * np.sqrt(share * (1 - share) * (1 / 400 + 1 / n))).tolist()
        report.check(
            f"seen in 10 s, {name}, b = 0, 2, 3, 4, 5 std ({n} runs)", expected, seen_in_time, allowed, "reference"
        )
        low, high = zip(*(interval(round(p * n), n) for p in seen_in_time))
        report.note(
            f"{name}: "
            + ", ".join(f"{p:.3f} [{a:.3f}, {b:.3f}]" for p, a, b in zip(seen_in_time, low, high))
            + " (95 %)"
        )

    fig, (ax, ax_delay) = plt.subplots(1, 2, figsize=(11, 4.4))
    reference = {1: 0.28, 5: 0.80, 10: 0.955, 50: 1.0}
    curves: dict[str, evaluation.Roc] = {}
    for (length, expected), line, colour in zip(reference.items(), plot.LINES, plot.COLOURS):
        J0 = np.asarray(detection.windowed(evaluations[0], length))[500:]
        J2 = np.asarray(detection.windowed(evaluations[2], length))[window].max(axis=0)
        found = evaluation.detection_at(J0, J2, 1e-4)
        share = (400 * expected + n * found + 1) / (400 + n + 2)
        allowed = (
            3 * np.sqrt(share * (1 - share) * (1 / 400 + 1 / n)) + 0.05
        )  # 0.05: the threshold rests on few samples
        report.check(f"ROC at false alarms 1e-4 per sample, 2 std, N = {length}", expected, found, allowed, "reference")
        curve = evaluation.roc(J0, J2, np.quantile(J0, 1 - np.geomspace(1e-5, 1, 200)))
        curves[f"N = {length}"] = curve
        threshold = np.quantile(J0, 1 - 1e-4)
        alarms = np.asarray(detection.windowed(evaluations[2], length)) > threshold
        delays = evaluation.first_alarm(alarms, DT * np.arange(len(alarms)), 100.0)
        times = np.linspace(0, 9.9, 100)
        ax_delay.plot(times, evaluation.detected_by(delays, times), line, color=colour, label=f"N = {length}")
    plot.roc(curves, samples=100, least=1e-5, ax=ax)
    ax.set(ylabel="P(alarm within 10 s) [1]")
    ax.set_title("constant fault of 2 std, roll star")
    ax.legend(loc="lower right", fontsize=8)
    ax_delay.set(xlabel="time after the fault [s]", ylabel="share detected [1]", ylim=(0, 1.02), xlim=(0, 10))
    ax_delay.set_title("delay at 1e-4 false alarms per sample")
    ax_delay.legend(loc="lower right", fontsize=8)
    fig.tight_layout()
    report.figure("roc", fig)


# limits


def limits(report: Report) -> None:
    """What raises the residual without a fault: pointing beyond the linear range, and a gyro bias."""
    n = 128
    offsets = (0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
    expected = (3.00, 3.04, 3.16, 3.73, 6.70, 14.7, 62)
    exactly, nis, exact, share = system_of(MEKF), [], [], 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the very limit that is measured here
        for offset in offsets:
            p, many = offset_by(offset, n)
            out = swept(many, 7, p=p)["main"]
            nis.append(out.nis[:, ROLL].mean())
            share = out.false_alarms[:, ROLL].mean()
            exact.append(swept(many, 7, exactly, p)["main"].nis.mean(axis=0).tolist())
    report.relative("NIS of the roll star, pointing 0.3 to 3 deg off", expected, nis, 0.05, "reference")
    report.note(
        "NIS by offset (about (1, 1, 1), mean of 300 s): "
        + ", ".join(f"{o:g} deg {a:.2f}" for o, a in zip(offsets, nis))
    )
    report.note(
        f"share of samples above 27 at 3 deg: {share:.2f} (reference 0.99; how its run was averaged is not said)"
    )
    report.check("NIS of the multiplicative EKF, 3 deg off", [3.0, 3.0], exact[-1], 0.02, "reference: 2.96 to 3.11")

    per_hour = DEG / 3600 / np.sqrt(3)
    references = {1.0: (3.9, 4.8), 3.0: (11.3, 18.6), 10.0: (94, 178)}
    for total, reference in references.items():
        many = drawn(n, 8, healthy._replace(bias=Vec3(*[total * per_hour] * 3)))
        found = swept(many, 8)["settled_nis"].mean(axis=0)
        formula = [3 + m * (total * per_hour / params.std_gyro) ** 2 for m in (1, 2)]
        name = f"NIS under a gyro bias of {total:g} deg/h, after 100 s"
        report.relative(f"{name}, by 3 + m (b / sg)^2", formula, found, 0.05, "reference")
        if total == 1.0:
            report.relative(name, reference, found, 0.05, "reference")
        report.note(f"{total:g} deg/h: {_list(found)} (reference {_list(reference)}, formula {_list(formula)})")

    fig, ax = plt.subplots(figsize=(6.5, 4))
    ax.semilogy(offsets, nis, "o-", color=plot.COLOURS[0], label="LMMSE, linear C (7)")
    style = dict(color=plot.COLOURS[1], mfc="none", ms=9, label="MEKF, exact residual")
    ax.semilogy(offsets, [a[0] for a in exact], "s--", **style)
    ax.axvline(0.5, color=GREY, ls=":", label="a warning from here on")
    ax.set(xlabel="pointing offset [deg]", ylabel="mean of r' M$^{-1}$ r, roll star [1]", ylim=(2, 100))
    ax.legend()
    report.figure("offset", fig)


def offset_by(degrees: float, n: int):
    """params and scenarios of a satellite that points off by a turn about (1, 1, 1)."""
    q = Quat(np.cos(degrees * DEG / 2), *[np.sin(degrees * DEG / 2) / np.sqrt(3)] * 3)
    w = quat_to_body(q, orbit_rate(scenario.orbit_rate))
    return params._replace(q_d=q), drawn(n, 9, healthy._replace(q=q, w=Vec3(*(float(a) for a in w))))


# options


def options(report: Report) -> None:
    """Gyro bias as a state, control from a filter, the angle between the stars, single precision."""
    n = 128
    rng = np.random.default_rng(12)
    bias = params.std_bias * rng.standard_normal((3, n))
    seven = system_of(WITH_BIAS)
    many = drawn(n, 13)._replace(bias=Vec3(*bias))
    result = swept(many, 13, seven)
    out = result["main"]
    report.check(
        "NIS of the 7-state filter, bias drawn at 10 deg/h", [3.0, 3.0], out.nis.mean(axis=0), 0.02, "reference"
    )
    error = np.sqrt(np.mean(np.square(np.stack(result["bias_error"])), axis=1)) / (DEG / 3600)
    report.note(
        f"bias error of the 7-state filter at 300 s, x y z: roll star {_list(error[:, ROLL])}, pitch star "
        f"{_list(error[:, PITCH])} deg/h; 3-state NEES {_list(out.nees.mean(axis=0))} (3 expected: the axis along the "
        "boresight is not observable, and the filter does not know it)"
    )
    for own in (ROLL, PITCH):
        star = on_sensor(own, tangential(own, Fault(onset=100.0, bias=100 * ARCSEC)))
        out = swept(many._replace(star=equal(star, n)), 14, seven)["main"]
        report.check(
            f"7 states, {NAMES[own]} 100 arcsec: share blamed rightly",
            1.0,
            np.mean(out.verdict == own + 1),
            0.05,
            "reference",
        )

    for number, tag in ((0, "ideal attitude"), (1, "roll filter"), (2, "pitch filter")):
        p = params._replace(feedback=float(number))
        quiet = swept(drawn(n, 15), 15, p=p)["main"]
        bad = swept(drawn(n, 15, scenario), 15, p=p)["main"]
        report.note(
            f"control from the {tag}: NIS {_list(quiet.nis.mean(axis=0))}, "
            f"pointing rms {quiet.pointing.mean() / DEG:.3f} deg, peak torque {quiet.peak_u.max():.3f} N m; "
            f"roll star 100 arcsec: pointing {bad.pointing.mean() / DEG:.3f} deg, "
            f"roll star blamed in {np.mean(bad.verdict == 1):.1%}"
        )
        if number == 1:
            report.check(
                "NIS with control from the roll filter", [3.0, 3.0], quiet.nis.mean(axis=0), 0.03, "issue: option"
            )

    gyro = Vec3(Fault(onset=100.0, bias=3e-5), Fault(onset=100.0, bias=3e-5), Fault(onset=100.0, bias=3e-5))
    out = swept(drawn(n, 16, healthy._replace(gyro=gyro)), 16)["main"]
    report.check(
        "gyro bias of 10 std per axis: share blamed on the gyro", 1.0, np.mean(out.verdict == 3), 0.03, "reference"
    )
    report.within("the same: share of angle alarms", 0, 0.05, np.mean(np.isfinite(out.angle_delay)), "needs no gyro")
    towards = Vec3(Fault(), Fault(onset=100.0, bias=100 * ARCSEC), Fault())  # the other star
    out = swept(drawn(n, 17, healthy._replace(star=on_sensor(ROLL, towards))), 17)["main"]
    report.check(
        "roll star, y axis 100 arcsec: share of angle alarms",
        1.0,
        np.mean(np.isfinite(out.angle_delay)),
        0.0,
        "issue: option",
    )
    found = swept(drawn(n, 18), 18)["angle"]
    report.check("mean of the squared angle between the stars", 1.0, found.mean(), 0.01, "chi-square, one degree")

    if not report.quick:
        single = lambda tree: jax.tree.map(lambda a: np.asarray(a, np.float32), tree)
        runs = ((params, scenario), (single(params), single(scenario)))
        J = [np.asarray(simulate(system, *trees, jax.random.key(1), ticks=END).verdict.J, float) for trees in runs]
        gap = np.abs(J[1] - J[0])
        report.note(
            f"float32 against float64: |dJ| at most {gap.max():.2g}, mean {gap.mean():.2g} (reference 0.15, 0.024)"
        )


def _list(values) -> str:
    return ", ".join(f"{a:.3g}" for a in np.ravel(values))


# does the multiplicative term matter?


def multiplicative_noise(report: Report) -> None:
    """The filter's three ways to weigh gyro noise, on the linear model it is designed for and on the truth."""
    n, ticks = (200 if report.quick else 400), 1000
    cases = {
        "sg 3e-6 (nominal)": (3e-6, 0.0, False, (3.91, 3.91, 3.91)),
        "sg 1e-3": (1e-3, 0.0, False, (3.77, 3.93, 13.9)),
        "sg 1e-2": (1e-2, 0.0, False, (3.86, 9.3, 170)),
        "sg 1e-1": (1e-1, 0.0, False, (3.83, 21.5, 2.7e4)),
        "60 deg offset, sg 1e-3": (1e-3, 60.0, False, (4.10, 4.12, 3427)),
        "180 deg offset, sg 1e-3": (1e-3, 180.0, False, (3.94, 4.09, 12816)),
        "unknown attitude, sg 1e-2": (1e-2, 0.0, True, (3.94, 5.39, 74.7)),
    }
    for name, (std, degrees, unknown, reference) in cases.items():
        found = [design_model(jax.random.key(30), n, ticks, std, degrees, unknown, law) for law in (0.0, 1.0, 2.0)]
        nees, errors = zip(*found)
        (mult, half), (xhat, wide), (fixed, _) = (mean_interval(a) for a in nees)
        report.check(f"4-state NEES, second moment, {name} (+-{half:.2f})", 4.0, mult, 0.5, "reference: consistent")
        report.note(
            f"{name}: NEES second moment {mult:.2f}, at the estimate {xhat:.3g} +- {wide:.2g}, fixed {fixed:.3g} (reference "
            f"{', '.join(f'{a:g}' for a in reference)}); "
            f"rms error {', '.join(f'{np.sqrt(np.mean(a)):.2g}' for a in errors)}"
        )

    n, std = 60, 1e-2
    for law, name, reference in (
        (0.0, "second moment", "4.2, 2.89, 7.2e-3"),
        (1.0, "at the estimate", "1321, 3.00, 2.2e-2"),
        (2.0, "fixed", "5.5, 3.01, 4.5e-3"),
        (3.0, "Q - P", "not tested"),
    ):
        p = params._replace(std_gyro=std, law=law)
        out = swept(drawn(n, 31, healthy._replace(std_gyro=std)), 31, p=p)
        nees, nis, rms = (a[:, ROLL].mean() for a in (out["nees_q"], out["main"].nis, out["rms"]))
        report.note(
            f"nonlinear truth, sg 1e-2, roll star, {name}: NEES {nees:.3g}, NIS {nis:.3g}, rms {rms:.2g} "
            f"(reference {reference})"
        )
        report.within(f"nonlinear truth, sg 1e-2: NIS, {name}", 2.7, 3.1, nis, "reference: detection is unaffected")


@partial(jax.jit, static_argnums=(1, 2, 5))
def design_model(key, n: int, ticks: int, std, degrees, unknown: bool, law):
    """NEES and squared error at the end, of n runs of the linear model with multiplicative noise; roll star.

    The gyro's reading is the nominal rate and the truth errs about it, x+ = A x + sum B_i x n_i, eq. (3).
    """
    start, gyros, stars = jax.random.split(key, 3)
    std_x = jnp.asarray([params.std_q0, params.std_qv, params.std_qv, params.std_qv])
    half = degrees * DEG / 2
    mean = jnp.asarray([jnp.cos(half), 0, 0, jnp.sin(half)])
    w_r, s = orbit_rate(jnp.asarray(params.orbit_rate)), Vec3(1.0, 0.0, 0.0)
    C = star_map(s)

    def one(errors, gyro, star):
        if unknown:  # uniform over all attitudes: mean zero, second moment I / 4
            truth, guess, std_guess = errors / jnp.linalg.norm(errors), jnp.zeros(4), 0.5 * jnp.ones(4)
        else:
            truth, guess, std_guess = mean, mean + std_x * errors, std_x

        def step(carry, noise):
            x, belief = carry
            n_gyro, n_star = noise
            x = quaternion_step(w_r - std * Vec3.of(n_gyro), w_r, DT)(x)
            y = Reading(C(x) + STD * Vec3.of(n_star), True)
            belief, _ = lmmse_update(lmmse_predict(belief, w_r, w_r, std, DT, law), y, s, STD)
            return (x, belief), None

        believed = lmmse_start(Quat.of(guess), diagonal(*std_guess**2))
        (x, belief), _ = jax.lax.scan(step, (Quat.of(truth), believed), (gyro, star))
        d = belief.mean - x
        return quaternion_error(belief.mean, belief.cov, x)[3], d @ d

    normals = lambda key: jax.vmap(lambda key: jax.random.normal(key, (3, n)))(jax.random.split(key, ticks))
    return jax.vmap(one, in_axes=-1)(jax.random.normal(start, (4, n)), normals(gyros), normals(stars))


# observability


def observability(report: Report) -> None:
    """What one star can tell of the attitude: Gramian of (A, C) at the nominal rate, and the covariance of a filter."""
    A, wo = _transition(params.orbit_rate), params.orbit_rate
    magnitudes = np.abs(np.linalg.eigvals(A))
    report.check("eigenvalues of A, |.|", [1, 1, 1, 1], np.sort(magnitudes), 1e-8, "reference: not stable")
    report.check("rank of I - A", 2, int(np.linalg.matrix_rank(np.eye(4) - A)), 0, "reference: (17) has no inverse")
    turning = lambda t: np.array([np.cos(wo * t), 0.0, -np.sin(wo * t)])  # an inertially fixed star, in the orbit frame
    gramians = {}
    for name, star in (
        ("roll star", lambda t: np.eye(3)[0]),
        ("pitch star", lambda t: np.eye(3)[1]),
        ("fixed star", turning),
    ):
        G, F = np.zeros((4, 4)), np.eye(4)
        least = {}
        for k in range(1, 14001):
            F = A @ F
            H = _map(star(k * DT)) @ F
            G += H.T @ H
            if k in (100, 3000, 14000):
                least[k] = np.linalg.eigvalsh(G)[0] / k
        gramians[name] = least
        report.note(
            f"least Gramian eigenvalue per step, {name}: "
            + ", ".join(f"{k * DT:g} s {a:.2g}" for k, a in least.items())
        )
    report.within(
        "Gramian per step at 1400 s, pitch star: least",
        None,
        1e-9,
        abs(gramians["pitch star"][14000]),
        "reference: zero",
    )
    report.within(
        "Gramian per step at 1400 s, fixed star: least",
        None,
        1e-9,
        abs(gramians["fixed star"][14000]),
        "reference: never",
    )
    report.relative(
        "Gramian per step, roll star, 10, 300, 1400 s",
        [4e-5, 0.036, 0.70],
        list(gramians["roll star"].values()),
        0.05,
        "reference",
    )
    report.within(
        "Gramian per step at 1400 s, roll star: least",
        1e-3,
        None,
        gramians["roll star"][14000],
        "reference: observable",
    )
    P = np.diag([params.std_q0**2, *[params.std_qv**2] * 3])
    believed = {}
    for axis in (ROLL, PITCH):
        p, q, C = P.copy(), P.copy(), _map(np.eye(3)[axis])
        q[0, 0] += 1.0
        for k in range(1, 14001):
            c = (0.5 * DT * params.std_gyro) ** 2
            W = c * (np.trace(q) * np.eye(4) - q)
            p, q = A @ p @ A.T + W, A @ q @ A.T + W
            K = p @ C.T @ np.linalg.inv(C @ p @ C.T + STD**2 * np.eye(3))
            p = p - K @ C @ p
            if k in (1000, 3000, 14000):
                believed[axis, k] = 2 * np.sqrt(p[1 + axis, 1 + axis]) / ARCSEC
    roll = [believed[ROLL, k] for k in (1000, 3000, 14000)]
    report.relative(
        "roll std of the roll star at 100, 300, 1400 s [arcsec]", [21.6, 11.0, 6.2], roll, 0.02, "reference"
    )
    report.check(
        "pitch std of the pitch star at 1400 s [arcsec]", 412.5, believed[PITCH, 14000], 1.0, "reference: stays"
    )


def _transition(wo: float) -> np.ndarray:
    """A of eq. (3) at the nominal rate, 4 x 4."""
    A = quaternion_step(Vec3(0.0, -wo, 0.0), Vec3(0.0, -wo, 0.0), DT)
    return np.array([A(e) for e in np.eye(4)], float).T


def _map(s: np.ndarray) -> np.ndarray:
    """C = [s, 2 [s x]], eq. (7), 3 x 4."""
    x, y, z = s
    return np.column_stack([s, 2 * np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])])


# identification by the innovations' likelihood


def likelihood(theta, readings):
    """Mean negative log likelihood of the innovations of both filters, theta = log (sg, ss) believed / true."""
    p = params._replace(std_gyro=params.std_gyro * jnp.exp(theta["gyro"]), std_star=STD * jnp.exp(theta["star"]))
    start = init(LMMSE, 1, p, healthy)[1].computer
    nll = jax.vmap(lambda told: replay(decide, p, start, told, dt=DT)[1].innovation.nll)(readings)
    return jnp.mean(nll[:, 1:])


def recorded(n: int, seed: int):
    """The readings of n healthy runs, shape (n, T, ...)."""
    fly = lambda key: simulate(system, params, healthy, key, ticks=END).readings
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(fly))(jax.random.split(jax.random.key(seed), n)))


def identification(report: Report) -> None:
    """Noise parameters by gradient; how little one short run says about the gyro's."""
    n = 16 if report.quick else 64
    readings = recorded(n, 41)
    one = jax.tree.map(lambda a: np.repeat(a[:1], n, axis=0), readings)  # one run, n times: one compile
    cost = jax.jit(likelihood)
    at = lambda data, **theta: float(cost({"gyro": 0.0, "star": 0.0, **theta}, data))
    factors = np.log(np.geomspace(0.1, 10, 15))
    fig, axes = plt.subplots(1, 2, figsize=(10, 4))
    for name, ax, limits in zip(("gyro", "star"), axes, ((-0.002, 0.03), (-0.5, 8))):
        kinds = ((readings, f"{n} runs", "o-"), (one, "one run", "s--"))
        for (data, label, style), colour in zip(kinds, plot.COLOURS):
            curve = [at(data, **{name: f}) - at(data) for f in factors]
            ax.semilogx(np.exp(factors), curve, style, ms=5, mfc="none", color=colour, label=f"{label} of 300 s")
        ax.set(xlabel=f"believed / true noise of the {name} [1]", ylim=limits)
        ax.axvline(1, color=GREY, lw=0.8)
        ax.legend()
    axes[0].set_title("gyro: nearly flat (fine scale)")
    axes[1].set_title("stars: sharp")
    axes[0].set_ylabel("-log likelihood, less the truth's [1 per sample]")
    fig.tight_layout()
    report.figure("likelihood", fig)
    low = np.log(0.37)
    report.note(
        f"likelihood per sample, one run, sg believed x 0.37: {at(one, gyro=low) - at(one):+.1e} (reference -6e-4); x 0.7: "
        f"{at(one, gyro=np.log(0.7)) - at(one):+.1e}; ss x 0.37: {at(one, star=low) - at(one):+.2f}"
    )
    start = {"gyro": np.log(3.0), "star": np.log(0.5)}
    best, history = tune(lambda theta, _: likelihood(theta, readings), start, optax.adam(0.1), 60, jax.random.key(0))
    found = {name: float(np.exp(best[name])) for name in best}
    report.check(f"noise of the stars by likelihood / truth ({n} runs)", 1.0, found["star"], 0.02, "identified")
    report.check(f"noise of the gyro by likelihood / truth ({n} runs)", 1.0, found["gyro"], 0.25, "identified, flat")
    report.note(
        f"from x 3 and x 0.5 to x {found['gyro']:.3f} (gyro) and x {found['star']:.4f} (stars) "
        f"in {len(history.cost)} steps"
    )


# threshold and window by gradient


def tuning(report: Report) -> None:
    """Threshold and window that trade delay for false alarms, tuned on some seeds, judged on others."""
    n, longest, size = (400 if report.quick else 1600), 40, 2.0
    star = on_sensor(ROLL, tangential(ROLL, Fault(onset=100.0, bias=size * STD / np.sqrt(2))))
    both = (evaluated(drawn(n, seed, healthy._replace(star=star)), seed, ONSET + 100) for seed in (50, 51))
    train, fresh = (nis[400:, :, ROLL] for nis in both)
    train = train[:, : n // 2]  # gradients cost more than judging
    onset = ONSET - 400
    weight = 3600.0  # [s] false alarms on 1e-4 of the samples cost as much as 0.36 s of delay

    def cost(theta, _):
        window, margin = jnp.exp(theta["window"]), jnp.exp(theta["margin"])
        threshold = 3 * window + margin * jnp.sqrt(6 * window)
        J = soft_scores.soft_windowed(train, window, longest)
        p = soft_scores.soft_alarm(J, threshold, 0.03 * threshold)
        return jnp.mean(soft_scores.soft_delay(p[onset:], DT)) + weight * jnp.mean(p[longest:onset])

    start = {"window": np.log(10.0), "margin": np.log(5.0)}  # the rule "moment 5, N = 10"
    best, history = tune(cost, start, optax.adam(0.03), 80, jax.random.key(0))
    window, margin = float(np.exp(best["window"])), float(np.exp(best["margin"]))
    length = max(1, round(window))
    report.note(
        f"tuned on {n // 2} runs: N = {window:.2f}, threshold 3 N + {margin:.2f} sqrt(6 N); "
        f"cost {history.cost[0]:.3f} -> {history.cost.min():.3f} s"
    )

    def judged(length, threshold):
        J = np.asarray(detection.windowed(fresh, length))
        alarms = threshold < J
        delays = np.minimum(evaluation.first_alarm(alarms, DT * np.arange(len(J)), onset * DT), 10.0)
        return delays.mean(), alarms[longest:onset].mean()

    rules = {
        "tuned": (length, 3 * length + margin * np.sqrt(6 * length)),
        "nsigma 3, N = 1": (1, 27.0),
        "moment 5, N = 10": (10, float(detection.threshold_moment(5, 30))),
    }
    costs = {}
    for name, (length, threshold) in rules.items():
        delay, rate = judged(length, threshold)
        costs[name] = delay + DT + weight * rate
        report.note(
            f"fresh seeds, {name} (N = {length}, threshold {threshold:.1f}): delay {delay:.2f} s, "
            f"false alarms {rate:.1e} per sample, cost {costs[name]:.3f} s"
        )
    report.within(
        "cost on fresh seeds, tuned / best of the fixed rules",
        None,
        1.02,
        costs["tuned"] / min(costs["nsigma 3, N = 1"], costs["moment 5, N = 10"]),
        "issue: judged on fresh seeds",
    )


# a campaign


def campaign(report: Report) -> None:
    """Fault size x direction x onset x kind x sensor: who is blamed, and how fast the sweep runs."""
    n = 2560 if report.quick else 20480
    many, truth, size, kind = faulty(n, 60)
    swept(jax.tree.map(lambda a: a[:128], many), 61)  # compiles
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    out = swept(many, 61)["main"]
    seconds = time.perf_counter() - start
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    report.note(
        f"{n} scenarios of 300 s in {seconds:.1f} s: {n / seconds:.0f} scenarios/s, "
        f"{n * END / seconds:.3g} ticks/s; memory grew by {grown:.0f} MiB"
    )
    report.check("scenarios that stayed finite", n, int(out.ok.sum()), 0, "all of them")
    report.within("memory grown [MiB]", None, 300, grown, "issue: bounded")

    verdict = np.asarray(detection.isolate_first(*out.delay.T, patience=5.0))
    verdict = np.where(truth == 0, out.verdict, verdict)  # a healthy run has no onset to count from
    large = (size > 10) | (truth == 0)
    table = evaluation.confusion(truth[large], verdict[large])
    shares = table / table.sum(axis=1, keepdims=True)
    causes = ("none", "roll star", "pitch star", "gyro")
    for i, row in enumerate(table):
        low, high = interval(int(row[i]), int(row.sum()))
        report.note(
            f"{causes[i]:10} ({row.sum():5d} runs, size > 10 std) blamed on "
            + ", ".join(f"{c} {a:.3f}" for c, a in zip(causes, shares[i]))
            + f"; right [{low:.3f}, {high:.3f}]"
        )
    chance = float(evaluation.chance(5.9e-6 * 2, END))
    report.check(
        "healthy runs with an alarm in 300 s",
        chance,
        1 - shares[0, 0],
        3 * np.sqrt(chance * (1 - chance) / table[0].sum()),
        "reference: chance level",
    )

    fig, (ax, ax_delay) = plt.subplots(1, 2, figsize=(11.5, 4.4))
    image = ax.imshow(shares, cmap=plot.MAP, vmin=0, vmax=1)
    for i in range(4):
        for j in range(4):
            ax.text(
                j, i, f"{shares[i, j]:.3f}", ha="center", va="center", color="black" if shares[i, j] > 0.5 else "white"
            )
    ax.set(xticks=range(4), yticks=range(4), xticklabels=causes, yticklabels=causes, xlabel="blamed", ylabel="at fault")
    ax.set_title("size > 10 std, verdict 5 s after the first alarm")
    fig.colorbar(image, ax=ax, label="share of runs [1]")
    edges = np.geomspace(1, 100, 11)
    for number, name in enumerate(("constant", "incipient", "noise growth")):
        share = []
        for low, high in pairwise(edges):
            here = (truth > 0) & (truth < 3) & (kind == number) & (size >= low) & (size < high)
            own = out.delay[here, truth[here] - 1]
            share.append(np.mean(own <= 30.0))
        style = dict(marker=plot.MARKS[number], ls=plot.LINES[number], color=plot.COLOURS[number], mfc="none")
        ax_delay.semilogx(np.sqrt(edges[1:] * edges[:-1]), share, label=name, **style)
    ax_delay.axhline(float(evaluation.chance(5.9e-6, 300)), color=GREY, ls=":", label="chance level")
    ax_delay.set_xticks([1, 2, 5, 10, 20, 50, 100], labels=["1", "2", "5", "10", "20", "50", "100"])
    ax_delay.minorticks_off()
    ax_delay.set(
        xlabel="size of the star sensor's fault [std of its noise]",
        ylabel="P(own alarm within 30 s) [1]",
        ylim=(-0.02, 1.02),
    )
    ax_delay.legend()
    fig.tight_layout()
    report.figure("campaign", fig)


def faulty(n: int, seed: int):
    """n scenarios with a fault drawn at random; also the cause (0 to 3), size [std] and kind (0 to 2) of each."""
    rng = np.random.default_rng(seed)
    truth, kind = rng.integers(0, 4, n), rng.integers(0, 3, n)
    size, angle = np.exp(rng.uniform(0, np.log(100), n)), rng.uniform(0, 2 * np.pi, n)
    onset, tau = rng.uniform(50, 200, n), np.exp(rng.uniform(np.log(5), np.log(100), n))

    def along(component, std, at_fault):
        bad = lambda value, otherwise=0.0: np.where(at_fault, value, otherwise)
        return Fault(
            onset=bad(onset, np.inf),
            end=np.full(n, np.inf),
            bias=bad((kind == 0) * size * component * std),
            drift=bad((kind == 1) * size * component * std),
            tau=tau,
            random=np.zeros(n),
            scale=np.ones(n),
            growth=np.where((kind == 2) & at_fault, np.maximum(size, 1), 1.0),
            stuck=np.zeros(n),
            missing=np.zeros(n),
        )

    zero, cos, sin = np.zeros(n), np.cos(angle), np.sin(angle)
    roll = Vec3(along(zero, STD, truth == 99), along(cos, STD, truth == 1), along(sin, STD, truth == 1))
    pitch = Vec3(along(cos, STD, truth == 2), along(zero, STD, truth == 99), along(sin, STD, truth == 2))
    star = jax.tree.map(lambda a, b: np.stack([a, b], axis=-1), roll, pitch)
    third = rng.standard_normal((3, n))
    third /= np.linalg.norm(third, axis=0)
    gyro = Vec3(*(along(a, params.std_gyro, truth == 3) for a in third))
    return drawn(n, seed)._replace(star=star, gyro=gyro), truth, size, kind
