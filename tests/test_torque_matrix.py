"""The torque matrix against NumPy: rank, singular values, and T x = a solved for x at every rank."""

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from clusters import FOUR, SKEWS, THREE, angles, matrices, torque  # noqa: E402

from jaxatt.cmg import cmg_axes, cmg_triads  # noqa: E402
from jaxatt.torque_matrix import (  # noqa: E402
    condition,
    condition_and_rank,
    gram_determinant,
    min_norm_solve,
    minors,
    pseudo_inverse,
    robust_solve,
    singular_values,
)
from jaxatt.vec import Mat3, Vec3, array, columns  # noqa: E402


@pytest.mark.parametrize("name", SKEWS)
def test_determinant_in_closed_form(name):
    g, b = angles(3, 1000), np.radians(SKEWS[name])
    t = torque(THREE[name], g)
    (d,) = minors(columns(t)).values()
    closed = np.sin(b) * (
        np.sin(g[1]) * np.sin(g[0] + g[2])
        + np.cos(b) * np.cos(g[1]) * (2 * np.cos(b) * np.cos(g[0]) * np.cos(g[2]) + np.sin(g[2] - g[0]))
    )
    np.testing.assert_allclose(d, closed, atol=1e-13)
    np.testing.assert_allclose(d, np.linalg.det(matrices(t)), atol=1e-13)
    t = torque(FOUR[name], angles(4, 1000))
    T = matrices(t)
    np.testing.assert_allclose(gram_determinant(t), np.linalg.det(T @ np.swapaxes(T, 1, 2)), atol=1e-13)


@pytest.mark.parametrize("axes", [*THREE.values(), *FOUR.values(), cmg_axes(1.0, np.arange(6.0))])
def test_singular_values_against_svd(axes):
    t = torque(axes, angles(len(axes.r.x), 20000))
    ours = np.stack(jax.jit(singular_values)(t), -1)
    theirs = np.linalg.svd(matrices(t), compute_uv=False)
    np.testing.assert_allclose(ours, theirs, atol=3e-9)
    kappa = theirs[:, 0] / theirs[:, 2]
    ok = kappa < 1e4
    np.testing.assert_allclose(np.asarray(condition(t))[ok], kappa[ok], rtol=1e-9)
    single = condition(jax.tree.map(jnp.float32, t))
    ok = kappa < 100
    assert single.dtype == jnp.float32
    assert np.quantile(np.abs(np.asarray(single)[ok] / kappa[ok] - 1), 0.99) < 1e-4


def test_rank_one_is_seen():
    T = np.zeros((3, 3))
    T[2] = 1  # box-90 at gimbal angles zero: all torques along z
    kappa, rank_one = condition_and_rank(Vec3(*T))
    assert np.isinf(kappa) and rank_one
    kappa, rank_one = condition_and_rank(cmg_triads(THREE["box"], np.zeros(3)).t)
    assert kappa > 1e7 and rank_one
    kappa, rank_one = condition_and_rank(Vec3(*np.eye(3)))
    assert kappa == 1 and not rank_one
    kappa, rank_one = condition_and_rank(Vec3(*np.diag([1.0, 1.0, 0.0])))
    assert np.isinf(kappa) and not rank_one


def test_condition_has_finite_gradients():
    kappa = jax.jit(lambda g: condition(cmg_triads(THREE["pyramid"], g).t))
    g = angles(3, 1)[:, 0]
    numeric = [(kappa(g + 1e-6 * e) - kappa(g - 1e-6 * e)) / 2e-6 for e in np.eye(3)]
    np.testing.assert_allclose(jax.jit(jax.grad(kappa))(g), numeric, rtol=1e-6)
    of_all = jax.jit(jax.vmap(jax.grad(lambda T: sum(singular_values(Vec3.of(T))))))
    assert np.isfinite(of_all(np.stack([np.eye(3), np.ones((3, 3)), np.zeros((3, 3)), np.diag([1.0, 1.0, 0.5])]))).all()
    flat = jax.jit(jax.grad(lambda T: condition(Vec3.of(T))))(np.diag([1.0, 1.0, 0.0]))
    assert np.isfinite(flat).all()


# solving T x = a


def solved(T, a, rcond):
    """`min_norm_solve` of matrices (m, 3, n) and right sides (m, 3)."""
    one = lambda T, a: min_norm_solve(Vec3.of(T), Vec3.of(a), rcond)
    return np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(T), jnp.asarray(a)))


