"""What float32 carries, and which warnings tell the rest."""

import warnings

import jax
import numpy as np
import pytest

from benchmarks.precision import NAMES, case, deviations
from jaxatt import star_filters
from jaxatt.engine import validated
from jaxatt.loops import cmg_loss, gyro_ekf, microsat, observer_pd, star_isolation, wheel_mrac

LOST = [  # system, params, scenario, what float32 loses of it
    (gyro_ekf.system, gyro_ekf.consistent(gyro_ekf.params), gyro_ekf.scenario, "the filter's covariance"),
    (gyro_ekf.system, gyro_ekf.params, gyro_ekf.scenario, None),
    (gyro_ekf.direct, gyro_ekf.consistent(gyro_ekf.params), gyro_ekf.scenario, None),  # has no filter
    (cmg_loss.system, cmg_loss.params, cmg_loss.scenario, "total momentum is not conserved"),
    (cmg_loss.system, cmg_loss.params, cmg_loss.lost(cmg_loss.PYRAMID, (45, 45, 45, 45), brake=1e-3), None),
    (star_isolation.system, star_isolation.params, star_isolation.scenario, "lines of sight"),
    (star_isolation.system_of(star_filters.MEKF), star_isolation.params, star_isolation.scenario, None),
    (observer_pd.system, observer_pd.params, observer_pd.scenario, None),
    (wheel_mrac.system, wheel_mrac.params, wheel_mrac.scenario, None),
    (microsat.system, microsat.params, microsat.scenario, None),
]


@pytest.mark.parametrize("real", ["float32", "float64"])
@pytest.mark.parametrize(("system", "params", "scenario", "lost"), LOST)
def test_what_float32_loses_is_said_before_it_runs(real, system, params, scenario, lost):
    given = jax.tree.map(lambda a: np.asarray(a, real), (params, scenario))
    with warnings.catch_warnings(record=True) as met:
        warnings.simplefilter("always")
        validated(system, *given)
    said = [str(warning.message) for warning in met if "float32" in str(warning.message)]
    assert len(said) == (real == "float32" and lost is not None) and all(str(lost) in words for words in said)


def test_the_table_compares_the_same_run_in_both_types():
    rows = {row["number"]: row for row in deviations("observer_pd", 0.01)}
    assert {"q", "w", "u", "xi", "alarm", "k_w"} <= set(rows)
    residual = rows.pop("xi")  # a difference of readings and estimates: it is rounded as they are
    assert 0 <= residual["deviation"] < 1e-6 * rows["w"]["largest"]
    assert all(0 <= row["share"] < 1e-5 for row in rows.values()) and rows["w"]["deviation"] > 0


def test_every_case_names_a_loop():
    for name in NAMES:
        system, params, scenario, seconds, every = case(name)
        validated(system, params, scenario)
        assert seconds / system.dt >= every >= 1
    with pytest.raises(SystemExit, match="must be one of"):
        case("none")
