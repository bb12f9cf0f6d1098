"""Linear analysis: the exponential against SciPy, growth rates and observability where they are known."""

from typing import NamedTuple

import jax
import numpy as np
import pytest
from scipy.linalg import expm

from jaxatt.engine import System
from jaxatt.linear import _exponential, growth_rates, observability_rank, sampled

jax.config.update("jax_enable_x64", True)


@pytest.mark.parametrize(
    "A", [[[4.0]], [[0.0]], [[0.0, 40.0], [-40.0, 0.0]], [[-1.0, 3.0, 0.5], [0, -2, 1], [0.1, 0, -5]]]
)
def test_the_exponential_is_scipys(A):
    """4 is the hard one: halved to 1 and no further, fifteen terms are not enough."""
    np.testing.assert_allclose(_exponential(np.array(A)), expm(np.array(A)), rtol=2e-14, atol=2e-14)


class X(NamedTuple):
    pos: jax.Array
    vel: jax.Array


def test_growth_rates_of_a_known_loop():
    """x'' = -x - 0.2 x': growth rate -0.1, but for the RK4 step's own error."""
    flow = lambda p, s, t, x, z: X(x.vel, -x.pos - 0.2 * x.vel)
    loop = System(lambda p, s: (X(s, s), ()), lambda p, s, now, x, z, n: (x, z, None), flow, dt=0.01)
    M = sampled(loop, 1.0, 1.0, ticks=5)
    np.testing.assert_allclose(growth_rates(M, 0.05), [-0.1, -0.1], atol=1e-9)
    assert sampled(loop, 1.0, 1.0, ticks=1, states=("pos",)).shape == (1, 1)
    with pytest.raises(ValueError, match="`states` must be a tuple of"):
        sampled(loop, 1.0, 1.0, ticks=1, states=("spin",))


def test_observability_of_a_double_integrator():
    A = np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0.0]])
    assert observability_rank(A, np.array([[1.0, 0, 0]]), np.ones(3), duration=10.0) == 2
    assert observability_rank(A, np.array([[0.0, 1, 0]]), np.ones(3), duration=10.0) == 1


@pytest.mark.parametrize("read, rank", [(0, 3), (1, 2), (2, 1)])
def test_a_chain_of_integrators_shows_what_lies_behind_the_reading(read, rank):
    assert observability_rank(np.eye(3, k=1), np.eye(3)[[read]], np.ones(3), duration=3.0) == rank


def test_directions_count_by_their_size():
    """Largest first 1, then 1e-5 and 1e-10 of it: above 1e-8 there are two, whatever the second one is."""
    rank = lambda *scale: observability_rank(np.zeros((3, 3)), np.eye(3), np.array(scale), duration=1.0)
    assert rank(1, 1e-5, 1e-10) == 2
    assert rank(1e-10, 1, 1e-5) == 2
    assert rank(1, 1e-5, 1e-7) == 3
