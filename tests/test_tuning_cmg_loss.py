"""The smooth command limit of the gyro-loss loop, and what its tuning study stands on."""

import jax
import numpy as np
import pytest

from experiments.tuning import cmg_loss as study
from jaxatt import simulate
from jaxatt.systems import cmg_loss as cmg


def test_the_smooth_limit_bounds_commands_and_keeps_a_slope():
    u = np.array([-1e15, -2.0, -1e-3, 0.0, 0.5, 3.0])
    limited = np.asarray(cmg.smoothly_limited(u, 0.7))
    assert (np.abs(limited) <= 0.7).all() and limited[2] == pytest.approx(-1e-3, rel=1e-5)
    np.testing.assert_array_equal(cmg.smoothly_limited(u, np.inf), u)
    slope = jax.vmap(jax.grad(cmg.smoothly_limited), in_axes=(0, None))
    assert (np.asarray(slope(u[1:], 0.7)) > 0).all() and np.isfinite(slope(u, np.inf)).all()


def test_a_limit_that_is_none_is_refused():
    with pytest.raises(ValueError, match=r"`params\.limit` must be greater than 0 \(inf for no limit\), but it is 0"):
        simulate(cmg.system, cmg.params._replace(limit=0.0), cmg.scenario, jax.random.key(0), ticks=1)


def test_a_design_keeps_its_bounds():
    params, shift = study.design(study.START + np.r_[np.zeros(5), [-50.0, 50, 0, 1, -1, 0]])
    assert (np.abs(shift) <= np.radians(5) + 1e-12).all() and shift[0, 1] == pytest.approx(np.radians(5))
    assert float(params.k_p) == pytest.approx(0.2) and float(params.steering.dither) == pytest.approx(0.1)
    days = study.days(study.momenta(study.TUNE, 3), shift)
    assert days.gamma.shape == (4, 6)
    np.testing.assert_allclose(np.degrees(days.gamma[3]), 95)  # the lost module is not rearranged
    np.testing.assert_allclose(days.h.x[:3], days.h.x[3:])


def test_gradients_of_gains_steering_and_rearrangement_are_those_of_the_values(monkeypatch):
    monkeypatch.setattr(study, "SECONDS", 3)
    h = study.momenta(study.TUNE, 2)

    def cost(theta):
        params, shift = study.design(theta)
        return study.costs(params, study.days(h, shift)).mean()

    along = np.random.default_rng(2).normal(size=study.START.size)
    line = jax.jit(lambda s: jax.jvp(lambda s: cost(study.START + s * along), (s,), (1.0,)))
    step = 1e-5
    slope, (up, down) = line(0.0)[1], (line(s)[0] for s in (step, -step))
    assert float(slope) == pytest.approx(float(up - down) / (2 * step), rel=1e-5)
