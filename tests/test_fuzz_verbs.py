"""Abuse of what runs, tunes, draws, sums up and replays: see `abuse`. The verbs refuse before anything is compiled."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from abuse import arrays, compiled, fuzzed, good, judged, junk, odd, plain, whole
from hypothesis import given
from hypothesis import strategies as st
from toy import SYSTEM, Params, Scenario

from jaxatt import check, linear, scores
from jaxatt.engine import noise_of, simulate, vmapped
from jaxatt.study import batch, rerun, sweep, varied
from jaxatt.systems import observer_pd
from jaxatt.tuning import tune

# the verbs, on a loop that compiles at once


def refuse_bad(params, scenario):
    lanes = check.shapes(params, scenario, Params(), Scenario())
    check.finite("params", params)
    return lanes


LOOP = SYSTEM._replace(check=refuse_bad)
KEY = jax.random.key(0)
KEYS = [KEY, jax.random.split(KEY, 2), jax.random.split(KEY, 0), jax.random.PRNGKey(0), np.zeros(2, np.uint32),
        jax.random.key(0, impl="rbg"), np.zeros((4, 1)), np.zeros((4, 1, 2)), np.zeros((4, 2)), np.zeros((4, 1), np.float32),
        7, None, "key", np.zeros(2), np.full((4, 1), np.nan), np.zeros((4, 1, 0)), jnp.zeros((4, 1), jnp.float16)]  # fmt: skip
for key in KEYS:  # unpacking a key of a new shape is a program of its own
    if hasattr(key, "dtype") and jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        jax.random.key_data(key)

lane_shapes = [(), (), (2,), (2,), (3,), (0,)]
leaves = st.one_of(good(-2, 2), arrays(lane_shapes), odd, junk)
params = st.one_of(st.builds(Params, good(-1, 1)), st.builds(Params, leaves), junk)
scenarios = st.one_of(
    st.sampled_from([Scenario(), batch(Scenario(), 2), batch(Scenario(np.float32(1)), 2), Scenario(np.ones(3))]),
    arrays([(2,), (2, 2), (2, 3)]).map(lambda a: Scenario(*a)), st.builds(Scenario, leaves, leaves), junk,
)  # fmt: skip
keys = st.sampled_from(KEYS)
ticks = st.one_of(st.just(4), st.sampled_from([4, 1, 13]), whole)
SCORES = [lambda params, scenario, now, log: scores.rms(log.position**2), None, 3]
VERBS = {
    "simulate": (
        lambda system, params, scenario, noise_or_key, ticks, every: simulate(
            system, params, scenario, noise_or_key, ticks=ticks, every=every),
        dict(system=st.just(LOOP), params=params, scenario=scenarios, noise_or_key=keys, ticks=ticks,
             every=st.one_of(st.just(1), st.sampled_from([1, 2]), whole)),
        {"key", "noise"},
    ),
    "sweep": (
        lambda system, params, scenarios, key, ticks, score: sweep(
            system, params, scenarios, key, ticks=ticks, score=score),
        dict(system=st.just(LOOP), params=params, scenarios=scenarios, key=keys, ticks=ticks,
             score=st.sampled_from([SCORES[0], *SCORES])),
        {"scenario"},
    ),
    "rerun": (
        lambda system, params, scenarios, key, index, ticks: rerun(system, params, scenarios, key, index, ticks=ticks),
        dict(system=st.just(LOOP), params=params, scenarios=scenarios, key=keys, index=whole, ticks=ticks),
        {"scenario"},
    ),
    "noise_of": (noise_of, dict(system=st.just(LOOP), key=keys, index=whole, ticks=ticks), set()),
    "linear.sampled": (
        lambda system, params, scenario, ticks, states: linear.sampled(
            system, params, scenario, ticks=ticks, states=states),
        dict(system=st.just(LOOP), params=params, scenario=scenarios, ticks=ticks,
             states=st.sampled_from([None, ("position",), ("speed", "position"), ("colour",), (), 3])),
        set(),
    ),
    "varied": (
        lambda system, pair, key, ticks: simulate(varied(system), (), pair, key, ticks=ticks),
        dict(system=st.just(LOOP), pair=st.tuples(params, scenarios), key=keys, ticks=ticks),
        {"params", "scenario", "noise_or_key", "noise"},
    ),
    "vmapped": (
        lambda system, params, scenario, key, ticks: simulate(vmapped(system), params, scenario, key, ticks=ticks),
        dict(system=st.just(LOOP), params=params, scenario=scenarios, key=keys, ticks=ticks),
        {"noise_or_key", "noise"},
    ),
    "tune": (
        lambda cost, theta, optimizer, steps, key: tune(cost, theta, optimizer, steps, key, progress=False),
        dict(cost=st.sampled_from([lambda theta, key: sum(jnp.sum(a**2) for a in jax.tree.leaves(theta)), None]),
             theta=st.one_of(good(-2, 2), plain(), arrays([(2,)]).map(lambda a: {"a": a}), st.just({"a": (1, 2.0)})),
             optimizer=st.sampled_from([optax.sgd(0.1), optax.sgd(0.1), optax.sgd(0.1), None, 3]),
             steps=st.one_of(st.just(2), st.sampled_from([0, -1, 2.5, "a", None])), key=keys),
        set(),
    ),
    "batch": (batch, dict(tree=st.one_of(scenarios, params), n=whole), set()),
}  # fmt: skip


@pytest.mark.parametrize("name", VERBS)
def test_verbs(name):
    f, strategies, also = VERBS[name]

    @fuzzed
    @given(st.fixed_dictionaries(strategies))
    def run(arguments):
        before = len(compiled)
        if not judged(f, {*strategies, *also}, **arguments):
            assert len(compiled) == before, "refused, but something was compiled"

    run()


# runs that no memory would hold


def test_ten_million_ticks_with_a_full_log_are_refused_with_the_way_out(monkeypatch):
    many = jax.random.split(KEY, 1000)
    scenario = batch(observer_pd.scenario, 1000)
    run = lambda every: simulate(observer_pd.system, observer_pd.params, scenario, many, ticks=10_000_000, every=every)
    before = len(compiled)
    with pytest.raises(
        ValueError, match=r"`ticks` = 10000000 with `every` = 1 takes .* TB|GB.*keep fewer records, by `every`"
    ):
        run(1)
    monkeypatch.setattr(check, "free_memory", lambda: 2e6)
    with pytest.raises(ValueError, match=r"`ticks` = 300000 takes .* GB, but 0.002 GB of memory are free"):
        noise_of(LOOP, KEY, 0, 300_000)
    with pytest.raises(ValueError, match=r"`ticks` = 300000 takes .* GB"):
        rerun(LOOP, Params(), batch(Scenario(), 2), KEY, 1, ticks=300_000)
    with pytest.raises(ValueError, match=r"`ticks` = 300000 with `every` = 1 takes 0.0024 GB"):
        simulate(LOOP, Params(), Scenario(), KEY, ticks=300_000)
    assert len(compiled) == before
    log = simulate(LOOP, Params(), Scenario(), KEY, ticks=300_000, every=1000)
    assert log.shape == (300,) and np.isfinite(log).all()
