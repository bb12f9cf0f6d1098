"""Paired intervals cover what they say; baselines find a minimum and spend what they are given."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.report import Report
from experiments.tuning import compare

LOW, HIGH = np.array([-2.0, -1.0]), np.array([2.0, 3.0])
LEAST = np.array([0.7, 1.9])


def bowl(x):
    d = (np.asarray(x) - LEAST) @ np.array([[1.0, 0.6], [0.0, 2.0]])
    return 0.5 + d @ d


costs = compare.one_by_one(bowl)


def covered(truth, interval_of, runs=400, n=60):
    """Share of runs whose interval holds the truth."""
    rng = np.random.default_rng(1)
    held = [c.low <= truth <= c.high for c in (interval_of(rng, n) for _ in range(runs))]
    return np.mean(held)


def test_the_paired_mean_interval_covers_and_is_narrower_than_the_unpaired():
    def pair(rng, n):
        common = rng.normal(0, 3, n)  # what the scenario brings to both
        return compare.paired_mean(common + rng.exponential(1, n), common + 0.5 + rng.exponential(1, n))

    assert 0.915 <= covered(0.5, pair) <= 0.98  # 95 % +- 3 binomial standard deviations
    one = pair(np.random.default_rng(0), 400)
    assert one.high - one.low < 0.5 * 2 * 1.96 * np.sqrt(2 * 10 / 400)
    assert one.after - one.before == pytest.approx(one.change)


@pytest.mark.parametrize("spread", [0.05, 0.4], ids=["close pairs", "loose pairs"])
@pytest.mark.parametrize("statistic", [np.mean, partial(np.quantile, q=0.9)], ids=["mean", "quantile"])
def test_the_paired_ratio_interval_covers(statistic, spread):
    def values(rng, n):
        size = rng.lognormal(0, 0.5, n)
        return size * rng.lognormal(0, spread, n), 0.8 * size * rng.lognormal(0, spread, n)

    def pair(rng, n):
        return compare.paired_ratio(*values(rng, n), statistic, resamples=300)

    before, after = values(np.random.default_rng(9), 2_000_000)
    share = covered(statistic(after) / statistic(before), pair, runs=200, n=200)
    assert share >= 0.90
    if spread > 0.1 or statistic is np.mean:  # for quantiles of close pairs the bootstrap is known to be wide
        assert share <= 0.99


def test_the_paired_share_interval_covers_and_no_discordant_pair_is_not_certainty():
    def pair(rng, n):
        u = rng.uniform(size=n)
        return compare.paired_share(u < 0.3, (u < 0.2) | (u > 0.95))  # 0.30 -> 0.25

    assert 0.925 <= covered(-0.05, pair, n=100) <= 0.99
    same = compare.paired_share(np.zeros(50), np.zeros(50))
    assert same.change == 0 and same.low < -0.02 and same.high > 0.02


def test_mcnemar_is_the_binomial_test_of_the_discordant_pairs():
    before = np.array([True] * 8 + [False] * 12)
    after = np.array([False] * 7 + [True] * 2 + [False] * 11)  # 7 lost, 1 gained
    assert compare.mcnemar(before, after) == pytest.approx(2 * (1 + 8) / 2**8)
    assert compare.mcnemar(before, before) == 1


@pytest.mark.parametrize(
    "bad, words",
    [([1.0, np.inf], r"`after\[1\]` must be finite"), ([1.0, 2.0, 3.0], "one shape"), ([1.0], "one shape")],
)
def test_what_cannot_be_paired_is_refused(bad, words):
    for paired in (compare.paired_mean, compare.paired_ratio):
        with pytest.raises(ValueError, match=words):
            paired([1.0, 2.0], bad)


@pytest.mark.parametrize("name", ["random", "cma", "nelder_mead"])
def test_baselines_find_the_minimum_within_bounds_and_budget(name):
    if name == "cma":
        pytest.importorskip("cma")
    start, budget = np.array([-1.0, 0.0]), 300
    search = dict(
        random=lambda: compare.random_search(costs, LOW, HIGH, budget, 1),
        cma=lambda: compare.cma_es(costs, start, LOW, HIGH, budget, 1),
        nelder_mead=lambda: compare.nelder_mead(costs, start, LOW, HIGH, budget),
    )[name]
    trace = search()
    assert len(trace.cost) == trace.spent[-1] <= budget
    assert (trace.theta >= LOW).all() and (trace.theta <= HIGH).all()
    np.testing.assert_array_equal(trace.cost, costs(trace.theta))
    found = compare.lowest(trace)
    assert np.abs(found - LEAST).max() < (0.3 if name == "random" else 1e-3)
    np.testing.assert_array_equal(search().cost, trace.cost)  # a seed means something


def test_a_minimum_on_the_bound_is_found():
    pytest.importorskip("cma")
    edge = compare.one_by_one(lambda x: x[0] + (x[1] - 1) ** 2)
    for trace in (
        compare.cma_es(edge, [1.0, 0.0], LOW, HIGH, 300, 0),
        compare.nelder_mead(edge, [1.0, 0.0], LOW, HIGH, 300),
    ):
        np.testing.assert_allclose(compare.lowest(trace), [-2, 1], atol=5e-3)


def test_costs_that_are_not_finite_count_as_worst_and_end_no_search():
    pytest.importorskip("cma")
    holed = compare.one_by_one(lambda x: np.nan if x[0] < 0 else bowl(x))
    for trace in (
        compare.random_search(holed, LOW, HIGH, 200, 0),
        compare.cma_es(holed, [1.5, 0.0], LOW, HIGH, 200, 0),
        compare.nelder_mead(holed, [1.5, 0.0], LOW, HIGH, 200),
    ):
        assert not np.isnan(trace.cost).any() and trace.cost.min() < 0.7
    assert np.isinf(compare.random_search(holed, LOW, HIGH, 200, 0).cost).any()


def test_a_race_counts_simulations_to_the_baselines_final_cost():
    gradient = compare.descent(
        SimpleNamespace(cost=[9.0, 4.0, np.nan, 1.0], theta={"a": np.arange(4.0), "b": np.arange(8.0).reshape(4, 2)}),
        compare.gradient_price(3),
    )
    np.testing.assert_array_equal(gradient.spent, [4, 8, 12, 16])
    np.testing.assert_array_equal(gradient.theta[2], [2, 4, 5])
    np.testing.assert_array_equal(compare.lowest(gradient), [3, 6, 7])
    baseline = compare.Trace(np.arange(1, 101), np.r_[10 - np.arange(80) / 10, np.full(20, 3.0)], np.zeros((100, 3)))
    race = compare.race(gradient, baseline, 100)
    assert race.target == pytest.approx(2.1) and race.baseline == 80 and race.gradient == 16
    assert race.fewer == 5 and race.fewer_than_budget == 100 / 16
    assert compare.race(gradient._replace(cost=gradient.cost + 9), baseline, 100).fewer == 0
    near = compare.race(gradient, baseline, 100, slack=0.5)  # half of the gain from 9 to 2.1
    assert near.target == pytest.approx(5.55) and near.baseline == 46 and near.gradient == 8
    np.testing.assert_array_equal(compare.best_after(gradient, np.array([3, 4, 11, 12, 99])), [np.inf, 9, 4, 4, 1])


def test_the_dearer_of_two_calls_is_told():
    work = np.zeros(200_000)
    ratio = compare.cpu_ratio(lambda n: [np.sin(work) for _ in range(20 * n)], lambda n: np.sin(work), 1)
    assert 4 < ratio < 100


def test_a_contest_runs_every_baseline_and_draws_it(tmp_path):
    pytest.importorskip("cma")
    report = Report(tmp_path, True, "bowl")
    start = np.array([-1.0, 0.0])
    x, points = start, [start]
    for _ in range(20):
        d = (x - LEAST) @ np.array([[1.0, 0.6], [0.0, 2.0]])
        x = x - 0.1 * 2 * np.array([[1.0, 0.6], [0.0, 2.0]]) @ d
        points.append(x)
    gradient = compare.descent(SimpleNamespace(cost=costs(points), theta=np.array(points)), compare.gradient_price(2))
    races = compare.contest(report, gradient, costs, start, LOW, HIGH, 80, "1", 4.0, range(2))
    assert {name: len(exact) for name, (exact, _) in races.items()} == {
        "random search": 2,
        "CMA-ES": 2,
        "Nelder-Mead": 1,
    }
    assert report.figures == ["bowl/budget.png"] and (tmp_path / "bowl" / "budget.png").stat().st_size > 10_000
    exact, near = races["random search"]
    assert all(a.target < b.target and a.baseline >= b.baseline for a, b in zip(exact, near))
