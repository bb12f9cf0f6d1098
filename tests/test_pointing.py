"""Pointing indices against loops and closed forms, interpretations against quadrature, bounds against their coverage."""

import jax

jax.config.update("jax_enable_x64", True)

from math import comb, cos, exp, pi  # noqa: E402

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from hypothesis import given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from hypothesis.extra import numpy as hnp  # noqa: E402
from scipy import integrate, optimize, signal, stats  # noqa: E402

from jaxatt import pointing  # noqa: E402
from jaxatt.pointing import indices, interpret, runs_needed, upper_bound  # noqa: E402

P = 0.9973
RNG = np.random.default_rng(5)


# indices


@pytest.mark.parametrize("shape", [(23,), (23, 3), (23, 3, 4)])
def test_indices_are_those_of_a_loop_over_windows(shape):
    e = RNG.standard_normal(shape)
    found = indices(e, dt=0.1, window=0.5, apart=0.7)
    mean = lambda start: sum(e[start + i] for i in range(5)) / 5
    starts = range(0, 19, 5)
    assert found.ape is e
    np.testing.assert_allclose(found.mpe, [mean(s) for s in starts])
    np.testing.assert_allclose(found.rpe, [e[s + i] - mean(s) for s in starts for i in range(5)], atol=1e-12)
    np.testing.assert_allclose(found.pde, [mean(s + 7) - mean(s) for s in range(0, 12, 5)], atol=1e-12)
    assert indices(e, 0.1, 0.5).pde is None


def test_jax_gives_what_numpy_gives_under_transformations_too():
    e = RNG.standard_normal((40, 7))
    ours, theirs = jax.jit(lambda e: indices(e, 0.1, 0.8, 1.6))(jnp.asarray(e)), indices(e, 0.1, 0.8, 1.6)
    for a, b in zip(ours, theirs):
        assert isinstance(a, jax.Array) and isinstance(b, np.ndarray)
        np.testing.assert_allclose(a, b, atol=1e-14)
    for how in ("ensemble", "temporal", "mixed"):
        assert jax.jit(lambda e, how=how: interpret(e, 0.9, how))(e) == interpret(e, 0.9, how)
        both = interpret(np.stack([e, 2 * e], 1), 0.9, how)  # two axes of the pointing error
        np.testing.assert_allclose(both, interpret(e, 0.9, how) * np.array([1, 2]))
    bound = jax.jit(lambda a: upper_bound(a, 0.9, 0.8).value)(jnp.arange(100.0))
    assert bound == upper_bound(np.arange(100.0), 0.9, 0.8).value


TAU, D, APART = 10.0, 5.0, 20.0  # [s] of the printed example
CLOSED = 0.9231713, 0.3843888, 1.1950455  # standard deviations of MPE, RPE, PDE
SAMPLED = 0.9232036, 0.3843113, 1.1950963  # of the same error, sampled at 0.1 s


def test_windowed_variances_of_a_gauss_markov_error_have_closed_forms():
    d = D / TAU
    mean = 2 * (d - 1 + exp(-d)) / d**2
    between = ((1 - exp(-d)) / d) ** 2 * exp(-(APART - D) / TAU)
    assert np.sqrt([mean, 1 - mean, 2 * (mean - between)]) == pytest.approx(np.array(CLOSED), abs=1e-7)
    w = np.linspace(1e-6, 400, 2_000_001)  # the same by the spectrum
    density = 2 * TAU / (1 + (w * TAU) ** 2) / pi
    weight = 2 * (1 - np.cos(w * D)) / (w * D) ** 2
    for factor, closed in ((weight, mean), (weight * 2 * (1 - np.cos(w * APART)), 2 * (mean - between))):
        assert integrate.simpson(density * factor, x=w) == pytest.approx(closed, abs=1e-4)


