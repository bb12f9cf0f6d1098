"""Windows, thresholds, causes and surrogates of detection."""

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from scipy import stats  # noqa: E402

from jaxatt import detection, soft_scores  # noqa: E402

RNG = np.random.default_rng(0)


def test_a_window_sums_the_last_values():
    J = RNG.chisquare(3, (50, 2, 4))
    plain = np.array([J[max(0, k - 6) : k + 1].sum(axis=0) for k in range(50)])
    np.testing.assert_allclose(detection.windowed(J, 7), plain, rtol=1e-14)
    np.testing.assert_allclose(soft_scores.soft_windowed(J, 7.0, 12), plain, rtol=1e-13)
    between = 0.5 * (detection.windowed(J, 7) + detection.windowed(J, 8))
    np.testing.assert_allclose(soft_scores.soft_windowed(J, 7.5, 12), between, rtol=1e-13)


def test_the_window_on_board_is_that_of_the_whole_run():
    J = RNG.chisquare(3, (20, 2))
    _, sums = jax.lax.scan(detection.window_sum, jnp.zeros((7, 2)), jnp.asarray(J))
    np.testing.assert_allclose(sums, detection.windowed(J, 7), rtol=1e-14)


@pytest.mark.parametrize("n", [0, -1, 1.5])
def test_a_window_of_no_length_is_refused(n):
    with pytest.raises(ValueError, match="`n` must be a whole number of at least 1"):
        detection.windowed(np.zeros((5, 2)), n)


def test_thresholds_are_those_of_the_table():
    assert detection.threshold_nsigma(3, 3) == 27 and detection.threshold_nsigma(3, 30) == 270
    assert detection.threshold_mean(5, 3) == 15
    np.testing.assert_allclose(detection.threshold_moment(jnp.array([3, 5]), 3), [10.35, 15.25], atol=5e-3)


def test_the_quantile_is_that_of_scipy():
    p, dof = np.meshgrid([0.5, 1e-2, 1e-5, 1e-9, 1e-100, 1e-290], [0.1, 1, 2, 3, 30, 300, 1e5])
    np.testing.assert_allclose(detection.threshold_quantile(p, dof), stats.chi2.isf(p, dof), rtol=1e-9)


@pytest.mark.parametrize(
    "p, dof, word", [(0.0, 3, "false_alarm"), (1.0, 3, "false_alarm"), (0.1, -1, "dof"), (0.1, 1e30, "dof")]
)
def test_a_quantile_of_nothing_is_refused(p, dof, word):
    with pytest.raises(ValueError, match=f"`{word}` must"):
        detection.threshold_quantile(p, dof)


def test_nan_alarms():
    assert detection.alarm(jnp.array([1.0, 28.0, np.nan]), 27.0).tolist() == [False, True, True]


def test_causes():
    first, second = jnp.array([0, 1, 0, 1], bool), jnp.array([0, 0, 1, 1], bool)
    assert detection.isolate(first, second).tolist() == [0, 1, 2, 3]
    times = jnp.array([np.inf, 3.0, 8.0, 3.0]), jnp.array([np.inf, np.inf, 3.0, 5.0])
    assert detection.isolate_first(*times, 1.0).tolist() == [0, 1, 2, 1]
    assert detection.isolate_first(*times, 5.0).tolist() == [0, 1, 3, 3]


def test_soft_delay_is_the_delay_where_alarms_are_certain():
    p = np.zeros((20, 3))
    p[[0, 7], [0, 1]] = 1.0
    np.testing.assert_allclose(soft_scores.soft_delay(jnp.asarray(p), 0.1), [0.1, 0.8, 2.0], rtol=1e-12)


@pytest.mark.slow
def test_surrogates_have_the_gradient_of_central_differences():
    J = jnp.asarray(RNG.chisquare(3, (40, 5)) * np.linspace(1, 6, 40)[:, None])

    def cost(theta):
        p = soft_scores.soft_alarm(soft_scores.soft_windowed(J, theta[0], 8), theta[1], 2.0)
        return jnp.mean(soft_scores.soft_delay(p, 0.1)) + 30 * jnp.mean(p[:10])

    at = jnp.array([3.4, 25.0])
    for i in range(2):
        h = 1e-5 * jnp.eye(2)[i]
        assert jax.grad(cost)(at)[i] == pytest.approx(float(cost(at + h) - cost(at - h)) / 2e-5, rel=1e-6)
    certain = jax.grad(lambda p: jnp.sum(soft_scores.soft_delay(p, 0.1)))(jnp.ones((4, 2)))
    assert np.isfinite(certain).all()


def test_the_worst_channel_is_one_and_only_above_the_threshold():
    above = lambda *statistic: detection.worst_above(jnp.array(statistic), 40.0).tolist()
    assert above(1.0, 2.0, 0.0) == [False, False, False]
    assert above(50.0, 60.0, 10.0) == [False, True, False]
    assert above(60.0, 60.0, 10.0) == [True, False, False]  # of equals, the first


def test_smoothed_noise_is_chi_square():
    z = np.random.default_rng(0).normal(size=200_000)
    m = jax.lax.scan(lambda m, z: ((n := detection.smoothed(m, z, 0.25)), n), 0.0, jnp.asarray(z))[1]
    c = np.asarray(detection.chi_square(m, 0.25))[100:]
    np.testing.assert_allclose([c.mean(), (c > 3.841).mean()], [1, 0.05], rtol=0.05)


def test_a_statistic_that_is_no_number_is_above_any_threshold():
    np.testing.assert_array_equal(detection.worst_above(jnp.array([1.0, np.nan, 9.0]), 5.0), [False, True, False])
