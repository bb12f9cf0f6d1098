"""The tuning study of the gyro loop: what its searches stand on."""

from functools import partial

import jax
import numpy as np
import optax
import pytest

from experiments.gyro_ekf import SUBSETS
from experiments.tuning import gyro_ekf as study
from jaxatt import tune
from jaxatt.linear import growth_rates
from jaxatt.loops.gyro_ekf import INERTIA, params


@pytest.fixture(scope="module")
def nominal():
    return study.loops()


def test_the_sampled_loop_is_affine_in_the_gains(nominal):
    factors = np.random.default_rng(3).uniform(0.2, 5, 9)
    there = study.linearised(factors, np.array(INERTIA))
    np.testing.assert_allclose(study.matrix(nominal, np.log(factors), np.arange(16)), there, atol=1e-12)


def test_the_gradient_finds_gains_for_two_dead_gyros(nominal):
    before = study.growth(nominal, np.zeros(9))
    theta, _ = tune(partial(study.margin_cost, nominal), np.zeros(9), optax.adam(0.02), 100, jax.random.key(0))
    after = study.growth(nominal, np.asarray(theta))
    for pair in ("AB", "AC"):
        assert before[SUBSETS.index(pair)] > 0.0039 and after[SUBSETS.index(pair)] < -0.002
    assert after[SUBSETS.index("BC")] > 0 and len(study.HELD) == 12


def test_the_cost_of_the_margin_has_the_slope_of_its_values(nominal):
    cost = jax.jit(lambda a: study.margin_cost(nominal, a, None))
    at, along = np.linspace(-0.3, 0.3, 9), np.random.default_rng(0).normal(size=9)
    slope = np.asarray(jax.jit(jax.grad(cost))(at)) @ along
    h = 1e-6
    assert slope == pytest.approx(float(cost(at + h * along) - cost(at - h * along)) / (2 * h), rel=1e-5)


def test_no_gains_of_any_sign_hold_the_x_axis_without_its_rate():
    rng = np.random.default_rng(1)
    p, q = rng.normal(size=(2, 50_000)) * 10 ** rng.uniform(-4, 1.5, (2, 50_000))
    radius = np.abs(np.linalg.eigvals(study.x_axis(p, q))).max(-1)
    assert (radius > 1).all()
    np.testing.assert_allclose(np.linalg.det(study.x_axis(p, q)), 1 + p - q, rtol=1e-6, atol=1e-6)


def test_the_x_axis_of_the_loop_is_the_one_of_the_argument(nominal):
    x, T, J = [0, 3, 6], study.PERIOD, INERTIA.x.x
    block = study.matrix(nominal, np.zeros(9), study.BC)[np.ix_(x, x)]
    p, q = params.k_f.x * params.k_p.x * T**2 / (2 * J), params.k_f.x * params.k_i.x * T**3 / (6 * J)
    alone = growth_rates(study.x_axis(p, q), T)
    np.testing.assert_allclose(growth_rates(block, T), alone, rtol=1e-4)  # up to the products of inertia


def test_pid_keeps_the_integral_time_and_levels_go_where_they_belong():
    tuned = study.pid(np.log([2.0, 3.0, 4.0, 5.0, 6.0, 7.0]))
    assert [float(a / b) for a, b in zip(tuned.k_p, params.k_p)] == pytest.approx([2, 3, 4])
    assert [float(a / b) for a, b in zip(tuned.k_i, params.k_i)] == pytest.approx([2, 3, 4])
    assert [float(a / b) for a, b in zip(tuned.k_d, params.k_d)] == pytest.approx([5, 6, 7])
    as_printed = study.filter_with(study.PRINTED)
    np.testing.assert_allclose(as_printed.R, params.R)
    np.testing.assert_allclose(as_printed.Q, params.Q)


def test_every_seed_brings_other_days_and_all_subsets():
    days = [study.drawn(seed, range(16), 2) for seed in (study.TUNE, study.CHOOSE, study.VERDICT)]
    assert len({float(day.w.x[0]) for day in days}) == 3
    onset = days[0].gyro.onset.reshape(16, 2, 4)
    assert (np.isfinite(onset).sum(-1) == np.array([[len(s)] for s in SUBSETS])).all()
    np.testing.assert_array_equal(days[0].h[:2], days[0].h[2:4])  # the same states for every subset
