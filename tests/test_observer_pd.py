"""The paper's loop against the numbers of an independent implementation, and against its own mathematics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_up import tallied

from experiments.observer_pd import FINE, HEALTHY, PRINTED, QUIET, last_outside, printed_flow, windows
from jaxatt import Fault, on_axes, simulate, sweep
from jaxatt.attitude import mrp_error, mrp_matrix, mrp_rate, mrp_rate_transposed
from jaxatt.bodies import body_acceleration
from jaxatt.contract import Now
from jaxatt.controllers import rate_gain_floor
from jaxatt.engine import rk4
from jaxatt.faults import Channel, Reading
from jaxatt.loops import observer_pd as op
from jaxatt.observers import AttitudeRate
from jaxatt.vec import Mat3, Vec3, array, cross, norm, zeros

KEY = jax.random.key(0)
LONG = 3500  # [ticks] of every run of the shipped loop here: one program


def start_of(ticks, log):
    return jax.tree.map(lambda a: a[:ticks], log)


def test_tracking_errors_vanish_at_the_target_alone():
    target = op.params._replace(q_d=Vec3(0.1, 0.2, -0.1), w_d=Vec3(0.01, -0.02, 0.03))
    e = op.errors(target, AttitudeRate(target.q_d, target.w_d))
    np.testing.assert_allclose([*e.q, *e.w], 0, atol=1e-16)
    e = op.errors(target, AttitudeRate(target.q_d, 2 * target.w_d))
    np.testing.assert_allclose(e.w, target.w_d)


@pytest.mark.parametrize(("flow", "sign"), [(op.flow, -1), (printed_flow, 1)])
def test_the_lyapunov_identity_holds_for_either_sign_in_body_and_observer(flow, sign):
    """V' of flow and readings in the exact form of the reference, with w x J w of the sign given (erratum 1)."""
    rng, n, p, J = np.random.default_rng(7), 200, op.params, op.INERTIA
    draw = lambda size=1.0: Vec3.of(size * rng.normal(size=(3, n)))
    q, w, q_hat, w_hat, n_q, n_w = draw(), draw(), draw(), draw(), draw(0.3), draw(0.3)
    x, z = op.init(p, op.scenario._replace(q=q, w=w, q_hat=q_hat, w_hat=w_hat))
    erring = lambda noise: Vec3(*(Channel(1.0, a) for a in noise))
    rate = flow(p, op.scenario, 0.0, x, z._replace(sensors=z.sensors._replace(star=erring(n_q), gyro=erring(n_w))))
    e_q, e_w, y_q = q - q_hat, w - w_hat, q + n_q
    dV = e_q @ (rate.q - rate.estimate.q) + e_w @ (J @ (rate.w - rate.estimate.w))
    expected = (
        -p.alpha * (e_q @ e_q) - p.beta * (e_w @ e_w) - p.alpha * (e_q @ n_q) - p.beta * (e_w @ n_w)
        - e_q @ (mrp_rate(y_q, w) - mrp_rate(q, w)) - sign * (e_w @ cross(w_hat, J @ n_w))
        - e_w @ mrp_rate_transposed(y_q, n_q)
    )  # fmt: skip
    np.testing.assert_allclose(dV, expected, atol=1e-9)


