"""Loss of a control moment gyro: the paper's cases, faults, one tick in plain numbers, bad input."""

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from made_up import tallied  # noqa: E402

from jaxatt import simulate, sweep, varied  # noqa: E402
from jaxatt.attitude import quat_rotate  # noqa: E402
from jaxatt.cmg import (  # noqa: E402
    GimbalAxes,
    ModuleInertia,
    Steering,
    cluster_inertia,
    cluster_momentum,
    cmg_axes,
    cmg_triads,
    modules,
    steer,
)
from jaxatt.contract import Now  # noqa: E402
from jaxatt.loops import cmg_loss as cmg  # noqa: E402
from jaxatt.vec import Quat, Vec3, array  # noqa: E402

KEY = jax.random.key(0)
P, B = cmg.PYRAMID, cmg.BOX
CASES = [  # structure, gamma(0) [deg], class of the paper, class at K_I = 0.02, |w(0)|
    (P, (45, 45, 45, 45), 0, 0, 0.0461636114),
    (P, (10, 55, 45, -10), 0, 0, 0.0266025786),
    (P, (90, 0, -90, 0), 1, None, 0.0138676583),  # None: rounding decides
    (P, (90, 0, -90, 5), 0, 0, 0.0139989029),
    (P, (-90, 90, 90, 95), 2, 2, 0.0350121495),
    (P, (-95, 90, 85, 95), 0, 2, 0.0350568915),
    (B, (45, 45, 45, 45), 0, 0, 0.0565628862),
    (B, (10, 55, 45, -10), 0, 2, 0.0310979751),
    (B, (90, 0, -90, 5), 2, 2, 0.0017435384),
    (B, (-90, 90, 90, 95), 2, 2, 0.0399322716),
    (B, (95, -5, -85, 5), 0, 0, 0.0020916538),
    (B, (-95, 90, 85, 95), 0, 2, 0.0399870246),
]


INERTIA = ModuleInertia(5e-4, 1e-3, 7e-4, 1e-3)  # I_cs, I_ct and I_cr all different


def figure_7(params, scenario=cmg.scenario):
    """The paper's case, or another, at 100 control samples; one program runs all."""
    return simulate(cmg.system, params, scenario, KEY, ticks=1000, every=10)


def stacked(trees):
    """Scenarios of one batch, every leaf (n, ...)."""
    return jax.tree.map(lambda *a: np.stack(np.broadcast_arrays(*a)), *trees)


def test_motion_is_equation_12_for_three_modules():
    """A plain NumPy transcript of the printed equations, J_T and all, against a run of the system."""
    sb, cb = np.sin(np.radians(54.7)), np.cos(np.radians(54.7))
    Js, Icr, Ics, Ict, Iws, br, tau = np.diag([50.0, 50, 30]), 5e-4, 1e-3, 5e-4, 1e-3, 1e-6, 0.05
    R = np.array([[sb, 0, -sb, 0], [0, sb, 0, -sb], [cb] * 4])

    def ST(g):
        s, c = np.sin(g), np.cos(g)
        S = [[-s[0] * cb, -c[1], s[2] * cb, c[3]], [c[0], -s[1] * cb, -c[2], s[3] * cb], list(s * sb)]
        T = [[-c[0] * cb, s[1], c[2] * cb, -s[3]], [-s[0], -c[1] * cb, s[2], c[3] * cb], list(c * sb)]
        return np.array(S), np.array(T)

    def J_T(S, T):
        return Js + Icr * R @ R.T + Ics * S @ S.T + Ict * T @ T.T

    def rates(x, u):
        w, g, gd, Om = x[:3], x[3:7], x[7:11], x[11]
        S, T = ST(g)
        J = J_T(S, T)
        gdd = np.append((u - gd[:3]) / tau, 0)
        h = J @ w + 0.6 * S[:, :3].sum(1) + Icr * R[:, :3] @ gd[:3] + Iws * Om * S[:, 3]
        inner = br * Om * S[:, 3] - Icr * R @ gdd
        for i in range(3):
            inner -= (Ics - Ict) * gd[i] * (T[:, i] * (S[:, i] @ w) + S[:, i] * (T[:, i] @ w))
        wd = np.linalg.solve(J, -np.cross(w, h) - 0.6 * T[:, :3] @ gd[:3] + inner)
        return np.concatenate([wd, gd, gdd, [-br * Om / Iws]])

    g = np.radians([45.0] * 4)
    S, T = ST(g)
    x = np.concatenate([-np.linalg.solve(J_T(S, T), 0.6 * S.sum(1)), g, np.zeros(4), [600.0]])
    integral, trace = 0, []
    for _ in range(50):
        S, T = ST(x[3:7])
        integral = integral - 0.1 * x[:3]
        a = -J_T(S, T) @ (-0.2 * x[:3] + 0.02 * integral) / 0.6
        u = np.clip(np.linalg.solve(T[:, :3], a), -1, 1)
        trace.append(x)
        for _ in range(100):
            k1 = rates(x, u)
            k2 = rates(x + 5e-4 * k1, u)
            k3 = rates(x + 5e-4 * k2, u)
            x = x + 1e-3 / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + 1e-3 * k3, u))
    log = jax.tree.map(lambda a: a[:50], figure_7(cmg.params))
    trace = np.array(trace)
    np.testing.assert_allclose(np.stack(log.w, -1), trace[:, :3], atol=1e-11)
    np.testing.assert_allclose(log.gamma, trace[:, 3:7], atol=1e-9)
    np.testing.assert_allclose(log.spin[:, 3], trace[:, 11], rtol=1e-12)
    swing = (log.u - log.rate)[:, :3] / tau
    np.testing.assert_allclose(log.acceleration, np.mean(swing**2, axis=1), rtol=1e-9)