def test_indices_of_a_sampled_gauss_markov_error_have_its_variances():
    m, s, a = 50, 200, exp(-0.1 / TAU)
    cov = lambda lag: a ** np.abs(lag)
    lags = np.subtract.outer(np.arange(m), np.arange(m))
    mean = cov(lags).mean()
    exact = np.sqrt([mean, 1 - mean, 2 * (mean - cov(lags + s).mean())])
    assert exact == pytest.approx(np.array(SAMPLED), abs=1e-7)
    squares = []
    for _ in range(4):  # 4 million samples each; their deviations scatter by 0.2 %, alone by 0.4 %
        noise = RNG.standard_normal((40_000, 100))
        noise[1:] *= np.sqrt(1 - a * a)
        found = indices(signal.lfilter([1.0], [1.0, -a], noise, axis=0), 0.1, D, APART)
        squares.append([np.mean(np.square(x)) for x in (found.mpe, found.rpe, found.pde)])
    assert np.sqrt(np.mean(squares, 0)) == pytest.approx(exact, rel=0.01)


# interpretations


def test_the_worked_numbers_of_ensemble_and_temporal():
    """e = b + sin(phase): the phases +-90 deg hold the largest error, midpoints of equal shares stand for b and phase."""
    top = np.sin(np.array([-pi / 2, pi / 2]))[:, None]
    share = (np.arange(1_000_000) + 0.5) / 1_000_000
    assert interpret(2 * share - 1 + top, P, "ensemble") == pytest.approx(1 + P, abs=2e-6)
    # the normal's midpoints step by 1e-6 / (2 pdf(3)) there
    assert interpret(stats.norm.ppf(share) + top, P, "ensemble") == pytest.approx(3.9999770, abs=2e-4)
    assert 1 + stats.norm.ppf((1 + P) / 2) == pytest.approx(3.9999770, abs=1e-7)
    e = np.array([-1.0, 1.0]) + np.sin(2 * pi * share)[:, None]
    assert interpret(e, P, "temporal") == pytest.approx(1.9999640, abs=1e-6)
    assert 1 + cos(pi * (1 - P)) == pytest.approx(1.9999640, abs=1e-7)


@pytest.mark.parametrize("b, value", [(stats.uniform(-1, 2), 1.9568053), (stats.norm(), 3.5331922)])
def test_the_worked_numbers_of_the_mixed_interpretation(b, value):
    below = lambda x: integrate.quad(lambda s: (b.cdf(x - np.sin(s)) - b.cdf(-x - np.sin(s))) / pi, -pi / 2, pi / 2,
                                     points=[np.arcsin(x - 1)] if x < 2 else None)[0]  # fmt: skip
    limit = optimize.brentq(lambda x: below(x) - P, 1, 5, xtol=1e-12)
    assert limit == pytest.approx(value, abs=1e-6)
    i = np.arange(1_000_000)  # a lattice fills the square of both shares to about ten points
    e = b.ppf((i + 0.5) / 1e6) + np.sin(2 * pi * (i * 0.618033988749895 + 0.5))
    assert below(interpret(e.reshape(1000, 1000), P, "mixed")) == pytest.approx(P, abs=2e-5)


logs = hnp.arrays(float, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.floats(-9, 9) | st.just(np.nan))


@settings(max_examples=100, deadline=None)
@given(logs, st.floats(0.001, 0.999) | st.sampled_from([0.5, 0.9, 0.9973, 1 / 3, 0.75]))
@pytest.mark.filterwarnings("ignore:.*hold NaN")
def test_ensemble_and_temporal_are_never_below_mixed_on_any_log(values, level):
    ensemble, temporal, mixed = (interpret(values, level, how) for how in ("ensemble", "temporal", "mixed"))
    assert ensemble >= mixed and temporal >= mixed
    a = np.abs(np.where(np.isnan(values).any(0), np.inf, values))
    assert mixed in a and np.mean(a <= mixed) >= level - 1e-12
    assert np.mean(a < mixed) < level  # the least such value


def test_a_level_counts_as_it_is_written():
    values = np.arange(1.0, 10_001.0)[None]
    assert interpret(values, 0.9973, "ensemble") == 9973
    assert interpret(values, 0.07, "ensemble") == 700 and 0.07 * 10_000 > 700