def test_the_flow_is_the_papers_equations_in_plain_matrices():
    """Sensors err between ticks as their channels say; the computer knows another inertia than the body has."""
    rng = np.random.default_rng(9)
    full = lambda: np.diag(rng.uniform(50, 90, 3)) + 2 * (lambda a: a + a.T)(rng.normal(size=(3, 3)))
    (J, believed), (q, w, q_hat, w_hat, q_d, w_d) = (full(), full()), 0.3 * rng.normal(size=(6, 3))
    (gain_q, gain_w), (off_q, off_w) = rng.uniform(0.5, 1.5, (2, 3)), 0.1 * rng.normal(size=(2, 3))
    p = op.params._replace(J=Mat3.of(believed), q_d=Vec3(*q_d), w_d=Vec3(*w_d))
    x, z = op.init(
        p, op.scenario._replace(J=Mat3.of(J), q=Vec3(*q), w=Vec3(*w), q_hat=Vec3(*q_hat), w_hat=Vec3(*w_hat))
    )
    channels = lambda gain, off: Vec3(*map(Channel, gain, off))
    z = z._replace(sensors=z.sensors._replace(star=channels(gain_q, off_q), gyro=channels(gain_w, off_w)))

    def G(q):
        S = np.array([[0, -q[2], q[1]], [q[2], 0, -q[0]], [-q[1], q[0], 0]])
        return ((1 - q @ q) * np.eye(3) + 2 * S + 2 * np.outer(q, q)) / 4

    y_q, y_w = gain_q * q + off_q, gain_w * w + off_w
    e_q = array(mrp_error(Vec3(*y_q), p.q_d))
    u = -p.k_q * e_q - p.k_w0 * (y_w - w_d)  # eq. (10)
    turning = np.cross(w_hat, believed @ y_w)
    w_hat_rate = np.linalg.solve(believed, -turning + p.beta * (y_w - w_hat) + G(y_q).T @ (y_q - q_hat) + u)
    got = op.flow(p, op.scenario._replace(J=Mat3.of(J)), 0.0, x, z)
    np.testing.assert_allclose(array(got.q), G(q) @ w, rtol=1e-12)
    np.testing.assert_allclose(array(got.w), np.linalg.solve(J, -np.cross(w, J @ w) + u), rtol=1e-12)
    np.testing.assert_allclose(array(got.estimate.q), G(y_q) @ w_hat + p.alpha * (y_q - q_hat), rtol=1e-12)  # eq. (7)
    np.testing.assert_allclose(array(got.estimate.w), w_hat_rate, rtol=1e-12)


def test_every_reading_has_noise_of_its_own():
    scenario = QUIET._replace(std_q=0.1, std_w=0.2)
    x, z = op.init(op.params, scenario)
    noise = np.arange(1.0, 7.0)
    sensors = op.sense(op.params, scenario, Now(jnp.asarray(3), jnp.asarray(3.0), 1.0), x, z, jnp.asarray(noise))
    np.testing.assert_allclose(array(sensors.y.q.value), array(scenario.q) + 0.1 * noise[:3], rtol=1e-12)
    np.testing.assert_allclose(array(sensors.y.w.value), array(scenario.w) + 0.2 * noise[3:], rtol=1e-12)


def test_momentum_is_conserved_by_eulers_sign_only():
    J = op.INERTIA

    def drift(sign):  # of 20 s; 1: Euler's, -1: as printed
        flow = lambda t, x: AttitudeRate(mrp_rate(x.q, x.w), sign * body_acceleration(x.w, zeros(), J))
        momentum = lambda x: mrp_matrix(x.q) @ (J @ x.w)
        start = jax.tree.map(jnp.asarray, AttitudeRate(zeros(), op.scenario.w))
        end, _ = jax.lax.scan(lambda x, _: (rk4(flow, 0.0, x, 0.001), None), start, None, 20_000)
        return norm(momentum(end) - momentum(start)) / norm(momentum(start))

    euler, printed = jax.jit(jax.vmap(drift))(jnp.array([1.0, -1.0]))
    assert euler < 1e-9
    assert printed == pytest.approx(0.948, rel=0.01)


@pytest.mark.parametrize(("system", "settling"), [(FINE, 5.22), (PRINTED, 5.31)], ids=["Euler", "as printed"])
def test_the_nominal_slew(system, settling):
    log = simulate(system, op.params, QUIET, KEY, ticks=1200)
    assert last_outside(norm(log.q), 0.01, 0.01) + 0.01 == pytest.approx(settling, abs=0.02)
    assert norm(log.u).max() == pytest.approx(147.52, abs=0.01)
    np.testing.assert_allclose(log.t, 0.01 * np.arange(1200), atol=1e-12)


