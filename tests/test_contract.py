import jax
from toy import SYSTEM, Params, Scenario

from jaxatt.contract import System, no_check


def test_equal_parts_make_equal_systems_that_serve_as_keys():
    again = System(*SYSTEM)
    assert again == SYSTEM and hash(again) == hash(SYSTEM) and {SYSTEM: 1}[again] == 1
    assert SYSTEM._replace(dt=0.1) != SYSTEM


def test_a_loop_needs_no_more_than_three_functions_and_a_period():
    system = System(SYSTEM.init, SYSTEM.tick, SYSTEM.flow, 0.1)
    assert (system.substeps, system.normals, system.check) == (1, 0, no_check)
    assert no_check(Params(jax.numpy.nan), Scenario()) is None
