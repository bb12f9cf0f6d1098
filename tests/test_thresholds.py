"""Thresholds from a stated false-alarm rate: the theory of CUSUM, and the tail of a healthy loop."""

import numpy as np
import pytest
from scipy import stats

from jaxatt.thresholds import cusum_arl, cusum_threshold, rate_above, tail, threshold_at


@pytest.mark.parametrize(
    "h, shift, one_sided",  # a Markov chain of 2000 states and Richardson's extrapolation gave the same digits
    [(5.0, 0.0, 930.887), (5.0, 1.0, 10.376), (5.7574, 1.0, 11.89), (8.0530, 1.0, 16.48), (10.3547, 1.0, 21.08)],
)
def test_the_run_length_of_a_cusum_is_that_of_the_integral_equation(h, shift, one_sided):
    two_sided = cusum_arl(h, 0.5, shift)
    expected = one_sided / 2 if shift == 0 else one_sided  # under a shift the other side adds next to nothing
    assert two_sided == pytest.approx(expected, abs=6e-3 if shift else 6e-4)


def test_a_markov_chain_gives_the_same_run_length():
    """Brook & Evans (1972): the sum in n cells; the error goes with 1 / n^2, and Richardson takes it out."""

    def chain(n, h=4.0, k=0.5, mean=0.25):
        width = 2 * h / (2 * n - 1)
        centres = width * np.arange(n)
        edges = np.append(centres + width / 2, np.inf)
        upper = stats.norm.cdf(edges[None, :-1] - centres[:, None] + k - mean)
        lower = np.hstack([np.zeros((n, 1)), upper[:, :-1]])
        return np.linalg.solve(np.eye(n) - (upper - lower), np.ones(n))[0]

    one_sided = lambda mean: (4 * chain(400, mean=mean) - chain(200, mean=mean)) / 3
    expected = 1 / (1 / one_sided(0.25) + 1 / one_sided(-0.25))
    assert cusum_arl(4.0, 0.5, 0.25) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("apart, h", [(1e3, 5.7574), (1e4, 8.0530), (1e5, 10.3547), (1e6, 12.6572)])
def test_thresholds_of_a_stated_distance_between_false_alarms(apart, h):
    found = cusum_threshold(apart, 0.5)
    assert found == pytest.approx(h, abs=6e-5)
    assert cusum_arl(found, 0.5) == pytest.approx(apart, rel=1e-6)


def test_the_tail_of_exponential_maxima_is_found_and_read_backwards():
    x = 20 + 3 * np.random.default_rng(1).exponential(size=200_000)
    found = tail(x, seconds=100.0)
    assert found.scale == pytest.approx(3, rel=0.05)  # 4 standard errors of the .999 quantile
    assert found.level == pytest.approx(20 + 3 * np.log(10), rel=2e-3) and found.rate == pytest.approx(3.6)
    wanted = 20 + 3 * np.log(36 / 1e-3)  # 36 blocks an hour, each above x with exp(-(x - 20) / 3)
    assert threshold_at(found, 1e-3) == pytest.approx(wanted, rel=0.02)
    assert rate_above(found, threshold_at(found, 1e-3)) == pytest.approx(1e-3, rel=1e-12)
    assert rate_above(found, found.top) == pytest.approx(36e-3, rel=1e-12)


@pytest.mark.parametrize(
    "level, top, threshold, per_hour",  # four statistics of a healthy loop in blocks of 100 s
    [(3.506, 4.442, 8.0, 9e-10), (99.18, 118.2, 140.0, 1.8e-4), (0.633, 0.809, 1.0, 2.4e-4), (9.38, 14.03, 12.0, 0.27)],
)
def test_rates_of_quantiles_by_hand(level, top, threshold, per_hour):
    by_hand = 3.6 * 100 ** -((threshold - level) / (top - level))
    maxima = np.interp(np.linspace(0, 1, 10_001), [0, 0.9, 0.999, 1], [0, level, top, 2 * top])
    found = tail(maxima, 100.0)
    assert (found.level, found.top) == pytest.approx((level, top), rel=1e-9)
    assert rate_above(found, threshold) == pytest.approx(by_hand, rel=1e-9)
    assert by_hand == pytest.approx(per_hour, rel=0.06)  # as printed, to two digits


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: cusum_arl(0.0, 0.5), "`threshold` must be a positive number, but it is 0"),
        (lambda: cusum_arl(5.0, -1.0), "`slack` must be a positive number, but it is -1"),
        (lambda: cusum_threshold(1.0, 0.5), "`values_between_alarms` must lie between"),
        (lambda: tail(np.arange(10.0), 100.0), "`maxima` must be 1000 or more"),
        (lambda: tail(np.ones(2000), 100.0), "`maxima` must have a tail"),
        (lambda: tail(np.full(2000, np.nan), 100.0), "`maxima"),
        (lambda: tail(np.arange(2000.0), 0.0), "`seconds` must be a positive number"),
        (lambda: threshold_at(tail(np.arange(2000.0), 100.0), 4.0), "`per_hour` must lie in"),
    ],
)
def test_what_gives_no_threshold_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