def test_the_observer_from_zero():
    log = simulate(FINE, op.params, QUIET._replace(q_hat=zeros(), w_hat=zeros()), KEY, ticks=1200)
    assert log.xi[0] == pytest.approx(1.514188, abs=1e-6)
    assert last_outside(log.xi, 0.01, 0.01) == pytest.approx(8.86, abs=0.02)


@pytest.mark.slow
def test_the_rate_gain_lands_on_its_floor_and_never_below():
    params = op.params._replace(eps=0.00304)
    floor = float(rate_gain_floor(zeros(), 0.00304, 31.8566039))
    for dt in (0.02, 0.1):
        log = simulate(op.system._replace(dt=dt), params, QUIET, KEY, ticks=round(60 / dt))
        assert log.k_w[-1] == pytest.approx(1.5726, abs=0.001)
        assert (log.k_w >= floor - 1e-9).all() and (jnp.diff(log.k_w) <= 0).all()


@pytest.mark.parametrize(
    ("eps", "tolerance", "table"),
    [
        (0.1, 0.03, [(0.001288, 0, 0.0001561, 0.001202), (0.05292, 0.992, 0.003395, 0.02626), (0.07514, 1, 0.01072, 0.08262)]),
        (0.00304, 0.06, [(0.001288, 0, 0.001184, 0.009374), (0.05292, 0.992, 0.001284, 0.01006), (0.07514, 1, 0.07812, 0.6194)]),
    ],
)  # fmt: skip
@pytest.mark.slow
def test_the_monte_carlo_table(eps, tolerance, table):
    system = op.system._replace(substeps=4 if eps == 0.1 else 8)
    scenarios = jax.vmap(lambda _: op.scenario)(np.arange(64))
    swept = sweep(system, op.params._replace(eps=eps), scenarios, jax.random.key(21), ticks=3500, score=windows)
    for got, (xi, share, q, w) in zip(swept, table):
        rms = [np.sqrt(a.mean()) for a in (got[0], got[2], got[3])]
        np.testing.assert_allclose(rms, [xi, q, w], rtol=tolerance)
        assert got[1].mean() == pytest.approx(share, abs=0.002)


def test_constant_faults_hide():
    """Spec, 4: biases of 0.03 leave |xi| at 0.0119 before and after the second, with a dip below the threshold."""
    scenario = QUIET._replace(star=on_axes(Fault(250.0, bias=0.03)), gyro=on_axes(Fault(150.0, bias=0.03)))
    log = simulate(op.system, op.params, scenario, KEY, ticks=LONG)
    assert log.xi[2490] == pytest.approx(0.0119, rel=0.02) and log.xi[-1] == pytest.approx(0.0119, rel=0.02)
    assert log.xi[2500:].min() < 0.01


@pytest.mark.short
@pytest.mark.slow
def test_gradients_are_finite_at_rest():
    scenario = QUIET._replace(q=zeros(), w=zeros(), q_hat=zeros(), w_hat=zeros())
    everything = lambda params, scenario: sum(
        jnp.sum(a) for a in jax.tree.leaves(simulate(op.system, params, scenario, KEY, ticks=10)) if a.dtype != bool
    )
    params, scenario = jax.tree.map(jnp.asarray, (op.params, scenario))
    for gradient in jax.tree.leaves(jax.jit(jax.grad(everything, argnums=(0, 1)))(params, scenario)):
        assert np.isfinite(gradient).all()


def test_torque_saturation_holds_on_every_axis():
    log = start_of(600, simulate(op.system, op.params._replace(u_max=1.0), QUIET, KEY, ticks=LONG))
    assert np.abs(array(log.u)).max() == 1.0 and norm(log.q)[-1] < norm(log.q)[0]


def test_the_shadow_set_keeps_a_tumbling_body_inside_the_unit_ball():
    spin = Vec3(0.0, 0.0, 3.0)
    scenario = QUIET._replace(q=zeros(), w=spin, q_hat=zeros(), w_hat=spin)
    log = start_of(100, simulate(op.system, op.params._replace(u_max=0.01), scenario, KEY, ticks=LONG))
    assert norm(log.q).max() <= 1 and log.xi[1:].max() < 0.01


