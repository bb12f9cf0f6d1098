"""What theory says, and no run has to be believed for: groups, conserved quantities, orders, decrease, chi-square,
linear solutions, eigenvalues."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.stats import chi2

from jaxatt import attitude as at
from jaxatt import bodies, detection, mounting, simulate
from jaxatt.controllers import Adaptation, quaternion_pd
from jaxatt.engine import System, rk4
from jaxatt.estimators import AttitudeRate
from jaxatt.faults import Fault, Reading, on_axes
from jaxatt.kalman import Belief, ekf_predict, kalman_update, nees
from jaxatt.linear import growth_rates, sampled
from jaxatt.study import batch
from jaxatt.systems import observer_pd as op
from jaxatt.systems import wheel_mrac as wm
from jaxatt.vec import Mat3, Quat, Vec3, array, cross, inverse, mat3, norm, vec3

KEY = jax.random.key(4)
RNG = np.random.default_rng(11)
J = np.array([[90.0, 2.0, -1.0], [2.0, 80.0, 3.0], [-1.0, 3.0, 60.0]])
law = settings(max_examples=60, deadline=None, derandomize=True, database=None)


def close(a, b, tolerance=1e-12):
    np.testing.assert_allclose(np.asarray(array(a)), np.asarray(array(b)), rtol=tolerance, atol=tolerance)


def lanes(n=40, size=1.0):
    return vec3(size * RNG.normal(size=(3, n)))


# groups


finite = dict(allow_nan=False, allow_infinity=False, allow_subnormal=False)  # XLA may flush subnormals to zero
coordinate = st.one_of(st.floats(-3, 3, **finite), st.sampled_from([0.0, 1.0, -1.0, 1e-9, 1e3, -1e-3]))
mrps = st.builds(Vec3, coordinate, coordinate, coordinate).map(lambda q: Vec3(*map(np.float64, q)))
units = mrps.map(at.quat_from_mrp)
turns = st.floats(-3.1, 3.1, **finite)
eulers = st.builds(Vec3, turns, st.floats(-1.5, 1.5, **finite), turns).map(lambda a: Vec3(*map(np.float64, a)))


@law
@given(mrps, mrps, mrps)
def test_mrp_make_a_group(p, q, r):
    times, matrix = at.mrp_product, at.mrp_matrix
    close(matrix(times(times(p, q), r)), matrix(times(p, times(q, r))), 1e-9)
    close(matrix(times(p, q)), matrix(p) @ matrix(q), 1e-9)
    zero = Vec3(0.0, 0.0, 0.0)
    for e in (times(p, zero), times(zero, p)):
        close(matrix(e), matrix(p), 1e-9)
    for e in (times(p, -p), times(-p, p), at.mrp_error(p, p)):
        close(matrix(e), matrix(zero), 1e-9)
    assert norm(times(p, q)) <= 1 + 1e-12
    close(matrix(at.mrp_inner(p)), matrix(p), 1e-9)
    close(matrix(p).T @ matrix(p), matrix(zero), 1e-9)


@law
@given(units, units, units, mrps)
def test_unit_quaternions_make_a_group_that_acts_on_vectors(p, q, r, v):
    one = Quat(1.0, 0.0, 0.0, 0.0)
    close((p * q) * r, p * (q * r))
    close(p * one, p)
    close(one * p, p)
    close(p * at.quat_conjugate(p), one)
    close(at.quat_error(p, q), at.quat_conjugate(q) * p)
    close(at.quat_matrix(p * q), at.quat_matrix(p) @ at.quat_matrix(q))
    size = 1 + norm(v)
    close(at.quat_rotate(p, at.quat_rotate(q, v)) / size, at.quat_rotate(p * q, v) / size)
    close(at.quat_rotate(p, v) / size, (at.quat_matrix(p) @ v) / size)
    assert abs(norm(at.quat_rotate(p, v)) / size - norm(v) / size) < 1e-12
    assert abs(norm(p * q) - 1) < 1e-12
    back = at.quat_from_mrp(at.mrp_from_quat(p))
    close(back * (1.0 if back @ p > 0 else -1.0), p, 1e-9)
    assert abs(at.quat_angle(at.quat_error(p, q)) - 2 * np.arccos(min(abs(p @ q), 1.0))) < 1e-6


@law
@given(eulers, eulers)
def test_euler_angles_are_coordinates_of_the_group(a, b):
    p, q = at.quat_from_euler(a), at.quat_from_euler(b)
    both = at.euler_from_quat(p * q)
    assert abs(both.y) <= np.pi / 2 + 1e-12
    close(at.quat_matrix(at.quat_from_euler(both)), at.quat_matrix(p) @ at.quat_matrix(q), 1e-7)
    close(at.quat_matrix(at.quat_from_euler(at.euler_from_quat(p))), at.quat_matrix(p), 1e-7)
    w = Vec3(0.3, -0.2, 0.5)
    close(at.euler_body_rate(a, at.euler_rate(a, w)), w, 1e-9)


def test_angles_of_one_axis_add():
    for axis in range(3):
        turn = lambda s, axis=axis: at.quat_from_euler(Vec3(*np.eye(3)[axis] * s))
        close(turn(0.4) * turn(0.5), turn(0.9))
        close(turn(0.7), at.quat_from_vector(Vec3(*np.eye(3)[axis] * 0.7)))
    r = Vec3(1e-6, -2e-6, 3e-6)  # where sin(h) / h is its series
    close(at.quat_from_vector(r).v * 2, r, 1e-17)
    close(at.quat_from_vector(1e4 * r), Quat(np.cos(norm(r) * 5e3), *(r * (np.sin(norm(r) * 5e3) / norm(r)))), 1e-15)


# conserved quantities


def test_a_free_rigid_body_keeps_momentum_and_energy():
    M = mat3(J)
    q, w = lanes(), lanes()
    dw = bodies.body_acceleration(w, Vec3(0.0, 0.0, 0.0), M, inverse(M))
    np.testing.assert_allclose(w @ (M @ dw), 0, atol=1e-11)  # energy
    close(M @ dw + cross(w, M @ w), 0 * w, 1e-11)  # momentum in inertial axes
    dq = at.mrp_rate(q, w)
    change = jax.jvp(lambda q, w: at.mrp_matrix(q) @ (M @ w), (q, w), (dq, dw))[1]
    close(change, 0 * w, 1e-10)
    u = lanes()
    dw = bodies.body_acceleration(w, u, M, inverse(M))
    np.testing.assert_allclose(w @ (M @ dw), w @ u, atol=1e-11)  # power


def test_a_body_with_wheels_keeps_momentum_and_its_motors_work():
    M, axes = mat3(J), mounting.wheel_pyramid(np.float64(0.7))
    q, w = lanes(), lanes()
    h, motor = RNG.normal(size=(2, 4, 40))
    H, T = mounting.total(axes, h), mounting.total(axes, motor)
    dw = bodies.wheeled_acceleration(w, H, T, M, inverse(M))
    momentum = lambda q, w, h: at.mrp_matrix(q) @ (M @ w + mounting.total(axes, h))
    change = jax.jvp(momentum, (q, w, h), (at.mrp_rate(q, w), dw, motor))[1]
    close(change, 0 * w, 1e-10)
    # kinetic energy w.Jw/2 + h^2/(2 Js): the motors, turning at h/Js - g.w, give all of its change
    spin = 0.05
    gain = w @ (M @ dw) + (h * motor).sum(0) / spin
    power = (motor * (h / spin - np.asarray(mounting.along(axes, w)))).sum(0)
    np.testing.assert_allclose(gain, power, rtol=1e-10, atol=1e-10)


def test_gravity_gradient_keeps_jacobis_integral():
    """On a circular orbit, in the orbit frame: T = w.Jw/2 + 3 wo^2 z.Jz/2 - wo y.Jy wo/2, w relative to the frame."""
    M, rate = mat3(J), 1.1e-3
    p, w = at.quat_from_mrp(lanes(size=0.5)), lanes(size=2e-3)
    seen = lambda p, v: at.quat_rotate(at.quat_conjugate(p), v)
    o = np.zeros(40)
    z, y = Vec3(o, o, o + 1), Vec3(o, o + 1, o)

    def integral(p, w):
        relative, down, normal = w + rate * seen(p, y), seen(p, z), seen(p, y)
        kinetic = relative @ (M @ relative) / 2
        return kinetic + 1.5 * rate**2 * (down @ (M @ down)) - rate**2 * (normal @ (M @ normal)) / 2

    u = bodies.gravity_gradient(seen(p, z), M, rate)
    dw = bodies.body_acceleration(w, u, M, inverse(M))
    dp = at.quat_rate(p, w) - 0.5 * (Quat(o, o, o - rate, o) * p)
    value, change = jax.jvp(integral, (p, w), (dp, dw))
    np.testing.assert_allclose(change / value, 0, atol=1e-12)
    np.testing.assert_allclose(u @ seen(p, z), 0, atol=1e-12)  # no torque about the vertical


def test_a_quaternion_pd_loop_is_linear_and_takes_out_energy():
    """J w' = u - w x J w makes w' = -2 wn^2 sign(e0) ev - 2 zeta wn w: eigenvalues of a second-order system."""
    M, wn, zeta = mat3(J), 0.05, 0.9
    e, w = at.quat_from_mrp(lanes(size=0.5)), lanes(size=0.1)
    u = quaternion_pd(e, w, w, M, wn, zeta)
    dw = bodies.body_acceleration(w, u, M, inverse(M))
    close(dw, -(2 * wn**2 * jnp.sign(e.w)) * e.v - 2 * zeta * wn * w, 1e-13)
    energy = lambda e, w: w @ w / 2 + 4 * wn**2 * (1 - jnp.abs(e.w))
    change = jax.jvp(energy, (e, w), (at.quat_rate(e, w), dw))[1]
    np.testing.assert_allclose(change, -2 * zeta * wn * (w @ w), atol=1e-14)


# the engine's order


def test_the_engine_is_of_order_four():
    """A tumbling body, torque held over every tick: errors fall by 16 where the steps are halved."""
    M = mat3(J)
    u = Vec3(0.3, -0.2, 0.1)

    def flow(params, scenario, t, x, z):
        return AttitudeRate(at.mrp_rate(x.q, x.w), bodies.body_acceleration(x.w, jnp.cos(t) * u, M, inverse(M)))

    tick = lambda params, scenario, now, x, z, noise: (x, z, x)
    start = AttitudeRate(Vec3(0.1, 0.2, -0.1), Vec3(0.2, -0.3, 0.1))
    ends = []
    for substeps in (1, 2, 4, 32):
        loop = System(lambda params, scenario: (scenario, 0.0), tick, flow, dt=0.5, substeps=substeps)
        log = simulate(loop, (), start, KEY, ticks=9)
        ends.append(np.concatenate([array(log.q)[:, -1], array(log.w)[:, -1]]))
    errors = np.linalg.norm(np.array(ends[:3]) - ends[3], axis=1)
    np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), 4, atol=0.2)


# decrease


def test_the_observers_lyapunov_function_falls_from_random_states():
    """V = |q - qh|^2 / 2 + (w - wh) J (w - wh) / 2 never grows in a clean closed loop (Yun & Kang, theorem 1)."""
    n, rng = 12, np.random.default_rng(5)
    s = batch(op.scenario._replace(star=on_axes(Fault()), gyro=on_axes(Fault()), std_q=0.0, std_w=0.0), n)
    draw = lambda size: vec3(size * rng.normal(size=(3, n)))
    s = s._replace(q=draw(0.3), w=draw(0.2), q_hat=draw(0.3), w_hat=draw(0.2))
    log = simulate(_seen(op.system), op.params, s, jax.random.split(KEY, n), ticks=120)
    M = mat3(np.array(op.INERTIA)[..., None, None])
    e_q, e_w = log.q - log.q_hat, log.w - log.w_hat
    V = np.asarray(e_q @ e_q + e_w @ (M @ e_w)) / 2
    same = np.asarray(norm(log.q)[1:] - norm(log.q)[:-1]) < 0.3  # the shadow switch moves both, and V with them
    growth = np.diff(V, axis=0)
    assert (growth[same] <= 1e-12).all()
    assert (V[-1] < 1e-3 * V[0]).all()


def _seen(system):
    """The loop, its log the truth and the estimate after the tick's shadow switches."""

    def tick(params, scenario, now, x, z, noise):
        x, z, _ = system.tick(params, scenario, now, x, z, noise)
        return x, z, op.Scenario(q=x.q, w=x.w, q_hat=x.estimate.q, w_hat=x.estimate.w)

    return system._replace(tick=tick)


