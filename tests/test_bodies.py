"""Conserved quantities of rigid bodies: momentum, energy, Jacobi's integral; torques of air, light and field."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from slopes import slopes

from jaxatt import fields
from jaxatt.attitude import mrp_matrix, mrp_rate, quat_from_mrp, quat_rate, quat_to_body
from jaxatt.bodies import (
    Facets,
    aero_torque,
    body_acceleration,
    box,
    dipole_torque,
    gravity_gradient,
    solar_torque,
)
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


# torques of the surroundings

BOX = box(0.5, 0.5, 0.7, Vec3(0.01, -0.005, 0.02))


def facets():
    """Six faces in odd directions, as `Facets` and as plain arrays."""
    n = RNG.normal(size=(6, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    r, A = RNG.normal(size=(6, 3)), RNG.uniform(0.1, 1, 6)
    return Facets(Vec3.of(n.T), Vec3.of(r.T), A, drag=2.4, specular=0.3, diffuse=0.25), n, r, A


def test_the_torque_on_a_dipole_is_across_moment_and_field():
    m, B = RNG.normal(size=(2, 3))
    u = array(dipole_torque(Vec3.of(m), Vec3.of(B)))
    np.testing.assert_allclose(u, np.cross(m, B), rtol=1e-14)
    x, y, z = (Vec3.of(e) for e in np.eye(3))
    assert dipole_torque(x, y) == z  # it turns the moment towards the field


def test_drag_is_that_of_every_face_by_itself():
    body, n, r, A = facets()
    for v in 7600 * RNG.normal(size=(5, 3)):
        total = np.zeros(3)
        for i in range(6):
            e = v / np.linalg.norm(v)
            total += np.cross(r[i], -0.5 * 3e-12 * (v @ v) * 2.4 * A[i] * max(n[i] @ e, 0) * e)
        np.testing.assert_allclose(array(aero_torque(body, Vec3.of(v), 3e-12)), total, rtol=1e-12)


def test_light_is_that_of_every_face_by_itself():
    body, n, r, A = facets()
    for s in RNG.normal(size=(5, 3)):
        s /= np.linalg.norm(s)
        total = np.zeros(3)
        for i in range(6):
            c = max(n[i] @ s, 0)
            total += np.cross(r[i], -4.56e-6 * A[i] * c * 0.8 * (0.7 * s + 2 * (0.3 * c + 0.25 / 3) * n[i]))
        np.testing.assert_allclose(array(solar_torque(body, Vec3.of(s), 0.8)), total, rtol=1e-12)


def test_a_box_has_the_faces_of_its_edges():
    n, r = np.stack(BOX.normal, -1), np.stack(BOX.arm, -1)
    np.testing.assert_array_equal(n, np.kron(np.eye(3), [[1], [-1]]))
    np.testing.assert_allclose(BOX.area, [0.35, 0.35, 0.35, 0.35, 0.25, 0.25])
    np.testing.assert_allclose(r, n * np.repeat([0.25, 0.25, 0.35], 2)[:, None] + [0.01, -0.005, 0.02])
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1)


def test_a_tail_turns_into_the_wind_and_a_black_plate_ahead_of_the_centre_away_from_the_sun():
    """Signs: a plate 1 m behind the centre, hit by wind from +x and +y, turns the body's x axis to the wind, about +z."""
    plate = lambda n, r, **surface: Facets(
        Vec3(*np.array(n)[:, None]), Vec3(*np.array(r)[:, None]), np.array([1.0]), **surface
    )
    tail = plate([0.0, 1.0, 0.0], [-1.0, 0.0, 0.0])
    wind = Vec3(7000.0, 700.0, 0.0)  # of the body against the air
    assert aero_torque(tail, wind, 1e-12).z > 0
    assert aero_torque(tail, -wind, 1e-12) == zeros()  # the back of a plate is no face
    black = plate([1.0, 0.0, 0.0], [1.0, 0.5, 0.0], specular=0.0, diffuse=0.0)
    u = solar_torque(black, Vec3(1.0, 0.0, 0.0), 1.0)
    assert u.z == pytest.approx(0.5 * 4.56e-6) and u.x == u.y == 0  # pushed along -x at y = .5 m
    mirror = solar_torque(plate([1.0, 0.0, 0.0], [1.0, 0.5, 0.0], specular=1.0, diffuse=0.0), Vec3(1.0, 0.0, 0.0), 1.0)
    assert mirror.z == pytest.approx(2 * u.z)  # a mirror takes twice the push
    assert solar_torque(black, Vec3(1.0, 0.0, 0.0), 0.0) == zeros()


