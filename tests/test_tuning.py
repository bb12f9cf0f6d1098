"""Tuning by gradient: the search itself, on costs with known minima."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxatt.tuning import FEW, tune, value_and_gradient

KEY = jax.random.key(11)


def bowl(theta, key):
    return jnp.sum((theta["a"] - 3.0) ** 2) + jnp.sum(theta["b"] ** 2) + jax.random.uniform(key)


def test_tune_finds_the_minimum_and_records_the_way():
    theta, history = tune(bowl, {"a": 0.0, "b": np.ones(2)}, optax.adam(0.3), 200, KEY)
    assert theta["a"] == pytest.approx(3, abs=1e-2) and np.abs(theta["b"]).max() < 1e-2
    assert history.cost.shape == (200,) and history.theta["b"].shape == (200, 2)
    assert history.cost[-1] < history.cost[0] and (history.step == 1).all()
    assert history.gradient[0] == pytest.approx(np.sqrt(36 + 8))


def test_forward_and_reverse_mode_agree_and_a_cost_must_be_a_scalar():
    quartic = lambda theta, key: jnp.sum(jnp.sin(theta) ** 4) + theta[0] * theta[-1]
    for n in (2, FEW, FEW + 1):
        theta = jnp.linspace(0.1, 2.0, n)
        value, gradient = value_and_gradient(quartic, theta, KEY)
        assert value == pytest.approx(float(quartic(theta, KEY)))
        np.testing.assert_allclose(gradient, jax.grad(quartic)(theta, KEY), rtol=1e-12)
    with pytest.raises(TypeError, match=r"`cost` must be a scalar, but its shape is \(2,\)"):
        tune(lambda theta, key: theta, np.ones(2), optax.sgd(0.1), 2, KEY)


def test_tune_takes_any_optax_optimizer():
    theta, _ = tune(bowl, {"a": 0.0, "b": 1.0}, optax.lbfgs(), 15, KEY)
    assert theta["a"] == pytest.approx(3, abs=1e-4)


def test_tune_survives_a_step_into_nan_and_keeps_the_best():
    cliff = lambda theta, key: jnp.where(theta < 4, (theta - 3.9) ** 2, jnp.nan)
    theta, history = tune(cliff, 0.0, optax.sgd(0.6), 60, KEY)
    assert np.isnan(history.cost).any() and history.step[-1] < 1
    assert np.nanmin(history.cost) == cliff(theta, KEY) and theta == pytest.approx(3.9, abs=1e-3)


def test_tune_refuses_a_cost_that_is_nan_from_the_start():
    with pytest.raises(ValueError, match="`cost` must be finite, with a finite gradient, at the start, but it is nan"):
        tune(lambda theta, key: theta * jnp.nan, 1.0, optax.sgd(0.1), 3, KEY)
    with pytest.raises(ValueError, match="`steps` must be a whole number of at least 1, but it is 0"):
        tune(bowl, 1.0, optax.sgd(0.1), 0, KEY)