def test_scores_of_a_run_with_known_answers():
    scenarios = jax.vmap(lambda bias: QUIET._replace(gyro=on_axes(Fault(30.0, bias=bias))))(np.array([0.2, 0.0]))
    swept = sweep(op.system, op.params, scenarios, KEY, ticks=500, score=op.score)
    assert swept.delay[0] == 0 and swept.delay[1] == np.inf
    assert swept.miss[0] < 0.05 and swept.miss[1] == 1
    for i in range(2):
        assert swept.false_alarms[i] == 0 and swept.start_up_alarms[i] == 0
        assert swept.settling[i] == pytest.approx(5.2, abs=0.11)
        assert swept.peak_u[i] >= 147.52 and swept.rms_u_faulty[i] < swept.rms_u[i]


J_FLAT = op.INERTIA._replace(z=Vec3(-1.0, 3.0, -10.0))


@pytest.mark.parametrize(
    ("params", "scenario", "message"),
    [
        (dict(J=J_FLAT), {}, r"`params\.J` must be positive definite .*, but it is -10\.\d+"),
        ({}, dict(J=J_FLAT), r"`scenario\.J` must be positive definite"),
        (dict(J=op.INERTIA._replace(x=Vec3(15.0, 9.0, -1.0))), {}, "symmetric"),
        (dict(alpha=-1.0), {}, r"`params.alpha` must be a positive number, but it is -1\."),
        (dict(k_q=0.0), {}, r"`params.k_q` must be a positive number, but it is 0\."),
        (dict(k_w0=np.nan), {}, r"`params.k_w0` must be a positive number, but it is nan\."),
        (dict(sigma=0.0), {}, r"`params.sigma` must be a positive number, but it is 0\."),
        (dict(eps=0.4), {}, r"`params.eps` must lie in \(0, 0.354348\).*but it is 0.4"),
        (dict(eps=0.0), {}, r"`params.eps` must lie in \(0, 0.354348\).*but it is 0"),
        (dict(u_max=0.0), {}, r"`params.u_max` must be greater than 0"),
        ({}, dict(q=Vec3(np.nan, 0.0, 0.0)), r"`scenario.q.x` must be finite, but it is nan"),
        ({}, dict(std_q=-1.0), r"`scenario.std_q` must not be negative, but it is -1"),
        ({}, dict(gyro=on_axes(Fault(onset=np.nan))), r"`scenario.gyro.x.onset` must be a number, but it is nan"),
        (dict(q_d=Vec3(np.inf, 0.0, 0.0)), {}, r"`params.q_d.x` must be finite, but it is inf"),
    ],
)
def test_bad_input_is_refused(params, scenario, message):
    with pytest.raises(ValueError, match=message) as refusal:
        simulate(op.system, op.params._replace(**params), op.scenario._replace(**scenario), KEY, ticks=3)
    assert "\n" not in str(refusal.value)


