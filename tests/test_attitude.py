"""Laws of the attitude algebra, on random attitudes and at the edges of every set of coordinates."""

from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxatt.attitude import (
    angles_from_quat,
    euler_body_rate,
    euler_from_matrix,
    euler_from_quat,
    euler_rate,
    full_turn,
    left_jacobian,
    left_jacobian_inverse,
    mrp_error,
    mrp_from_matrix,
    mrp_from_quat,
    mrp_inner,
    mrp_matrix,
    mrp_nearest,
    mrp_product,
    mrp_rate,
    mrp_rate_transposed,
    nearest_rotation,
    quat_angle,
    quat_conjugate,
    quat_error,
    quat_from_angles,
    quat_from_euler,
    quat_from_matrix,
    quat_from_mrp,
    quat_from_rotation,
    quat_from_scalar_last,
    quat_from_vector,
    quat_matrix,
    quat_mean,
    quat_normalised,
    quat_rate,
    quat_rotate,
    quat_to_body,
    scalar_last_from_quat,
    vector_from_quat,
    wrapped,
)
from jaxatt.vec import Mat3, Quat, Vec3, array, cross, norm, zeros

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


SEQUENCES = ["".join(name) for name in product("123", repeat=3) if name[0] != name[1] != name[2]]
COORDINATES = {
    "MRP": (mrp_from_quat, quat_from_mrp),
    "shadow": (lambda p: shadow(mrp_from_quat(p)), quat_from_mrp),
    "quaternion": (lambda p: p, quat_normalised),
    "opposite quaternion": (lambda p: -p, quat_normalised),
    "quaternion of three digits": (lambda p: 32.767 * p, quat_normalised),
    "scalar last": (scalar_last_from_quat, quat_from_scalar_last),
    "Euler angles": (euler_from_quat, quat_from_euler),
    "rotation vector": (vector_from_quat, quat_from_vector),
    "matrix": (quat_matrix, quat_from_matrix),
    "axes": (quat_matrix, quat_from_rotation),
    "MRP of a matrix": (lambda p: mrp_from_matrix(quat_matrix(p)), quat_from_mrp),
    "Euler angles of a matrix": (lambda p: euler_from_matrix(quat_matrix(p)), quat_from_euler),
} | {
    name: (lambda p, name=name: angles_from_quat(p, name), lambda a, name=name: quat_from_angles(a, name))
    for name in SEQUENCES
}  # fmt: skip


@pytest.mark.parametrize("name", COORDINATES)
def test_coordinates_give_back_the_rotation_near_0_90_180_and_360_deg(name):
    there, back = COORDINATES[name]
    matrices = np.moveaxis(TURNS.as_matrix(), 0, -1)
    np.testing.assert_allclose(array(quat_matrix(QUATERNIONS)), matrices, atol=1e-15)
    again = back(there(QUATERNIONS))
    np.testing.assert_allclose(array(quat_matrix(again)), matrices, atol=2e-15)
    np.testing.assert_allclose(quat_angle(again), TURNS.magnitude(), atol=2e-15)
    single = back(there(jax.tree.map(jnp.float32, QUATERNIONS)))
    assert all(a.dtype == jnp.float32 for a in jax.tree.leaves(single))
    np.testing.assert_allclose(array(quat_matrix(single)), matrices, atol=2e-6)


@pytest.mark.parametrize("name", [name for name in COORDINATES if name != "shadow"])  # which is at infinity
def test_gradients_of_conversions_are_finite_at_their_singularities(name):
    """At no turn, at half a turn and just before it, at gimbal lock."""
    there, back = COORDINATES[name]
    turn = lambda r, p: back(there(p * quat_from_vector(r)))
    slope = jax.jit(jax.vmap(lambda p: jax.jacfwd(turn)(zeros(), p)))
    quarter = np.sqrt(0.5)
    edges = [(1, 0, 0, 0), (5e-7, 1, 0, 0), (5e-7, 0, 1, 0), (5e-7, 2 / 7, -3 / 7, 6 / 7), (0, 1, 0, 0)]
    edges += [(quarter, *(sign * quarter * np.eye(3)[i])) for sign in (1, -1) for i in range(3)]
    found = slope(Quat.of(np.array(edges).T))
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(found))


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
    np.testing.assert_allclose(array(vector_from_quat(p)).T, P.as_rotvec(), atol=2e-15)
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