# the paper's cases


def swept(*given):
    """Scores of pairs (params, scenarios), the computer knowing how the modules are mounted; one sweep for all."""
    pairs = stacked([(params._replace(axes=s.axes), s) for params, scenarios in given for s in scenarios])
    return sweep(varied(cmg.system), (), pairs, KEY, ticks=6001, score=varied(cmg.score), progress=False)


@pytest.fixture(scope="module")
def found():
    """Scores of the paper's cases under K_I of table 4, of table 5, the robust inverse without and with dither, and of bad ones."""
    paper = [cmg.lost(axes, gamma) for axes, gamma, *_ in CASES]
    robust = [cmg.table5._replace(steering=law) for law in (Steering(lam0=0.01), Steering(lam0=0.01, dither=0.1))]
    broken = paper[0]._replace(spin=np.array([600.0, 1e200, 600.0, 600.0]))  # overflows
    bad = [broken, paper[0]._replace(h=Vec3(2.0, 0.0, 0.0)), cmg.lost(B, (0, 0, 0, 0))]
    return swept(*((params, paper) for params in (cmg.params, cmg.table5, *robust)), (cmg.table5, bad))


@pytest.fixture(scope="module")
def cases(found):
    """Of the paper's cases, law by law."""
    part = lambda k: jax.tree.map(lambda a: a[k * len(CASES) : (k + 1) * len(CASES)], found)
    return [part(k) for k in range(4)]


@pytest.mark.slow
def test_start(cases):
    for run in cases[:2]:
        np.testing.assert_allclose(run.start, [case[4] for case in CASES], atol=1e-10)
        assert run.ok.all() and run.absorbable.all() and (run.momentum < 1e-7).all()


@pytest.mark.slow
def test_classes_of_table_5(cases):
    printed, table5 = map(cmg.classify, cases[:2])
    assert table5.tolist() == [case[2] for case in CASES]
    assert [c for c, case in zip(printed, CASES) if case[3] is not None] == [
        case[3] for case in CASES if case[3] is not None
    ]


@pytest.mark.slow
def test_settling_and_residual_rate(cases):
    printed, table5 = cases[:2]
    assert printed.settling[0] == pytest.approx(30.4, abs=0.1)
    assert table5.settling[0] == pytest.approx(14.6, abs=0.1)
    # K_I = 0 leaves the rate at which K_P J gives way to the brake, wherever the brake's axis lies
    proper = cmg.classify(table5) == cmg.PROPER
    assert (np.abs(table5.final[proper] - 5.7e-5) < 4e-5).all()


@pytest.mark.slow
@pytest.mark.parametrize("params, peak, at", [(cmg.params, 52.18, 4.7), (cmg.table5, 31.56, 6.3)])
def test_condition_of_figure_7(params, peak, at):
    log = figure_7(params)
    assert log.condition[0] == pytest.approx(2.0004, abs=1e-4)
    assert np.max(log.condition) == pytest.approx(peak, abs=0.05)
    assert 0.1 * np.argmax(log.condition) == pytest.approx(at, abs=0.1)


# faults, seams, batches


