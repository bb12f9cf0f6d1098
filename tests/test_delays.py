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


@pytest.mark.parametrize("real", [np.float32, np.float64])
@pytest.mark.parametrize("whole", [1, 2, 3, 5, 6])
def test_an_age_that_rounding_parts_from_a_whole_tick_is_that_tick(whole, real):
    """delay / dt of a delay that means whole ticks is off by two roundings at most: neighbours that are NaN stay out."""
    values = np.arange(8.0, dtype=real)
    line = jnp.asarray(np.where(np.arange(8) == whole, values, np.nan))
    ages = {whole, np.nextafter(real(whole), real(0)), np.nextafter(real(whole), real(9))}
    ages |= {real(whole * dt) / real(dt) for dt in (0.01, 0.1, 0.3, 1 / 3)}
    ages |= {5.0000005 * whole / 5} if real == np.float32 else set()
    assert [float(delayed(line, real(age))) for age in ages] == [whole] * len(ages)
    assert np.isnan(delayed(line, real(whole + 1e-5))) and np.isnan(delayed(line, real(whole - 1e-5)))


def test_a_whole_age_has_the_slope_towards_the_older_sample():
    slope = jax.grad(lambda age: delayed(LINE, age))
    assert float(slope(1.0)) == 7.0 - -2.0 and float(slope(2.0)) == 1.0 - 7.0
    assert float(slope(5.0)) == 0 and float(jax.grad(lambda age: delayed(LINE.at[2].set(jnp.nan), age))(1.0)) == 0