def turned(n, seed):
    """Random rotations, evenly distributed."""
    return Rotation.from_quat(np.random.default_rng(seed).normal(size=(n, 4)))


# gimbal lock


def apart(p, turns):
    """The largest turn [rad] between quaternions and SciPy's rotations."""
    return (Rotation.from_quat(np.asarray(array(p), float).T, scalar_first=True).inv() * turns).magnitude().max()


def scipys(name):
    return name.translate(str.maketrans("123", "XYZ"))


@pytest.mark.parametrize("name", SEQUENCES)
def test_all_sequences_agree_with_scipy(name):
    turns = turned(300, 3)
    a = angles_from_quat(quat_from_scalar_last(turns.as_quat().T), name)
    expected = turns.as_euler(scipys(name))
    assert (np.abs(np.sin(expected[:, 1])) > 1e-3).all() or name[0] != name[2]
    np.testing.assert_allclose(wrapped(array(a).T - expected), 0, atol=1e-12)
    assert apart(quat_from_angles(Vec3.of(expected.T), name), turns) < 2e-15


@pytest.mark.parametrize("kind", [np.float64, np.float32])
@pytest.mark.parametrize("name", SEQUENCES)
def test_the_attitude_survives_gimbal_lock(name, kind):
    rng = np.random.default_rng(5)
    locks = (0, np.pi) if name[0] == name[2] else (np.pi / 2, -np.pi / 2)
    tolerance = 10 * np.finfo(kind).eps
    for lock, offset in product(locks, [0, 1e-12, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2]):
        second = lock - np.sign(lock or -1) * offset
        angles = np.stack([rng.uniform(-np.pi, np.pi, 100), np.full(100, second), rng.uniform(-np.pi, np.pi, 100)], 1)
        turns = Rotation.from_euler(scipys(name), angles)
        a = angles_from_quat(quat_from_scalar_last(turns.as_quat().T.astype(kind)), name)
        assert apart(quat_from_angles(a, name), turns) < tolerance
        assert (np.abs(array(a)) <= np.pi * (1 + np.finfo(kind).eps)).all()
        if not offset:
            assert (np.asarray(a.z) == 0).mean() > 0.9  # rounding of the quaternion may be an offset


def test_at_90_deg_of_pitch_yaw_takes_the_sum_and_roll_is_zero():
    for sign in (1, -1):
        a = euler_from_quat(quat_from_euler(Vec3(0.3, sign * np.pi / 2, 0.5)))
        close(a, Vec3(0.0, sign * np.pi / 2, 0.5 - sign * 0.3), 1e-15)


@pytest.mark.parametrize("wrong", ["", "32", "3211", "121x", "112", "322", "zyx", "ZYX", "421", 321, None])
def test_a_sequence_that_is_none_is_refused(wrong):
    for refused in (
        lambda: quat_from_angles(zeros(), wrong),
        lambda: angles_from_quat(Quat(1.0, 0.0, 0.0, 0.0), wrong),
    ):
        with pytest.raises(ValueError, match=r"^`sequence` must .*'321'"):
            refused()


# matrices


def matrices(turns):
    return np.moveaxis(turns.as_matrix(), 0, -1)


def test_matrices_of_any_trace_agree_with_scipy():
    turns = turned(300, 4)
    p = quat_from_matrix(Mat3.of(matrices(turns)))
    expected = turns.as_quat(canonical=True, scalar_first=True)
    np.testing.assert_allclose(array(p).T, expected, atol=2e-15)
    np.testing.assert_allclose(array(mrp_from_matrix(Mat3.of(matrices(turns)))).T, turns.as_mrp(), atol=2e-15)
    euler = array(euler_from_matrix(Mat3.of(matrices(turns))))
    np.testing.assert_allclose(euler[::-1].T, turns.as_euler("ZYX"), atol=1e-12)


