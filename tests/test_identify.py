"""Numbers of on-board code from recorded flights: the likelihood against closed forms, the fit against SciPy, words for what is blind."""

import importlib.util
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from jaxatt import identify
from jaxatt.check import positive
from jaxatt.faults import Reading
from jaxatt.filters import Belief, update
from jaxatt.loops import gyro_ekf
from jaxatt.vec import Vec3

N, TICKS = 40, 80


class Walk(NamedTuple):
    """x' = decay x + sqrt(q) N, y = gain x + sqrt(r) N."""

    decay: Annotated[Any, "1"] = 0.5
    q: Annotated[Any, "1", positive] = 1.0
    r: Annotated[Any, "1", positive] = 1.0
    gain: Annotated[Any, "1"] = 1.0


TRUE = Walk(0.9, 0.2, 0.5)


def decide(params, now, belief, y):
    """A scalar Kalman filter; a NaN is no measurement."""
    mean, P = params.decay * belief.mean, params.decay**2 * belief.cov + params.q
    nu, S = y - params.gain * mean, params.gain**2 * P + params.r
    K = jnp.where(jnp.isfinite(y), P * params.gain / S, 0)
    return Belief(mean + K * jnp.where(jnp.isfinite(y), nu, 0), (1 - K * params.gain) * P), (nu[None], S[None, None])


MODEL = identify.Model(decide, lambda log: log, 1.0)
START, SPREAD = dict(decay=0.5, log_q=0.0, log_r=0.0), dict(decay=0.5, log_q=2.0, log_r=2.0)
TRUTH = dict(decay=0.9, log_q=np.log(0.2), log_r=np.log(0.5))


def build(theta):
    return Walk(theta["decay"], jnp.exp(theta["log_q"]), jnp.exp(theta["log_r"]))


def white(theta):
    return Walk(0.0, 1e-9, jnp.exp(theta["log_r"]))


def walks(n=N, ticks=TICKS, seed=3):
    rng, x, y = np.random.default_rng(seed), np.zeros(n), np.zeros((n, ticks))
    for k in range(ticks):
        x = TRUE.decay * x + np.sqrt(TRUE.q) * rng.normal(size=n)
        y[:, k] = x + np.sqrt(TRUE.r) * rng.normal(size=n)
    y[:, 20:25] = np.nan
    return identify.Flights(Belief(np.zeros(n), np.zeros(n)), y)


FLIGHTS = walks()
some = lambda which: jax.tree.map(lambda a: a[which], FLIGHTS)
row = lambda tree: np.array([tree[name] for name in START])


def dense(theta, y):
    """Negative log-likelihood of flights (n, T) by their joint covariance, which knows no innovations."""
    a, q, r = theta["decay"], np.exp(theta["log_q"]), np.exp(theta["log_r"])
    k = np.arange(1, y.shape[1] + 1)
    variance = q * np.cumsum(a ** (2 * (k - 1)))
    C = a ** np.abs(k[:, None] - k) * variance[np.minimum(k[:, None], k) - 1] + r * np.eye(len(k))
    there = np.isfinite(y[0])
    return -np.sum(multivariate_normal(np.zeros(there.sum()), C[np.ix_(there, there)]).logpdf(y[:, there]))


@pytest.fixture(scope="module")
def each():
    return identify.fit(MODEL, build, START, FLIGHTS, spread=SPREAD, each=True)


@pytest.fixture(scope="module")
def together():
    return identify.fit(MODEL, build, START, FLIGHTS, spread=SPREAD)


# the likelihood


def test_the_innovations_have_the_likelihood_of_the_joint_gaussian():
    found = identify.held_out(MODEL, build, TRUTH, FLIGHTS)
    assert np.allclose(found, [dense(TRUTH, y[None]) for y in FLIGHTS.readings], rtol=1e-10)


def test_a_pair_and_the_filters_innovation_are_alike_and_what_is_missing_counts_for_nothing():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(3, 3))
    S, R, y = A @ A.T, np.array([0.5, 0.2, 0.7]), np.array([0.3, np.nan, -1.2])
    met = update(Belief(np.zeros(3), S), Reading(y, np.isfinite(y)), lambda x: x, R)[1]
    nll, rows = identify.surprise((y, S + np.diag(R)))
    assert np.isclose(nll, met.nll, rtol=1e-12) and rows == met.rows == 2
    unknown = np.where(np.isfinite(y[:, None] + y), S + np.diag(R), np.nan)
    assert identify.surprise((y, unknown))[0] == nll
    both = identify.surprise([(y, S + np.diag(R)), met])
    assert np.isclose(both[0], 2 * nll) and both[1] == 4