def test_scores_are_those_of_a_made_up_log():
    rng, dt, onset, end = np.random.default_rng(8), 2.0, 24.5, 29.0
    three = lambda scale: Vec3(*(scale * rng.normal(size=(3, 16))))
    e_q = three(np.where(np.arange(16) < 5, 0.1, 1e-3))
    alarm = np.isin(np.arange(16), [0, 2, 6, 9, 10, 14])
    t = dt * np.arange(16)
    log = op.Log(
        t, q=three(1), w=three(1), e_q=e_q, e_w=three(1), u=three(1), estimate=AttitudeRate(three(1), three(1)),
        xi=rng.random(16), alarm=alarm, k_w=rng.random(16),
    )  # fmt: skip
    fault = HEALTHY._replace(y=Fault(onset=onset, end=end, bias=1.0))
    got = tallied(op.score, op.params, op.scenario._replace(star=HEALTHY, gyro=fault), log, dt)
    start, before, faulty = t < op.START_UP, t < onset, (t >= onset) & (t < end)
    size = lambda v: np.linalg.norm(np.stack(v), axis=0)
    rms = lambda a: np.sqrt(np.mean(a**2))
    q, w, u = size(log.e_q), size(log.e_w), size(log.u)
    found = {
        "delay": 28 - onset, "start_up_alarms": alarm[start & before].mean(), "false_alarms": alarm[~start & before].mean(),
        "miss": (~alarm[faulty]).mean(), "rms_q": rms(q), "rms_w": rms(w), "rms_q_faulty": rms(q[faulty]),
        "rms_w_faulty": rms(w[faulty]), "peak_q": q[~start].max(), "peak_w": w[~start].max(), "settling": t[q > 0.01][-1],
        "rms_u": rms(u), "rms_u_faulty": rms(u[faulty]), "peak_u": u.max(), "ok": True,
    }  # fmt: skip
    for name in op.Scores._fields:
        np.testing.assert_allclose(getattr(got, name), found[name], rtol=1e-12, err_msg=name)


@pytest.mark.parametrize("gone", [Reading(Vec3(np.nan, 0.1, 0.2), True), Reading(Vec3(9.0, 9.0, 9.0), False)])
def test_without_readings_the_observer_predicts_and_nothing_alarms(gone):
    """The estimate moves by the model alone, on the torque of its own errors; beyond half a turn it changes its set."""
    rng, p, J = np.random.default_rng(3), op.params, array(op.INERTIA)
    q, w = np.array([0.4, -0.2, 0.3]), rng.normal(size=3)
    computer, y = op.Computer(AttitudeRate(Vec3(*q), Vec3(*w)), 80.0), AttitudeRate(gone, gone)
    rate = op.computer_flow(p, computer, y)["estimate"]
    S = np.array([[0, -q[2], q[1]], [q[2], 0, -q[0]], [-q[1], q[0], 0]])
    G = ((1 - q @ q) * np.eye(3) + 2 * S + 2 * np.outer(q, q)) / 4
    u = -p.k_q * q - 80.0 * w
    np.testing.assert_allclose(array(rate.q), G @ w, rtol=1e-12)
    np.testing.assert_allclose(array(rate.w), np.linalg.solve(J, u - np.cross(w, J @ w)), rtol=1e-12)
    far = computer._replace(estimate=AttitudeRate(Vec3(*(3 * q / np.linalg.norm(q))), Vec3(*w)))
    now = Now(jnp.asarray(5), 0.5, 0.1)
    after, (xi, alarmed) = op.decide(p, now, far, y)
    assert xi == 0 and not alarmed
    np.testing.assert_allclose(array(after.estimate.q), -q / np.linalg.norm(q) / 3, rtol=1e-12)
    half = op.decide(p, now, computer, y._replace(q=Reading(Vec3(*(q + 0.01)), True)))[1]
    np.testing.assert_allclose(half[0], 0.01 * np.sqrt(3), rtol=1e-9)  # the attitude alone


def test_a_run_goes_through_an_outage_on_its_estimate():
    """2 s of no readings: the noiseless loop with the believed inertia does not notice; with noise nothing alarms."""
    gap = on_axes(Fault(onset=1.0, end=3.0, missing=1.0))
    run = lambda s: start_of(60, simulate(op.system, op.params, s, KEY, ticks=LONG))
    told, blind = run(QUIET), run(QUIET._replace(star=gap, gyro=gap))
    for a, b in ((told.q, blind.q), (told.w, blind.w), (told.u, blind.u), (told.estimate.w, blind.estimate.w)):
        np.testing.assert_allclose(b, a, atol=1e-6)  # RK4 of estimate and truth
    noisy = run(op.scenario._replace(star=gap, gyro=gap))
    assert not noisy.alarm.any() and (noisy.xi[10:30] == 0).all() and (noisy.xi[30:] > 0).all()