@pytest.mark.slow
def test_failures_of_table_1():
    start = (P, (45, 45, 45, 45))
    several = [
        cmg.lost(*start, onset=1.0, brake=1e-3),
        cmg.lost(*start, module=1, onset=1.0, brake=0.0)._replace(std_w=1e-4),
        cmg.lost(*start, onset=1.0, brake=0.0, free=1.0, friction=1e-3),
    ]
    log = jax.tree.map(lambda *a: np.stack(a)[:, :30], *(figure_7(cmg.params, s) for s in several))
    before, after = log.gamma[:, 11] - log.gamma[:, 10], log.gamma[:, 29] - log.gamma[:, 20]
    assert (np.abs(before[:, 0]) > 0).all()
    assert np.abs(after[0, 3]) < 1e-9 and np.abs(after[1, 1]) < 1e-9 and np.abs(after[2, 3]) > 0.01
    assert log.spin[0, 29, 3] == pytest.approx(600 * np.exp(-1.9), rel=1e-6)
    assert (log.spin[1:] == 600).all()
    assert max(np.ptp(c, axis=1).max() for c in log.momentum) < 1e-9
    assert (log.u[0, 10:, 3] == 0).all() and (np.abs(log.u[0, :10, 3]) > 0).any()


@pytest.mark.slow
def test_what_is_wrong_is_flagged(found):
    """And leaves the others alone: tests/test_loops.py."""
    assert found.ok.tolist() == len(CASES) * 4 * [True] + [False, True, True]
    assert found.absorbable[-3:].tolist() == [True, False, True]
    assert found.rank_one[-3:].tolist() == [0, 0, 1]
    assert cmg.classify(found)[-3] == cmg.FLUCTUATION  # NaN is never proper


def test_the_gyro_reads_rate_bias_and_noise():
    s = cmg.lost(P, (45, 45, 45, 45))._replace(bias_w=Vec3(1e-3, -2e-3, 3e-3), std_w=1e-4)
    x, z = cmg.init(cmg.params, s)
    read = cmg.sense(cmg.params, s, Now(0, 0.0, cmg.DT), x, z, jnp.array([1.0, 2.0, -3.0]))
    np.testing.assert_allclose(array(read.w.value - x.w), [1.1e-3, -1.8e-3, 2.7e-3], rtol=1e-10)
    assert read.healthy.tolist() == [1, 1, 1, 0] and (read.gamma.value == x.gamma).all()
    assert read.w.valid and read.gamma.valid.all()


def test_one_tick_is_the_equations_in_plain_numbers():
    rng = np.random.default_rng(8)
    day = cmg.lost(P, (10, 55, 45, -10), module=1, brake=2e-3, free=1.0)._replace(u_max=0.3, tau_g=0.2, module=INERTIA)
    believed = ModuleInertia(6e-4, 1.2e-3, 4e-4, 1.1e-3)
    p = cmg.params._replace(module=believed)
    healthy = np.array([1.0, 0, 1, 1])
    q, w, integral = rng.normal(size=4), 2e-4 * rng.normal(size=3), 2e-4 * rng.normal(size=3)
    (rate, before), u_before = rng.normal(size=(2, 4)), np.array([-0.2, 0.0, 0.28, 0.1])
    q /= np.linalg.norm(q)
    x, z = cmg.init(p, day)
    x = x._replace(q=Quat(*(2 * q)), w=Vec3(*w), rate=jnp.asarray(rate))
    computer, drive = z.computer._replace(integral=Vec3(*integral)), z.drive._replace(u=jnp.asarray(u_before))
    z = z._replace(rate=jnp.asarray(before), computer=computer, drive=drive)
    tick = lambda k: cmg.tick(p, day, Now(jnp.asarray(k), jnp.asarray(k * cmg.DT), cmg.DT), x, z, jnp.zeros(3))
    moved, after, log = tick(20)

    at = cmg_triads(day.axes, day.gamma)
    r, s, T = (np.stack([np.asarray(c) for c in v]) for v in at)
    J_T = lambda m: array(day.J) + m.I_cr * r @ r.T + m.I_cs * s @ s.T + m.I_ct * T @ T.T  # eq. (11)
    integral = integral - 0.1 * w
    a = -J_T(believed) @ (-0.2 * w + 0.02 * integral) / (believed.I_ws * 600)  # eq. (7)
    wanted = np.linalg.pinv(T * healthy) @ a
    u = healthy * np.clip(wanted, -0.3, 0.3)
    np.testing.assert_allclose(array(after.computer.integral), integral, rtol=1e-12)
    np.testing.assert_allclose(after.computer.u, wanted, rtol=1e-9, atol=1e-12)
    assert (np.abs(wanted) > 0.3).any() and (np.abs(u) == 0.3).sum() < 3
    for got in (log.u, after.drive.u):
        np.testing.assert_allclose(got, u, rtol=1e-9)
    np.testing.assert_allclose(after.drive.brake, 2e-3 * (1 - healthy))
    np.testing.assert_allclose(after.drive.free, 1 - healthy)
    np.testing.assert_allclose(after.rate, rate)
    np.testing.assert_allclose(array(moved.q), q, rtol=1e-12)
    np.testing.assert_allclose(log.variation, healthy @ np.abs(rate - before), rtol=1e-12)
    assert log.jumps == (np.abs(u - u_before) > 0.3).sum() == 2
    np.testing.assert_allclose(log.acceleration, healthy @ ((u - rate) / 0.2) ** 2 / 3, rtol=1e-9)
    sizes = np.linalg.svd(T * healthy, compute_uv=False)
    np.testing.assert_allclose(log.condition, sizes[0] / sizes[2], rtol=1e-9)
    h = J_T(INERTIA) @ w + INERTIA.I_cr * r @ rate + INERTIA.I_ws * 600 * s.sum(1)
    np.testing.assert_allclose(array(log.momentum), array(quat_rotate(Quat(*q), Vec3(*h))), rtol=1e-12)
    between = tick(21)[1].computer  # no control sample
    np.testing.assert_array_equal(between.u, z.computer.u)
    np.testing.assert_array_equal(array(between.integral), array(z.computer.integral))