def test_the_gradient_is_that_of_central_differences():
    problem = identify._problem(MODEL, build, START, FLIGHTS, SPREAD)
    u, h = np.array([[0.3, -0.2, 0.1]]), 1e-5
    slope = problem.call(identify._slopes, u)[1]
    for i in range(3):
        step = h * np.eye(3)[i]
        ends = [problem.call(identify._slopes, u + sign * step)[0] for sign in (1, -1)]
        assert np.allclose((ends[0] - ends[1]) / (2 * h), slope[:, i], rtol=1e-7)


# the fit


def prior(theta):
    return sum(0.5 * ((theta[i] - START[i]) / SPREAD[i]) ** 2 for i in START)


def test_the_fit_is_the_minimum_that_scipy_finds_of_the_closed_form(together):
    cost = lambda at: dense(dict(zip(START, at)), FLIGHTS.readings) + prior(dict(zip(START, at)))
    least = minimize(cost, row(TRUTH), method="Nelder-Mead", options=dict(xatol=1e-6, fatol=1e-9))
    assert together.converged and np.all(np.abs(row(together.theta) - least.x) < 5e-3 * row(together.std))
    assert np.isclose(together.nll + prior(together.theta), least.fun, rtol=1e-9)


def test_the_covariance_is_the_inverse_of_the_hessian_by_jax(together):
    def cost(at):
        theta = dict(zip(START, at))
        one = lambda computer, y: jnp.sum(identify.likelihood(MODEL, build(theta), computer, y)[0])
        return jnp.sum(jax.vmap(one)(*FLIGHTS)) + prior(theta)

    inverse = np.linalg.inv(jax.jit(jax.hessian(cost))(jnp.asarray(row(together.theta))))
    assert np.allclose(together.covariance, inverse, rtol=1e-5)
    assert np.allclose(row(together.std), np.sqrt(np.diagonal(inverse)), rtol=1e-6)


def test_flights_fitted_side_by_side_are_at_their_own_minima(each):
    """Of each: the slope of its own likelihood vanishes, to what a Newton step would gain."""
    assert each.converged.all() and each.gap.max() < 1e-4
    problem = identify._problem(MODEL, build, START, FLIGHTS, SPREAD)
    u = (np.stack([each.theta[i] for i in START], 1) - problem.start) / problem.spread
    slope = problem.call(identify._slopes, u)[1] + u
    std = np.stack([each.std[i] for i in START], 1) / problem.spread
    assert np.abs(slope * std).max() < 0.03  # of a deviation


def test_intervals_hold_the_truth_and_the_sandwich_agrees_where_the_model_is_right(each, together):
    held = np.mean([(each.low[i] <= TRUTH[i]) & (TRUTH[i] <= each.high[i]) for i in START])
    assert 0.88 < held < 1
    for i in START:
        assert abs(together.theta[i] - TRUTH[i]) < 3 * together.std[i]
        assert 0.75 < together.robust[i] / together.std[i] < 1.33


def test_the_sandwich_holds_where_the_noise_is_not_gaussian():
    y = np.random.default_rng(1).standard_t(5, size=(N, TICKS))
    flights = identify.Flights(Belief(np.zeros(N), np.zeros(N)), y)
    found = identify.fit(MODEL, white, dict(log_r=0.0), flights, spread=2.0)
    square = y.ravel() ** 2
    true = np.sqrt(np.var(square) / square.size) / np.mean(square)  # of the logarithm of a mean square
    assert np.isclose(found.robust["log_r"], true, rtol=0.02) and found.std["log_r"] < 0.75 * true


# what the data cannot tell


def gained(theta):
    return build(theta)._replace(gain=jnp.exp(theta["log_gain"]))


def test_directions_without_information_are_named_and_no_others(together):
    assert together.blind == () and together.directions.shape == (0, 3)
    wide = dict(log_gain=1.0, colour=3.0)
    start = START | dict(log_gain=0.0, colour=1.0)
    found = identify.fit(MODEL, gained, start, FLIGHTS, spread=SPREAD | wide)
    pair, alone = sorted(found.blind, key=len, reverse=True)
    assert pair in ("the data cannot tell log_q and log_gain apart: only log_q + 2 log_gain counts",
                    "the data cannot tell log_gain and log_q apart: only log_gain + 0.5 log_q counts")  # fmt: skip
    assert alone == "the data cannot tell colour: it may lie anywhere within its spread of 3"
    assert found.converged and np.isclose(found.std["colour"], 3, rtol=1e-6)
    free = found.theta["log_q"] + 2 * found.theta["log_gain"]
    assert np.isclose(free, together.theta["log_q"], atol=0.1 * together.std["log_q"])
    assert "The data cannot tell colour" in identify.report(found)


def test_three_numbers_of_one_direction_are_named_together():
    way = np.array([[1.0, 0.5, -1.0]]) / 1.5
    hessian = 100 * (np.eye(3) - way.T @ way)
    words, ways = identify._blind(hessian, ("a", "b", "c"), np.array([1.0, 1.0, 2.0]))
    assert len(words) == 1 and "a by" in words[0] and "b by" in words[0] and "c by" in words[0]
    move = ways[0] / ways[0][0]
    assert np.allclose(move, [1, 0.5, -2])