def test_min_norm_solve_is_the_pseudo_inverse():
    rng = np.random.default_rng(3)
    for axes in (*THREE.values(), *FOUR.values()):
        T, a = matrices(torque(axes, angles(len(axes.r.x), 500))), rng.normal(size=(500, 3))
        np.testing.assert_allclose(
            solved(T, a, 1e-15), np.einsum("mij,mj->mi", np.linalg.pinv(T), a), rtol=1e-10, atol=1e-10
        )
    # a column of zeros changes nothing, so a failed module is a mask
    x, y = solved(T * [1, 1, 0, 1], a, 1e-15), solved(T[:, :, [0, 1, 3]], a, 1e-15)
    np.testing.assert_allclose(x[:, [0, 1, 3]], y, rtol=1e-12)
    np.testing.assert_array_equal(x[:, 2], 0)


def test_min_norm_solve_cuts_small_singular_values():
    rng = np.random.default_rng(4)
    sizes = [  # sigma, rcond
        ((1.5, 0.7, 0.01), 0.02), ((1.5, 0.7, 1e-13), 1e-8), ((1.5, 1.5, 0), 1e-15), ((1.5, 1.5, 1.5), 0.5),
        ((1.5, 1e-3, 1e-4), 1e-3), ((1.5, 0.7, 0.01), 0.6), ((1.5, 0.2, 0.2), 0.2), ((0, 0, 0), 1e-15),
    ]  # fmt: skip
    for n in (3, 4, 6):
        for sigma, rcond in sizes:
            left, right = (np.linalg.qr(rng.normal(size=(k, k)))[0] for k in (3, n))
            T, a = left @ np.diag(sigma) @ right[:3], rng.normal(size=3)
            x = min_norm_solve(Vec3.of(jnp.asarray(T)), Vec3.of(a), rcond)
            np.testing.assert_allclose(
                x, np.linalg.pinv(T, rcond) @ a, rtol=1e-9, atol=1e-9, err_msg=f"{sigma} {rcond}"
            )


def test_min_norm_solve_at_rank_two_whatever_axis_gets_no_torque():
    rng = np.random.default_rng(5)
    for axis in range(3):
        T = rng.normal(size=(200, 3, 4)) * (np.arange(3) != axis)[:, None]
        a = np.tile([0.3, -0.2, 0.5], (200, 1))
        np.testing.assert_allclose(
            solved(T, a, 1e-8), np.einsum("mij,mj->mi", np.linalg.pinv(T), a), atol=1e-11, rtol=1e-9
        )


def test_min_norm_solve_of_parallel_columns():
    """Rank one: sigma_2 is rounding, of size 1e-16 sigma_1, which a small rcond must tell from a true one."""
    t = cmg_triads(THREE["box"], np.zeros(3)).t  # box-90 at gimbal angles zero: all torques along z
    for rcond in (1e-15, 1e-12, 1e-8):
        np.testing.assert_allclose(min_norm_solve(t, Vec3(0.3, -0.4, 0.2), rcond), np.full(3, 1 / 15), rtol=1e-12)
    rng = np.random.default_rng(6)
    for n in (3, 4):
        axis, size, a = rng.normal(size=(300, 3, 1)), rng.normal(size=(300, 1, n)), rng.normal(size=(300, 3))
        T = axis * size
        for rcond in (1e-14, 1e-10):
            np.testing.assert_allclose(
                solved(T, a, rcond), np.einsum("mij,mj->mi", np.linalg.pinv(T, rcond), a), rtol=1e-9, atol=1e-12
            )


def test_min_norm_solve_keeps_small_true_singular_values():
    """sigma_2 = 1e-10 sigma_1 counts at rcond 1e-12: from T T' alone nobody could tell it from rounding."""
    T = np.array([[1.0, 1.0, 1.0], [1e-10, 0.0, -1e-10], [0.0, 0.0, 0.0]])
    x = min_norm_solve(Vec3.of(jnp.asarray(T)), Vec3(0.3, 1e-10, 0.2), 1e-12)
    np.testing.assert_allclose(x, [0.6, 0.1, -0.4], rtol=1e-6)


RANKS = [(1, 0.7, 0.3), (2, 0.1, 0.1), (1, 1, 0), (1, 0.01, 0), (1, 1e-3, 0), (1, 0, 0), (0, 0, 0)]  # singular values


