"""The door: what it lets by and what it says."""

import jax
import numpy as np
import pytest
from toy import SYSTEM, Params, Scenario

from jaxatt import check, rk4, scores, sweep
from jaxatt.attitude import mrp_rate
from jaxatt.plot import front
from jaxatt.vec import Vec3

KEY = jax.random.key(0)


def test_an_error_in_a_function_that_is_handed_in_is_seen_whole():
    with pytest.raises(ZeroDivisionError, match=r"^division by zero$"):
        rk4(lambda t, x: 1 / 0, 0.0, 1.0, 0.1)


def test_a_call_with_other_arguments_says_how_to_call():
    with pytest.raises(
        TypeError, match=r"^`mrp_rate` must be called as mrp_rate\(q.*: missing a required argument: 'w'"
    ):
        mrp_rate(Vec3(0.0, 0.0, 0.0))


def test_a_tracer_where_a_number_is_needed_is_jaxs_own_word():
    with pytest.raises(jax.errors.TracerArrayConversionError):
        jax.jit(front)(np.ones((3, 2)))


def test_params_carry_the_lanes_of_the_scenario_or_none():
    like = Params(), Scenario()
    scenario = Scenario(np.ones(2), np.ones(2))
    assert check.shapes(Params(), scenario, *like) == check.shapes(Params(np.ones(2)), scenario, *like) == (2,)
    with pytest.raises(
        ValueError, match=r"^`params` must carry no lanes, or the scenario's, \(2,\), but it is \(3,\)\.$"
    ):
        check.shapes(Params(np.ones(3)), scenario, *like)


def test_a_sweep_of_nothing_is_refused():
    score = lambda params, scenario, now, log: scores.always(True)
    with pytest.raises(ValueError, match=r"^`scenarios` must hold at least one array, but it is empty"):
        sweep(SYSTEM, Params(), (), KEY, ticks=3, score=score)
