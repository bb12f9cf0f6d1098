"""ROC curves, delays, chance levels, intervals, confusion."""

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
import pytest  # noqa: E402
from scipy import stats  # noqa: E402

from jaxatt import evaluation  # noqa: E402

RNG = np.random.default_rng(0)


def test_roc_of_two_chi_squares_is_the_closed_form():
    healthy = np.asarray(stats.chi2.rvs(3, size=200_000, random_state=1))
    faulty = np.asarray(stats.ncx2.rvs(3, 9, size=200_000, random_state=2))
    at = np.array([2.0, 8.0, 15.0])
    curve = evaluation.roc(healthy, faulty, at)
    assert curve.threshold.tolist() == at[::-1].tolist()
    np.testing.assert_allclose(curve.false_alarm, stats.chi2.sf(at[::-1], 3), atol=4e-3)
    np.testing.assert_allclose(curve.detection, stats.ncx2.sf(at[::-1], 3, 9), atol=4e-3)
    found = evaluation.detection_at(healthy, faulty, 1e-2)
    assert found == pytest.approx(stats.ncx2.sf(stats.chi2.isf(1e-2, 3), 3, 9), abs=0.02)
    pairs = np.mean(RNG.choice(faulty, 10_000) > RNG.choice(healthy, 10_000))
    assert evaluation.area(evaluation.roc(healthy[:2000], faulty[:2000])) == pytest.approx(pairs, abs=0.03)


def test_small_roc_by_hand():
    curve = evaluation.roc([1.0, 2.0], [2.0, 3.0])
    assert curve.threshold.tolist() == [3, 2, 1, -np.inf]
    assert curve.false_alarm.tolist() == [0, 0, 0.5, 1] and curve.detection.tolist() == [0, 0.5, 1, 1]
    assert evaluation.area(curve) == pytest.approx(0.875)  # 3 of 4 pairs right, one tied
    assert evaluation.detection_at([1.0, 2.0], [2.0, 3.0], 0.0) == 0.5
    assert evaluation.detection_at([1.0, 2.0], [2.0, 3.0], 1.0) == 1.0


def test_delays_and_confusion():
    alarms = np.zeros((10, 3), bool)
    alarms[[2, 6, 8], [0, 0, 1]] = True
    delays = evaluation.first_alarm(alarms, 0.5 * np.arange(10), 2.0)
    assert delays.tolist() == [1.0, 2.0, np.inf]
    assert evaluation.detected_by(delays, [0.5, 1.0, 5.0]).tolist() == pytest.approx([0, 1 / 3, 2 / 3])
    table = evaluation.confusion([0, 1, 1, 3], [0, 1, 3, 3])
    assert table[1].tolist() == [0, 1, 0, 1] and table.sum() == 4 and table[3, 3] == 1


def test_chance_is_one_less_silence():
    assert evaluation.chance(1.6e-3, 1000) == pytest.approx(1 - (1 - 1.6e-3) ** 1000, rel=1e-12)
    assert evaluation.chance(1e-12, 1) == pytest.approx(1e-12, rel=1e-9)


@pytest.mark.parametrize("k, n, level", [(0, 10, 0.95), (5, 10, 0.95), (10, 10, 0.95), (3, 1000, 0.99)])
def test_the_interval_of_a_rate_ends_where_the_binomial_tails_do(k, n, level):
    low, high = evaluation.interval(k, n, level)
    tail = pytest.approx((1 - level) / 2)
    assert low == 0 if k == 0 else stats.binom.sf(k - 1, n, low) == tail
    assert high == 1 if k == n else stats.binom.cdf(k, n, high) == tail


