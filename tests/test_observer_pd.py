"""The paper's loop against the numbers of an independent implementation, and against its own mathematics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_up import tallied

from jaxatt import Fault, on_axes, scores, simulate, sweep
from jaxatt.attitude import mrp_error, mrp_matrix, mrp_rate, mrp_rate_transposed
from jaxatt.bodies import body_acceleration
from jaxatt.controllers import adapted_rate_gain, rate_gain_floor
from jaxatt.engine import Now, rk4
from jaxatt.estimators import AttitudeRate, mrp_observer
from jaxatt.faults import Channel
from jaxatt.study import batch
from jaxatt.systems import observer_pd as op
from jaxatt.vec import Vec3, array, cross, inverse, mat3, norm, vec3

HEALTHY = on_axes(Fault())
QUIET = op.scenario._replace(star=HEALTHY, gyro=HEALTHY, std_q=0.0, std_w=0.0)
FINE = op.system._replace(dt=0.01, substeps=1)  # ticks on the grid that the reference numbers are given on
KEY = jax.random.key(0)
RNG = np.random.default_rng(7)


def last_outside(values, bound, dt):
    return dt * np.max(np.flatnonzero(np.asarray(values) > bound))


def test_tracking_errors_vanish_at_the_target_alone():
    target = op.params._replace(q_d=Vec3(0.1, 0.2, -0.1), w_d=Vec3(0.01, -0.02, 0.03))
    e = op.errors(target, AttitudeRate(target.q_d, target.w_d))
    np.testing.assert_allclose([*e.q, *e.w], 0, atol=1e-16)
    e = op.errors(target, AttitudeRate(target.q_d, 2 * target.w_d))
    np.testing.assert_allclose(e.w, target.w_d)


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_lyapunov_identity_of_the_observer(sign):
    """V' = -alpha |xi_q|^2 - beta |xi_w|^2 for clean readings; with noise the exact form of the reference."""
    n, J, J_inv, alpha, beta = 200, op.INERTIA, inverse(op.INERTIA), 1.1, 15.0
    draw = lambda size=1.0: vec3(size * RNG.normal(size=(3, n)))
    for noise in (0.0, 0.3):
        q, w, q_hat, w_hat, u = (draw() for _ in range(5))
        n_q, n_w = draw(noise), draw(noise)
        y, estimate = AttitudeRate(q + n_q, w + n_w), AttitudeRate(q_hat, w_hat)
        hat = mrp_observer(estimate, y, u, J, J_inv, alpha, beta, sign)
        e_q, e_w = q - q_hat, w - w_hat
        dV = e_q @ (mrp_rate(q, w) - hat.q) + e_w @ (J @ (body_acceleration(w, u, J, J_inv, sign) - hat.w))
        dG_w = mrp_rate(y.q, w) - mrp_rate(q, w)
        expected = (
            -alpha * (e_q @ e_q) - beta * (e_w @ e_w) - alpha * (e_q @ n_q) - beta * (e_w @ n_w) - e_q @ dG_w
            - sign * (e_w @ cross(w_hat, J @ n_w)) - e_w @ mrp_rate_transposed(y.q, n_q)
        )  # fmt: skip
        np.testing.assert_allclose(dV, expected, atol=1e-10)


