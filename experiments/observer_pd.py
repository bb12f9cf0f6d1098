"""Yun & Kang (2020): sensor-fault detection by a nonlinear observer, tolerance by an adaptive PD law.

The paper gives no fault signals, noise law or step sizes; the reference numbers are those of an independent
implementation with the choices of docs/loops/observer_pd.md. Figures 1-3 are compared with the paper's words about them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from experiments.report import interval, quantile
from jaxatt import Fault, noise_of, on_axes, scores, simulate, soft_scores, sweep
from jaxatt.attitude import mrp_matrix, mrp_rate, mrp_rate_transposed
from jaxatt.bodies import body_acceleration
from jaxatt.engine import rk4
from jaxatt.loops import observer_pd as op
from jaxatt.observers import AttitudeRate, mrp_observer
from jaxatt.plot import COLOURS, GREY, LINES, MARKS
from jaxatt.tuning import value_and_gradient
from jaxatt.vec import Vec3, array, cross, inverse, norm, zeros

HEALTHY = on_axes(Fault())
QUIET = op.scenario._replace(star=HEALTHY, gyro=HEALTHY, std_q=0.0, std_w=0.0)
FINE = op.system._replace(dt=0.01, substeps=1)  # the grid of the reference numbers
KEY = jax.random.key(2020)
REFERENCE = "independent implementation"


def printed_flow(params: op.Params, scenario: op.Scenario, t, x: op.X, z: op.Z) -> op.X:
    """The loop's flow with + w x J w, as printed in (4), in body and observer; Euler's equation has - (erratum 1)."""
    y, rate, w_hat = op.readings(z.sensors.star, z.sensors.gyro, x), op.flow(params, scenario, t, x, z), x.estimate.w
    turned = lambda w, J, momentum: 2 * (inverse(J) @ cross(w, momentum))
    estimate = rate.estimate._replace(w=rate.estimate.w + turned(w_hat, params.J, params.J @ y.w))
    return rate._replace(w=rate.w + turned(x.w, scenario.J, scenario.J @ x.w), estimate=estimate)


PRINTED = FINE._replace(flow=printed_flow)


def run(report) -> None:
    """All checks and figures of the paper's loop."""
    mathematics(report)
    nominal(report)
    figures(report)
    monte_carlo(report)
    fault_sizes(report)


def mathematics(report) -> None:
    """What must hold whatever the numbers are."""
    rng = np.random.default_rng(1)
    J, alpha, beta = op.INERTIA, 1.1, 15.0

    def draw(size=1.0):
        return Vec3.of(size * rng.normal(size=(3, 1000)))

    for label, noise in (("clean", 0.0), ("noisy", 0.3)):
        q, w, q_hat, w_hat, u, n_q, n_w = draw(), draw(), draw(), draw(), draw(), draw(noise), draw(noise)
        y = AttitudeRate(q + n_q, w + n_w)
        hat = mrp_observer(AttitudeRate(q_hat, w_hat), y, u, J, alpha, beta)
        e_q, e_w = q - q_hat, w - w_hat
        dV = e_q @ (mrp_rate(q, w) - hat.q) + e_w @ (J @ (body_acceleration(w, u, J) - hat.w))
        exact = (
            -alpha * (e_q @ e_q) - beta * (e_w @ e_w) - alpha * (e_q @ n_q) - beta * (e_w @ n_w)
            - e_q @ (mrp_rate(y.q, w) - mrp_rate(q, w)) + e_w @ cross(w_hat, J @ n_w)
            - e_w @ mrp_rate_transposed(y.q, n_q)
        )  # fmt: skip
        report.check(
            f"V' identity of the observer, {label} readings", 0, np.abs(dV - exact).max(), 1e-10, "V'; reference"
        )

    q = draw()
    G = np.stack([array(mrp_rate(q, Vec3.of([np.full(1000, a) for a in e]))) for e in np.eye(3)], axis=1)
    excess = np.linalg.norm(np.moveaxis(G, -1, 0), 2, axis=(1, 2)) - (1 + np.asarray(q @ q)) / 4
    report.check("|G(q)| - (1 + |q|^2)/4", 0, np.abs(excess).max(), 1e-12, "reference")

    def flow(t, x):
        return AttitudeRate(mrp_rate(x.q, x.w), body_acceleration(x.w, zeros(), J))

    start = jax.tree.map(jnp.asarray, AttitudeRate(zeros(), op.scenario.w))
    end, _ = jax.lax.scan(lambda x, _: (rk4(flow, 0.0, x, 0.001), None), start, None, 20_000)
    momentum = [mrp_matrix(x.q) @ (J @ x.w) for x in (start, end)]
    drift = norm(momentum[1] - momentum[0]) / norm(momentum[0])
    report.check("torque-free momentum drift, 20 s", 0, float(drift), 1e-9, "eq. (4), reference")

    theta = jnp.log(jnp.array([1.1, 15.0, 330.0, 125.0]))
    scenario = op.scenario._replace(q_hat=Vec3(0.35, 0.2, -0.6), gyro=on_axes(Fault(5.0, bias=0.02)))
    loss = jax.jit(lambda theta: smooth_loss(theta, scenario))
    _, gradient = jax.jit(lambda theta: value_and_gradient(lambda theta, key: loss(theta), theta, KEY))(theta)
    central = np.array([(loss(theta + d) - loss(theta - d)) / 2e-5 for d in 1e-5 * np.eye(4)])
    error = np.abs(np.asarray(gradient) / central - 1).max()
    report.check("gradient against central difference, relative", 0, error, 1e-5, "alpha, beta, k_q, k_w0")


