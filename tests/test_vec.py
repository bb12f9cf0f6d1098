"""Vectors, matrices and quaternions against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt import vec
from jaxatt.vec import (
    Mat3,
    Quat,
    Vec3,
    array,
    cross,
    det,
    diagonal,
    inverse,
    largest,
    largest_eigenvalue,
    largest_eigenvector,
    norm,
)

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("batch", [(), (5,)])
def test_vectors_and_matrices_agree_with_numpy(batch):
    a, b = RNG.normal(size=(2, 3, *batch))
    m, n = RNG.normal(size=(2, 3, 3, *batch))
    A, B, M, N = Vec3.of(a), Vec3.of(b), Mat3.of(m), Mat3.of(n)
    for ours, plain in [
        (A + B, a + b), (A - B, a - b), (-A, -a), (2 * A, 2 * a), (A * 2, 2 * a), (A / 2, a / 2),
        (cross(A, B), np.cross(a, b, axis=0)), (M @ A, np.einsum("ij...,j...->i...", m, a)),
        (M @ N, np.einsum("ij...,jk...->ik...", m, n)), (M.T, np.swapaxes(m, 0, 1)), (M + N, m + n), (M - N, m - n),
        (-M, -m), (3 * M, 3 * m), (M * 3, 3 * m), (M / 3, m / 3), (vec.outer(A, B), np.einsum("i...,j...->ij...", a, b)),
        (vec.skew(A) @ B, np.cross(a, b, axis=0)), (vec.scaled_identity(a[0]) @ B, a[0] * b),
    ]:  # fmt: skip
        np.testing.assert_allclose(array(ours), plain, rtol=1e-14, atol=1e-14)
        assert type(ours) is (Mat3 if plain.ndim == 2 + len(batch) else Vec3)
    np.testing.assert_allclose(A @ B, (a * b).sum(0), rtol=1e-13)
    np.testing.assert_allclose(norm(A), np.sqrt((a * a).sum(0)), rtol=1e-14)
    np.testing.assert_array_equal(largest(A), np.abs(a).max(0))
    np.testing.assert_allclose(det(M), np.linalg.det(np.moveaxis(m, (0, 1), (-2, -1))), rtol=1e-12)
    identity = np.broadcast_to(np.eye(3).reshape(3, 3, *[1] * len(batch)), m.shape)
    np.testing.assert_allclose(array(inverse(M) @ M), identity, atol=1e-12)


def test_quaternions_agree_with_numpy_component_by_component():
    p, q = RNG.normal(size=(2, 4))
    P, Q = Quat.of(p), Quat.of(q)
    for ours, plain in [(P + Q, p + q), (P - Q, p - q), (-P, -p), (2 * P, 2 * p), (P * 2, 2 * p), (P / 2, p / 2)]:
        np.testing.assert_allclose(array(ours), plain, rtol=1e-14)
        assert isinstance(ours, Quat)
    np.testing.assert_allclose(P @ Q, p @ q, rtol=1e-14)
    np.testing.assert_allclose(norm(P), np.linalg.norm(p), rtol=1e-14)
    np.testing.assert_array_equal(array(P.v), p[1:])


def test_hamilton_product_of_the_units():
    one, i, j, k = (Quat.of(row) for row in np.eye(4))
    assert array(i * j).tolist() == array(k).tolist()
    assert array(j * k).tolist() == array(i).tolist()
    assert array(k * i).tolist() == array(j).tolist()
    assert array(i * i).tolist() == array(-one).tolist()


TUPLE = (1.0, 2.0, 3.0)
V, M, Q = Vec3(1.0, 2.0, 3.0), diagonal((1.0, 2.0, 3.0)), Quat(1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Q * V, r"`Quat \* Vec3` is not defined: `quat_rotate\(q, v\)` turns a vector\.$"),
        (lambda: V * Q, r"`Vec3 \* Quat` is not defined"),
        (lambda: M * V, r"`Mat3 \* Vec3` is not defined: `m @ v`"),
        (lambda: V * V, r"`Vec3 \* Vec3` is not defined: `a @ b` is the dot product"),
        (lambda: V * (1.0, 2.0, 3.0), r"`Vec3 \* tuple` is not defined"),
        (lambda: V + 1, r"`Vec3 \+ number` is not defined"),
        (lambda: V + np.ones(3), r"`Vec3 \+ array` is not defined"),
        (lambda: V - Q, r"`Vec3 - Quat` is not defined"),
        (lambda: M + V, r"`Mat3 \+ Vec3` is not defined"),
        (lambda: M @ Q, r"`Mat3 @ Quat` is not defined: a matrix multiplies a Vec3 or a Mat3\.$"),
        (lambda: M @ np.ones(3), r"`Mat3 @ array` is not defined"),
        (lambda: V @ M, r"`Vec3 @ Mat3` is not defined"),
        (lambda: Q @ V, r"`Quat @ Vec3` is not defined"),
        (lambda: V / V, r"`Vec3 / Vec3` is not defined"),
        (lambda: M / M, r"`Mat3 / Mat3` is not defined: `inverse\(m\)` is the inverse"),
        (lambda: Q / Q, r"`Quat / Quat` is not defined"),
        (lambda: 1 + V, r"`number \+ Vec3` is not defined: .*`sum\(vectors, zeros\(\)\)`\.$"),  # pyright: ignore[reportOperatorIssue]
        (lambda: sum([V, V]), r"`number \+ Vec3` is not defined"),  # pyright: ignore[reportArgumentType, reportCallIssue]
        (lambda: TUPLE + V, r"`tuple \+ Vec3` is not defined"),
        (lambda: TUPLE + M, r"`tuple \+ Mat3` is not defined"),
        (lambda: V < 2 * V, r"`Vec3 < Vec3` is not defined: there is no order; compare `norm\(v\)` or components\.$"),
        (lambda: max(V, V), r"`Vec3 > Vec3` is not defined"),
        (lambda: sorted([Q, Q]), r"`Quat < Quat` is not defined"),
        (lambda: V >= 1, r"`Vec3 >= number` is not defined"),  # pyright: ignore[reportOperatorIssue]
        (lambda: V**2, "unsupported operand"),  # pyright: ignore[reportOperatorIssue]
        (lambda: abs(V), "bad operand"),  # pyright: ignore[reportArgumentType]
        (lambda: jnp.ones(3) + V, r"`array \+ Vec3` is not defined"),  # pyright: ignore[reportOperatorIssue]
        (lambda: 1 - V, "unsupported operand"),  # pyright: ignore[reportOperatorIssue]
        (lambda: 1 / V, "unsupported operand"),  # pyright: ignore[reportOperatorIssue]
        (lambda: np.ones(3) + V, r"`array \+ Vec3` is not defined|not implemented for NumPy arrays"),
        (lambda: np.ones((3, 3)) @ V, "Vec3"),
    ],
)
def test_operands_that_do_not_go_together_raise(wrong, message):
    with pytest.raises(TypeError, match=message):
        wrong()


def test_numpy_and_jax_scalars_on_the_left_do_not_make_arrays():
    for s in (np.float64(2), jnp.float32(2), np.ones(4), 2):
        assert isinstance(s * V, Vec3) and isinstance(V * s, Vec3)
    assert isinstance(np.float64(2) * Q, Quat) and isinstance(np.float64(2) * M, Mat3)


def test_diagonal_zeros_and_where():
    np.testing.assert_array_equal(array(M), np.diag([1.0, 2.0, 3.0]))
    assert vec.zeros() == (0, 0, 0)
    for a in (V, Q, M):
        assert vec.where(True, a, -a) == a and vec.where(False, a, -a) == -a


def test_wrong_lengths_are_no_vectors():
    for make, a in ((Vec3.of, np.ones(4)), (Quat.of, np.ones(3)), (Mat3.of, np.ones((3, 2)))):
        with pytest.raises(ValueError, match="unpack"):
            make(a)


def test_the_inverse_of_a_singular_matrix_is_not_finite():
    assert not np.isfinite(array(inverse(diagonal((1.0, 2.0, 0.0))))).all()


def test_gradients_at_zero_are_finite():
    assert jax.grad(norm)(vec.zeros()) == (0, 0, 0)
    assert jax.grad(vec.safe_sqrt)(0.0) == 1.0  # finite; of v @ v it multiplies zero


def test_safe_sqrt_lets_nan_through():
    assert np.isnan(vec.safe_sqrt(jnp.nan))


# axes


AXES = RNG.normal(size=(3, 4))


@pytest.mark.parametrize("axes", [AXES, jnp.asarray(AXES), Vec3(*AXES), tuple(map(Vec3.of, AXES.T))])
def test_project_and_resultant_are_the_products_with_a_matrix_of_columns(axes):
    v, s = RNG.normal(size=3), RNG.normal(size=4)
    np.testing.assert_allclose(vec.project(axes, Vec3.of(v)), AXES.T @ v, rtol=1e-14)
    np.testing.assert_allclose(array(vec.resultant(axes, s)), AXES @ s, rtol=1e-14)


@pytest.mark.parametrize(
    ("axes", "error", "message"),
    [
        (AXES.T, ValueError, r"`axes` must have shape \(3, n\), but it is of shape \(4, 3\)"),
        (AXES[:, 0], ValueError, r"`axes` must have shape \(3, n\), but it is of shape \(3,\)"),
        (V, TypeError, r"`axes` must be Vec3, one for each axis, or an array \(3, n\), but it is Vec3"),
        (M, TypeError, r"`axes` must be Vec3, .* but it is Mat3"),  # by rows or by columns?
        ([], TypeError, r"`axes` must be Vec3, .* but it is list"),
        (AXES.tolist(), TypeError, r"`axes` must be Vec3, .* but it is list"),
        (3.0, TypeError, r"`axes` must be Vec3, .* but it is float"),
    ],
)
def test_what_holds_no_axes_is_refused(axes, error, message):
    for call in (lambda: vec.project(axes, V), lambda: vec.resultant(axes, np.ones(4))):
        with pytest.raises(error, match=message):
            call()


def test_a_resultant_takes_one_number_for_each_axis():
    with pytest.raises(ValueError, match="`s` must hold a number for each of the 4 axes, but it holds 3"):
        vec.resultant(AXES, np.ones(3))
    with pytest.raises(ValueError, match="`s` must hold a number for each of the 4 axes, but it holds one"):
        vec.resultant(AXES, 1.0)


# the largest eigenvalue


def symmetric(values):
    """A symmetric matrix with these eigenvalues, its axes at random."""
    turn, _ = np.linalg.qr(RNG.normal(size=(3, 3)))
    return turn @ np.diag(values) @ turn.T


def test_the_largest_eigenvalue_of_random_matrices_is_numpys():
    m = RNG.normal(size=(1000, 3, 3)) * 10.0 ** RNG.uniform(-6, 6, (1000, 1, 1))
    m = m + np.swapaxes(m, 1, 2)
    size = np.abs(m).max((1, 2))
    ours = largest_eigenvalue(Mat3.of(np.moveaxis(m, 0, -1)))
    np.testing.assert_allclose(ours / size, np.linalg.eigvalsh(m)[:, -1] / size, atol=1e-14)


@pytest.mark.parametrize("values", [(2, 2, 2), (0, 0, 0), (5, 5, 1), (5, 1, 1), (-1, -1, -4), (1, 1, 1 - 1e-9)])
def test_the_largest_eigenvalue_where_eigenvalues_coincide(values):
    m = Mat3.of(symmetric(np.array(values, float)))
    assert largest_eigenvalue(m) == pytest.approx(max(values), abs=3e-8)  # half the digits at a double root
    gradient = jax.grad(largest_eigenvalue)(jax.tree.map(jnp.asarray, m))
    assert all(np.isfinite(g) for g in jax.tree.leaves(gradient))


def test_the_gradient_of_the_largest_eigenvalue_is_the_central_difference():
    m, h = symmetric([15.0, 27.0, 31.0]), 1e-4
    value = lambda m: largest_eigenvalue(Mat3.of(m))
    gradient = jax.grad(value)(jnp.asarray(m))
    for i in range(3):
        for j in range(i + 1):
            d = np.zeros((3, 3))
            d[i, j] = d[j, i] = h
            central = (np.linalg.eigvalsh(m + d)[-1] - np.linalg.eigvalsh(m - d)[-1]) / (2 * h)
            assert np.sum(gradient * d) / h == pytest.approx(central, abs=1e-8)


def test_the_largest_eigenvalue_in_float32():
    m = symmetric([1e-12, 2e-12, 3e-12]).astype(np.float32)  # p^3 alone would underflow
    assert largest_eigenvalue(Mat3.of(m)) == pytest.approx(3e-12, rel=1e-6)


def test_the_largest_eigenvector_of_four_by_four_is_that_of_lapack():
    """To rounding over the gap to the next eigenvalue, matrices of attitude (trace 0) and of one rank among them."""
    rng = np.random.default_rng(9)
    many = rng.normal(size=(400, 4, 4))
    many += np.swapaxes(many, 1, 2)
    many[100:200] -= np.trace(many[100:200], axis1=1, axis2=2)[:, None, None] / 4 * np.eye(4)
    ones = rng.normal(size=(100, 4))
    many[200:300] = ones[:, :, None] * ones[:, None, :]
    values, vectors = np.linalg.eigh(many)
    size, gap = np.abs(values).max(1), values[:, -1] - values[:, -2]
    best = vectors[:, :, -1] * np.sign(vectors[:, :1, -1])
    run = jax.jit(largest_eigenvector)
    for kind, rounding in ((np.float64, 1e-14), (np.float32, 5e-6)):
        value, v = run(tuple(Quat.of(row) for row in np.moveaxis(many, 0, -1).astype(kind)))
        assert (np.abs(value - values[:, -1]) <= rounding * size).all()
        clear = (np.abs(best[:, 0]) > 1e-3) & (gap > 0.1 * size)  # else the sign of w is a matter of rounding
        assert clear.sum() > 300 and (np.abs(array(v).T - best).max(1) <= rounding * size / gap)[clear].all()
    pair = run(tuple(map(Quat.of, np.diag([1.0, 1.0, 0.5, 0.0]))))[1]
    assert np.isnan(array(pair)).all()


def test_the_largest_eigenvector_has_the_gradient_of_differences():
    K = np.random.default_rng(10).normal(size=(4, 4))
    K = K + K.T
    D = np.outer([1.0, -2.0, 0.5, 0.3], [1.0, -2.0, 0.5, 0.3])
    along = lambda s: largest_eigenvector(tuple(map(Quat.of, jnp.asarray(K) + s * jnp.asarray(D))))
    run = jax.jit(lambda s: jax.jvp(along, (s,), (1.0,)))
    slope = jax.tree.map(lambda a, b: (a - b) / 2e-6, run(1e-6)[0], run(-1e-6)[0])
    for a, b in zip(jax.tree.leaves(run(0.0)[1]), jax.tree.leaves(slope)):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-8)
