"""Attitudes from vectors of one instant against eigenvalues, SciPy, and the covariances they promise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from slopes import slopes

from jaxatt.single_frame import davenport, davenport_covariance, triad_attitude, triad_covariance
from jaxatt.vec import Quat, Vec3, array, norm

N = 4000  # of every batch: one program serves all
WEIGHTS = (1.0, 3.0, 0.5)
SPECIAL = Rotation.from_quat(np.eye(4))  # three half turns and the identity


def columns(v):
    """Vectors (n, 3) as a `Vec3` of arrays (n,)."""
    return Vec3(*np.moveaxis(v, -1, 0))


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def cases(vectors, seed, noise, n=N):
    """Attitudes, the four special ones among them, and vectors (vectors, n, 3) in both axes."""
    rng = np.random.default_rng(seed)
    q = Rotation.concatenate([Rotation.from_quat(rng.normal(size=(n - 400, 4))), *[SPECIAL] * 100])
    r = unit(rng.normal(size=(vectors, n, 3)))
    b = np.stack([q.inv().apply(one) for one in r])
    return q, unit(b + noise * rng.normal(size=b.shape)), r


def by_eigh(b, r, weights):
    """Quaternions, scalar first, and eigenvalues of Davenport's matrix written down as a sum of 4x4 matrices.

    |b - A'r|^2 = 2 - 2 r.(q b q*) with r.(q b q*) = q' [r]_L' [b]_R q of unit vectors as pure quaternions.
    """

    def left(v):
        x, y, z = np.moveaxis(v, -1, 0)
        o = np.zeros_like(x)
        return np.moveaxis(np.array([[o, -x, -y, -z], [x, o, -z, y], [y, z, o, -x], [z, -y, x, o]]), -1, 0)

    def right(v):
        x, y, z = np.moveaxis(v, -1, 0)
        o = np.zeros_like(x)
        return np.moveaxis(np.array([[o, -x, -y, -z], [x, o, z, -y], [y, -z, o, x], [z, y, -x, o]]), -1, 0)

    w = np.array(weights[: len(b)]) / np.sum(weights[: len(b)])
    K = sum(a * np.swapaxes(left(y), 1, 2) @ right(x) for a, x, y in zip(w, b, r))
    values, vectors = np.linalg.eigh((K + np.swapaxes(K, 1, 2)) / 2)
    return vectors[:, :, -1], values


def angle(p, q):
    """Between attitudes given as (4, n) and (n, 4) [rad]."""
    p, q = (Rotation.from_quat(np.asarray(a, float), scalar_first=True) for a in (np.stack(p, -1), q))
    return (p.inv() * q).magnitude()


@jax.jit
def three(b, r, weights):
    return jax.vmap(davenport, in_axes=(0, 0, None))(b, r, weights)


def fit(b, r, weights=WEIGHTS):
    """Of two or three vectors (vectors, N, 3); the third of two is any, and its weight nothing."""
    kind = b.dtype.type
    third = np.broadcast_to(kind([0.0, 0.0, 1.0]), (3 - len(b), N, 3))
    weights = [kind(w) for w in [*weights[: len(b)], 0.0]][:3]
    return three(*(tuple(map(columns, np.concatenate([v, third]))) for v in (b, r)), tuple(weights))


@pytest.mark.parametrize("vectors", [2, 3])
@pytest.mark.parametrize("noise", [0.0, 1e-3, 1.0])
def test_davenport_is_the_eigenvector_of_the_largest_eigenvalue(vectors, noise):
    _, b, r = cases(vectors, 11, noise)
    got = fit(b, r)
    q, values = by_eigh(b, r, WEIGHTS)
    gap = values[:, -1] - values[:, -2]
    apart = gap > 0.1
    assert np.mean(apart) > 0.5
    assert angle(got.q, q)[apart].max() < 1e-11
    assert np.all(np.asarray(got.q.w) >= 0)
    np.testing.assert_allclose(got.loss, 1 - values[:, -1], atol=1e-13)
    np.testing.assert_allclose(got.gap, gap, atol=1e-7)  # where two eigenvalues meet their digits are halved
    np.testing.assert_allclose(np.asarray(got.gap)[apart], gap[apart], atol=2e-7)


def test_davenport_is_scipy_s_alignment():
    _, b, r = cases(3, 12, 0.1)
    got = fit(b, r)
    some = np.arange(N)[::10]
    want = [Rotation.align_vectors(r[:, i], b[:, i], weights=WEIGHTS)[0].as_quat(scalar_first=True) for i in some]
    apart = np.asarray(got.gap)[some] > 0.1
    assert angle([c[some] for c in got.q], np.array(want))[apart].max() < 1e-11


def test_float32_keeps_six_digits():
    """The turn is off by 2 |dK| / gap to first order, and rounding moves Davenport's matrix by two units of the last place."""
    _, b, r = cases(2, 13, 1e-3)
    b, r = b.astype(np.float32), r.astype(np.float32)
    got = fit(b, r)
    q, values = by_eigh(unit(b.astype(float)), unit(r.astype(float)), WEIGHTS)
    off, gap = angle(got.q, q), values[:, -1] - values[:, -2]
    assert got.q.w.dtype == np.float32
    assert (off * gap)[gap > 0.1].max() < 4 * np.finfo(np.float32).eps
    assert np.median(off) < 2e-7 and np.quantile(off, 0.99) < 7e-6