def gains(theta):
    """Params with the gains exp(theta) of (alpha, beta, k_q, k_w0)."""
    alpha, beta, k_q, k_w0 = jnp.exp(theta)
    return op.params._replace(alpha=alpha, beta=beta, k_q=k_q, k_w0=k_w0)


def smooth_loss(theta, scenario):
    """A smooth loss of one run of 15 s."""
    log = simulate(op.system, gains(theta), scenario, KEY, ticks=150)
    return jnp.mean(soft_scores.soft_alarm(log.xi, 0.01, 0.001) + 20 * norm(log.e_q)) + 0.02 * jnp.sqrt(
        jnp.mean(log.u @ log.u)
    )


def last_outside(values, bound: float, dt: float) -> float:
    """Last time at which a record exceeds a bound."""
    return dt * float(np.max(np.flatnonzero(np.asarray(values) > bound)))


def nominal(report) -> None:
    """Runs without noise and faults."""
    for system, settling, label in ((FINE, 5.22, "Euler"), (PRINTED, 5.31, "as printed")):
        log = simulate(system, op.params, QUIET, KEY, ticks=1000)
        name = f"|q| < 0.01 after [s], dynamics {label}"
        report.check(name, settling, last_outside(norm(log.q), 0.01, 0.01) + 0.01, 0.02, REFERENCE)
        if system is FINE:
            report.check("peak |u| [N m]", 147.52, float(norm(log.u).max()), 0.01, REFERENCE)
    log = simulate(FINE, op.params, QUIET._replace(q_hat=zeros(), w_hat=zeros()), KEY, ticks=1200)
    report.check("observer from zero: |xi(0)|", 1.514188, float(log.xi[0]), 1e-6, REFERENCE)
    report.check("observer from zero: last above sigma [s]", 8.86, last_outside(log.xi, 0.01, 0.01), 0.02, REFERENCE)
    log = simulate(op.system, op.params._replace(eps=0.00304), QUIET, KEY, ticks=601)
    report.check("k_w at 60 s, eps = 0.00304 [N m s]", 1.5726, float(log.k_w[-1]), 0.001, "eq. (19), reference")
    report.within("least k_w of that run [N m s]", 1.5715, None, float(log.k_w.min()), "never below h(0)")
    faults = QUIET._replace(star=on_axes(Fault(250.0, bias=0.03)), gyro=on_axes(Fault(150.0, bias=0.03)))
    log = simulate(op.system, op.params, faults, KEY, ticks=3500)
    name = "constant faults of 0.03: |xi| before, after 250 s"
    report.relative(name, [0.0119, 0.0119], [float(log.xi[2490]), float(log.xi[-1])], 0.02, "reference")