# covariance


def test_a_kalman_filter_of_a_linear_system_is_honest():
    """NIS and NEES of 400 runs of 40 steps lie in the 99.9 % bands of their chi-squares; the covariance is RK4's."""
    n, steps, dt = 400, 40, 0.1
    A = np.array([[0.0, 1.0], [-1.0, -0.2]])
    Q, R, H = np.array([0.0, 0.3]), np.array([0.04]), np.array([[1.0, 0.5]])
    step = expm(np.block([[A, np.diag(Q)], [np.zeros((2, 2)), -A.T]]) * dt)  # Van Loan
    Phi = step[:2, :2]
    noise = step[:2, 2:] @ Phi.T
    rng = np.random.default_rng(8)
    x = rng.normal(size=(2, n))
    # components written out: the filter knows no matrix
    f = lambda x: jnp.stack([x[1], -x[0] - 0.2 * x[1]])
    h = lambda x: (x[0] + 0.5 * x[1])[None]
    belief = Belief(jnp.zeros((2, n)), jnp.broadcast_to(jnp.eye(2)[..., None], (2, 2, n)))

    @jax.jit
    def filtered(belief, y):
        belief = ekf_predict(belief, f, jnp.zeros((0, n)), jnp.asarray(Q), dt)
        return kalman_update(belief, Reading(y, jnp.ones(y.shape, bool)), h, jnp.asarray(R))

    P, nis, wrong = np.eye(2), [], []
    for _ in range(steps):
        x = Phi @ x + np.linalg.cholesky(noise) @ rng.normal(size=(2, n))
        y = H @ x + np.sqrt(R)[:, None] * rng.normal(size=(1, n))
        belief, met = filtered(belief, y)
        P = rk4(lambda t, P: A @ P + P @ A.T + np.diag(Q), 0.0, P, dt)
        P = P - P @ H.T @ H @ P / (H @ P @ H.T + R)
        nis.append(met.nis)
        wrong.append(nees(belief, x))
    np.testing.assert_allclose(belief.cov[..., 0], P, rtol=1e-10)
    for values, dof, independent in ((nis, 1, 40 * n), (wrong[5:], 2, 5 * n)):  # errors last for a second
        values = np.asarray(values)
        mean = values.mean(1)
        low, high = chi2.ppf([0.0005, 0.9995], dof * n) / n
        assert np.mean((mean > low) & (mean < high)) > 0.94
        share = np.mean(values > chi2.ppf(0.95, dof))
        assert share == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / independent))