def test_the_gap_tells_what_cannot_be_told():
    v = np.full((2, N, 3), [0.6, 0.0, 0.8])
    v[1, 1], v[1, 2] = -v[1, 1], [0.0, 1.0, 0.0]
    same, opposite, across = fit(v, v, (1.0, 1.0)).gap[:3]
    assert same < 1e-7 and opposite < 1e-7 and across > 0.5


def test_a_weight_of_nothing_leaves_a_vector_out():
    _, b, r = cases(3, 14, 0.1)
    one = [tuple(Vec3(*v[0]) for v in a[:2]) for a in (b, r)]
    two = jax.jit(davenport)(*one, (2.0, 6.0)).q  # only the ratio counts
    np.testing.assert_allclose(np.stack(fit(b, r, (1.0, 3.0, 0.0)).q)[:, 0], np.array(two), atol=1e-14)


# TRIAD


@jax.jit
def both(b1, b2, r1, r2):
    return jax.vmap(triad_attitude)(b1, b2, r1, r2)


def triad(b, r):
    return both(*map(columns, b), *map(columns, r))


def test_triad_takes_the_first_vector_exactly_and_the_second_into_its_plane():
    _, b, r = cases(2, 15, 0.2)
    got = triad(b, r)
    A = Rotation.from_quat(np.stack(got.value, -1), scalar_first=True)
    apart = np.asarray(got.valid)
    limit = np.sin(np.radians(5))
    want = (np.linalg.norm(np.cross(*b), axis=1) > limit) & (np.linalg.norm(np.cross(*r), axis=1) > limit)
    np.testing.assert_array_equal(apart, want)
    np.testing.assert_allclose(A.apply(b[0])[apart], r[0][apart], atol=1e-14)
    second = A.apply(b[1])[apart]
    assert np.abs(np.sum(second * np.cross(*r)[apart], axis=1)).max() < 1e-14
    across = np.cross(r[0], np.cross(*r))[apart]  # away from r2
    assert (np.sum(second * across, axis=1) < 0).all()
    assert np.isfinite(np.stack(got.value)).all()


def test_triad_of_exact_vectors_is_the_attitude():
    q, b, r = cases(2, 16, 0.0)
    got = triad(b, r)
    off = angle(got.value, q.as_quat(scalar_first=True))
    assert off[np.asarray(got.valid)].max() < 1e-13