# comparison and posterior


def test_the_right_model_foretells_fresh_flights_better(together):
    found = [identify.fit(MODEL, white, dict(log_r=0.0), FLIGHTS, spread=2.0), together]
    fresh = walks(seed=4)
    gain = identify.compare(*(identify.held_out(MODEL, f, a.theta, fresh) for f, a in zip((white, build), found)))
    assert gain.value > 4 * gain.error > 0 and gain.n == N
    d = identify.compare(np.array([1.0, 3.0]), np.zeros(2))
    assert (d.value, d.error) == (2.0, 1.0)


@pytest.mark.skipif(not importlib.util.find_spec("blackjax"), reason="needs the extra posterior")
def test_the_posterior_is_laplaces_where_there_is_much_data(together):
    draws = identify.posterior(MODEL, build, START, FLIGHTS, jax.random.key(0), spread=SPREAD, draws=300, warmup=100)
    for i in START:
        assert 0.85 < np.std(draws.theta[i]) / together.std[i] < 1.15
        assert abs(np.mean(draws.theta[i]) - together.theta[i]) < 0.3 * together.std[i]
    assert draws.divergent < 0.02


def test_the_posterior_without_blackjax_says_what_is_missing(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "blackjax", None)
    with pytest.raises(ImportError, match="pip install 'jaxatt\\[posterior\\]'"):
        identify.posterior(MODEL, build, START, FLIGHTS, jax.random.key(0), spread=SPREAD)


# names and refusals


def test_numbers_are_put_by_name_and_unknown_names_refused():
    params = identify.put(gyro_ekf.params, {"J.x.x": 3.0, "k_p": Vec3(1.0, 2.0, 3.0)})
    assert params.J.x.x == 3 and params.J.y == gyro_ekf.params.J.y and params.k_p.z == 3
    assert identify.put((1.0, (2.0, 3.0)), {"1.0": 5.0}) == (1.0, (5.0, 3.0))
    for name, said in (("J.x.w", "here: x, y, z"), ("thresold", "threshold"), ("gamma.x", "none, it is a number")):
        with pytest.raises(ValueError, match=f"`numbers` must name fields of params .*{said}.*but it is '{name}'"):
            identify.put(gyro_ekf.params, {name: 1.0})


def test_bad_input_is_refused_in_one_line():
    nothing = FLIGHTS._replace(readings=np.where(np.arange(N)[:, None] == 3, np.nan, FLIGHTS.readings))
    negative = lambda theta: Walk(theta["decay"], theta["log_q"], jnp.exp(theta["log_r"]))
    lengths = FLIGHTS._replace(readings=dict(a=FLIGHTS.readings, b=FLIGHTS.readings[:, :5]))
    cases = [
        (dict(flights=nothing), "`flights` must hold a finite innovation in every flight, but it is without one in flight 3"),
        (dict(flights=lengths), r"`flights.readings\['b'\]` must have shape \(40, 80, ...\), flights of one length"),
        (dict(flights=FLIGHTS._replace(computer=Belief(np.zeros(3), np.zeros(3)))), "`flights.computer` must lead with the 40 flights"),
        (dict(flights=identify.Flights((), FLIGHTS.readings[0])), r"`flights.readings` must have shape \(80, T, ...\)"),
        (dict(start=START | dict(log_q=np.nan)), r"`start\['log_q'\]` must be finite"),
        (dict(start=START | dict(decay=1e200)), "`start` must have a finite likelihood and gradient in every flight"),
        (dict(build=negative), r"`build\(start\).q` must be a positive number, but it is 0"),
        (dict(spread=dict(decay=1.0)), r"`spread` must be one number, or hold those of start \(decay, log_q, log_r\), but it is decay"),
        (dict(spread=SPREAD | dict(log_q=0.0)), r"`spread\['log_q'\]` must be a positive number"),
        (dict(steps=0), "`steps` must be a whole number of at least 1"),
    ]  # fmt: skip
    for other, said in cases:
        given = dict(model=MODEL, build=build, start=START, flights=FLIGHTS, spread=SPREAD) | other
        with pytest.raises(ValueError, match=said):
            identify.fit(**given)
    with pytest.raises(TypeError, match="`innovations` must return an Innovation, a pair"):
        identify.fit(MODEL._replace(innovations=lambda log: 3.0), build, START, FLIGHTS, spread=SPREAD)
    with pytest.raises(ValueError, match="`second` must be of shape"):
        identify.compare(np.zeros(3), np.zeros(2))


def test_a_fit_does_not_depend_on_the_switch_of_precision(together):
    with jax.enable_x64(False):
        found = identify.fit(MODEL, build, START, FLIGHTS, spread=SPREAD)
    assert found.std["decay"].dtype == np.float64 and np.allclose(row(found.theta), row(together.theta), rtol=1e-12)
