"""Conserved quantities of rigid bodies: momentum, energy, Jacobi's integral."""

import jax
import numpy as np
import pytest

from jaxatt.attitude import mrp_matrix, mrp_rate, quat_from_mrp, quat_rate, quat_to_body
from jaxatt.bodies import body_acceleration, gravity_gradient
from jaxatt.vec import Mat3, Quat, Vec3, array, project, resultant, zeros

RNG = np.random.default_rng(11)
N = 40
J = np.array([[90.0, 2.0, -1.0], [2.0, 80.0, 3.0], [-1.0, 3.0, 60.0]])
M = Mat3.of(J)


def draw(size=1.0):
    return Vec3.of(size * RNG.normal(size=(3, N)))


def test_the_acceleration_is_eulers_equation_in_plain_matrices():
    w, u, h = RNG.normal(size=(3, 3))
    for stored, momentum in ((None, J @ w), (Vec3.of(h), J @ w + h)):
        expected = np.linalg.solve(J, u - np.cross(w, momentum))
        ours = body_acceleration(Vec3.of(w), Vec3.of(u), M, stored)
        np.testing.assert_allclose(array(ours), expected, rtol=1e-12)


def test_a_free_rigid_body_keeps_momentum_and_energy():
    q, w, u = draw(), draw(), draw()
    dw = body_acceleration(w, zeros(), M)
    np.testing.assert_allclose(w @ (M @ dw), 0, atol=1e-11)  # energy
    change = jax.jvp(lambda q, w: mrp_matrix(q) @ (M @ w), (q, w), (mrp_rate(q, w), dw))[1]
    np.testing.assert_allclose(array(change), 0, atol=1e-10)  # momentum in inertial axes
    np.testing.assert_allclose(w @ (M @ body_acceleration(w, u, M)), w @ u, atol=1e-11)  # power


def test_a_body_with_wheels_keeps_momentum_and_its_motors_work():
    axes = np.array([[1, -1, -1, 1], [1, 1, -1, -1], [2**0.5] * 4]) / 2
    q, w = draw(), draw()
    h, motor = RNG.normal(size=(2, 4, N))
    dw = body_acceleration(w, -resultant(axes, motor), M, resultant(axes, h))
    momentum = lambda q, w, h: mrp_matrix(q) @ (M @ w + resultant(axes, h))
    change = jax.jvp(momentum, (q, w, h), (mrp_rate(q, w), dw, motor))[1]
    np.testing.assert_allclose(array(change), 0, atol=1e-10)
    # kinetic energy w.Jw/2 + h^2/(2 Js): the motors, turning at h/Js - g.w, give all of its change
    spin = 0.05
    gain = w @ (M @ dw) + (h * motor).sum(0) / spin
    power = (motor * (h / spin - np.asarray(project(axes, w)))).sum(0)
    np.testing.assert_allclose(gain, power, rtol=1e-10, atol=1e-10)


def test_gravity_gradient_keeps_jacobis_integral():
    """On a circular orbit, in the orbit frame: T = w.Jw/2 + 3 wo^2 z.Jz/2 - wo y.Jy wo/2, w relative to the frame."""
    rate = 1.1e-3
    p, w = quat_from_mrp(draw(0.5)), draw(2e-3)
    o = np.zeros(N)
    z, y = Vec3(o, o, o + 1), Vec3(o, o + 1, o)

    def integral(p, w):
        relative, down, normal = w + rate * quat_to_body(p, y), quat_to_body(p, z), quat_to_body(p, y)
        kinetic = relative @ (M @ relative) / 2
        return kinetic + 1.5 * rate**2 * (down @ (M @ down)) - rate**2 * (normal @ (M @ normal)) / 2

    u = gravity_gradient(quat_to_body(p, z), M, rate)
    dw = body_acceleration(w, u, M)
    dp = quat_rate(p, w) - 0.5 * (Quat(o, o, o - rate, o) * p)
    value, change = jax.jvp(integral, (p, w), (dp, dw))
    np.testing.assert_allclose(change / value, 0, atol=1e-12)
    np.testing.assert_allclose(u @ quat_to_body(p, z), 0, atol=1e-12)  # no torque about the vertical


def test_gravity_gradient_of_a_pitched_dumbbell():
    """3 wo^2 (Jz - Jx) sin cos about y, which turns the long axis to the vertical."""
    angle, rate = 0.3, 1e-3
    down = Vec3(-np.sin(angle), 0.0, np.cos(angle))
    u = gravity_gradient(down, Mat3.of(np.diag([100.0, 100.0, 10.0])), rate)
    assert u.y == pytest.approx(3 * rate**2 * (10 - 100) * np.sin(angle) * np.cos(angle), rel=1e-12)
    assert (u.x, u.z) == (0, 0)
