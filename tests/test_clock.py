"""Instants: each starts and ends at its tick, whatever its number is rounded to."""

from fractions import Fraction
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt import Fault, System, scores, simulate, sweep
from jaxatt.check import instant
from jaxatt.clock import at_tick, meant, time_of
from jaxatt.faults import active

PERIODS = {0.01: (1, 100), 0.1: (1, 10), 0.3: (3, 10), 0.005: (1, 200), 1 / 3: (1, 3), 1 / 128: (1, 128)}
REAL = [np.float32, np.float64]
KEY = jax.random.key(0)


class Scenario(NamedTuple):
    fault: Fault
    pair: Any = ()  # faults in a tuple and in a dict are found too


class Window(NamedTuple):
    start: Annotated[Any, "s", instant] = 0.0


def seen(params, scenario, now, x, z, noise):
    return x, z, dict(on=active(scenario.fault, now.t), since=now.t - scenario.fault.onset, t=now.t, late=now.t >= 0.9)


def score(params, scenario, now, log):
    return dict(first=scores.first(now, log["on"]), ticks=scores.total(log["on"]))


def system_of(dt):
    return System(lambda params, scenario: ((), ()), seen, lambda params, scenario, t, x, z: (), dt=dt)


def first_tick(seconds: Fraction, dt) -> int:
    """The number of the first tick not earlier, in whole numbers."""
    return -(-seconds // Fraction(*PERIODS[dt]))


@pytest.mark.parametrize("real", REAL)
@pytest.mark.parametrize("dt", PERIODS)
def test_the_time_of_a_tick_is_the_number_next_to_it(dt, real):
    k = np.concatenate([np.arange(3000), 2**23 - np.arange(1000), 2**24 - np.arange(1000)]).astype(np.int32)
    if real == np.float64:  # beyond, half a tick may be a tie between two numbers of float32
        k = np.append(k, 2**31 - 1 - np.arange(1000, dtype=np.int32))
    right = np.array([float(int(i) * Fraction(*PERIODS[dt])) for i in k]).astype(real)
    assert meant(dt) == Fraction(*PERIODS[dt])
    for t in (time_of(k, dt, real), jax.jit(lambda k: time_of(k, dt, real))(k)):
        assert t.dtype == real
        np.testing.assert_array_equal(t, right)


def test_a_period_that_is_no_simple_fraction_means_itself():
    assert meant(np.pi / 100) == Fraction(np.pi / 100) and meant(0.1 + 0.2) == Fraction(3, 10)
    assert meant(float(np.float32(0.1))) == Fraction(float(np.float32(0.1)))


@pytest.mark.parametrize("real", REAL)
@pytest.mark.parametrize("dt", PERIODS)
def test_an_instant_that_is_off_by_rounding_becomes_the_time_of_its_tick(dt, real):
    k = np.concatenate([np.arange(5000), 2**20 + np.arange(1000)]).astype(np.int32)
    t = time_of(k, dt, real)
    for told in (t, np.nextafter(t, real(np.inf)), np.nextafter(t, real(0))):
        np.testing.assert_array_equal(at_tick(told, dt), t)
        np.testing.assert_array_equal(jax.jit(lambda a: at_tick(a, dt))(told), t)
    drawn = t[:5000].astype(np.float32).astype(real)  # a batch drawn in float32, a run in float64
    np.testing.assert_array_equal(at_tick(drawn, dt), t[:5000])
    between = ((k[:5000] + 0.25) * dt).astype(real)
    others = np.array([np.inf, -np.inf, -3.21, 1e30], real)
    for told in (between, others):
        np.testing.assert_array_equal(at_tick(told, dt), told)
        np.testing.assert_array_equal(jax.jit(lambda a: at_tick(a, dt))(told), told)
    assert at_tick(np.array(3), dt).dtype == int


def test_the_gradient_of_an_instant_is_one():
    for told in (0.3, 0.34, np.inf):
        assert (
            jax.grad(lambda a: at_tick(a, 0.1))(told) == 1
            and jax.jvp(lambda a: at_tick(a, 0.1), (told,), (2.0,))[1] == 2
        )


# loops


@pytest.mark.parametrize("real", REAL)
@pytest.mark.parametrize("dt", [0.01, 0.3, 1 / 3])
def test_every_tenth_of_a_second_starts_at_its_tick_and_lasts_its_ticks(dt, real):
    tenths = np.arange(600)
    onset, end = tenths * 0.1, tenths * 0.1 + 0.7  # as a user works them out
    right = np.array([[first_tick(Fraction(int(i) + j, 10), dt) for j in (0, 7)] for i in tenths])
    scenarios = Scenario(jax.tree.map(lambda a: np.broadcast_to(a, 600), Fault())._replace(onset=onset, end=end))
    scenarios = jax.tree.map(lambda a: np.asarray(a, real), scenarios)
    found = sweep(system_of(dt), (), scenarios, KEY, ticks=int(61 / dt), score=score)
    np.testing.assert_array_equal(found["first"], time_of(right[:, 0], dt, real))
    np.testing.assert_array_equal(found["ticks"], right[:, 1] - right[:, 0])


@pytest.mark.parametrize("real", REAL)
def test_single_runs_and_traced_ones_start_at_the_same_ticks(real):
    dt, tenths = 0.3, np.arange(100)
    right = np.array([[first_tick(Fraction(int(i) + j, 10), dt) for j in (0, 9)] for i in tenths])

    def run(onset):
        return simulate(system_of(dt), (), Scenario(Fault(onset, onset + real(0.9))), KEY, ticks=40)

    logs = jax.jit(jax.vmap(run))((tenths * 0.1).astype(real))
    np.testing.assert_array_equal(np.argmax(logs["on"], axis=1), right[:, 0])
    np.testing.assert_array_equal(np.sum(logs["on"], axis=1), right[:, 1] - right[:, 0])
    one = run(real(0.9))
    assert np.flatnonzero(one["on"]).tolist() == [3, 4, 5] and one["since"][3] == 0 and one["t"].dtype == real
    np.testing.assert_array_equal(one["late"], np.arange(40) >= 3)  # a number in the loop's own code
    slope = jax.grad(lambda onset: jnp.sum(run(onset)["since"]))(jnp.asarray(0.9, real))
    assert slope == -40


def test_instants_of_jax_that_are_known_are_known_within_jit():
    """As where params are traced and the scenario, drawn before, is not."""
    onsets = jnp.array([0.3 + 1e-8, np.inf, 0.77])
    found = jax.jit(lambda a: a + at_tick(onsets, 0.1))(0.0)
    np.testing.assert_array_equal(found, at_tick(np.asarray(onsets), 0.1))


@pytest.mark.parametrize("k", [2**20, 2**22, 2**23 - 20])
def test_float32_tells_the_ticks_of_eight_million_apart(k):
    dt, end = 0.005, k + 10
    fault = jax.tree.map(np.float32, Fault(k * dt, end * dt))
    put = at_tick(fault.onset, dt), at_tick(fault.end, dt)
    t = time_of(np.arange(k - 5, k + 15), dt, np.float32)
    assert np.flatnonzero((t >= put[0]) & (t < put[1])).tolist() == list(range(5, 15))


def test_instants_are_found_wherever_they_are():
    from jaxatt import fields

    off = np.float32(1.1).astype(float)  # rounded to float32
    tree = Scenario(Fault(off, off), ({"a": Fault(off)}, Window(off), 7.0))
    put = fields.instants(tree, lambda a: at_tick(np.asarray(a), 0.1))
    assert put.fault.onset == put.fault.end == put.pair[0]["a"].onset == put.pair[1].start == 1.1 and put.pair[2] == 7
    assert put.fault.bias == 0 and type(put.pair[0]["a"]) is Fault