def test_triad_of_parallel_or_missing_vectors_is_not_valid():
    good = np.broadcast_to([[[0.6, 0.0, 0.8]], [[0.0, 1.0, 0.0]]], (2, N, 3))
    bad = good.copy()
    seconds = [[0.6, 0.0, 0.8], [-0.6, 0.0, -0.8], [0.61, 0.02, 0.79], [np.nan, 0.0, 1.0], [0, 0, 0]]
    bad[1, :5] = seconds
    for pair in ((bad, good), (good, bad)):
        got = triad(*pair)
        assert not got.valid[:5].any() and got.valid[5:].all()
        assert np.isfinite(np.stack(got.value)).all()


# covariances


DRAWS = 200_000
S = np.array([1e-3, 3e-3, 1e-2])


def whitened(estimate, covariance, stds):
    """Covariance of L^-1 turn over draws of noisy vectors; the identity if the covariance L L' is true.

    estimate: of vectors (vectors, N, 3) in both axes, the attitude.
    """
    rng = np.random.default_rng(17)
    q = Rotation.from_rotvec([0.5, -1.0, 0.7])
    b = unit(np.array([[1.0, 0.2, -0.1], [0.3, 1.0, 0.4], [-0.5, 0.3, 1.0]]))[: len(stds)]
    r = q.apply(b)
    r, turns = np.broadcast_to(r[:, None], (len(b), N, 3)), []
    for _ in range(DRAWS // N):
        noisy = unit(b[:, None] + np.array(stds)[:, None, None] * rng.normal(size=(len(b), N, 3)))
        found = Rotation.from_quat(np.stack(estimate(noisy, r), -1), scalar_first=True)
        turns.append((q.inv() * found).as_rotvec())
    turn = np.concatenate(turns)
    P = np.asarray(array(covariance(tuple(Vec3(*v) for v in b))))
    return np.cov(np.linalg.solve(np.linalg.cholesky(P), turn.T))


@pytest.mark.parametrize("s1, s2", [(S[0], S[1]), (S[1], S[0]), (S[1], S[2])])
def test_triad_s_covariance_is_that_of_its_errors(s1, s2):
    got = whitened(lambda b, r: triad(b, r).value, lambda b: triad_covariance(b[0], b[1], s1, s2), (s1, s2))
    np.testing.assert_allclose(got, np.eye(3), atol=0.02)


@pytest.mark.parametrize("count", [2, 3])
def test_davenport_s_covariance_is_that_of_its_errors(count):
    stds = tuple(S[:count])
    weights = tuple(1 / s**2 for s in stds)
    got = whitened(lambda b, r: fit(b, r, weights).q, lambda b: davenport_covariance(b, stds), stds)
    np.testing.assert_allclose(got, np.eye(3), atol=0.02)


# gradients


def pair(b):
    """Two vectors, the second turned against the first by the numbers b."""
    r1, r2 = Vec3(1.0, 0.0, 0.0), Vec3(0.0, 0.8, 0.6)
    shift = lambda v, d: (v + Vec3(*d)) / norm(v + Vec3(*d))
    return (shift(r1, b[:3]), shift(r2, b[3:])), (r1, r2)


def weighted(b):
    """Davenport's attitude and loss as one number."""
    found = davenport(*pair(b), (1.0, 4.0))
    return found.q @ Quat(1.0, 2.0, -3.0, 0.5) + found.loss


def framed(b):
    """TRIAD's attitude as one number."""
    b, r = pair(b)
    return triad_attitude(*b, *r).value @ Quat(1.0, 2.0, -3.0, 0.5)


@pytest.mark.parametrize("estimate", [framed, weighted])
def test_gradients_are_those_of_central_differences(estimate):
    found, central = slopes(estimate, [0.02, -0.1, 0.05, 0.03, 0.2, -0.04])
    np.testing.assert_allclose(found, central, rtol=1e-6, atol=1e-8)


def test_gradients_are_finite_where_triad_is_not_valid():
    def total(d):
        first, second = Vec3(1.0, 0.0, 0.0), Vec3(1.0, d, 0.0)
        return jnp.stack(triad_attitude(first, second, first, second).value).sum()

    assert np.isfinite(jax.jit(jax.grad(total))(0.0))
