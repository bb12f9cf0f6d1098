"""Laws that turn a body, against their equations and what they promise. Those of a wheel: tests/test_wheel_mrac.py."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from slopes import slopes

from jaxatt.attitude import quat_error, quat_from_mrp, quat_normalised, quat_rate, quat_rotate, quat_to_body
from jaxatt.bodies import body_acceleration, dipole_torque
from jaxatt.contract import System
from jaxatt.controllers import (
    adapted_rate_gain,
    bdot,
    bdot_gain,
    pd,
    pd_margins,
    pid,
    quaternion_pd,
    rate_gain_floor,
    saturated,
    unloading,
)
from jaxatt.engine import rk4
from jaxatt.environment import Table, at
from jaxatt.orbit import EARTH, MU, Elements, along, kepler
from jaxatt.scores import first
from jaxatt.sweeping import sweep
from jaxatt.vec import Mat3, Quat, Vec3, array, norm, zeros

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


# magnetic torquers


def test_bdot_opposes_the_rate_across_the_field():
    """B' = -w x B of a tumbling body: the torque is -k times the rate less its part along B, in plain vectors."""
    w, B, k = RNG.normal(size=3) / 100, 4e-5 * np.array([0.6, -0.48, 0.64]), 0.011
    m = bdot(Vec3.of(B), Vec3.of(B + np.cross(w, B) * 0.5), 0.5, k, np.inf)
    b = B / np.linalg.norm(B)
    torque = np.cross(array(m), B)
    np.testing.assert_allclose(torque, -k * (w - b * (b @ w)), rtol=1e-9)
    assert torque @ w < 0
    strong = bdot(Vec3.of(B), Vec3.of(-B), 0.5, 1e3, 12.0)
    np.testing.assert_allclose(array(strong), -12 * np.sign(B))


def test_the_gain_of_bdot():
    """60 kg satellite, 500 km, orbit 83 deg from the geomagnetic equator: .0110088 N m s."""
    n = np.sqrt(MU / (EARTH + 500e3) ** 3)
    least = np.linalg.eigvalsh(np.array([[3.7, 0.06, -0.04], [0.06, 3.5, 0.05], [-0.04, 0.05, 2.5]]))[0]
    assert bdot_gain(n, np.deg2rad(83.0), least) == pytest.approx(
        2 * n * (1 + np.sin(np.deg2rad(83))) * least, rel=1e-12
    )
    assert bdot_gain(n, np.deg2rad(83.0), least) == pytest.approx(0.0110088, rel=1e-3)  # the angle has two digits


class Params(NamedTuple):
    table: Table
    inertia: Mat3


class Scenario(NamedTuple):
    gain: Any  # [N m s]
    w: Vec3  # [rad/s] at the start


class X(NamedTuple):
    q: Quat
    w: Vec3


class Z(NamedTuple):
    moment: Vec3
    last: Vec3


SATELLITE = Mat3.of([[3.7, 0.06, -0.04], [0.06, 3.5, 0.05], [-0.04, 0.05, 2.5]])


def detumbling():
    """B-dot once a second, 12 A m^2; the torque m x B turns with the body between ticks."""
    field = lambda params, t, q: quat_to_body(q, at(params.table, t).field)

    def tick(params, scenario, now, x, z, noise):
        x = x._replace(q=quat_normalised(x.q))
        B = field(params, now.t, x.q)
        m = bdot(B, z.last, now.dt, scenario.gain, 12.0)
        m = Vec3(*(jnp.where(now.k > 0, a, 0.0) for a in m))  # no difference at the first reading
        return x, Z(m, B), norm(x.w)

    def flow(params, scenario, t, x, z):
        torque = dipole_torque(z.moment, field(params, t, x.q))
        return X(quat_rate(x.q, x.w), body_acceleration(x.w, torque, params.inertia))

    start = lambda params, scenario: (X(Quat(1.0, 0.0, 0.0, 0.0), scenario.w), Z(zeros(), zeros()))
    return System(start, tick, flow, dt=1.0)


