"""What the tuning study of the satellite rests on: bounds, seeds, the cost."""

import numpy as np
import pytest

from experiments.microsat import days
from experiments.tuning import microsat as study
from jaxatt.loops import microsat as ms


def test_the_start_lies_within_the_bounds_and_is_what_ships():
    assert np.all(study.LOW < study.START) and np.all(study.START < study.HIGH)
    params = study.shipped(study.START)
    assert (params.kp, params.kd) == (ms.params.kp, ms.params.kd)


def test_seeds_share_no_day():
    starts = [set(np.asarray(days(seed, 50).t0).tolist()) for seed in (study.TUNE, study.CHOOSE, study.JUDGE)]
    assert len(set.union(*starts)) == 150


def test_ten_seconds_of_rate_error_count_as_pointing_error():
    assert study.weighed(0.02**2, 0.0) == pytest.approx(study.weighed(0.0, (0.02 / study.SPAN) ** 2))
