"""The nonlinear observer against the paper's mathematics. Least squares: tests/test_wheel_mrac.py."""

import jax
import numpy as np
import pytest

from jaxatt import Fault, on_axes, simulate
from jaxatt.attitude import mrp_rate, mrp_rate_transposed
from jaxatt.bodies import body_acceleration
from jaxatt.loops import observer_pd as op
from jaxatt.observers import AttitudeRate, mrp_observer, residual_norm
from jaxatt.vec import Vec3, cross, norm

RNG = np.random.default_rng(7)
J = op.INERTIA


def draw(size=1.0, n=200):
    return Vec3.of(size * RNG.normal(size=(3, n)))


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_the_lyapunov_identity_of_the_observer(noise):
    """V' = -alpha |xi_q|^2 - beta |xi_w|^2 for clean readings; with noise the exact form of the reference."""
    alpha, beta = 1.1, 15.0
    q, w, q_hat, w_hat, u = (draw() for _ in range(5))
    n_q, n_w = draw(noise), draw(noise)
    y = AttitudeRate(q + n_q, w + n_w)
    hat = mrp_observer(AttitudeRate(q_hat, w_hat), y, u, J, alpha, beta)
    e_q, e_w = q - q_hat, w - w_hat
    dV = e_q @ (mrp_rate(q, w) - hat.q) + e_w @ (J @ (body_acceleration(w, u, J) - hat.w))
    dG_w = mrp_rate(y.q, w) - mrp_rate(q, w)
    expected = (
        -alpha * (e_q @ e_q) - beta * (e_w @ e_w) - alpha * (e_q @ n_q) - beta * (e_w @ n_w) - e_q @ dG_w
        + e_w @ cross(w_hat, J @ n_w) - e_w @ mrp_rate_transposed(y.q, n_q)
    )  # fmt: skip
    np.testing.assert_allclose(dV, expected, atol=1e-10)


def test_the_residual_is_measured_in_mrp_and_rad_per_second_alike():
    y, estimate = (
        AttitudeRate(Vec3(1.0, 2.0, 3.0), Vec3(4.0, 5.0, 6.0)),
        AttitudeRate(Vec3(0.0, 2.0, 1.0), Vec3(4.0, 1.0, 4.0)),
    )
    assert residual_norm(y, estimate) == 5.0  # 1, 0, 2 and 0, 4, 2
    assert residual_norm(y, y) == 0
    gradient = jax.grad(residual_norm)(y, y)
    assert all(np.isfinite(g) for g in jax.tree.leaves(gradient))


def test_the_observers_lyapunov_function_falls_from_random_states():
    """V = |q - qh|^2 / 2 + (w - wh) J (w - wh) / 2 never grows in a clean closed loop (Yun & Kang, theorem 1)."""
    n, rng, healthy = 12, np.random.default_rng(5), on_axes(Fault())
    states = [Vec3.of(size * rng.normal(size=(3, n))) for size in (0.3, 0.2, 0.3, 0.2)]
    noise = np.zeros((120, op.system.normals))

    def run(q, w, q_hat, w_hat):
        scenario = op.scenario._replace(star=healthy, gyro=healthy, q=q, w=w, q_hat=q_hat, w_hat=w_hat)
        return simulate(op.system, op.params, scenario, noise, ticks=120)

    log = jax.vmap(run)(*states)  # truth and estimate after the tick's shadow switches
    e_q, e_w = log.q - log.estimate.q, log.w - log.estimate.w
    V = np.asarray(e_q @ e_q + e_w @ (J @ e_w)) / 2
    switched = (
        np.abs(np.diff(norm(log.q), axis=1)) >= 0.3
    )  # the shadow switch moves truth and estimate, and V with them
    assert (np.diff(V, axis=1)[~switched] <= 1e-12).all()
    assert (V[:, -1] < 1e-3 * V[:, 0]).all()
