"""Abuse of what estimates small probabilities and looks at failures. A loss that others are asked of is made once."""

from typing import Any

import jax
import numpy as np
import pytest
from abuse import arrays, fuzzed, good, judged, junk, nearly, odd, plain, tidy, whole
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.rare import mirror
from jaxatt import check, rare, scores


def refuse_bad(params, scenario):
    check.number("params", params)
    check.number("scenario", scenario)


LOOP = mirror(2)._replace(check=refuse_bad)
PARAMS, SCENARIO, KEY = np.float32(1), np.float32(0), jax.random.key(0)


def first(params, scenario, now, log):
    return scores.final(params * log[0])


def step(params, scenario, now, log):
    return scores.always(log[0] > 1)


def pair(params, scenario, now, log):
    return scores.final(log)


def drawn(u):
    return u[0]


def itself(theta):
    return theta


ASK: dict[str, Any] = dict(system=LOOP, params=PARAMS, scenario=SCENARIO, key=KEY, ticks=1, score=first, above=3.0)
small = dict(chains=8, moves=5, repeats=4)
VERBS = "probability", "design_point", "importance", "failure", "groups", "sensitivity"
SIZES = st.one_of(st.just(8), whole)


@pytest.fixture(scope="module")
def told():
    """A loss, and its design points."""
    loss = rare.probability(**ASK, chains=64, repeats=4, progress=False)
    return loss, rare.design_point(**ASK, starts=2)


def asked(loss, points):
    """What each verb may be handed, beside what is right."""
    event = dict(
        params=st.one_of(good(0.5, 2), odd, junk), scenario=st.one_of(st.just(drawn), odd, junk),
        key=st.sampled_from([KEY, jax.random.split(KEY, 2), 7, None, np.zeros(2, np.uint32)]),
        ticks=st.one_of(st.just(2), whole), score=st.sampled_from([first, step, pair, None, 3]),
        above=st.one_of(good(1, 3), odd, junk), normals=st.one_of(st.just(1), whole),
    )  # fmt: skip
    losses = st.one_of(st.just(loss), junk)
    return {
        "probability": event
        | dict(chains=SIZES, moves=SIZES, repeats=SIZES, label=st.sampled_from([None, 3, "a"]), path=st.sampled_from([None, 3])),
        "design_point": event | dict(starts=whole, steps=whole),
        "importance": event
        | dict(points=st.one_of(st.just(points), st.just(points._replace(u=np.ones((1, 3)))), junk), runs=whole, against=losses),
        "failure": dict(loss=losses, i=whole),
        "groups": dict(loss=losses, features=st.one_of(arrays([(len(loss.failures.score), 2), (3, 2)]), plain()), most=whole),
        "sensitivity": dict(
            loss=losses, system=st.just(LOOP), params_of=st.sampled_from([itself, None, 3]),
            theta=st.one_of(good(0.5, 2), odd, junk), ticks=st.one_of(st.just(1), whole),
            score=st.sampled_from([first, None, 3]),
        ),
    }  # fmt: skip


@pytest.mark.parametrize("name", VERBS)
def test_rare_events(name, told):
    loss, points = told
    strategies = asked(loss, points)[name]
    right = ASK | small | dict(
        normals=0, label=None, path=None, starts=2, steps=5, points=points, runs=10, against=loss, loss=loss, i=0,
        features=np.ones((len(loss.failures.score), 2)), most=3, params_of=itself, theta=np.float32(1),
    )  # fmt: skip
    rest = {"system": LOOP} if name in ("probability", "design_point", "importance") else {}
    rest |= {"progress": False} if name == "probability" else {}

    @fuzzed
    @given(nearly(right, strategies))
    def run(arguments):
        judged(getattr(rare, name), {name, "params", *strategies, *rest}, **rest, **arguments)

    run()
    tidy()
