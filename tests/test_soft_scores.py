"""Smooth terms of a cost: their limits, and their gradients."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_up import repeated

from jaxatt import Fault, linear, on_axes, scores, soft_scores, sweep
from jaxatt.contract import Now
from jaxatt.loops import observer_pd as op

RNG = np.random.default_rng(3)
DT = 0.1


def told(tally, *signals):
    """The value of a tally function (now, *values) summed over the ticks of signals, shape (ticks, n)."""
    total = None
    for k, values in enumerate(zip(*signals)):
        one = tally(Now(k, DT * k, DT), *map(jnp.asarray, values))
        total = one if total is None else scores.add(total, one)
    return scores.values(total)


def test_weights_are_explicit():
    class Terms(NamedTuple):
        a: object
        b: object

    assert soft_scores.weighted(Terms(np.array([1.0, 3.0]), 7.0), {"a": 2.0}) == 4
    assert soft_scores.weighted({"a": 1.0, "b": np.array([2.0, 4.0])}, {"a": 1.0, "b": 0.5}) == 2.5
    with pytest.raises(KeyError):
        soft_scores.weighted({"a": 1.0}, {"c": 1.0})
    np.testing.assert_allclose(soft_scores.penalty(np.array([-1.0, 0.0, 2.0])), [0, 0, 4])


def test_soft_detection_tends_to_the_real_one():
    evaluation = np.abs(RNG.normal(size=(60, 8))) + 1.5 * (np.arange(60) > 40)[:, None]
    onset, start = 3.05, 0.45
    for temperature, tolerance in ((0.2, 1.0), (1e-6, 1e-9)):
        soft = told(
            lambda now, x, t=temperature: soft_scores.detection(now, soft_scores.soft_alarm(x, 2.0, t), onset, start),
            evaluation,
        )
        alarms, t = evaluation > 2.0, DT * np.arange(60)
        faulty, quiet = t >= onset, (t < onset) & (t >= start)
        first = np.where(alarms[faulty].any(0), DT * alarms[faulty].argmax(0), DT * faulty.sum())
        assert np.abs(soft.delay - first).max() <= tolerance
        assert np.abs(soft.miss - (~alarms[faulty]).mean(0)).max() <= tolerance / 5
        assert np.abs(soft.false_alarms - alarms[quiet].mean(0)).max() <= tolerance / 5
    p = soft_scores.soft_alarm(evaluation[31:], 2.0, 0.2)
    delay = told(lambda now, x: soft_scores.detection(now, x, 0.0), p).delay
    np.testing.assert_allclose(delay, soft_scores.soft_delay(jnp.concatenate([p, p[:1]]), DT) - DT, rtol=1e-12)


def test_soft_settling_tends_to_the_last_time_outside():
    q = np.abs(np.exp(-0.3 * DT * np.arange(80))[:, None] * np.cos(DT * np.arange(80)[:, None] * np.linspace(1, 3, 6)))
    window = DT * np.arange(80) < 6.95
    told_by = lambda width: told(
        lambda now, x: soft_scores.soft_settling(now, soft_scores.soft_alarm(x, 0.2, width), now.t < 6.95), q
    )
    last = np.array([DT * (1 + np.flatnonzero(window & (column > 0.2)).max()) for column in q.T])
    np.testing.assert_allclose(told_by(1e-7), last, atol=1e-6)
    assert np.abs(told_by(0.01) - last).max() < 0.7  # a lobe that just reaches the band counts in part
    p = soft_scores.soft_alarm(q[:70], 0.2, 0.05)
    silent_after = np.cumprod((1 - p)[::-1], axis=0)[::-1]
    np.testing.assert_allclose(told_by(0.05), DT * np.sum(1 - silent_after, axis=0), rtol=1e-12)


def test_chatter_is_the_rms_of_the_jumps_in_one_window():
    u = RNG.normal(size=(30, 4))
    got = told(lambda now, x: soft_scores.chatter(x, now.t > 0.95), u)
    np.testing.assert_allclose(got, np.sqrt((np.diff(u[10:], axis=0) ** 2).mean(0)), rtol=1e-12)
    assert np.isnan(told(lambda now, x: soft_scores.chatter(x, now.t > 2.85), u)).all()  # one tick has no jump
    gradient = jax.grad(lambda u: told(lambda now, x: soft_scores.chatter(x), [u, u, u]))(1.0)
    assert gradient == 0  # a resting command: no NaN


def test_tallies_go_through_a_sweep():
    def score(params, scenario, now, log):
        p = soft_scores.soft_alarm(log.xi, params.sigma, 0.1 * params.sigma)
        return soft_scores.detection(now, p, scenario.gyro.x.onset), soft_scores.chatter(log.u.x)

    scenario = op.scenario._replace(gyro=on_axes(Fault(2.0, bias=0.05)), star=on_axes(Fault()))
    scenarios = repeated(scenario, 3)
    found, jumps = sweep(op.system, op.params, scenarios, jax.random.key(0), ticks=30, score=score)
    assert found.delay.max() < 0.2 and found.miss.max() < 0.1 and (jumps > 0.1).all()


def test_the_innovation_cost_is_least_at_the_true_variance():
    truth = 2.3
    r = np.sqrt(truth) * RNG.normal(size=200_000)
    cost = lambda variance: jnp.mean(soft_scores.innovation_cost(r, variance))
    assert cost(np.mean(r * r)) == pytest.approx(0.5 * (1 + np.log(2 * np.pi * np.mean(r * r))), rel=1e-12)
    assert jax.grad(cost)(float(np.mean(r * r))) == pytest.approx(0, abs=1e-12)
    assert cost(truth) < min(cost(0.9 * truth), cost(1.1 * truth))
    missing = jax.grad(
        lambda s: jnp.sum(soft_scores.innovation_cost(jnp.array([jnp.nan, 1.0]), s, jnp.array([False, True])))
    )
    assert missing(1.0) == 0


def test_the_smooth_growth_rate_bounds_the_largest_one():
    A = RNG.normal(size=(20, 6, 6))
    step = np.array([linear._exponential(0.1 * a) for a in A])
    largest = linear.growth_rates(step, 0.1)[:, 0]
    np.testing.assert_allclose(largest, np.linalg.eigvals(A).real.max(-1), rtol=1e-8)
    for sharpness in (1.0, 100.0):
        smooth = soft_scores.growth_rate(step, 0.1, sharpness)
        assert (smooth >= largest - 1e-12).all() and (smooth <= largest + np.log(6) / sharpness).all()
    rate = lambda c: soft_scores.growth_rate(jnp.asarray(step[0]) + c * jnp.eye(6), 0.1, 5.0)
    assert jax.grad(rate)(0.02) == pytest.approx(float((rate(0.02 + 1e-5) - rate(0.02 - 1e-5)) / 2e-5), rel=1e-7)