# linear solutions


LINEAR = wm.params._replace(law=Adaptation(gamma=0.0), ope=0.0, a_r=0.4, a_y=-0.1, K=1.5, b_m=9.0, a_m=11.0)
STILL = wm.scenario._replace(noise=0.0, momentum=3e-3, torque=2e-6)


def exact(params, s, ticks, dt=wm.DT):
    """The wheel loop without adaptation, solved by the matrix exponential over every tick: theta, y, y_m, turns."""
    a, b = s.wheel.a - s.wheel.b * params.a_y, s.wheel.b * params.a_r
    # state theta, y, y_m, t, r, 1 with r held
    A = np.zeros((6, 6))
    A[0, 1], A[0, 3], A[0, 5] = -s.J_w / s.J_z, np.degrees(s.torque) / s.J_z, s.momentum / s.J_z
    A[1, 1], A[1, 4] = -a, b
    A[2, 2], A[2, 4] = -params.a_m, params.b_m
    A[3, 5] = 1
    step, x, rows = expm(A * dt), np.array([0.0, 0, 0, 0, 0, 1]), []
    for k in range(ticks):
        target, rate = (float(v) for v in wm.slew(params, k * dt))
        x[4] = (params.forward * rate + params.K * (target - x[0])) / (-params.J_w / params.J_hat)
        rows.append(x[:3].copy())
        x = step @ x
    return np.array(rows)