def test_six_modules_with_three_lost():
    axes = cmg_axes(np.radians(60.0), np.arange(6) * np.pi / 3)
    six, params = cmg.lost(axes, [30.0, 50, 70, 20, 10, -40], module=[0, 1, 2]), cmg.params._replace(axes=axes)
    assert np.isinf(six.failure.onset).tolist() == 3 * [False] + 3 * [True]
    cmg.refuse_bad(params, six)
    with pytest.raises(ValueError, match=r"`params\.axes` must be of 6 modules, as `scenario\.axes`, but it is of 4"):
        cmg.refuse_bad(cmg.params, six)
    x, z = cmg.init(params, six)
    x = x._replace(rate=jnp.linspace(-1.0, 1.0, 6))
    z = z._replace(drive=cmg.Drive(jnp.linspace(0.5, -0.5, 6), six.failure.brake, six.failure.free))

    def momentum(x):
        at = cmg_triads(axes, x.gamma)
        J_T = cluster_inertia(six.J, at, six.module)
        return quat_rotate(x.q, cluster_momentum(x.w, x.rate, x.spin, at, J_T, six.module))

    _, leak = jax.jvp(momentum, (x,), (cmg.flow(params, six, 0.0, x, z),))
    assert np.linalg.norm(np.stack(leak)) < 1e-14
    T = np.stack([np.asarray(c) for c in cmg_triads(axes, six.gamma).t])
    for healthy in (np.ones(6), np.array([0.0, 1, 1, 0, 1, 1])):
        u = steer(Steering(), Vec3(0.1, -0.2, 0.05), axes, six.gamma, healthy, 0.0)
        np.testing.assert_allclose(u, np.linalg.pinv(T * healthy) @ [0.1, -0.2, 0.05], rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_robust_inverse_ends_the_chatter(cases):
    """With lam0 = 0.01 and K_I = 0 none of the reference's hard cases fluctuates; dither frees the pyramid's lock."""
    robust, dithered = map(cmg.classify, cases[2:])
    assert (robust != cmg.FLUCTUATION).all()
    assert robust[2] == cmg.LOCK and robust[8] == cmg.LOCK  # pyramid [90, 0, -90, 0], box [90, 0, -90, 5]
    assert dithered[2] == cmg.PROPER and dithered[8] == cmg.LOCK


def test_bad_input_is_refused_in_one_line():
    s, run = cmg.scenario, lambda p, s: simulate(cmg.system, p, s, KEY, ticks=1)
    onset = s.failure._replace(onset=np.array([0.0, np.inf, np.inf, 0.0]))
    flat = cmg_axes(0.0, np.arange(4.0))
    long = GimbalAxes(Vec3(*(1.1 * c for c in s.axes.r)), s.axes.s0)
    two = modules(s.axes, [0, 1])
    few = cmg.lost(two, [0.0, 0.0], module=0, onset=np.inf)
    bad = [
        (cmg.params._replace(k_p=-1.0), s, "params.k_p"),
        (cmg.params._replace(steering=Steering(lam0=-1.0)), s, "params.steering.lam0"),
        (cmg.params, s._replace(failure=onset), "healthy modules of scenario.axes"),
        (cmg.params._replace(axes=two), few, "healthy modules of params.axes"),
        (cmg.params, few, r"params\.axes` must be of 2 modules"),
        (cmg.params._replace(axes=flat), s, "parallel"),
        (cmg.params, s._replace(axes=flat), "parallel"),
        (cmg.params, s._replace(axes=long), r"\|scenario.axes.r\|\[0\]` must be 1"),
        (cmg.params, s._replace(gamma=np.array([0.0, np.nan, 0.0, 0.0])), "scenario.gamma"),
        (cmg.params, s._replace(tau_g=0.0), "scenario.tau_g"),
        (cmg.params, s._replace(failure=s.failure._replace(free=np.full(4, 0.5))), "scenario.failure.free"),
        (cmg.params, s._replace(rate=np.zeros(3)), r"`scenario\.rate` must have shape \(4,\)"),
    ]
    for p, scenario, words in bad:
        with pytest.raises(ValueError, match=words) as error:
            run(p, scenario)
        assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="`module` must be one of"):
        cmg.lost(P, (0, 0, 0, 0), module=4)