def test_one_series_is_one_run():
    e = RNG.standard_normal(500)
    assert interpret(e, 0.9, "ensemble") == np.abs(e).max()
    assert interpret(e, 0.9, "temporal") == interpret(e, 0.9, "mixed") == np.sort(np.abs(e))[449]


def test_a_run_with_nan_exceeds_every_limit_and_is_reported():
    values = np.ones((10, 100))
    values[3, 7] = np.nan
    for how, limit in (("ensemble", 1), ("temporal", np.inf), ("mixed", 1)):
        with pytest.warns(UserWarning, match="1 of 100 runs hold NaN or inf"):
            assert interpret(values, 0.99, how) == limit
    for how in ("ensemble", "temporal", "mixed"):
        with pytest.warns(UserWarning, match="1 of 100 runs"):
            assert interpret(values, 0.995, how) == np.inf
    with pytest.warns(UserWarning, match="1 of 100 runs"):
        assert upper_bound(values[3], 0.9, 0.9) == (1, 6, pytest.approx(0.942423, abs=1e-6), 100)
    with pytest.warns(UserWarning, match="1 of 100 runs"):
        assert upper_bound(values[3], 0.97, 0.9).value == np.inf


# how many runs


@pytest.mark.parametrize(
    "level, confidence, runs",
    [
        (0.9973, 0.90, (852, 1440, 1970, 2959, 5259)),
        (0.9973, 0.95, (1109, 1756, 2330, 3388, 5814)),
        (0.999, 0.90, (2302, 3889, 5321, 7992, 14204)),
        (0.99, 0.90, (230, 388, 531, 798, 1418)),
        (0.95, 0.90, (45, 77, 105, 158, 282)),
        (0.99999, 0.99, (460515, 663833, 840592, 1160459, 1878307)),
        (0.5, 0.75, (2,)),  # 1 - 1/4: reached exactly
    ],
)
def test_runs_needed(level, confidence, runs):
    assert tuple(runs_needed(level, confidence, rank) for rank in (1, 2, 3, 5, 10)[: len(runs)]) == runs


def test_the_confidence_is_the_binomial_sum_and_the_rank_the_greatest():
    promised = lambda n, r: 1 - sum(comb(n, i) * (1 - P) ** i * P ** (n - i) for i in range(r))
    bound = upper_bound(RNG.permutation(10_000).astype(float), P, 0.90)
    assert bound == (9980, 20, pytest.approx(promised(10_000, 20), rel=1e-9), 10_000)
    assert bound.confidence == pytest.approx(0.93154, abs=1e-5) and promised(10_000, 21) < 0.90
    assert upper_bound(np.arange(852.0), P, 0.90) == (851, 1, pytest.approx(0.90009, abs=1e-5), 852)
    assert upper_bound([1.0, 2.0], 0.5, 0.75).rank == 1
    assert upper_bound([3.0, 1.0, 2.0], 0.001, 0.5).rank == 3  # all of them


@pytest.mark.parametrize("n, rank", [(852, 1), (2959, 5)])
def test_the_bound_covers_as_often_as_it_says(n, rank):
    truth = stats.lognorm.ppf(P, 1.0)
    bounds = [upper_bound(RNG.lognormal(size=n), P, 0.90) for _ in range(2000)]
    assert {b.rank for b in bounds} == {rank}
    assert 0.88 <= np.mean([b.value >= truth for b in bounds]) <= 0.92


@pytest.mark.slow
@pytest.mark.parametrize("n, level, confidence", [(852, P, 0.90), (500, 0.99, 0.95), (60, 0.95, 0.80)])
def test_the_coverage_is_the_stated_one_within_a_point(n, level, confidence):
    runs = RNG.gumbel(size=(8000, n))  # the share scatters by 0.3 points
    bounds = jax.jit(jax.vmap(lambda values: upper_bound(values, level, confidence).value))(runs)
    promised = upper_bound(runs[0], level, confidence).confidence
    assert promised >= confidence
    assert np.mean(bounds >= stats.gumbel_r.ppf(level)) == pytest.approx(promised, abs=0.01)


