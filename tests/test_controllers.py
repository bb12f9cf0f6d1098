"""Laws that turn a body, against their equations and what they promise. Those of a wheel: tests/test_wheel_mrac.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt.attitude import quat_error, quat_from_mrp, quat_rate, quat_rotate
from jaxatt.bodies import body_acceleration
from jaxatt.controllers import adapted_rate_gain, pd, pd_margins, pid, quaternion_pd, rate_gain_floor, saturated
from jaxatt.engine import rk4
from jaxatt.vec import Mat3, Vec3, array, norm, zeros

RNG = np.random.default_rng(12)
N = 40
J = Mat3.of([[90.0, 2.0, -1.0], [2.0, 80.0, 3.0], [-1.0, 3.0, 60.0]])


def draw(size=1.0):
    return Vec3.of(size * RNG.normal(size=(3, N)))


def close(a, b, tolerance=1e-12):
    np.testing.assert_allclose(array(a), array(b), rtol=tolerance, atol=tolerance)


def test_laws_act_against_the_error_on_every_axis_with_its_own_gain():
    e, w, integral = Vec3(0.1, -0.2, 0.3), Vec3(0.4, 0.5, -0.6), Vec3(7.0, -8.0, 9.0)
    close(pd(e, w, 2.0, 10.0), Vec3(-4.2, -4.6, 5.4))
    k = [Vec3.of(10.0**i * np.array([1.0, 2.0, 3.0])) for i in range(4)]
    expected = [-f * (p * a + i * s + d * r) for f, p, i, d, a, s, r in zip(*k, e, integral, w)]
    close(pid(e, integral, w, *k), Vec3(*expected))


def test_saturation_limits_every_axis_by_itself():
    u = Vec3(3.0, -0.5, -7.0)
    assert saturated(u, 2.0) == (2.0, -0.5, -2.0)
    assert saturated(u, np.inf) == u


def test_the_floor_of_the_rate_gain_is_that_of_the_reference():
    assert rate_gain_floor(zeros(), 0.00304, 31.8566039) == pytest.approx(1.5726, abs=1e-4)
    e = Vec3(0.3, -0.4, 1.2)  # |e| = 1.3
    assert rate_gain_floor(e, 0.1, 30.0) == pytest.approx(0.75 * (3 + 2 * 1.3 + 3 * 1.69) + 1.5, rel=1e-14)


def test_the_adaptation_step_is_the_solution_of_19():
    e_q, e_w, eps, lam = Vec3(0.1, 0.2, -0.1), Vec3(0.05, 0.0, 0.1), 0.1, 31.86
    h = rate_gain_floor(e_q, eps, lam)
    c = eps * lam * norm(e_w) + 1 + e_q @ e_q
    step = lambda k_w, _: (rk4(lambda t, k: -c * c / (2 * eps * (k - h)), 0.0, k_w, 0.01), None)
    k_w, _ = jax.lax.scan(step, jnp.asarray(125.0), None, 1000)
    assert adapted_rate_gain(125.0, e_q, e_w, eps, lam, 10.0) == pytest.approx(float(k_w), rel=1e-10)
    assert adapted_rate_gain(125.0, e_q, e_w, eps, lam, 1e9) == pytest.approx(float(h), rel=1e-14)
    assert adapted_rate_gain(1.0, e_q, e_w, eps, lam, 10.0) == 1.0  # below the floor it stays


def test_a_quaternion_pd_loop_is_linear_and_takes_out_energy():
    """J w' = u - w x (J w + h) makes w' = -2 wn^2 sign(e0) ev - 2 zeta wn w: eigenvalues of a second-order system."""
    wn, zeta = 0.05, 0.9
    e, w = quat_from_mrp(draw(0.5)), draw(0.1)
    for h in (None, draw(5.0)):
        u = quaternion_pd(e, w, w, J, wn, zeta, h=h)
        dw = body_acceleration(w, u, J, h)
        close(dw, -(2 * wn**2 * jnp.sign(e.w)) * e.v - 2 * zeta * wn * w, 1e-13)
    energy = lambda e, w: w @ w / 2 + 4 * wn**2 * (1 - jnp.abs(e.w))
    change = jax.jvp(energy, (e, w), (quat_rate(e, w), dw))[1]
    np.testing.assert_allclose(change, -2 * zeta * wn * (w @ w), atol=1e-14)


def test_feed_forward_keeps_a_body_on_a_target_that_accelerates():
    """Without an error the body's acceleration is the target's."""
    w, acceleration, h = draw(0.1), draw(0.01), draw(5.0)
    on_target = quat_error(*[quat_from_mrp(draw(0.5))] * 2)
    u = quaternion_pd(on_target, 0 * w, w, J, 0.05, 0.9, acceleration, h)
    close(body_acceleration(w, u, J, h), acceleration, 1e-13)


def test_either_sign_of_the_error_quaternion_gives_the_same_torque():
    e, w = quat_from_mrp(draw(0.5)), draw(0.1)
    close(quaternion_pd(e, w, w, J, 0.05, 0.9), quaternion_pd(-e, w, w, J, 0.05, 0.9))


def test_the_torque_turns_with_the_body_axes():
    """No axis is special: law and inertia seen from turned body axes give the turned torque."""
    e, w, t = quat_from_mrp(draw(0.5)), draw(0.1), quat_from_mrp(Vec3(0.2, -0.3, 0.4))
    turned = lambda v: quat_rotate(t, v)
    columns = Mat3(*(turned(Vec3.of(a)) for a in np.eye(3)))  # rows are the turned axes: the transpose of the matrix
    J_turned = columns.T @ J @ columns
    e_turned = e._replace(**turned(e.v)._asdict())
    u = quaternion_pd(e_turned, turned(w), turned(w), J_turned, 0.05, 0.9)
    close(u, turned(quaternion_pd(e, w, w, J, 0.05, 0.9)), 1e-11)


def test_the_margins_of_the_papers_proof():
    """From an independent implementation: k_q = 330 needs eps > 0.00303032; T_I at the start is 31.7 for eps = 0.1, -0.0206 for 0.00304."""
    largest, q, w = 31.8566039, 0.76533, 1.30721
    m = pd_margins(330.0, 125.0, 0.1, largest, q, w)
    assert abs(m.T - 31.7) < 0.05 and m.eps == pytest.approx(0.354348 - 0.1, abs=1e-6)
    assert abs(pd_margins(330.0, 125.0, 0.00304, largest, q, w).T + 0.0206) < 1e-4
    least = 330 - np.sqrt(330**2 - 2)  # root of k_q = eps / 2 + 1 / eps, eq. (18)
    assert least == pytest.approx(0.00303032, abs=5e-9)
    assert pd_margins(330.0, 125.0, least, largest).k_q == pytest.approx(0, abs=1e-7)
    h = 0.7 * largest / 4 * (3 + 2 * q + 3 * q * q) + 1.5  # the floor of the rate gain; here eps^2 / 2 counts
    c = 0.7 * largest * w + 1 + q * q
    T = pd_margins(330.0, 200.0, 0.7, largest, q, w).T
    assert pytest.approx(0.7 * 330 - 0.7**2 / 2 - 1 - c * c / (200 - h), rel=1e-9) == T
    assert pd_margins(330.0, 1.0, 0.1, largest, q, w).T < 0
    gradient = jax.grad(lambda k: pd_margins(330.0, k, 0.1, largest, q, w).T)
    assert gradient(1.0) > 0 and gradient(125.0) > 0  # towards larger rate gains from either side of the floor