def test_disturbances_of_a_small_satellite_have_their_sizes():
    """60 kg at 500 km: drag <= 5.6e-7 N m, light <= 6e-8, a dipole of .22 A m^2 in 45 uT 1e-5, over all attitudes."""
    e = RNG.normal(size=(3, 4000))
    e /= np.linalg.norm(e, axis=0)
    size = lambda u: float(jnp.max(jnp.linalg.norm(array(u), axis=0)))
    one = lambda f: jax.vmap(f, in_axes=-1, out_axes=-1)(e)
    drag = size(one(lambda e: aero_torque(BOX, 7613 * Vec3.of(e), 6.967e-13)))
    light = size(one(lambda e: solar_torque(BOX, Vec3.of(e), 1.0)))
    assert 4e-7 < drag < 5.7e-7 and 4e-8 < light < 6.5e-8
    assert np.linalg.norm([0.15, -0.1, 0.12]) * 45e-6 == pytest.approx(1e-5, rel=0.04)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda b: b._replace(normal=2 * b.normal), r"`\|body.normal\|\[0\]` must be 1, but it is 2"),
        (lambda b: b._replace(specular=0.7, diffuse=0.4), r"`body\.specular \+ diffuse` must not exceed 1"),
        (lambda b: b._replace(area=-b.area), r"`body\.area\[0\]` must not be negative"),
        (lambda b: b._replace(area=b.area[1:]), r"`body\.area` must have shape"),
    ],
)
def test_faces_that_are_none_are_refused(change, message):
    fields.validate("body", BOX)
    with pytest.raises(ValueError, match=message):
        fields.validate("body", change(BOX))


def test_gradients_of_the_torques_are_those_of_central_differences():
    aim = Vec3(1.0, -2.0, 0.5)
    body = facets()[0]
    costs = [
        lambda p: 1e3 * (aero_torque(body._replace(drag=p[3]), Vec3(*p[:3]), 1e-3 * p[4]) @ aim),
        lambda p: 1e6 * (solar_torque(body._replace(specular=p[3], diffuse=p[4]), Vec3(*p[:3]), p[5]) @ aim),
        lambda p: dipole_torque(Vec3(*p[:3]), Vec3(*p[3:])) @ aim,
    ]
    for cost in costs:
        found, central = slopes(cost, [0.6, -0.3, 0.7, 0.4, 0.2, 0.9])
        np.testing.assert_allclose(found, central, rtol=1e-6, atol=1e-8)
        assert np.isfinite(jax.jit(jax.grad(cost))(jnp.zeros(6, jnp.float32))).all()


def test_torques_of_many_scenarios_are_those_of_each():
    v = RNG.normal(size=(3, 5))
    one = lambda v: (aero_torque(BOX, Vec3.of(v), 1.0), solar_torque(BOX, Vec3.of(v), 1.0), dipole_torque(Vec3.of(v), Vec3(1.0, 2.0, 3.0)))  # fmt: skip
    together = jax.vmap(one, in_axes=-1, out_axes=-1)(v)
    for i in range(5):
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(one(v[:, i]))):
            np.testing.assert_allclose(a[i], b, rtol=1e-12, atol=1e-18)