def test_the_flow_is_the_papers_equations_in_plain_matrices():
    """Sensors err between ticks as their channels say; the board knows another inertia than the body has."""
    rng = np.random.default_rng(9)
    full = lambda: np.diag(rng.uniform(50, 90, 3)) + 2 * (lambda a: a + a.T)(rng.normal(size=(3, 3)))
    (J, believed), (q, w, q_hat, w_hat, q_d, w_d) = (full(), full()), 0.3 * rng.normal(size=(6, 3))
    (gain_q, gain_w), (off_q, off_w) = rng.uniform(0.5, 1.5, (2, 3)), 0.1 * rng.normal(size=(2, 3))
    p = op.params._replace(J=mat3(believed), q_d=Vec3(*q_d), w_d=Vec3(*w_d))
    x, z = op.init(p, op.scenario._replace(J=mat3(J), q=Vec3(*q), w=Vec3(*w), q_hat=Vec3(*q_hat), w_hat=Vec3(*w_hat)))
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
    got = op.flow(p, op.scenario._replace(J=mat3(J)), 0.0, x, z)
    np.testing.assert_allclose(array(got.q), G(q) @ w, rtol=1e-12)
    np.testing.assert_allclose(array(got.w), np.linalg.solve(J, -np.cross(w, J @ w) + u), rtol=1e-12)
    np.testing.assert_allclose(array(got.estimate.q), G(y_q) @ w_hat + p.alpha * (y_q - q_hat), rtol=1e-12)  # eq. (7)
    np.testing.assert_allclose(array(got.estimate.w), w_hat_rate, rtol=1e-12)


def test_every_reading_has_noise_of_its_own():
    scenario = QUIET._replace(std_q=0.1, std_w=0.2)
    x, z = op.init(op.params, scenario)
    noise = np.arange(1.0, 7.0)
    held = op.sense(op.params, scenario, Now(jnp.asarray(3), jnp.asarray(3.0), 1.0), x, z, jnp.asarray(noise))
    np.testing.assert_allclose(array(held.y.q), array(scenario.q) + 0.1 * noise[:3], rtol=1e-12)
    np.testing.assert_allclose(array(held.y.w), array(scenario.w) + 0.2 * noise[3:], rtol=1e-12)


@pytest.mark.parametrize(("sign", "drift"), [(-1, 5.9e-12), (1, 0.948)])
def test_momentum_is_conserved_by_eulers_sign_only(sign, drift):
    J, J_inv = op.INERTIA, inverse(op.INERTIA)

    def flow(t, x):
        return AttitudeRate(mrp_rate(x.q, x.w), body_acceleration(x.w, Vec3(0.0, 0.0, 0.0), J, J_inv, sign))

    momentum = lambda x: mrp_matrix(x.q) @ (J @ x.w)
    step = jax.jit(lambda x, _: (rk4(flow, 0.0, x, 0.001), None))
    start = AttitudeRate(Vec3(0.0, 0.0, 0.0), vec3(list(op.scenario.w)))
    start = jax.tree.map(jnp.asarray, start)
    end, _ = jax.lax.scan(step, start, None, 20_000)
    change = float(norm(momentum(end) - momentum(start)) / norm(momentum(start)))
    if sign < 0:
        assert change < 1e-9
    else:
        assert change == pytest.approx(drift, rel=0.01)


@pytest.mark.parametrize(("sign", "settling"), [(-1.0, 5.22), (1.0, 5.31)])
def test_the_nominal_slew(sign, settling):
    params, scenario = op.params._replace(sign=sign), QUIET._replace(sign=sign)
    log = simulate(FINE, params, scenario, KEY, ticks=1000)
    assert last_outside(norm(log.q), 0.01, 0.01) + 0.01 == pytest.approx(settling, abs=0.02)
    assert norm(log.u).max() == pytest.approx(147.52, abs=0.01)


def test_the_observer_from_zero():
    zero = Vec3(0.0, 0.0, 0.0)
    log = simulate(FINE, op.params, QUIET._replace(q_hat=zero, w_hat=zero), KEY, ticks=1200)
    assert log.xi[0] == pytest.approx(1.514188, abs=1e-6)
    assert last_outside(log.xi, 0.01, 0.01) == pytest.approx(8.86, abs=0.02)