def test_half_turns_are_exact():
    for i in range(3):
        half = np.diag(np.where(np.arange(3) == i, 1.0, -1.0))
        p = quat_from_matrix(Mat3.of(half))
        np.testing.assert_array_equal(array(p), np.append(0, np.eye(3)[i]))
        np.testing.assert_array_equal(array(vector_from_quat(p)), np.pi * np.eye(3)[i])


@pytest.mark.parametrize("size", [1e-6, 1e-3, 0.1])
def test_the_nearest_rotation_is_that_of_the_svd(size):
    rng = np.random.default_rng(6)
    m = turned(200, 5).as_matrix() + size * rng.normal(size=(200, 3, 3))
    U, _, V = np.linalg.svd(m)
    for factor in (1.0, 2.0, 32767.0):  # a common scale is no rotation
        ours = nearest_rotation(Mat3.of(factor * np.moveaxis(m, 0, -1)))
        np.testing.assert_allclose(np.moveaxis(np.asarray(array(ours)), -1, 0), U @ V, atol=1e-14)
    rounded = np.round(turned(50, 6).as_matrix(), 3)
    U, _, V = np.linalg.svd(rounded)
    p = quat_from_matrix(Mat3.of(np.moveaxis(rounded, 0, -1)))
    assert apart(p, Rotation.from_matrix(U @ V)) < 1e-14


def test_a_reflection_is_refused_and_in_a_program_it_is_nan():
    for m in (-np.eye(3), np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3))):
        for f in (nearest_rotation, quat_from_matrix, mrp_from_matrix, euler_from_matrix):
            with pytest.raises(ValueError, match=r"^`det\(m\)` must be 1 .* but it is -?[01]\.$"):
                f(Mat3.of(m))
        assert np.isnan(array(jax.jit(quat_from_matrix)(Mat3.of(m)))).all()
    gap = np.where(np.arange(2) == 0, np.nan, np.eye(3)[..., None])  # a missing row of a log
    np.testing.assert_array_equal(array(quat_from_matrix(Mat3.of(gap))).T, [[np.nan] * 4, [1, 0, 0, 0]])


# rotation vectors


def test_the_rotation_vector_keeps_its_digits_near_zero():
    for size in (0.0, 1e-300, 1e-12, 1e-8, 1.9e-4, 2.1e-4, 1e-2):
        r = Vec3(size * 2 / 7, -size * 3 / 7, size * 6 / 7)
        close(vector_from_quat(quat_from_vector(r)), r, 1e-15 * max(size, 1e-300))
    for factor in (-1.0, 3.0):  # the opposite quaternion, and one of another length
        close(vector_from_quat(factor * quat_from_vector(Vec3(0.3, -0.2, 0.1))), Vec3(0.3, -0.2, 0.1), 1e-15)
    assert np.isnan(array(vector_from_quat(Quat(0.0, 0.0, 0.0, 0.0)))).all()


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.0099, 0.0101, 1.0, np.pi, 6.0])
def test_the_left_jacobian_is_the_derivative_of_the_rotation(size):
    r = Vec3(size * 2 / 7, -size * 3 / 7, size * 6 / 7)
    p, J, inverse = quat_from_vector(r), left_jacobian(r), left_jacobian_inverse(r)
    for d in map(Vec3.of, np.eye(3)):
        _, rate = jax.jvp(quat_from_vector, (r,), (d,))
        close(rate, 0.5 * (Quat(0.0, *(J @ d)) * p), 1e-13)
        close(rate, 0.5 * (p * Quat(0.0, *(J.T @ d))), 1e-13)  # in body axes
    close(J @ inverse, Mat3.of(np.eye(3)), 1e-12)
    a = np.array(array(r))
    S = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    series, term = np.eye(3), np.eye(3)
    for n in range(2, 60):  # J = sum of S^(n - 1) / n!
        term = term @ S / n
        series = series + term
    np.testing.assert_allclose(array(J), series, atol=1e-13)
    for f in (left_jacobian, left_jacobian_inverse):
        assert all(np.isfinite(g) for g in jax.tree.leaves(jax.jacfwd(f)(r)))