def figures(report) -> None:
    """Figures 1-3 of the paper, one run."""
    log = simulate(op.system, op.params, op.scenario, noise_of(op.system, KEY, 0, ticks=3500), ticks=3500)
    fig, ax = plt.subplots(figsize=(7, 3.5), layout="constrained")
    ax.semilogy(log.t, log.xi, LINES[0], color=COLOURS[0], linewidth=0.6, label=r"residual norm $|\xi|$")
    ax.axhline(op.params.sigma, color=COLOURS[1], linestyle=LINES[1], label=r"threshold $\sigma$ = 0.01")
    ax.set(ylabel=r"$|\xi|$ [1, rad/s]", ylim=(3e-4, 0.5))
    mark_onsets(ax)
    ax.legend(loc="upper left")
    report.figure("fig1_residual", fig)
    for name, error, label in (
        ("fig2_attitude_error", log.e_q, "attitude error, MRP [1]"),
        ("fig3_rate_error", log.e_w, "rate error [rad/s]"),
    ):
        fig, axes = plt.subplots(3, sharex=True, sharey=True, figsize=(7, 5), layout="constrained")
        limit = 1.3 * max(float(np.abs(a[log.t > 150]).max()) for a in error)
        for ax, axis, values, colour in zip(axes, "xyz", error, COLOURS):
            ax.plot(log.t, values, color=colour, linewidth=0.6)
            mark_onsets(ax, named=axis == "x")
            ax.set(ylabel=axis, ylim=(-limit, limit))
        note = "the slew of the first 10 s leaves the frame"
        axes[0].annotate(note, (0.05, 0.97), xycoords="axes fraction", va="top", fontsize="small")
        fig.supylabel(label, fontsize="medium")
        report.figure(name, fig)
    alarms = np.asarray(log.alarm)
    report.check(
        "Fig. 1: alarm at the onset, share of 50-150 s",
        [1, 0],
        [alarms[1500], alarms[500:1500].mean()],
        0,
        "words on Fig. 1",
    )


def mark_onsets(ax, named: bool = True) -> None:
    """The paper's time axis with both fault onsets, dotted."""
    for t, text in ((150, "gyro fault"), (250, "star-sensor fault")):
        ax.axvline(t, color=GREY, linestyle=":")
        if named:
            ax.annotate(
                text, (t, 0.97), xycoords=("data", "axes fraction"), xytext=(4, 0),
                textcoords="offset points", va="top", fontsize="small",
            )  # fmt: skip
    ax.set(xlim=(0, 350))
    if ax.get_subplotspec().is_last_row():
        ax.set_xlabel("time [s]")


def windows(params, scenario, now, log):
    """Mean squares of residual and errors, and the alarm share, in three windows."""
    inside = [(now.t >= a) & (now.t < b) for a, b in ((60, 150), (150, 250), (250, 350))]
    xi, q, w = log.xi**2, log.e_q @ log.e_q, log.e_w @ log.e_w
    return [[scores.mean(a, i) for a in (xi, log.alarm, q, w)] for i in inside]


def monte_carlo(report) -> None:
    """The table of windows for both values of eps, random held faults of 0.03 per axis."""
    n = 64 if report.quick else 256
    scenarios = jax.vmap(lambda _: op.scenario)(np.arange(n))
    table = {
        0.1: [(0.001288, 0.0, 0.0001561, 0.001202), (0.05292, 0.992, 0.003395, 0.02626), (0.07514, 1.0, 0.01072, 0.08262)],
        0.00304: [(0.001288, 0.0, 0.001184, 0.009374), (0.05292, 0.992, 0.001284, 0.01006), (0.07514, 1.0, 0.07812, 0.6194)],
    }  # fmt: skip
    for eps, rows in table.items():
        system = op.system._replace(substeps=4 if eps == 0.1 else 8)
        params = op.params._replace(eps=eps)
        swept = sweep(system, params, scenarios, KEY, ticks=3500, score=windows)
        for span, (xi, share, q, w), got in zip(("60-150", "150-250", "250-350"), rows, swept):
            rms = [float(np.sqrt(a.mean())) for a in (got[0], got[2], got[3])]
            name = f"eps {eps}, {span} s: rms |xi|, |e_q|, |e_w|"
            report.relative(name, [xi, q, w], rms, 0.03 if eps == 0.1 else 0.06, f"{REFERENCE}, {n} runs")
            report.check(
                f"eps {eps}, {span} s: share above sigma", share, got[1].mean(), 0.002, f"{REFERENCE}, {n} runs"
            )


