import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt import vec
from jaxatt.vec import Quat, Vec3, array, cross, det, diagonal, inverse, mat3, norm, quat, vec3

RNG = np.random.default_rng(0)
SHAPES = [(), (5,), (2, 3)]


@pytest.mark.parametrize("lanes", SHAPES)
def test_vectors_and_matrices_agree_with_numpy(lanes):
    a, b = RNG.normal(size=(2, 3, *lanes))
    m, n = RNG.normal(size=(2, 3, 3, *lanes))
    A, B, M, N = vec3(a), vec3(b), mat3(m), mat3(n)
    for ours, plain in [
        (A + B, a + b), (A - B, a - b), (-A, -a), (2 * A, 2 * a), (A * 2, 2 * a), (A / 2, a / 2),
        (cross(A, B), np.cross(a, b, axis=0)), (M @ A, np.einsum("ij...,j...->i...", m, a)),
        (M @ N, np.einsum("ij...,jk...->ik...", m, n)), (M.T, np.swapaxes(m, 0, 1)), (M + N, m + n), (M - N, m - n),
        (-M, -m), (3 * M, 3 * m), (M * 3, 3 * m),
    ]:  # fmt: skip
        np.testing.assert_allclose(array(ours), plain, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(A @ B, (a * b).sum(0), rtol=1e-13)
    np.testing.assert_allclose(norm(A), np.sqrt((a * a).sum(0)), rtol=1e-14)
    np.testing.assert_allclose(det(M), np.linalg.det(np.moveaxis(m, (0, 1), (-2, -1))), rtol=1e-12)
    identity = np.broadcast_to(np.eye(3).reshape(3, 3, *[1] * len(lanes)), m.shape)
    np.testing.assert_allclose(array(inverse(M) @ M), identity, atol=1e-12)


def test_diagonal():
    np.testing.assert_array_equal(array(diagonal((1.0, 2.0, 3.0))), np.diag([1.0, 2.0, 3.0]))


def test_hamilton_product_of_the_units():
    one, i, j, k = (quat(row) for row in np.eye(4))
    assert array(i * j).tolist() == array(k).tolist()
    assert array(j * k).tolist() == array(i).tolist()
    assert array(k * i).tolist() == array(j).tolist()
    assert array(i * i).tolist() == array(-one).tolist()
    assert (i @ i, i @ j) == (1, 0)


def test_numpy_and_jax_scalars_on_the_left_do_not_make_arrays():
    v = Vec3(1.0, 2.0, 3.0)
    for s in (np.float64(2), jnp.float32(2), np.ones(4), 2):
        assert isinstance(s * v, Vec3) and isinstance(v * s, Vec3)
    assert isinstance(np.float64(2) * Quat(1.0, 0.0, 0.0, 0.0), Quat)
    assert isinstance(np.float64(2) * diagonal((1.0, 1.0, 1.0)), vec.Mat3)


def test_gradients_at_zero_are_finite():
    zero = Vec3(0.0, 0.0, 0.0)
    assert jax.grad(norm)(zero) == (0, 0, 0)
    assert jax.grad(vec.safe_sqrt)(0.0) == 1.0  # finite; of v @ v it multiplies zero


def test_safe_sqrt_lets_nan_through():
    assert np.isnan(vec.safe_sqrt(jnp.nan))


def test_once_is_the_function_itself_and_differentiable():
    def plain(a, b):
        return Vec3(a * b, a + b, jnp.sin(a))

    def through(a, b):
        return vec.once(plain, a, b)

    assert jax.jit(through)(2.0, 3.0) == jax.jit(plain)(2.0, 3.0)
    assert through(2.0, 3.0) == plain(2.0, 3.0)
    loss = lambda f: lambda a, b: norm(f(a, b))
    np.testing.assert_allclose(jax.jit(jax.grad(loss(through)))(2.0, 3.0), jax.grad(loss(plain))(2.0, 3.0))
    np.testing.assert_allclose(jax.jit(jax.jacfwd(loss(through)))(2.0, 3.0), jax.grad(loss(plain))(2.0, 3.0))
