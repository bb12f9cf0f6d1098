"""The delay line: whole and broken ages, its ends, what it does to NaN, its gradients; readings that come now and then."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt.delays import aged, delayed, due, empty_line, pushed
from jaxatt.faults import Reading
from jaxatt.vec import Quat

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


# readings


def readings(ticks, length, age):
    """What a line gives at each of the ticks, of quaternions that are sampled at even ones."""
    line = empty_line(Reading(Quat(0.0, 0.0, 0.0, 0.0), jnp.asarray(False)), length)

    def tick(line, k):
        line = pushed(line, Reading(Quat(1.0 * k, 2.0 * k, 3.0 * k, 4.0 * k), k % 2 == 0))
        return line, aged(line, age)

    return jax.lax.scan(tick, line, jnp.arange(ticks))[1]


@pytest.mark.parametrize("age", [0, 1, 3])
def test_a_reading_comes_as_late_as_asked_with_its_flag(age):
    found = readings(10, 4, age)
    taken = np.arange(10) - age
    np.testing.assert_array_equal(found.valid, (taken >= 0) & (taken % 2 == 0))
    for i, component in enumerate(found.value):
        np.testing.assert_array_equal(component, (i + 1) * np.maximum(taken, 0))


def test_no_reading_is_valid_before_the_line_is_full():
    assert not readings(3, 4, 3).valid.any() and readings(4, 4, 3).valid[3]


def test_the_age_may_differ_from_scenario_to_scenario():
    ages = jnp.array([0.0, 2.0, 1.0, 3.0, 9.0])
    together = jax.vmap(lambda age: readings(10, 4, age), out_axes=-1)(ages)
    for i, age in enumerate((0, 2, 1, 3, 3)):  # beyond the line its oldest
        alone = readings(10, 4, age)
        np.testing.assert_array_equal(together.valid[:, i], alone.valid)
        np.testing.assert_array_equal(together.value.y[:, i], alone.value.y)


def test_an_age_that_a_division_has_rounded_down_is_the_age_that_was_meant():
    line = jnp.arange(5.0)
    assert 0.3 / 0.1 < 3 and aged(line, 0.3 / 0.1) == 3


@pytest.mark.parametrize("p, q", [(2, 5), (1, 1), (1, 10), (3, 7), (7, 10), (99, 100)])
def test_sampling_never_drifts(p, q):
    """Before tick k there were p k / q samples, to the next whole one, for all k; distances differ by one tick at most."""
    read = np.asarray(due(jnp.arange(40 * q), p, q))
    np.testing.assert_array_equal(np.cumsum(read), [p * k // q + 1 for k in range(40 * q)])
    assert np.ptp(np.diff(np.flatnonzero(read))) <= 1
    late = due(jnp.asarray(2**31 - 1, jnp.int32), p, q)  # no overflow at the last tick that 32 bits count
    assert bool(late) == (p * ((2**31 - 1) % q) % q < p)


def test_four_hertz_on_a_ten_hertz_bus():
    assert np.flatnonzero(due(jnp.arange(16), 2, 5)).tolist() == [0, 3, 5, 8, 10, 13, 15]


@pytest.mark.parametrize("p, q, word", [(0, 5, "p"), (6, 5, "q"), (2.5, 5, "p")])
def test_a_sampling_that_is_none_is_refused(p, q, word):
    with pytest.raises(ValueError, match=f"`{word}` must be a whole number"):
        due(0, p, q)
