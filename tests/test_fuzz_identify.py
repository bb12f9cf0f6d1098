"""Abuse of what finds on-board numbers in recorded flights: refused by name, or fitted to what there is."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from abuse import arrays, fuzzed, judged, junk, nearly, odd, plain, tidy, tuples, whole
from hypothesis import given
from hypothesis import strategies as st

from jaxatt.identify import Fit, Flights, Model, compare, fit, held_out, put, report
from jaxatt.loops import observer_pd


def decide(params, now, computer, y):
    return computer, ((y - params)[None], jnp.eye(1, dtype=y.dtype))


MODEL = Model(decide, lambda log: log, 0.5)
FLIGHTS = Flights((), np.linspace(-1.0, 1.0, 8).reshape(2, 4))


def build(theta):
    return sum(jnp.sum(jnp.asarray(a, float)) for a in jax.tree.leaves(theta))


numbers = st.one_of(odd, junk, st.sampled_from([{"a": 1.0}, {"a": np.float32(2)}, {"a": np.nan}, {"a": "b"}, {}]))
models = st.one_of(st.builds(Model, st.sampled_from([decide, decide, None]), st.sampled_from([MODEL.innovations, None, 3]), plain()), junk)  # fmt: skip
flights = st.one_of(arrays([(2, 4)]).map(lambda a: Flights((), a)), st.builds(Flights, st.one_of(arrays(), junk), st.one_of(arrays(), junk)), junk)  # fmt: skip
ASK = dict(model=models, build=st.sampled_from([build, None, 3]), flights=flights)
GOOD = dict(
    model=MODEL, build=build, start={"a": 0.5}, theta={"a": 0.5}, flights=FLIGHTS, spread=1.0, steps=3, each=False, params=observer_pd.params,
    numbers={"k_q": 2.0}, first=np.zeros(3), second=np.ones(3), found=None,
)  # fmt: skip
VERBS: dict[str, Any] = {
    "fit": (
        lambda model, build, start, flights, spread, steps, each: fit(
            model, build, start, flights, spread=spread, steps=steps, each=each, progress=False),
        ASK | dict(start=numbers, spread=numbers, steps=whole, each=st.booleans()),
    ),
    "held_out": (held_out, ASK | dict(theta=numbers)),
    "compare": (compare, dict(first=plain([(3,), (2,)]), second=plain([(3,), (2,)]))),
    "put": (put, dict(params=st.one_of(st.just(observer_pd.params), junk),
                      numbers=st.one_of(st.dictionaries(st.sampled_from(["k_q", "J.x.x", "J.x.w", "", ".", "k_q.x"]), plain()), junk))),
    "report": (report, dict(found=st.one_of(tuples(Fit), junk))),
}  # fmt: skip


@pytest.mark.parametrize("name", VERBS)
def test_identify(name):
    f, strategies = VERBS[name]

    @fuzzed
    @given(nearly(GOOD, strategies))
    def run(arguments):
        judged(f, {name, "start", "spread", *strategies}, **arguments)

    run()
    tidy()