def test_the_wheel_loop_without_adaptation_is_its_linear_solution():
    log = simulate(wm.system, LINEAR, STILL, KEY, ticks=1500)
    theirs = exact(LINEAR, STILL, 1500)
    ours = np.stack([log.theta, log.y, log.y_m], axis=1)
    scale = np.abs(theirs).max(0)
    np.testing.assert_allclose(ours / scale, theirs / scale, atol=1e-9)


@pytest.mark.parametrize("K", [1.5, 300.0])
@pytest.mark.slow
def test_sampled_eigenvalues_are_the_growth_of_a_run(K):
    """The slowest mode of the sampled wheel loop, stable and unstable, against two runs that start apart."""
    loop, ticks = wm.loop(sampled=True, substeps=5), 60
    params = LINEAR._replace(K=K, turn=0.0)
    matrix = sampled(loop, params, STILL, ticks=1, states=("theta", "y"))
    grown = np.asarray(growth_rates(matrix, wm.DT))
    values = np.linalg.eigvals(matrix)
    assert (grown[0] > 0) == (K > 2)
    apart = 1e-3
    log = [
        simulate(loop._replace(init=lambda p, s, d=d: _moved(wm.init(p, s), d)), params, STILL, KEY, ticks=ticks)
        for d in (0.0, apart)
    ]
    gap = np.stack([log[1].theta - log[0].theta, log[1].y - log[0].y])
    predicted = np.linalg.matrix_power(matrix, ticks - 1) @ np.array([apart, 0.0])
    np.testing.assert_allclose(gap[:, -1], predicted, rtol=1e-5, atol=1e-9 * np.abs(predicted).max())
    assert np.log(np.abs(values).max()) / wm.DT == pytest.approx(grown[0], rel=1e-12)