def test_scores_are_those_of_a_made_up_log():
    rng, dt = np.random.default_rng(6), 0.5
    three = lambda *size: Vec3(*(np.array(size) * rng.normal(size=(3, 6))))
    four = lambda: rng.normal(size=(6, 4))
    log = cmg.Log(
        dt * np.arange(6), three(4, 3, 2, 1, 0.5, 0.01), *(four() for _ in range(4)), momentum=three(1.0), condition=np.array([3, 5, 9, 8, 9, 1.0]),
        rank_one=np.array([False, True, False, False, True, False]), variation=rng.random(6), jumps=np.array([0, 2, 1, 0, 0, 3]),
        acceleration=rng.random(6), w0=np.full(6, 2.5),
    )  # fmt: skip
    onset = np.array([np.inf, 10.0, np.inf, np.inf])
    h = np.array([0.3, -0.4, 1.2])
    day = cmg.scenario._replace(failure=cmg.scenario.failure._replace(onset=onset), h=Vec3(*h))
    got = tallied(cmg.score, cmg.params, day, log, dt)
    t, w = dt * np.arange(6), np.linalg.norm(np.stack(log.w), axis=0)
    found = {
        "variation": log.variation.sum(), "jumps": 6, "acceleration": np.sqrt(log.acceleration.mean()), "condition": 9.0,
        "condition_at": 1.0, "settling": t[w > 0.05 * 2.5][-1], "final": w[-1], "start": 2.5,
        "momentum": np.linalg.norm(np.stack(log.momentum), axis=0)[-1], "rank_one": 1.0, "ok": True,
    }  # fmt: skip
    for name, value in found.items():
        np.testing.assert_allclose(getattr(got, name), value, rtol=1e-12, err_msg=name)
    # the modules that are left hold at most their momentum at right angles to the gimbal axes
    r = np.stack(cmg.scenario.axes.r)
    lever = np.linalg.norm(r - np.outer(h, h @ r) / (h @ h), axis=0)  # sine of the angle between axis and h
    hull = np.sum(np.sqrt(1 - (h @ r / 1.3) ** 2) * np.isinf(onset) * cmg.scenario.module.I_ws * cmg.scenario.spin)
    np.testing.assert_allclose(lever, np.sqrt(1 - (h @ r / 1.3) ** 2))
    for size, fits in ((0.999, True), (1.001, False)):
        scaled = day._replace(h=Vec3(*(h / 1.3 * hull * size)))
        assert bool(tallied(cmg.score, cmg.params, scaled, log, dt).absorbable) is fits
    assert tallied(cmg.score, cmg.params, day._replace(h=Vec3(0.0, 0.0, 0.0)), log, dt).absorbable


def test_classes_of_runs():
    run = cmg.Scores(*[None] * len(cmg.Scores._fields))
    run = run._replace(
        variation=np.array([20.0, 20.1, 1.0, np.nan]), final=np.array([0.2, 0.0, 0.21, 0.0]), start=np.ones(4)
    )
    assert cmg.classify(run).tolist() == [cmg.PROPER, cmg.FLUCTUATION, cmg.LOCK, cmg.FLUCTUATION]


def test_the_start_holds_the_total_momentum_it_is_given():
    h = Vec3(0.3, -0.4, 1.2)
    start = cmg.scenario._replace(h=h, rate=np.array([0.1, -0.2, 0.3, 0.4]))
    x, _ = cmg.init(cmg.params, start)
    at = cmg_triads(start.axes, x.gamma)
    held = cluster_momentum(x.w, x.rate, x.spin, at, cluster_inertia(start.J, at, start.module), start.module)
    np.testing.assert_allclose(quat_rotate(x.q, held), h, rtol=1e-12)
