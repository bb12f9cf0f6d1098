"""Windows, thresholds, causes, curves and surrogates of detection."""

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from scipy import stats  # noqa: E402

from jaxatt import detection, objectives  # noqa: E402

RNG = np.random.default_rng(0)


def test_a_window_sums_the_last_values():
    J = RNG.chisquare(3, (50, 2, 4))
    plain = np.array([J[max(0, k - 6) : k + 1].sum(axis=0) for k in range(50)])
    np.testing.assert_allclose(detection.windowed(J, 7), plain, rtol=1e-14)
    np.testing.assert_allclose(objectives.soft_windowed(J, 7.0, 12), plain, rtol=1e-13)
    between = 0.5 * (detection.windowed(J, 7) + detection.windowed(J, 8))
    np.testing.assert_allclose(objectives.soft_windowed(J, 7.5, 12), between, rtol=1e-13)


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


def test_roc_of_two_chi_squares_is_the_closed_form():
    healthy, faulty = (
        stats.chi2.rvs(3, size=200_000, random_state=1),
        stats.ncx2.rvs(3, 9, size=200_000, random_state=2),
    )
    at = np.array([2.0, 8.0, 15.0])
    curve = detection.roc(healthy, faulty, at)
    assert curve.threshold.tolist() == at[::-1].tolist()
    np.testing.assert_allclose(curve.false_alarm, stats.chi2.sf(at[::-1], 3), atol=4e-3)
    np.testing.assert_allclose(curve.detection, stats.ncx2.sf(at[::-1], 3, 9), atol=4e-3)
    found = detection.detection_at(healthy, faulty, 1e-2)
    assert found == pytest.approx(stats.ncx2.sf(stats.chi2.isf(1e-2, 3), 3, 9), abs=0.02)
    pairs = np.mean(RNG.choice(faulty, 10_000) > RNG.choice(healthy, 10_000))
    assert detection.area(detection.roc(healthy[:2000], faulty[:2000])) == pytest.approx(pairs, abs=0.03)


def test_small_roc_by_hand():
    curve = detection.roc([1.0, 2.0], [2.0, 3.0])
    assert curve.threshold.tolist() == [3, 2, 1, -np.inf]
    assert curve.false_alarm.tolist() == [0, 0, 0.5, 1] and curve.detection.tolist() == [0, 0.5, 1, 1]
    assert detection.area(curve) == pytest.approx(0.875)  # 3 of 4 pairs right, one tied
    assert detection.detection_at([1.0, 2.0], [2.0, 3.0], 0.0) == 0.5
    assert detection.detection_at([1.0, 2.0], [2.0, 3.0], 1.0) == 1.0


def test_delays_and_confusion():
    alarms = np.zeros((10, 3), bool)
    alarms[[2, 6, 8], [0, 0, 1]] = True
    delays = detection.first_alarm(alarms, 0.5 * np.arange(10), 2.0)
    assert delays.tolist() == [1.0, 2.0, np.inf]
    assert detection.detected_by(delays, [0.5, 1.0, 5.0]).tolist() == pytest.approx([0, 1 / 3, 2 / 3])
    table = detection.confusion([0, 1, 1, 3], [0, 1, 3, 3])
    assert table[1].tolist() == [0, 1, 0, 1] and table.sum() == 4 and table[3, 3] == 1


def test_chance_is_one_less_silence():
    assert detection.chance(1.6e-3, 1000) == pytest.approx(1 - (1 - 1.6e-3) ** 1000, rel=1e-12)
    assert detection.chance(1e-12, 1) == pytest.approx(1e-12, rel=1e-9)


def test_soft_delay_is_the_delay_where_alarms_are_certain():
    p = np.zeros((20, 3))
    p[[0, 7], [0, 1]] = 1.0
    np.testing.assert_allclose(objectives.soft_delay(jnp.asarray(p), 0.1), [0.1, 0.8, 2.0], rtol=1e-12)


@pytest.mark.slow
def test_surrogates_have_the_gradient_of_central_differences():
    J = jnp.asarray(RNG.chisquare(3, (40, 5)) * np.linspace(1, 6, 40)[:, None])

    def cost(theta):
        p = objectives.soft_alarm(objectives.soft_windowed(J, theta[0], 8), theta[1], 2.0)
        return jnp.mean(objectives.soft_delay(p, 0.1)) + 30 * jnp.mean(p[:10])

    at = jnp.array([3.4, 25.0])
    for i in range(2):
        h = 1e-5 * jnp.eye(2)[i]
        assert jax.grad(cost)(at)[i] == pytest.approx(float(cost(at + h) - cost(at - h)) / 2e-5, rel=1e-6)
    certain = jax.grad(lambda p: jnp.sum(objectives.soft_delay(p, 0.1)))(jnp.ones((4, 2)))
    assert np.isfinite(certain).all()


@pytest.mark.parametrize(
    ("k", "n", "low", "high"), [(0, 10, 0.0, 0.27753), (5, 10, 0.23659, 0.76341), (10, 10, 0.72247, 1.0)]
)
def test_wilson_interval(k, n, low, high):
    assert detection.interval(k, n) == pytest.approx((low, high), abs=1e-5)
