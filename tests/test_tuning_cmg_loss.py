"""The tuning study of the gyro-loss loop: what its searches stand on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.tuning import cmg_loss as study
from jaxatt import Now, Reading, Vec3
from jaxatt.loops import cmg_loss as cmg


def test_the_rounded_limit_bounds_commands_and_leaves_small_ones_alone():
    lost, u = cmg.lost(cmg.PYRAMID, (45, 45, 45, 45), onset=np.inf), np.array([-1e15, -2.0, -1e-3, 0.5])
    x, z = cmg.init(cmg.params, lost)
    z = z._replace(computer=z.computer._replace(u=u))
    now = Now(1, 0.01, 0.01)  # between control samples: the command is held

    def driven(rounded):
        case = study.Case(rounded, cmg.params, lost)
        return study.rounded_tick((), case, now, x, z, np.zeros(3))[1].drive.u

    clipped, rounded = jax.jit(jax.vmap(driven))(np.array([0.0, 1.0]))
    np.testing.assert_allclose(clipped, [-1, -1, -1e-3, 0.5])
    np.testing.assert_allclose(rounded, np.tanh(u))


def test_a_design_keeps_its_bounds():
    params, shift = study.design(study.START + np.r_[np.zeros(5), [-50.0, 50, 0, 1, -1, 0]])
    assert (np.abs(shift) <= np.radians(5) + 1e-12).all() and shift[0, 1] == pytest.approx(np.radians(5))
    assert float(params.k_p) == pytest.approx(0.2) and float(params.steering.dither) == pytest.approx(0.1)
    days = study.days(study.momenta(study.TUNE, 3), shift)
    assert days.gamma.shape == (6, 4)
    np.testing.assert_allclose(np.degrees(days.gamma[:, 3]), 95)  # the lost module is not rearranged
    np.testing.assert_allclose(days.h.x[:3], days.h.x[3:])
    np.testing.assert_allclose(np.degrees(days.gamma[0, :3]), np.array([-90, 90, 90]) + np.degrees(shift[0]))


def test_commands_have_the_slopes_of_their_values():
    days = study.days(study.momenta(study.TUNE, 1), np.zeros((2, 3)))
    gamma_0, healthy = days.gamma[0], np.array([1.0, 1, 1, 0])
    computer = cmg.Computer(Vec3(0.01, 0.0, -0.02), np.zeros(4), Vec3(0.0, 0.0, 0.0), np.zeros(4))

    def commands(theta):
        params, shift = study.design(theta)
        gamma = Reading(gamma_0 + jnp.append(shift[0], 0), np.ones(4, bool))
        readings = cmg.Readings(Reading(Vec3(0.03, -0.02, 0.01), True), gamma, healthy)
        return cmg.decide(params, Now(0, 0.3, 0.01), computer, readings)[0].u

    along = np.random.default_rng(2).normal(size=study.START.size)
    line = jax.jit(lambda s: jax.jvp(lambda s: commands(study.START + s * along), (s,), (1.0,)))
    h = 1e-6
    slope, difference = line(0.0)[1], (line(h)[0] - line(-h)[0]) / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-5)
    assert (np.abs(slope[:3]) > 1e-3).all() and slope[3] == 0