def _moved(xz, by):
    x, z = xz
    return x._replace(theta=x.theta + by), z


# chi-square


def test_windowed_chi_square_has_its_mean_and_its_tail():
    """A window of N values of r' M^-1 r is chi-square with 3 N degrees of freedom: thresholds in its units."""
    r = np.random.default_rng(2).normal(size=(3, 20_000, 5))
    J_ = detection.windowed((r**2).sum(0), 4)[3:]
    assert np.mean(J_) == pytest.approx(12, rel=0.01) and np.var(J_) == pytest.approx(24, rel=0.03)
    limit = detection.threshold_quantile(0.01, 12)
    assert np.mean(detection.alarm(J_, limit)) == pytest.approx(0.01, abs=0.002)
    assert detection.threshold_moment(3.0, 12) == pytest.approx(12 + 3 * np.sqrt(24))
    assert detection.threshold_nsigma(3.0, 12) == 108 and detection.threshold_mean(3.0, 12) == 36


def test_rk4_of_a_tree_is_the_taylor_series_to_fourth_order():
    h = 0.1
    out = rk4(lambda t, x: {"a": x["a"], "b": t**3}, 0.5, {"a": 1.0, "b": 0.0}, h)
    assert out["a"] == pytest.approx(1 + h + h**2 / 2 + h**3 / 6 + h**4 / 24, rel=1e-14)
    assert out["b"] == pytest.approx((0.6**4 - 0.5**4) / 4, rel=1e-12)  # Simpson's rule is exact for cubics


def test_matrices_of_components():
    m = RNG.normal(size=(3, 3))
    M = mat3(m)
    assert isinstance(M @ M, Mat3)
    np.testing.assert_allclose(array(M.T @ M), m.T @ m, rtol=1e-12)