@pytest.mark.parametrize("n, p", [(1000, 0.5), (1000, 0.1), (10_000, 0.01), (10_000, 0.002)])
def test_the_interval_of_a_rate_covers_what_it_says_within_a_point(n, p):
    """Exact, by the sum over all counts that have a share in it. Rarer than 20 in n it covers more: up to 98 %."""
    k = np.arange(*stats.binom.interval(1 - 1e-9, n, p)).astype(int)
    ends = np.array([evaluation.interval(int(a), n) for a in k])
    covered = stats.binom.pmf(k, n, p) @ ((ends[:, 0] <= p) & (p <= ends[:, 1]))
    assert 0.95 - 1e-8 <= covered <= 0.96


@pytest.mark.parametrize("n", [50, 1000])
def test_the_interval_of_a_quantile_covers_it_whatever_the_distribution(n):
    shares = np.array([0.05, 0.5, 0.95])
    truth = stats.expon.ppf(shares)
    ends = [evaluation.quantile_interval(RNG.exponential(size=n), shares, 0.9) for _ in range(1000)]
    low, high = np.swapaxes(ends, 0, 1)
    covered = np.mean((low <= truth) & (truth <= high), 0)
    steps = stats.binom.pmf(np.rint(n * shares), n, shares)  # order statistics move the coverage in such steps
    assert np.all(covered >= 0.9 - 0.03) and np.all(covered <= 0.9 + 0.03 + steps)


def test_too_few_values_bound_no_quantile_far_out():
    low, high = evaluation.quantile_interval([1.0, 2.0, np.inf], [0.05, 0.5, 1.0])
    assert low.tolist() == [-np.inf, -np.inf, np.inf] and high.tolist() == [2.0, np.inf, np.inf]


def test_a_delay_counts_from_the_onset_of_each_run():
    alarms = np.array([[1, 0], [0, 1], [1, 1]], bool)
    assert evaluation.first_alarm(alarms, [0.0, 1.0, 2.0], since=np.array([0.5, 1.0])).tolist() == [1.5, 0.0]


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda e: e.roc([], [1.0]), "`healthy` must hold at least one number, but it is empty"),
        (lambda e: e.roc([1.0], [1.0, np.nan]), "`faulty[1]` must be a number, but it is nan"),
        (lambda e: e.roc([1.0], [1.0], ["high"]), "`thresholds` must hold real numbers, but it is ['high']"),
        (lambda e: e.detection_at([1.0], [1.0], 1.5), "`false_alarm` must lie in [0, 1], but it is 1.5"),
        (lambda e: e.area((1.0, 2.0)), "`curve` must be a Roc, but it is (1.0, 2.0)"),
        (lambda e: e.first_alarm(np.ones((3, 2), bool), np.arange(2)), "`alarms` must lead with as many ticks as `t`"),
        (lambda e: e.detected_by([np.nan], 1.0), "`delays[0]` must be a number, but it is nan"),
        (lambda e: e.chance(-0.1, 3), "`false_alarm` must lie in [0, 1], but it is -0.1"),
        (lambda e: e.chance(0.1, -3), "`samples` must not be negative, but it is -3"),
        (lambda e: e.interval(1, 0), "`trials` must be a whole number of at least 1, but it is 0"),
        (lambda e: e.interval(3, 2), "`successes` must be at most the 2 trials, but it is 3"),
        (lambda e: e.interval(1, 2, -1.0), "`level` must lie in (0, 1), a probability, but it is -1"),
        (lambda e: e.quantile_interval([], 0.5), "`values` must hold at least one number, but it is empty"),
        (lambda e: e.quantile_interval([1.0], 50), "`shares` must lie in [0, 1], but it is 50"),
        (lambda e: e.confusion([0, 1], [0]), "`verdict` must have the shape (2,) of `truth`, but it is of shape (1,)"),
        (lambda e: e.confusion([0, 4], [0, 1]), "`truth[1]` must be a cause, 0 to 3, but it is 4"),
    ],
)
def test_bad_input_is_refused_by_name(call, words):
    with pytest.raises((ValueError, TypeError)) as refused:
        call(evaluation)
    assert words in str(refused.value)
