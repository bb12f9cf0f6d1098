import itertools
from functools import partial

import jax
import numpy as np
import pytest
from scipy.stats import kstest, qmc

from jaxatt.campaign import designs

KEY = jax.random.key(5)


@partial(jax.jit, static_argnums=0)
def drawn(point, key, indices):
    return jax.vmap(lambda index: point(key, index))(indices)


def points(design, indices, key=KEY):
    """The points of the indices, or of the first so many."""
    return np.asarray(drawn(design.point, key, np.arange(indices) if np.ndim(indices) == 0 else indices))


@pytest.mark.parametrize(
    "design", [designs.iid(3), designs.latin(1000, 3), designs.sobol(3)], ids=["iid", "latin", "sobol"]
)
def test_points_fill_the_cube_and_depend_on_index_and_key_alone(design):
    u = points(design, 1000)
    assert u.shape == (1000, 3) and (u > 0).all() and (u < 1).all()
    assert (u[[7, 3]] == points(design, np.array([7, 3]))).all()
    assert (u != points(design, 1000, jax.random.key(6))).all()
    for column in u.T:
        assert kstest(column, "uniform").pvalue > 1e-4
    assert np.abs(np.corrcoef(u.T) - np.eye(3)).max() < 0.1


@pytest.mark.parametrize("n", [1, 3, 1000])
def test_a_latin_hypercube_has_one_point_in_every_interval(n):
    u = points(designs.latin(n, 3), n)
    assert designs.latin(n, 3).size == n
    for column in u.T:
        assert sorted(np.floor(column * n)) == list(range(n))
    if n == 1000:
        assert len({tuple(np.argsort(c)) for c in u.T}) == 3  # the axes are permuted each in its own way
        assert qmc.discrepancy(u) < qmc.discrepancy(points(designs.iid(3), n))


def test_sobol_points_are_those_of_scipy_but_for_the_shift():
    u = points(designs.sobol(5), 4096)
    words = (u * 2.0**32).astype(np.uint32)
    expected = (qmc.Sobol(5, scramble=False, bits=32).random(4096) * 2.0**32).astype(np.uint32)
    assert (words ^ words[0] == expected ^ expected[0]).all()
    for m in (1, 4, 10):  # any 2^m first points: one in each interval
        for column in u[: 2**m].T:
            assert sorted(np.floor(column * 2**m)) == list(range(2**m))
    f = lambda u: np.prod(1 + (u - 0.5), axis=1)  # mean 1
    assert abs(f(u).mean() - 1) < 0.2 * abs(f(points(designs.iid(5), 4096)).mean() - 1)


def test_float32_points():
    with jax.enable_x64(False):
        for design in (designs.iid(2), designs.sobol(2), designs.latin(100, 2)):
            u = points(design, 100)
            assert u.dtype == np.float32 and (u > 0).all() and (u < 1).all()


def test_combinations():
    a, b, c = designs.factorial(np.arange(30), (2, 3, 4))
    assert list(zip(a[:24].tolist(), b[:24].tolist(), c[:24].tolist())) == list(
        itertools.product(range(2), range(3), range(4))
    )
    assert a[24:].tolist() == a[:6].tolist()  # a replicate
    table = designs.subsets(4)
    assert table.shape == (16, 4) and len({tuple(row) for row in table}) == 16 and not table[0].any()
    assert designs.subsets(4, 2).sum(1).tolist() == [0] + [1] * 4 + [2] * 6
    assert designs.subsets(3, 0).tolist() == [[False] * 3]


def test_bad_designs_are_refused():
    with pytest.raises(ValueError, match="`dims` must be a whole number of at least 1, but it is 0"):
        designs.sobol(0)
    with pytest.raises(ValueError, match="`n` must be a whole number of at least 1, but it is -1"):
        designs.latin(-1, 2)
