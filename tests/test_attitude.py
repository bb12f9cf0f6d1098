"""Laws of the attitude algebra, on random attitudes, large and small, in lanes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
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
)  # fmt: skip
from jaxatt.engine import rk4
from jaxatt.vec import Vec3, array, cross, norm, vec3

RNG = np.random.default_rng(2)
N = 50


def vectors(size=1.0):
    return vec3(size * RNG.normal(size=(3, N)))


def close(a, b, tolerance=1e-12):
    np.testing.assert_allclose(array(a), array(b), atol=tolerance)


def test_the_mrp_rate_map_is_G_of_the_paper():
    q, w = vectors(), vectors()
    for i in range(N):
        a, b = np.array(array(q))[:, i], np.array(array(w))[:, i]
        S = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
        G = ((1 - a @ a) * np.eye(3) + 2 * S + 2 * np.outer(a, a)) / 4
        np.testing.assert_allclose(array(mrp_rate(vec3(a), vec3(b))), G @ b, atol=1e-13)
        np.testing.assert_allclose(array(mrp_rate_transposed(vec3(a), vec3(b))), G.T @ b, atol=1e-13)
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
    close(mrp_error(q, shadow), Vec3(0.0, 0.0, 0.0))
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
    A, dA = np.moveaxis(array(mrp_matrix(q)), -1, 0), np.moveaxis((array(ahead) - array(back)) / (2 * h), -1, 0)
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
    np.testing.assert_allclose(np.moveaxis(array(quat_matrix(p)), -1, 0), P.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(np.moveaxis(array(quat_matrix(p * q)), -1, 0), (P * Q).as_matrix(), atol=1e-12)
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
    np.testing.assert_allclose(np.moveaxis(array(quat_matrix(q)), -1, 0), reference, atol=1e-12)
    close(euler_from_quat(q), a)
    close(euler_body_rate(a, euler_rate(a, w)), w)
    rate = jax.jvp(quat_from_euler, (a,), (euler_rate(a, w),))[1]
    close(rate, quat_rate(q, w))


@pytest.mark.slow
def test_gradients_are_finite_at_zero_rotation():
    zero = Vec3(0.0, 0.0, 0.0)
    for f in (
        lambda r: quat_from_vector(r).v, lambda r: quat_angle(quat_from_vector(r)), mrp_inner,
        lambda r: mrp_error(r, zero), lambda r: mrp_nearest(r, zero), lambda r: norm(mrp_rate(r, r)),
        lambda r: euler_from_quat(quat_from_euler(r)), lambda r: mrp_from_quat(quat_from_vector(r)),
    ):  # fmt: skip
        assert all(np.isfinite(g) for g in jax.tree.leaves(jax.jacrev(f)(zero)))
        assert all(np.isfinite(g) for g in jax.tree.leaves(jax.jacfwd(f)(zero)))


def test_rk4_is_of_order_four():
    errors = []
    for n in (10, 20, 40):
        x = Vec3(1.0, 0.0, 0.5)
        for k in range(n):
            x = rk4(lambda t, x: Vec3(x.y, -x.x, jnp.cos(t) * x.z), k / n, x, 1 / n)
        exact = np.array([np.cos(1), -np.sin(1), 0.5 * np.exp(np.sin(1))])
        errors.append(np.abs(array(x) - exact).max())
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert (np.abs(orders - 4) < 0.15).all()