# means, angles


def test_the_mean_attitude_is_the_eigenvector_whatever_the_signs():
    rng = np.random.default_rng(7)
    turns = Rotation.from_rotvec([0.3, 2.0, -1.5]) * Rotation.from_rotvec(0.2 * rng.normal(size=(20, 3)))
    q = turns.as_quat(scalar_first=True) * rng.choice([-1, 1], 20)[:, None]
    mean_of = jax.jit(lambda q, weights: quat_mean(Quat.of(q.T), weights))
    for weights in (np.ones(20), rng.uniform(0, 5, 20)):
        mean = mean_of(q, weights)
        best = np.linalg.eigh((q.T * weights) @ q)[1][:, -1]
        np.testing.assert_allclose(array(mean), best * np.sign(best[0]), atol=2e-15)
        assert apart(jax.tree.map(lambda a: a[None], mean), turns.mean(weights)) < 1e-14
    close(mean_of(0.999 * q, np.ones(20)), mean_of(q, np.ones(20)), 1e-15)
    same = np.repeat(q[:1], 20, axis=0)
    close(mean_of(same, np.full(20, 0.3)), Quat.of(q[0] * np.sign(q[0][0])), 1e-15)
    slope = jax.jit(lambda q: jax.jvp(lambda s: quat_mean(Quat.of(q.T), s), (np.ones(20),), (np.arange(20.0),))[1])
    for at in (q, same):
        assert all(np.isfinite(a).all() for a in jax.tree.leaves(slope(at)))
    apart_by_half_a_turn = np.repeat([[1.0, 0, 0, 0], [0, 1.0, 0, 0]], 10, axis=0)
    assert np.isnan(array(mean_of(apart_by_half_a_turn, np.ones(20)))).all()


def test_conversions_take_quaternions_of_any_length():
    turns = turned(50, 8)
    p = quat_from_scalar_last(turns.as_quat().T)
    for f in (quat_matrix, mrp_from_quat, vector_from_quat, euler_from_quat, lambda p: angles_from_quat(p, "313")):
        for factor in (0.9995, 32767.0):
            close(f(factor * p), f(p), 1e-13)
        assert np.isnan(array(f(0 * p))).all()


def test_scalar_last_is_another_order_and_no_quaternion_is_taken_for_it():
    np.testing.assert_array_equal(array(quat_from_scalar_last([1, 2, 3, 4])), [4, 1, 2, 3])
    np.testing.assert_array_equal(scalar_last_from_quat(Quat(4, 1, 2, 3)), [1, 2, 3, 4])
    with pytest.raises(TypeError, match="`a` must be an array with the rows x, y, z, w, but it is a Quat"):
        quat_from_scalar_last(Quat(1.0, 0.0, 0.0, 0.0))


def test_angles_are_wrapped_by_the_turn_of_their_unit():
    assert [full_turn(unit) for unit in ("rad", "deg", "rad/s", "m")] == [2 * np.pi, 360, np.inf, np.inf]
    np.testing.assert_array_equal(wrapped(np.array([359.0, -359, 180.5, 0, 719]), 360.0), [-1, 1, -179.5, 0, -1])
    np.testing.assert_allclose(wrapped(np.array([6.0, -3.0, 2e3 * np.pi])), [6 - 2 * np.pi, -3, 0], atol=1e-12)
    np.testing.assert_array_equal(wrapped(np.array([359.0, 7.0]), np.array([np.inf, 2.0])), [359, -1])
    assert jax.grad(wrapped)(3.5) == 1 and jax.grad(wrapped)(400.0, np.inf) == 1


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
