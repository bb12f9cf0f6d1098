"""What the tuning study of the wheel test bed rests on: bounds, seeds, the kinds of friction."""

import jax
import numpy as np
import pytest

from experiments.tuning import wheel_mrac as study
from jaxatt import noise_of
from jaxatt.controllers import Adaptation, mrac_sampled_bound
from jaxatt.loops import wheel_mrac as wm


def test_gamma_is_bounded_where_the_sampled_law_is_stable():
    bound = mrac_sampled_bound(Adaptation(gamma=study.STABLE), wm.DT, 10.0, 20.0)
    assert float(bound) == pytest.approx(2 * study.FASTEST**2)
    scenarios = study.world(500, 1)
    rate = float(wm.slew(wm.params, wm.params.duration / 2)[1])
    assert rate * scenarios.J_z.max() / wm.J_WHEEL <= study.FASTEST
    assert np.all(study.LOW < study.START) and np.all(study.START < study.HIGH)


def test_seeds_share_no_scenario_and_no_noise():
    assert len({study.TUNE, study.CHOOSE, study.JUDGE}) == 3
    worlds = [set(np.asarray(study.world(50, seed).J_z).tolist()) for seed in (study.TUNE, study.CHOOSE, study.JUDGE)]
    assert len(set.union(*worlds)) == 150
    a, b = (noise_of(wm.system, jax.random.key(seed), 0, 3) for seed in (study.TUNE, study.JUDGE))
    assert np.all(np.asarray(a) != np.asarray(b))


def test_stuck_wheels_hold_one_kind_of_friction_each():
    scenarios = study.stuck(3)
    for i, kind in enumerate(study.KINDS):
        for j, size in enumerate(study.SIZES):
            at = 3 * (i * len(study.SIZES) + j)
            width = size / 20 if kind in ("dead_zone", "gate") else size
            for name in study.KINDS:
                assert np.all(getattr(scenarios.wheel, name)[at : at + 3] == (width if name == kind else 0))
