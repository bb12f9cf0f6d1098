"""The delay line: whole and broken ages, its ends, what it does to NaN, its gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt.delays import delayed, pushed

LINE = jnp.array([4.0, -2.0, 7.0, 1.0])


def test_a_signal_comes_out_as_old_as_asked():
    """A ramp of slope 1 per tick, read with age a, is a behind, whole or broken."""
    line = jnp.zeros(6)
    for k in range(20):
        line = pushed(line, float(k))
    for age in (0.0, 1.0, 2.25, 5.0):
        assert float(delayed(line, age)) == pytest.approx(19 - age)


def test_between_two_samples_it_is_the_line_through_them():
    ages = np.linspace(0, 3, 31)
    np.testing.assert_allclose(jax.vmap(lambda a: delayed(LINE, a))(ages), np.interp(ages, range(4), LINE), atol=1e-12)


@pytest.mark.parametrize("age, sample", [(-1.0, 4.0), (3.2, 1.0), (1e9, 1.0)])
def test_an_age_that_the_line_does_not_hold_gives_its_end(age, sample):
    assert float(delayed(LINE, age)) == sample


def test_nan_counts_only_where_it_is_asked_for():
    line = LINE.at[1].set(jnp.nan)
    found = np.array([delayed(line, age) for age in (0.0, 0.5, 1.0, 2.0, 3.0)])
    assert np.isnan(found).tolist() == [False, True, True, False, False]
    assert np.isfinite(jax.grad(delayed)(line, 2.5)).all()


def test_gradients_in_samples_and_age():
    by_line, by_age = jax.grad(delayed, (0, 1))(LINE, 1.25)
    np.testing.assert_allclose(by_line, [0, 0.75, 0.25, 0])
    assert float(by_age) == pytest.approx(7.0 - -2.0)
