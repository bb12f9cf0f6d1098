"""Laws of the attitude algebra, on random attitudes and at the edges of every set of coordinates."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxatt.attitude import (
    euler_body_rate,
    euler_from_quat,
    euler_rate,
    mrp_error,
    mrp_from_quat,
    mrp_inner,
    mrp_matrix,
    mrp_nearest,
    mrp_product,
    mrp_rate,
    mrp_rate_transposed,
    quat_angle,
    quat_conjugate,
    quat_error,
    quat_from_euler,
    quat_from_mrp,
    quat_from_vector,
    quat_matrix,
    quat_normalised,
    quat_rate,
    quat_rotate,
    quat_to_body,
)
from jaxatt.vec import Quat, Vec3, array, cross, norm, zeros

RNG = np.random.default_rng(2)
N = 50


def vectors(size=1.0):
    return Vec3.of(size * RNG.normal(size=(3, N)))


def close(a, b, tolerance=1e-12):
    np.testing.assert_allclose(array(a), array(b), rtol=tolerance, atol=tolerance)


# every set of coordinates near the angles where one of them is singular or changes its representative

ANGLES = [0, 1e-9, 1e-5, 90 - 1e-9, 90, 90 + 1e-9, 180 - 1e-9, 180, 180 + 1e-9, 270, 360 - 1e-5, 360 - 1e-9, 360]
AXES = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (2 / 7, -3 / 7, 6 / 7)]
TURNS = Rotation.from_rotvec([np.radians(angle) * np.array(axis) for axis in AXES for angle in ANGLES])
QUATERNIONS = Quat.of(np.roll(TURNS.as_quat(), 1, axis=1).T)


def shadow(q):
    return -q / np.where(q @ q > 0, q @ q, -1)


def rotation_vector(p):
    return Vec3.of(Rotation.from_quat(np.roll(array(p), -1, axis=0).T).as_rotvec().T)


@pytest.mark.parametrize(
    ("there", "back"),
    [
        (mrp_from_quat, quat_from_mrp),
        (lambda p: shadow(mrp_from_quat(p)), quat_from_mrp),
        (lambda p: p, quat_normalised),
        (lambda p: -p, quat_normalised),
        (euler_from_quat, quat_from_euler),
        (rotation_vector, quat_from_vector),
    ],
    ids=["MRP", "shadow", "quaternion", "opposite quaternion", "Euler angles", "rotation vector"],
)
def test_coordinates_give_back_the_rotation_near_0_90_180_and_360_deg(there, back):
    matrices = np.moveaxis(TURNS.as_matrix(), 0, -1)
    np.testing.assert_allclose(array(quat_matrix(QUATERNIONS)), matrices, atol=1e-15)
    again = back(there(QUATERNIONS))
    # at 90 deg about y the angles about x and z are one, and half of the digits are lost
    tolerance = np.where((back is quat_from_euler) & (np.abs(matrices[2, 0]) > 1 - 1e-12), 3e-8, 1e-14)
    assert (np.abs(array(quat_matrix(again)) - matrices) <= tolerance).all()
    assert (np.abs(quat_angle(again) - TURNS.magnitude()) <= tolerance).all()


def test_mrp_matrix_and_inner_representative_near_0_90_180_and_360_deg():
    q = mrp_from_quat(QUATERNIONS)
    assert (norm(q) <= 1 + 1e-15).all()
    for representative in (q, shadow(q)):
        np.testing.assert_allclose(array(mrp_matrix(representative)), np.moveaxis(TURNS.as_matrix(), 0, -1), atol=1e-14)
        assert (norm(mrp_inner(representative)) <= 1 + 1e-15).all()


# MRP, quaternions and Euler angles at random


def test_the_mrp_rate_map_is_G_of_the_paper():
    q, w = vectors(), vectors()
    for i in range(N):
        a, b = np.array(array(q))[:, i], np.array(array(w))[:, i]
        S = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
        G = ((1 - a @ a) * np.eye(3) + 2 * S + 2 * np.outer(a, a)) / 4
        np.testing.assert_allclose(array(mrp_rate(Vec3.of(a), Vec3.of(b))), G @ b, atol=1e-13)
        np.testing.assert_allclose(array(mrp_rate_transposed(Vec3.of(a), Vec3.of(b))), G.T @ b, atol=1e-13)
        assert np.linalg.norm(G, 2) == pytest.approx((1 + a @ a) / 4, abs=1e-12)  # reference: (3) is 3-4 times this


def test_mrp_product_is_the_product_of_the_matrices():
    p, q = vectors(), vectors()
    close(mrp_matrix(mrp_product(p, q)), mrp_matrix(p) @ mrp_matrix(q))
    assert (norm(mrp_product(p, q)) <= 1 + 1e-12).all()


def test_mrp_group_laws():
    p, q, r = vectors(), vectors(), vectors()
    zero = 0 * p
    close(mrp_product(mrp_product(p, q), r), mrp_product(p, mrp_product(q, r)))
    close(mrp_product(p, -p), zero)
    close(mrp_product(p, zero), mrp_inner(p))
    close(mrp_error(p, zero), mrp_inner(p))
    close(mrp_error(p, p), zero)
    close(mrp_matrix(mrp_error(p, q)), mrp_matrix(q).T @ mrp_matrix(p))


def test_opposite_representatives_of_one_attitude_have_no_error():
    q = Vec3(0.6, -0.3, 0.5)
    shadow = -q / (q @ q)
    close(mrp_error(q, shadow), zeros())
    gradient = jax.jacrev(lambda q: mrp_error(q, shadow))(q)
    assert all(np.isfinite(g) for g in jax.tree.leaves(gradient))


def test_shadows():
    q = vectors()
    shadow = -q / (q @ q)
    close(mrp_matrix(shadow), mrp_matrix(q))
    close(mrp_inner(shadow), mrp_inner(q))
    close(mrp_nearest(q, shadow), shadow)
    close(mrp_nearest(shadow, q), q)
    close(mrp_nearest(0 * q, q), 0 * q)


def test_the_attitude_matrix_turns_with_the_body_rate():
    q, w = vectors(0.4), vectors(0.4)
    h = 1e-5
    ahead, back = mrp_matrix(q + h * mrp_rate(q, w)), mrp_matrix(q - h * mrp_rate(q, w))
    A, dA = jnp.moveaxis(array(mrp_matrix(q)), -1, 0), jnp.moveaxis((array(ahead) - array(back)) / (2 * h), -1, 0)
    S = np.array([[[0, -c, b], [c, 0, -a], [-b, a, 0]] for a, b, c in array(w).T])
    np.testing.assert_allclose(dA, A @ S, atol=1e-8)


def test_the_corrected_error_follows_its_own_kinematics_and_the_printed_one_does_not():
    """Spec, 5.4: e' = G(e) w holds with + in the cross term for a target at rest."""
    q, q_d, w = vectors(0.3), vectors(0.3), vectors()
    rate = jax.jvp(lambda q: mrp_error(q, q_d), (q,), (mrp_rate(q, w),))[1]
    close(rate, mrp_rate(mrp_error(q, q_d), w), 1e-10)

    def printed(q):
        numerator = (q @ q - 1) * q_d - (q_d @ q_d - 1) * q - 2 * cross(q, q_d)
        return numerator / (1 + (q @ q) * (q_d @ q_d) + 2 * (q @ q_d))

    rate = jax.jvp(printed, (q,), (mrp_rate(q, w),))[1]
    assert np.abs(array(rate) - array(mrp_rate(printed(q), w))).max() > 0.1


