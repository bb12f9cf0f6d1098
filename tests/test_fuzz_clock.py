"""Instants as they are written, and tallies of runs of any length, for any tick, period and type."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from abuse import fuzzed, odd
from hypothesis import given
from hypothesis import strategies as st

from jaxatt import scores
from jaxatt.clock import at_tick, meant, time_of
from jaxatt.delays import delayed
from jaxatt.soft_scores import chatter

ticks = st.one_of(
    st.integers(0, 2**31 - 1), st.integers(0, 1000), st.sampled_from([2**23, 2**24 - 1, 2**24 + 1, 2**31 - 1])
)
periods = st.one_of(
    st.sampled_from([0.1, 0.01, 0.3, 1 / 3, 0.5, 1.0, 2.0, 1e-3, 0.025, 1 / 7, 1 / 1024, np.pi / 10, 60.0]),
    st.builds(lambda a, b: a / b, st.integers(1, 999), st.integers(1, 999)),
)


def apart(a, exact) -> Fraction:
    return abs(Fraction(float(a)) - exact)


@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_the_time_of_a_tick_is_the_number_next_to_the_product(real):
    @fuzzed
    @given(ticks, periods)
    def run(k, dt):
        exact = k * meant(dt)
        t = time_of(np.asarray(k), dt, real)
        assert t.dtype == real
        assert apart(t, exact) <= min(apart(np.nextafter(t, real(side)), exact) for side in (-np.inf, np.inf))

    run()


@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_an_instant_that_rounding_parts_from_a_tick_is_that_tick(real):
    """Up to where the rounding of two operations tells the ticks apart."""

    @fuzzed
    @given(st.integers(0, 10**6), periods, st.sampled_from([-1, 0, 1]))
    def run(k, dt, side):
        t = time_of(np.asarray(k), dt, real)
        near = t if side == 0 else np.nextafter(t, real(np.inf * side))
        assert at_tick(np.asarray(near), dt) == t
        between = real((k + 0.5) * dt)
        assert at_tick(np.asarray(between), dt) == between

    run()


def test_odd_instants_stay_what_they_are():
    @fuzzed
    @given(odd, periods)
    def run(instant, dt):
        with np.errstate(all="ignore"):
            instant = np.asarray(float(instant) if abs(instant) < 1e308 else np.inf)
            found = at_tick(instant, dt)
        assert found.shape == () and found.dtype == instant.dtype
        assert np.array_equal(found, instant, equal_nan=True) or abs(found - instant) <= max(
            1e-6 * abs(instant), 1e-8 * dt
        )

    run()


TALLIES = {"mean": scores.mean, "rms": lambda v: scores.rms(v * v), "total": scores.total, "span": scores.span, "peak": scores.peak,
           "chatter": chatter}  # fmt: skip
doubled = jax.jit(scores.add)
values = st.floats(-1e3, 1e3, width=32).map(lambda v: v if abs(v) > 1e-9 else 0.0)  # whose squares do not underflow


@pytest.mark.parametrize("name", TALLIES)
def test_tallies_of_any_length_are_right_in_float32(name):
    """n ticks of one value, put together from 1, 2, 4, ... of them."""

    @fuzzed
    @given(st.one_of(st.integers(1, 2**31 - 1), st.integers(1, 9)), values)
    def run(n, v):
        some = jax.tree.map(jnp.asarray, TALLIES[name](np.float32(v)))
        all_, left = scores.empty(some), n
        while left:
            if left % 2:
                all_ = doubled(all_, some)
            left //= 2
            some = doubled(some, some)
        right = {"mean": v, "rms": abs(v), "total": n * v, "span": 0, "peak": v, "chatter": 0 if n > 1 else np.nan}[
            name
        ]
        assert float(scores.values(all_)) == pytest.approx(right, rel=1e-6, abs=1e-30, nan_ok=True)

    run()


@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_a_whole_age_takes_one_sample_and_no_other(real):
    age_of = jax.jit(delayed)

    @fuzzed
    @given(st.integers(0, 63), periods)
    def run(age, dt):
        line = np.full(64, np.nan, real)
        line[age] = 7
        assert age_of(line, real(age * dt) / real(dt)) == 7

    run()
