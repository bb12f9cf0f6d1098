"""What float32 carries, and what the door says of the rest."""

import warnings

import jax
import numpy as np
import pytest

from benchmarks.precision import NAMES, case, deviations
from jaxatt.engine import admit
from jaxatt.systems import gyro_ekf


@pytest.mark.parametrize(("real", "consistent", "warned"), [("float32", 1, 1), ("float32", 0, 0), ("float64", 1, 0)])
def test_precise_sensors_in_float32_are_warned_of_at_the_door(real, consistent, warned):
    params = gyro_ekf.consistent(gyro_ekf.params) if consistent else gyro_ekf.params
    given = jax.tree.map(lambda a: np.asarray(a, real), (params, gyro_ekf.scenario))
    with warnings.catch_warnings(record=True) as met:
        warnings.simplefilter("always")
        admit(gyro_ekf.system, *given)
        admit(gyro_ekf.direct, *given)  # has no filter
    assert len(met) == warned and all("float32" in str(w.message) for w in met)


def test_the_table_compares_the_same_run_in_both_types():
    rows = {row["number"]: row for row in deviations("observer_pd", 0.01)}
    assert {"q", "w", "u", "xi", "alarm", "k_w"} <= set(rows)
    assert all(0 <= row["share"] < 1e-4 for row in rows.values()) and rows["w"]["deviation"] > 0


def test_every_case_names_a_loop():
    for name in NAMES:
        system, params, scenario, seconds, every = case(name)
        admit(system, params, scenario)
        assert seconds / system.dt >= every >= 1
    with pytest.raises(SystemExit, match="must be one of"):
        case("none")