def test_quaternions_agree_with_scipy():
    r, s, v = vectors(), vectors(), vectors()
    p, q = quat_from_vector(r), quat_from_vector(s)
    P, Q = Rotation.from_rotvec(np.array(array(r)).T), Rotation.from_rotvec(np.array(array(s)).T)
    np.testing.assert_allclose(jnp.moveaxis(array(quat_matrix(p)), -1, 0), P.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(jnp.moveaxis(array(quat_matrix(p * q)), -1, 0), (P * Q).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(array(quat_rotate(p, v)).T, P.apply(np.array(array(v)).T), atol=1e-12)
    np.testing.assert_allclose(quat_angle(quat_error(p, q)), (Q.inv() * P).magnitude(), atol=1e-7)
    np.testing.assert_allclose(array(mrp_from_quat(p)).T, P.as_mrp(), atol=1e-12)
    close(quat_from_mrp(mrp_from_quat(p)).v * jnp.sign(quat_from_mrp(mrp_from_quat(p)).w), p.v * jnp.sign(p.w))
    close(quat_conjugate(p) * p, quat_from_vector(0 * r))
    close(quat_normalised(3 * p), p)


def test_quaternion_rate_and_rotation_vector_agree():
    r = vectors()
    h = 1e-6
    start = quat_from_vector(r)
    turned = start * quat_from_vector(h * r)
    close((turned - start) * (1 / h), quat_rate(start, r), 1e-5)


def test_euler_angles_agree_with_scipy_and_with_their_rate():
    a, w = vectors(0.4), vectors()
    q = quat_from_euler(a)
    reference = Rotation.from_euler("ZYX", np.array(array(a))[::-1].T).as_matrix()
    np.testing.assert_allclose(jnp.moveaxis(array(quat_matrix(q)), -1, 0), reference, atol=1e-12)
    close(euler_from_quat(q), a)
    close(euler_body_rate(a, euler_rate(a, w)), w)
    rate = jax.jvp(quat_from_euler, (a,), (euler_rate(a, w),))[1]
    close(rate, quat_rate(q, w))


@pytest.mark.slow
def test_gradients_are_finite_at_zero_rotation():
    zero = zeros()
    for f in (
        lambda r: quat_from_vector(r).v, lambda r: quat_angle(quat_from_vector(r)), mrp_inner,
        lambda r: mrp_error(r, zero), lambda r: mrp_nearest(r, zero), lambda r: norm(mrp_rate(r, r)),
        lambda r: euler_from_quat(quat_from_euler(r)), lambda r: mrp_from_quat(quat_from_vector(r)),
    ):  # fmt: skip
        assert all(np.isfinite(g) for g in jax.tree.leaves(jax.jacrev(f)(zero)))
        assert all(np.isfinite(g) for g in jax.tree.leaves(jax.jacfwd(f)(zero)))


# groups


law = settings(max_examples=60, deadline=None, derandomize=True, database=None)
# XLA may flush subnormals to zero
finite: dict[str, Any] = dict(allow_nan=False, allow_infinity=False, allow_subnormal=False)
coordinate = st.one_of(st.floats(-3, 3, **finite), st.sampled_from([0.0, 1.0, -1.0, 1e-9, 1e3, -1e-3]))
mrps = st.builds(Vec3, coordinate, coordinate, coordinate).map(lambda q: Vec3(*map(np.float64, q)))
units = mrps.map(quat_from_mrp)
turns = st.floats(-3.1, 3.1, **finite)
eulers = st.builds(Vec3, turns, st.floats(-1.5, 1.5, **finite), turns).map(lambda a: Vec3(*map(np.float64, a)))


@law
@given(mrps, mrps, mrps)
def test_mrp_make_a_group(p, q, r):
    times, matrix = mrp_product, mrp_matrix
    close(matrix(times(times(p, q), r)), matrix(times(p, times(q, r))), 1e-9)
    close(matrix(times(p, q)), matrix(p) @ matrix(q), 1e-9)
    zero = zeros()
    for e in (times(p, zero), times(zero, p)):
        close(matrix(e), matrix(p), 1e-9)
    for e in (times(p, -p), times(-p, p), mrp_error(p, p)):
        close(matrix(e), matrix(zero), 1e-9)
    assert norm(times(p, q)) <= 1 + 1e-12
    close(matrix(mrp_inner(p)), matrix(p), 1e-9)
    close(matrix(p).T @ matrix(p), matrix(zero), 1e-9)


@law
@given(units, units, units, mrps)
def test_unit_quaternions_make_a_group_that_acts_on_vectors(p, q, r, v):
    one = Quat(1.0, 0.0, 0.0, 0.0)
    close((p * q) * r, p * (q * r))
    close(p * one, p)
    close(one * p, p)
    close(p * quat_conjugate(p), one)
    close(quat_error(p, q), quat_conjugate(q) * p)
    close(quat_matrix(p * q), quat_matrix(p) @ quat_matrix(q))
    size = 1 + norm(v)
    close(quat_rotate(p, quat_rotate(q, v)) / size, quat_rotate(p * q, v) / size)
    close(quat_rotate(p, v) / size, (quat_matrix(p) @ v) / size)
    close(quat_to_body(p, quat_rotate(p, v)) / size, v / size)
    assert abs(norm(quat_rotate(p, v)) / size - norm(v) / size) < 1e-12
    assert abs(norm(p * q) - 1) < 1e-12
    back = quat_from_mrp(mrp_from_quat(p))
    close(back * (1.0 if back @ p > 0 else -1.0), p, 1e-9)
    assert abs(quat_angle(quat_error(p, q)) - 2 * np.arccos(min(abs(p @ q), 1.0))) < 1e-6


@law
@given(eulers, eulers)
def test_euler_angles_are_coordinates_of_the_group(a, b):
    p, q = quat_from_euler(a), quat_from_euler(b)
    both = euler_from_quat(p * q)
    assert abs(both.y) <= np.pi / 2 + 1e-12
    close(quat_matrix(quat_from_euler(both)), quat_matrix(p) @ quat_matrix(q), 1e-7)
    close(quat_matrix(quat_from_euler(euler_from_quat(p))), quat_matrix(p), 1e-7)
    w = Vec3(0.3, -0.2, 0.5)
    close(euler_body_rate(a, euler_rate(a, w)), w, 1e-9)


def test_angles_of_one_axis_add():
    for axis in range(3):
        turn = lambda s, axis=axis: quat_from_euler(Vec3(*np.eye(3)[axis] * s))
        close(turn(0.4) * turn(0.5), turn(0.9))
        close(turn(0.7), quat_from_vector(Vec3(*np.eye(3)[axis] * 0.7)))
    r = Vec3(1e-6, -2e-6, 3e-6)  # where sin(h) / h is its series
    close(quat_from_vector(r).v * 2, r, 1e-17)
    close(quat_from_vector(1e4 * r), Quat(np.cos(norm(r) * 5e3), *(r * (np.sin(norm(r) * 5e3) / norm(r)))), 1e-15)
