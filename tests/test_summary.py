from functools import lru_cache

import numpy as np
import pytest
import xarray as xr
from scipy.stats import binom

from jaxatt.campaign.summary import (
    Rate,
    describe,
    failing,
    first_order,
    narrowed,
    quantiles,
    rate_of,
    rates,
    sensitivity,
)


def test_the_interval_covers_the_rate_whatever_it_is():
    for n in (5, 60):
        intervals = [rate_of(k, n) for k in range(n + 1)]
        for p in np.linspace(0, 1, 41):
            covered = [r.low <= p <= r.high for r in intervals]
            assert binom.pmf(np.arange(n + 1), n, p) @ covered >= 0.95 - 1e-12
    assert rate_of(0, 10).low == 0 and rate_of(10, 10).high == 1
    assert rate_of(0, 100).high == pytest.approx(1 - 0.025 ** (1 / 100))  # in closed form
    assert str(Rate(1, 4, 0.1, 0.5)) == "0.25 (0.1 to 0.5)"


def test_stopping_early_keeps_the_coverage():
    """5000 campaigns for each rate: the interval at the stop covers the rate in at least 95 % of them."""
    looks, rng = [256, 512, 1024, 2048, 4096], np.random.default_rng(8)
    at, stops = lru_cache(None)(rate_of), set()
    for p in (0.003, 0.05, 0.2, 0.5, 0.97):
        new = rng.binomial(np.diff([0, *looks]), p, (5000, len(looks)))
        covered = 0
        for counts in np.cumsum(new, axis=1):
            counts = [int(k) for k in counts]
            for k, n in zip(counts, looks):
                rate = at(k, n, 1 - 0.05 / len(looks))
                if (rate.high - rate.low) / 2 <= 0.03:
                    break
            covered += rate.low <= p <= rate.high
            stops.add(n)
        assert rate == narrowed(counts, looks, 0.03)  # the rule itself
        # 5000 campaigns of coverage 95 % would fall below 0.9424 once in 100; Bonferroni gives 98 % and more
        assert covered / 5000 >= 0.95, p
    assert len(stops) >= 3  # it did stop early, and late
    assert narrowed([3, 5], [10, 20], 0.001).trials == 20
    asked = iter([0, 1])
    assert narrowed(asked, [10_000, 20_000], 0.1).trials == 10_000 and next(asked) == 1  # it asks no further


def ishigami(n, seed):
    x = np.random.default_rng(seed).uniform(-np.pi, np.pi, (3, n))
    return x, np.sin(x[0]) + 7 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0])


def test_first_order_indices_of_a_function_that_is_known():
    x, y = ishigami(100_000, 1)
    for column, exact in zip(x, (0.3139, 0.4424, 0.0)):
        index, floor = first_order(column, y)
        assert index == pytest.approx(exact, abs=0.01) and floor < 0.001
    kind = np.random.default_rng(2).integers(0, 3, 100_000)
    assert first_order(kind, kind + y)[0] == pytest.approx((2 / 3) / (2 / 3 + y.var()), abs=0.01)
    onset = np.where(kind == 0, np.inf, x[0])  # an input may be infinite
    assert first_order(onset, y + 5.0 * (kind == 0))[0] > 0.2


def test_an_input_without_effect_exceeds_the_floor_one_time_in_twenty():
    rng = np.random.default_rng(3)
    for draw in (rng.normal, rng.exponential, lambda size: rng.random(size) < 0.3):
        found = np.array([first_order(rng.random(1000), draw(size=1000)) for _ in range(600)])
        assert abs(found[:, 0].mean()) < 0.002
        above = (found[:, 0] > found[:, 1]).sum()
        assert 30 - 3 * 5.34 < above < 30 + 3 * 5.34  # binomial: 600, 0.05


def test_what_cannot_be_estimated_is_nan():
    u = np.random.default_rng(4).random(1000)
    for x, y in ((u[:99], u[:99]), (u, np.ones(1000)), (np.ones(1000), u), (u, np.full(1000, np.inf))):
        assert np.isnan(first_order(x, y)).all()


@pytest.fixture
def made():
    """A campaign's dataset, made by hand: delay grows with size, and is infinite where size is small."""
    rng = np.random.default_rng(6)
    size, other = rng.random(2000), rng.random((2, 2000))
    delay = np.where(size < 0.25, np.inf, 3 * size)
    status = np.zeros(2000, np.int8)
    status[[4, 9]] = 1, 2
    score = {"role": "score"}
    return xr.Dataset(
        {
            "status": ("scenario", status, {"role": "status"}),
            "delay": ("scenario", delay, score | {"units": "s"}),
            "ok": ("scenario", status == 0, score),
            "none": ("scenario", np.full(2000, np.nan), score),
            "size": ("scenario", size, {"role": "input"}),
            "other": (("other_0", "scenario"), other, {"role": "input"}),
        },
        {"scenario": np.arange(2000) + 100},
    )


def test_a_dataset_in_numbers_and_words(made):
    assert failing(made).tolist() == [104, 109]
    share = rates(made)
    assert share["ok"].successes == 1998 and share["delay finite"].successes == np.isfinite(made.delay).sum()
    low, middle, high = quantiles(made)["delay"]
    assert low == pytest.approx(0.9, abs=0.1) and middle == pytest.approx(2.25, abs=0.1) and high == np.inf
    found = sensitivity(made)
    assert found["index"].sel(score="delay", input="size") > 0.99
    assert found["index"].sel(score="delay finite", input="size") > 0.9
    assert abs(found["index"].sel(score="delay", input="other[1]")) < 0.05
    text = describe(made)
    assert text.startswith("2000 scenarios done: 1998 good, 1 failed, 1 refused; share not good 0.001 (")
    assert "not good: 104, 109\n" in text and "delay [s]: 5 %, 50 %, 95 %: " in text
    assert "\nnone: NaN in every scenario" in text
    assert "driven by size 1.00" in text and "finite driven by size" in text
    assert describe(made.isel(scenario=slice(0))) == "0 scenarios are done"