def test_bdot_takes_the_rate_out_in_the_time_of_the_reference():
    """From 5.265 deg/s to below .3 deg/s: 1172 s at the gain k, 910 s at 2 k, 1465 s at 4 k, 3043 s at 8 k.

    An independent simulation, on the circular orbit at 500 km; more gain is not faster, for it locks the rest to the field.
    """
    t = np.arange(-10.0, 3121.0, 10.0)
    elements = Elements(EARTH + 500e3, i=np.deg2rad(97.4), node=np.deg2rad(50))
    table = along(t, *kepler(elements, t), "2026-03-21T00:00")
    k, w = 0.0110088, np.deg2rad([3.0, -3.6, 2.4])
    assert np.rad2deg(np.linalg.norm(w)) == pytest.approx(5.265, abs=5e-4)
    scenarios = Scenario(k * np.array([1.0, 2.0, 4.0, 8.0]), Vec3(*(np.full(4, a) for a in w)))
    slow = lambda params, scenario, now, rate: first(now, rate < np.deg2rad(0.3))
    found = sweep(detumbling(), Params(table, SATELLITE), scenarios, jax.random.key(0), ticks=3100, score=slow)
    np.testing.assert_allclose(found, [1172, 910, 1465, 3043], atol=2)


def test_unloading_takes_out_the_momentum_across_the_field_at_its_gain():
    """Held by the wheels, h' = m x B = -k (h - b b.h): the part across decays as exp(-k t), the part along stays."""
    h0, B, k = np.array([0.1, -0.05, 0.02]), 3e-5 * np.array([0.6, -0.48, 0.64]), 2e-3
    b = B / np.linalg.norm(B)
    rate = lambda t, h: dipole_torque(unloading(h, Vec3.of(B), k, np.inf), Vec3.of(B))
    h, _ = jax.lax.scan(lambda h, t: (rk4(rate, t, h, 10.0), None), Vec3.of(jnp.asarray(h0)), jnp.arange(100) * 10.0)
    across = h0 - b * (b @ h0)
    np.testing.assert_allclose(array(h), b * (b @ h0) + np.exp(-k * 1000) * across, rtol=1e-7)
    m = unloading(Vec3.of(1e3 * h0), Vec3.of(B), k, 12.0)
    np.testing.assert_allclose(np.abs(array(m)).max(), 12.0)
    assert np.cross(array(m), B) @ h0 < 0  # the other order of the product would spin the wheels up


def test_torquers_never_push_along_the_field_and_rest_without_one():
    for m in (bdot(Vec3(1e-5, 2e-5, 3e-5), Vec3(2e-5, 1e-5, 3e-5), 1.0, 0.01, 12.0), unloading(Vec3(1.0, 2.0, 0.5), Vec3(1e-5, 2e-5, 3e-5), 1e-3, 12.0)):  # fmt: skip
        torque = dipole_torque(m, Vec3(1e-5, 2e-5, 3e-5))
        assert abs(torque @ Vec3(1.0, 2.0, 3.0)) < 1e-15 * float(norm(torque)) + 1e-20
    none = unloading(Vec3(1.0, 2.0, 0.5), zeros(), 1e-3, 12.0), bdot(zeros(), zeros(), 1.0, 0.01, 12.0)
    assert all(norm(m) == 0 for m in none)
    by_field = jax.grad(lambda B: array(unloading(Vec3(1.0, 2.0, 0.5), Vec3.of(B), 1e-3, 12.0)).sum())
    assert np.isfinite(by_field(jnp.zeros(3, jnp.float32))).all()


def test_gradients_of_the_magnetic_laws_are_those_of_central_differences():
    aim = Vec3(1.0, -2.0, 0.5)
    costs = [
        lambda p: bdot(Vec3(*p[:3]), Vec3(*p[3:6]), p[6], p[7], 2.0) @ aim,
        lambda p: unloading(Vec3(*p[:3]), Vec3(*p[3:6]), p[6], 2.0) @ aim + bdot_gain(p[6], p[7], 2.5),
    ]
    for cost in costs:
        found, central = slopes(cost, [0.3, -0.5, 0.4, 0.2, 0.1, -0.6, 0.7, 0.2])
        np.testing.assert_allclose(found, central, rtol=1e-6, atol=1e-8)


def test_magnetic_laws_of_many_scenarios_are_those_of_each():
    h, B = RNG.normal(size=(2, 3, 4))
    one = lambda h, B: (unloading(Vec3.of(h), Vec3.of(B), 0.1, 0.2), bdot(Vec3.of(B), Vec3.of(h), 0.5, 0.01, 0.03))
    together = jax.vmap(one, in_axes=-1, out_axes=-1)(h, B)
    for i in range(4):
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(one(h[:, i], B[:, i]))):
            np.testing.assert_allclose(a[i], b, rtol=1e-13)