def fault_sizes(report) -> None:
    """Detection delay and miss share over the size of held random faults and of constant biases."""
    runs = 16 if report.quick else 128
    sizes = np.geomspace(0.003, 0.1, 8)
    cases = [(sensor, kind, size) for sensor in ("gyro", "star") for kind in ("random", "bias") for size in sizes]
    cases += [("gyro", "bias", 0.0)] * 8
    n = len(cases) * runs
    onset = np.random.default_rng(3).uniform(30, 40, n)

    def column(sensor, kind):
        """The size of this kind of fault in every scenario, (n,)."""
        return np.repeat([size if case == [sensor, kind] else 0.0 for *case, size in cases], runs)

    def drawn(onset, size):
        fault = lambda sensor: on_axes(Fault(onset, random=size[sensor, "random"], bias=size[sensor, "bias"]))
        return op.scenario._replace(star=fault("star"), gyro=fault("gyro"))

    size = {(sensor, kind): column(sensor, kind) for sensor in ("gyro", "star") for kind in ("random", "bias")}
    swept = sweep(
        op.system, op.params, jax.vmap(drawn)(onset, size), jax.random.fold_in(KEY, 1), ticks=700, score=op.score
    )
    by_case = jax.tree.map(lambda a: a.reshape(len(cases), runs), swept)
    report.check("fault-size sweep: share of finite runs", 1, swept.ok.mean(), 0, f"{n} scenarios")
    chance = np.isfinite(by_case.delay[-8:])
    low, high = interval(int(chance.sum()), chance.size)
    report.note(
        f"chance level, no fault: alarm within 30-40 s in {chance.mean():.4f} of runs (95 %: {low:.4f} to {high:.4f})"
    )
    fig, axes = plt.subplots(2, 2, figsize=(9, 6), sharex=True, sharey="row", layout="constrained")
    for j, (sensor, unit) in enumerate((("gyro", "rad/s"), ("star", "1, MRP"))):
        found_ax, miss_ax = axes[:, j]
        for i, (kind, label) in enumerate((("random", "random, held"), ("bias", "constant bias"))):
            rows = [k for k, c in enumerate(cases[:-8]) if c[:2] == (sensor, kind)]
            delay, miss = by_case.delay[rows], by_case.miss[rows]
            found = np.isfinite(delay).sum(1)
            low, high = np.array([interval(int(f), runs) for f in found]).T
            # the first larger and hollow: seen where both lie on one line
            style = dict(linestyle=LINES[i], color=COLOURS[i], marker=MARKS[i])
            style |= (dict(markersize=9, fillstyle="none"), dict(markersize=5))[i]
            found_ax.plot(sizes, found / runs, label=label, **style)
            found_ax.fill_between(
                sizes, low, high, color=COLOURS[i], alpha=0.2, linewidth=0, label=f"{label}: 95 % interval"
            )
            miss_ax.plot(sizes, miss.mean(1), **style)
            text = "  ".join(f"{s:.3g}: {quantile(d, 0.5)} s" for s, d in zip(sizes, delay))
            report.note(f"{sensor}, {label}: size: median delay (inf: not found)  {text}")
        found_ax.axhline(chance.mean(), color=GREY, linestyle=":", label="chance level")
        found_ax.set(title=f"{sensor} fault".replace("star", "star-sensor"))
        miss_ax.set(xlabel=f"size per axis [{unit}]", xscale="log")
    axes[0, 0].set_ylabel("share of faults detected [1]")
    axes[1, 0].set_ylabel("share of faulty time without alarm [1]")
    axes[0, 1].legend(loc="center right")
    report.figure("fault_sizes", fig)
    loud = by_case.miss[[k for k, c in enumerate(cases) if c[0] == "gyro" and c[1] == "random" and c[2] > 0.09]]
    report.within("miss share, random gyro fault of 0.1 rad/s", None, 0.01, loud.mean(), "ten times the threshold")
    # A constant star-sensor bias is absorbed (DC gain 0), whatever its size: reference.
    star = by_case.miss[[k for k, c in enumerate(cases) if c[0] == "star" and c[1] == "bias"]]
    report.within("least miss share, constant star-sensor bias", 0.5, None, star.mean(1).min(), "DC gain 0, reference")