def of_rank(sigma, n, m, seed=0):
    """m matrices (3, n) with these singular values and directions at random, and right sides."""
    rng = np.random.default_rng(seed)
    left, right = np.linalg.qr(rng.normal(size=(m, 3, 3)))[0], np.linalg.qr(rng.normal(size=(m, n, n)))[0][:, :3]
    return left @ (np.array(sigma)[:, None] * right), rng.normal(size=(m, 3))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("n", [3, 4, 6])
def test_min_norm_solve_needs_no_threshold_to_know_the_rank(n, dtype):
    """rcond 0: what is left of a zero singular value is rounding, in either precision and however small the others are."""
    for sigma in RANKS:
        T, a = of_rank(sigma, n, 200)
        T, a = T.astype(dtype), a.astype(dtype)
        rank = np.count_nonzero(sigma)
        P = np.linalg.pinv(T.astype(float), rcond=sigma[rank - 1] / sigma[0] / 2 if rank else 1)
        x, expected = solved(T, a, dtype(0)), np.einsum("mij,mj->mi", P, a)
        spread = 100 * np.finfo(dtype).eps * (sigma[0] / sigma[rank - 1]) if rank else 0  # the problem's own condition
        bound = spread * np.linalg.norm(P, axis=(1, 2)) * np.linalg.norm(a, axis=1)
        assert (np.linalg.norm(x - expected, axis=1) <= bound).all(), sigma


def test_the_pseudo_inverse_does_not_depend_on_the_unit():
    T, a = of_rank((1, 0.5, 0.2), 4, 50)
    T, a = T.astype(np.float32), a.astype(np.float32)
    for size in (1e-12, 1e12):
        np.testing.assert_allclose(solved(size * T, size * a, 0.0), solved(T, a, 0.0), rtol=2e-5, atol=1e-5)


def along(s, factors):
    """P (4, 3) of T = (L + s L') (R + s R'), whose rank does not change with s."""
    left, dleft, right, dright = factors
    return array(pseudo_inverse(Vec3.of((left + s * dleft) @ (right + s * dright)), 1e-12)).T


SLOPES = jax.jit(lambda factors: (along(0.0, factors), *(d(along)(0.0, factors) for d in (jax.jacfwd, jax.jacrev))))
BEND = jax.jit(jax.jacfwd(jax.jacrev(along)))


@pytest.mark.parametrize("rank", [3, 2, 1, 0])
def test_the_derivative_of_the_pseudo_inverse_is_exact_at_constant_rank(rank):
    """Along a direction that keeps the rank, against a central difference of NumPy's; twice differentiable too."""
    rng = np.random.default_rng(rank)
    used = np.arange(3) < rank
    left, right = rng.normal(size=(2, 3, 3)) * used, rng.normal(size=(2, 3, 4)) * used[:, None]
    plain = lambda s: np.linalg.pinv((left[0] + s * left[1]) @ (right[0] + s * right[1]), rcond=1e-9)
    value, slope, back = SLOPES((*left, *right))
    np.testing.assert_allclose(value, plain(0.0), atol=1e-11)
    h = 1e-5
    np.testing.assert_allclose(slope, (plain(h) - plain(-h)) / (2 * h), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(back, slope, atol=1e-10)
    bend = (plain(10 * h) - 2 * plain(0.0) + plain(-10 * h)) / (10 * h) ** 2
    np.testing.assert_allclose(BEND(0.0, (*left, *right)), bend, rtol=1e-3, atol=1e-3)


def test_gradients_of_the_pseudo_inverse_are_finite_at_every_rank():
    cost = jax.jit(jax.vmap(jax.grad(lambda T: jnp.sum(array(pseudo_inverse(Vec3.of(T), 0.0))))))
    for dtype in (np.float64, np.float32):
        T = [
            np.eye(3, 4),
            np.ones((3, 4)),
            np.zeros((3, 4)),
            np.diag([1.0, 1, 0]) @ np.ones((3, 4)),
            1e-30 * np.eye(3, 4),
        ]
        assert np.isfinite(cost(np.array(T[:4], dtype))).all()
    assert np.isfinite(cost(np.array(T))).all()


def test_robust_solve():
    T, a, E = matrices(torque(FOUR["box"], angles(4, 1)))[0], np.array([1.0, -2.0, 0.3]), np.diag([0.1, 0.2, 0.3])
    x = robust_solve(Vec3.of(jnp.asarray(T)), Vec3.of(a), Mat3.of(E))
    np.testing.assert_allclose(x, T.T @ np.linalg.solve(T @ T.T + E, a), rtol=1e-12)