def test_an_instant_of_each_run_drawn_at_random_bounds_the_mixed_index():
    """e = b + sin(phase), b normal: the pool of all instants of all runs has its 99.73 % quantile at 3.5331922."""
    covered = []
    for _ in range(1000):
        b, start = RNG.standard_normal(1000), RNG.uniform(0, 2 * pi, 1000)
        errors = np.abs(b + np.sin(start + 2 * pi * np.arange(20)[:, None] / 20))
        one = errors[RNG.integers(20, size=1000), np.arange(1000)]
        covered.append(upper_bound(one, P, 0.90).value >= 3.5331922)
    assert np.mean(covered) == pytest.approx(1 - P**1000, abs=0.024)  # 0.933: three standard errors


def test_pooled_instants_would_claim_what_they_do_not_hold():
    """20 runs of 400 s at 0.1 s, correlated over 10 s: 80 000 instants are not 80 000 runs; one of each run is refused."""
    a, truth, held = exp(-0.1 / TAU), stats.norm.ppf((1 + P) / 2), []
    for _ in range(100):
        noise = RNG.standard_normal((4000, 20))
        noise[1:] *= np.sqrt(1 - a * a)
        pool = np.abs(signal.lfilter([1.0], [1.0, -a], noise, axis=0)).ravel()
        bound = upper_bound(pool, P, 0.90)
        held.append(bound.value >= truth)
    assert bound.rank == 197 and np.mean(held) < 0.75  # 56 % where 90 % is claimed
    with pytest.raises(ValueError, match="one number a run"):
        upper_bound(np.ones((4000, 20)), P, 0.90)


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda: upper_bound(np.ones(851), P, 0.90), "`values` must be of at least 852 runs for the level 0.9973"),
        (lambda: upper_bound([], 0.9, 0.9), "`values` must be of at least 22 runs"),
        (lambda: upper_bound(np.ones(9), 1.0, 0.9), "`level` must lie in (0, 1), the probability of the requirement"),
        (lambda: upper_bound(["far"], 0.5, 0.9), "`values` must hold real numbers"),
        (lambda: runs_needed(0.9, 0.0), "`confidence` must lie in (0, 1), the confidence of the bound, but it is 0"),
        (lambda: runs_needed(0.9, 0.9, 0), "`rank` must be a whole number of at least 1"),
        (lambda: interpret(3.0, 0.9, "mixed"), "of shape (T, ..., n), time first and runs last, but it is of shape ()"),
        (lambda: interpret(np.ones((5, 0)), 0.9, "mixed"), "`values` must hold numbers of shape (T, ..., n)"),
        (lambda: interpret(np.ones((5, 2)), 0.9, "worst"), "`how` must be one of ensemble, temporal, mixed, but it is 'worst'"),
        (lambda: interpret(np.ones((5, 2)), 99.73, "mixed"), "`level` must lie in (0, 1)"),
        (lambda: indices(np.ones(9), 0.1, 0.25), "`window` must be a whole number of `dt` = 0.1 s, at least 2, but it is 0.25"),
        (lambda: indices(np.ones(9), 0.1, 0.1), "`window` must be a whole number of `dt` = 0.1 s, at least 2"),
        (lambda: indices(np.ones(9), 0.1, 1.0), "`error` must hold at least one window of 10 samples, but it is of 9"),
        (lambda: indices(np.ones(9), 0.1, 0.5, 0.5), "two windows 5 samples apart, 10 samples, but it is of 9"),
        (lambda: indices(3.0, 0.1, 0.5), "`error` must lead with time"),
        (lambda: indices(np.ones(9), 0.0, 0.5), "`dt` must be a positive number, but it is 0"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_by_name(call, words):
    with pytest.raises((ValueError, TypeError)) as refused:
        call()
    assert words in str(refused.value)


def test_the_examples_of_the_docstrings_hold():
    import doctest

    failed, tried = doctest.testmod(pointing, extraglobs={"np": np})
    assert tried >= 4 and not failed
