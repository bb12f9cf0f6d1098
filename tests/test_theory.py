"""What theory says, and no run has to be believed for: orders, chi-square, linear solutions, eigenvalues."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import chi2

from jaxatt import bodies, detection, simulate
from jaxatt.attitude import mrp_rate
from jaxatt.contract import System
from jaxatt.controllers import Adaptation
from jaxatt.engine import rk4
from jaxatt.faults import Reading
from jaxatt.filters import Belief, nees, predict, update
from jaxatt.linear import growth_rates, sampled
from jaxatt.loops import wheel_mrac as wm
from jaxatt.observers import AttitudeRate
from jaxatt.vec import Mat3, Vec3, array

KEY = jax.random.key(4)

# the engine's order


def test_the_engine_is_of_order_four():
    """A tumbling body under a torque that varies: errors fall by 16 where the steps are halved."""
    J = Mat3.of([[90.0, 2.0, -1.0], [2.0, 80.0, 3.0], [-1.0, 3.0, 60.0]])
    u = Vec3(0.3, -0.2, 0.1)

    def flow(params, scenario, t, x, z):
        return AttitudeRate(mrp_rate(x.q, x.w), bodies.body_acceleration(x.w, jnp.cos(t) * u, J))

    tick = lambda params, scenario, now, x, z, noise: (x, z, x)
    start = AttitudeRate(Vec3(0.1, 0.2, -0.1), Vec3(0.2, -0.3, 0.1))
    ends = []
    for substeps in (1, 2, 4, 32):
        loop = System(lambda params, scenario: (scenario, 0.0), tick, flow, dt=0.5, substeps=substeps)
        log = simulate(loop, (), start, KEY, ticks=9)
        ends.append(np.concatenate([array(log.q)[:, -1], array(log.w)[:, -1]]))
    errors = np.linalg.norm(np.array(ends[:3]) - ends[3], axis=1)
    np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), 4, atol=0.2)


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
    belief = Belief(np.zeros((n, 2)), np.broadcast_to(np.eye(2), (n, 2, 2)))

    @jax.jit
    @jax.vmap
    def filtered(belief, y, truth):
        belief = predict(belief, f, jnp.zeros(0), Q, dt)
        belief, told = update(belief, Reading(y, jnp.ones(1, bool)), h, R)
        return belief, told.nis, nees(belief, truth)

    P, nis, wrong = np.eye(2), [], []
    for _ in range(steps):
        x = Phi @ x + np.linalg.cholesky(noise) @ rng.normal(size=(2, n))
        y = H @ x + np.sqrt(R)[:, None] * rng.normal(size=(1, n))
        belief, *squares = filtered(belief, y.T, x.T)
        P = rk4(lambda t, P: A @ P + P @ A.T + np.diag(Q), 0.0, P, dt)
        P = P - P @ H.T @ H @ P / (H @ P @ H.T + R)
        nis.append(squares[0])
        wrong.append(squares[1])
    np.testing.assert_allclose(belief.cov[0], P, rtol=1e-10)
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
    loop, ticks = wm.system_of(sampled=True, substeps=5), 60
    params = LINEAR._replace(K=K, turn=0.0)
    matrix = sampled(loop, params, STILL, ticks=1, states=("x.theta", "x.y"))
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