@pytest.mark.slow
def test_the_rate_gain_lands_on_its_floor_and_never_below():
    params = op.params._replace(eps=0.00304)
    floor = float(rate_gain_floor(Vec3(0.0, 0.0, 0.0), 0.00304, 31.8566039))
    assert floor == pytest.approx(1.5726, abs=1e-4)
    for dt in (0.02, 0.05, 0.1):
        log = simulate(op.system._replace(dt=dt), params, QUIET, KEY, ticks=round(60 / dt))
        assert log.k_w[-1] == pytest.approx(1.5726, abs=0.001)
        assert (log.k_w >= floor - 1e-9).all() and (jnp.diff(log.k_w) <= 0).all()


def test_the_adaptation_step_is_the_solution_of_19():
    e_q, e_w, eps, lam = Vec3(0.1, 0.2, -0.1), Vec3(0.05, 0.0, 0.1), 0.1, 31.86
    h = rate_gain_floor(e_q, eps, lam)
    c = eps * lam * norm(e_w) + 1 + e_q @ e_q
    k_w = 125.0
    for _ in range(1000):
        k_w = rk4(lambda t, k: -c * c / (2 * eps * (k - h)), 0.0, k_w, 0.01)
    assert adapted_rate_gain(125.0, e_q, e_w, eps, lam, 10.0) == pytest.approx(float(k_w), rel=1e-10)
    assert adapted_rate_gain(125.0, e_q, e_w, eps, lam, 1e9) == pytest.approx(float(h), rel=1e-14)
    assert adapted_rate_gain(1.0, e_q, e_w, eps, lam, 10.0) == 1.0  # below the floor it stays


def windows(params, scenario, now, log):
    """Tallies of the table of section 3 of the reference."""
    inside = [(now.t >= a) & (now.t < b) for a, b in ((60, 150), (150, 250), (250, 350))]
    qq, ww = log.e_q @ log.e_q, log.e_w @ log.e_w
    return [
        (scores.mean(log.xi**2, i), scores.mean(log.alarm, i), scores.mean(qq, i), scores.mean(ww, i)) for i in inside
    ]


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
    swept = sweep(
        system, op.params._replace(eps=eps), batch(op.scenario, 64), jax.random.key(21), ticks=3500, score=windows
    )
    for got, (xi, share, q, w) in zip(swept, table):
        rms = [np.sqrt(a.mean()) for a in (got[0], got[2], got[3])]
        np.testing.assert_allclose(rms, [xi, q, w], rtol=tolerance)
        assert got[1].mean() == pytest.approx(share, abs=0.002)


def test_constant_faults_hide():
    """Spec, 4: biases of 0.03 leave |xi| at 0.0119 before and after the second, with a dip below the threshold."""
    scenario = QUIET._replace(star=on_axes(Fault(250.0, bias=0.03)), gyro=on_axes(Fault(150.0, bias=0.03)))
    log = simulate(op.system, op.params, scenario, KEY, ticks=3500)
    assert log.xi[2490] == pytest.approx(0.0119, rel=0.02) and log.xi[-1] == pytest.approx(0.0119, rel=0.02)
    assert log.xi[2500:].min() < 0.01


@pytest.mark.slow
def test_gradients_are_finite_at_rest():
    zero = Vec3(0.0, 0.0, 0.0)
    scenario = QUIET._replace(q=zero, w=zero, q_hat=zero, w_hat=zero)
    everything = lambda params, scenario: sum(
        jnp.sum(a) for a in jax.tree.leaves(simulate(op.system, params, scenario, KEY, ticks=10)) if a.dtype != bool
    )
    params, scenario = jax.tree.map(jnp.asarray, (op.params, scenario))
    for gradient in jax.tree.leaves(jax.jit(jax.grad(everything, argnums=(0, 1)))(params, scenario)):
        assert np.isfinite(gradient).all()


def test_torque_saturation_holds_on_every_axis():
    log = simulate(op.system, op.params._replace(u_max=1.0), QUIET, KEY, ticks=600)
    assert np.abs(array(log.u)).max() == 1.0 and norm(log.q)[-1] < norm(log.q)[0]


def test_the_shadow_set_keeps_a_tumbling_body_inside_the_unit_ball():
    scenario = QUIET._replace(
        w=Vec3(0.0, 0.0, 3.0), w_hat=Vec3(0.0, 0.0, 3.0), q=Vec3(0.0, 0.0, 0.0), q_hat=Vec3(0.0, 0.0, 0.0)
    )
    log = simulate(op.system, op.params._replace(u_max=0.01), scenario, KEY, ticks=100)
    assert norm(log.q).max() <= 1 and log.xi[1:].max() < 0.01


def test_scores_of_a_run_with_known_answers():
    start = QUIET._replace(gyro=on_axes(Fault(30.0, bias=0.2)))
    swept = sweep(op.system, op.params, batch(start, 2), KEY, ticks=500, score=op.score)
    assert swept.delay[0] == 0 and swept.miss[0] < 0.05
    assert swept.false_alarms[0] == 0 and swept.start_up_alarms[0] == 0
    assert swept.settling[0] == pytest.approx(5.2, abs=0.11)
    assert swept.peak_u[0] >= 147.52 and swept.rms_u_ill[0] < swept.rms_u[0]


J_FLAT = op.INERTIA._replace(z=Vec3(-1.0, 3.0, -10.0))


@pytest.mark.parametrize(
    ("params", "scenario", "message"),
    [
        (
            dict(J=J_FLAT),
            {},
            r"`params.J` must be positive definite, but its smallest principal moment is -10\.\d+ kg m\^2",
        ),
        ({}, dict(J=J_FLAT), r"`scenario.J` must be positive definite"),
        (dict(J=op.INERTIA._replace(x=Vec3(15.0, 9.0, -1.0))), {}, "symmetric"),
        (dict(alpha=-1.0), {}, r"`params.alpha` must be a positive number, but it is -1\."),
        (dict(k_q=0.0), {}, r"`params.k_q` must be a positive number, but it is 0\."),
        (dict(k_w0=np.nan), {}, r"`params.k_w0` must be a positive number, but it is nan\."),
        (dict(sigma=0.0), {}, r"`params.sigma` must be a positive number, but it is 0\."),
        (dict(eps=0.4), {}, r"`params.eps` must lie in \(0, 0.354348\).*but it is 0.4"),
        (dict(eps=0.0), {}, r"`params.eps` must lie in \(0, 0.354348\).*but it is 0"),
        (dict(u_max=0.0), {}, r"`params.u_max` must be greater than 0"),
        (dict(sign=0.5), {}, r"`params.sign` must be one of \(-1, 1\), but it is 0.5"),
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
    log = op.Log(three(1), three(1), e_q, three(1), three(1), rng.random(16), alarm, rng.random(16))
    fault = HEALTHY._replace(y=Fault(onset=onset, end=end, bias=1.0))
    got = tallied(op.score, op.params, op.scenario._replace(star=HEALTHY, gyro=fault), log, dt)
    t = dt * np.arange(16)
    start, before, ill = t < op.START_UP, t < onset, (t >= onset) & (t < end)
    size = lambda v: np.linalg.norm(np.stack(v), axis=0)
    rms = lambda a: np.sqrt(np.mean(a**2))
    q, w, u = size(log.e_q), size(log.e_w), size(log.u)
    found = {
        "delay": 28 - onset, "start_up_alarms": alarm[start & before].mean(), "false_alarms": alarm[~start & before].mean(),
        "miss": (~alarm[ill]).mean(), "rms_q": rms(q), "rms_w": rms(w), "rms_q_ill": rms(q[ill]), "rms_w_ill": rms(w[ill]),
        "peak_q": q[~start].max(), "peak_w": w[~start].max(), "settling": t[q > 0.01][-1], "rms_u": rms(u), "rms_u_ill": rms(u[ill]),
        "peak_u": u.max(), "ok": True,
    }  # fmt: skip
    for name in op.Scores._fields:
        np.testing.assert_allclose(getattr(got, name), found[name], rtol=1e-12, err_msg=name)
