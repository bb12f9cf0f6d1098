"""Abuse of what runs, tunes, draws, evaluates, sums up and replays. The verbs refuse before anything is compiled."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
import pandas
import pytest
import xarray as xr
from abuse import arrays, fault, fuzzed, good, judged, junk, nearly, odd, plain, tidy, tuples, vectors, whole
from hypothesis import given
from hypothesis import strategies as st
from made_up import compilations, repeated
from toy import SYSTEM, Params, Scenario

from jaxatt import check, plot, scores
from jaxatt.campaign.designs import factorial, iid, latin, sobol, subsets
from jaxatt.campaign.summary import (
    columns,
    describe,
    failing,
    first_order,
    narrowed,
    quantiles,
    rate_of,
    rates,
    sensitivity,
)
from jaxatt.cmg import GimbalAxes, cmg_axes
from jaxatt.engine import simulate
from jaxatt.evaluation import (
    Roc,
    area,
    chance,
    confusion,
    detected_by,
    detection_at,
    first_alarm,
    interval,
    quantile_interval,
    roc,
)
from jaxatt.exporting import write as export
from jaxatt.faults import Reading
from jaxatt.linear import sampled
from jaxatt.loops import observer_pd
from jaxatt.noise import noise_of
from jaxatt.pointing import indices, interpret, runs_needed, upper_bound
from jaxatt.replay import checked, replay, resample, together
from jaxatt.sweeping import rerun, sweep, varied
from jaxatt.tuning import (
    History,
    averaged,
    best_of,
    bounded,
    gradient_check,
    multi_start,
    tune,
    value_and_gradient,
    worst_case,
)
from jaxatt.vec import Vec3
from jaxatt.view import movie, picture

# the verbs, on a loop that compiles at once


def refuse_bad(params, scenario):
    check.kind("params", params, Params)
    check.kind("scenario", scenario, Scenario)


LOOP = SYSTEM._replace(check=refuse_bad)
KEY = jax.random.key(0)
KEYS = [KEY, jax.random.split(KEY, 2), jax.random.split(KEY, 0), jax.random.PRNGKey(0), np.zeros(2, np.uint32),
        jax.random.key(0, impl="rbg"), np.zeros((4, 1)), np.zeros((4, 1, 2)), np.zeros((4, 2)), np.zeros((4, 1), np.float32),
        7, None, "key", np.zeros(2), np.full((4, 1), np.nan), np.zeros((4, 1, 0)), jnp.zeros((4, 1), jnp.float16)]  # fmt: skip
for key in KEYS:  # unpacking a key of a new shape is a program of its own
    if hasattr(key, "dtype") and jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        jax.random.key_data(key)

leaves = st.one_of(good(-2, 2), arrays([(), (), (2,), (2,), (3,), (0,)]), odd, junk)
params = st.one_of(st.builds(Params, good(-1, 1)), st.builds(Params, leaves), junk)
scenario = st.one_of(st.sampled_from([Scenario(), Scenario(np.float32(1)), Scenario(np.ones(3))]), st.builds(Scenario, leaves, leaves), junk)  # fmt: skip
scenarios = st.one_of(
    st.sampled_from([repeated(Scenario(), 2), repeated(Scenario(np.float32(1)), 2), Scenario(np.ones(3)), Scenario()]),
    arrays([(2,), (2, 2), (2, 3)]).map(lambda a: Scenario(*a)), st.builds(Scenario, leaves, leaves), junk,
)  # fmt: skip
keys = st.sampled_from(KEYS)
ticks = st.one_of(st.just(4), st.sampled_from([4, 1, 13]), whole)
SCORES = [
    lambda params, scenario, now, log: scores.rms(log.position**2),
    None,
    3,
    lambda params, scenario, now, log: log.u,
    lambda params, scenario, now, log: scores.final(np.ones(3)),
    lambda params, scenario, now, log: [
        scores.final(now.t),
        scores.mean(True, False),
        scores.total(now.k),
        scores.rms(2, now.k),
    ],
    lambda params, scenario, now, log: (
        scores.peak(now.k > 2, np.nan),
        scores.settling(now, 1),
        scores.first(now, log.u, since=now.k),
    ),
    lambda params, scenario, now, log: {"a": scores.mean(log.u), "b": 3.0},
]
COSTS = [lambda theta, key: sum(jnp.sum(a**2) for a in jax.tree.leaves(theta)), None]
VERBS = {
    "simulate": (
        lambda system, params, scenario, noise_or_key, ticks, every: simulate(
            system, params, scenario, noise_or_key, ticks=ticks, every=every),
        dict(system=st.one_of(st.just(LOOP), st.just(LOOP), st.just(LOOP), junk), params=params, scenario=scenario, noise_or_key=keys, ticks=ticks,
             every=st.one_of(st.just(1), st.sampled_from([1, 2]), whole)),
        {"key", "noise"},
    ),
    "sweep": (
        lambda system, params, scenarios, key, ticks, score: sweep(
            system, params, scenarios, key, ticks=ticks, score=score),
        dict(system=st.just(LOOP), params=params, scenarios=scenarios, key=keys, ticks=ticks,
             score=st.sampled_from(SCORES)),
        {"scenario"},
    ),
    "rerun": (
        lambda system, params, scenarios, key, index, ticks: rerun(system, params, scenarios, key, index, ticks=ticks),
        dict(system=st.just(LOOP), params=params, scenarios=scenarios, key=keys, index=whole, ticks=ticks),
        {"scenario"},
    ),
    "noise_of": (noise_of, dict(system=st.just(LOOP), key=keys, index=whole, ticks=ticks), set()),
    "linear.sampled": (
        lambda system, params, scenario, ticks, states, after: sampled(
            system, params, scenario, ticks=ticks, states=states, after=after),
        dict(system=st.just(LOOP), params=params, scenario=scenario, ticks=ticks, after=st.one_of(st.none(), st.none(), whole),
             states=st.sampled_from([None, ("x.position",), ("x.speed", "x.position"), ("z",), ("x", "z"), ("colour",), (), 3])),
        set(),
    ),
    "varied": (
        lambda system, pairs, key, ticks, score: sweep(varied(system), (), pairs, key, ticks=ticks, score=varied(score)),
        dict(system=st.one_of(st.just(LOOP), st.just(LOOP), junk), pairs=st.tuples(st.builds(Params, leaves), scenarios), key=keys,
             ticks=ticks, score=st.sampled_from(SCORES)),
        {"params", "scenarios", "loop"},
    ),
    "tune": (
        lambda cost, theta, optimizer, steps, key: tune(cost, theta, optimizer, steps, key, progress=False),
        dict(cost=st.sampled_from(COSTS),
             theta=st.one_of(good(-2, 2), plain(), arrays([(2,)]).map(lambda a: {"a": a}), st.just({"a": (1, 2.0)})),
             optimizer=st.sampled_from([optax.sgd(0.1), optax.sgd(0.1), optax.sgd(0.1), None, 3]),
             steps=st.one_of(st.just(2), st.sampled_from([0, -1, 2.5, "a", None])), key=keys),
        set(),
    ),
}  # fmt: skip


GOOD = dict(
    system=LOOP, params=Params(), scenario=Scenario(), scenarios=repeated(Scenario(), 2), noise_or_key=KEY, key=KEY, ticks=4, every=1,
    score=SCORES[0], index=1, states=None, after=None, pairs=repeated((Params(), Scenario()), 2), cost=COSTS[0], theta=0.5, optimizer=optax.sgd(0.1), steps=2,
)  # fmt: skip


def mixed(name, good, strategies):
    wild = st.fixed_dictionaries(strategies)
    several = {
        "linear.sampled": 0,
        "tune": 1,
        "worst_case": 1,
        "multi_start": 1,
    }  # what few shall compute
    return st.one_of(*[wild] * 7, *[nearly(good, strategies)] * several.get(name, 99))


@pytest.mark.parametrize("name", VERBS)
def test_verbs(name):
    f, strategies, also = VERBS[name]

    @fuzzed
    @given(mixed(name, GOOD, strategies))
    def run(arguments):
        before = len(compilations)
        said = judged(f, {*strategies, *also}, **arguments)
        if (
            said and "finite gradient, at the start" not in said and "comes back" not in said
        ):  # what only a run can tell
            assert len(compilations) == before, "refused, but something was compiled"

    run()
    tidy()


# tuning


trees = st.one_of(
    good(-2, 2), plain(), arrays([(2,)]).map(lambda a: {"a": a}), st.just({"a": (1, 2.0)}), st.just({"a": np.zeros(2)})
)
history = st.one_of(
    tuples(History), st.just(History({"a": np.zeros((2, 3))}, np.zeros((2, 3)), np.ones((2, 3)), np.ones((2, 3))))
)
directions = st.sampled_from([None, True, False])
COSTS_MADE = [COSTS[0], COSTS[0], lambda theta, key: theta, None]
TUNING = {
    "value_and_gradient": (lambda cost, theta, key, forward: value_and_gradient(cost, theta, key, forward=forward),
                           dict(cost=st.sampled_from(COSTS_MADE), theta=trees, key=st.just(KEY), forward=directions)),
    "multi_start": (lambda cost, thetas, optimizer, steps, key: multi_start(cost, thetas, optimizer, steps, key, progress=False),
                    dict(cost=st.sampled_from(COSTS), thetas=trees, key=keys, steps=st.one_of(st.just(2), st.sampled_from([0, 2.5, "a"])),
                         optimizer=st.sampled_from([optax.sgd(0.1), optax.sgd(0.1), None, 3]))),
    "best_of": (best_of, dict(history=history)),
    "averaged": (lambda cost, draws, theta, key: averaged(cost, draws)(theta, key),
                 dict(cost=st.sampled_from([COSTS[0], None]), draws=whole, theta=st.sampled_from([0.5, np.ones(2)]), key=keys)),
    "bounded": (lambda low, high, theta: (lambda b: b.within(b.free(theta)))(bounded(low, high)), dict(low=trees, high=trees, theta=trees)),
    "within": (lambda low, high, theta: bounded(low, high).within(theta), dict(low=trees, high=trees, theta=trees)),
    "worst_case": (lambda harm, low, high, optimizer, steps, key, starts: worst_case(
        harm, low, high, optimizer, steps, key, starts=starts, progress=False),
        dict(harm=st.sampled_from(COSTS), low=trees, high=trees, key=keys, steps=whole, starts=whole,
             optimizer=st.sampled_from([optax.sgd(0.1), optax.sgd(0.1), None, 3]))),
    "gradient_check": (lambda cost, theta, key, step, forward: gradient_check(cost, theta, key, step=step, forward=forward),
                       dict(cost=st.sampled_from(COSTS_MADE), theta=trees, key=st.just(KEY), step=st.one_of(st.none(), plain()), forward=directions)),
}  # fmt: skip
TOGETHER = GOOD | dict(
    theta=np.full(2, 0.5), thetas=np.full((3, 2), 0.5), low=-1.0, high=1.0, harm=COSTS[0], starts=2, draws=2, step=1e-3, forward=None,
)  # fmt: skip


@pytest.mark.parametrize("name", TUNING)
def test_tuning(name):
    f, strategies = TUNING[name]

    @fuzzed
    @given(mixed(name, TOGETHER, strategies))
    def run(arguments):
        before = len(compilations)
        said = judged(f, {name, *strategies, "cost"}, **arguments)
        if (
            said
            and "with a finite gradient, at the start" not in said
            and name in ("multi_start", "worst_case", "averaged")
        ):
            assert len(compilations) == before, said

    run()
    tidy()


# what draws, sums up and replays


@st.composite
def datasets(draw):
    """What a campaign leaves, or something like it."""
    n = draw(st.sampled_from([0, 3, 120]))
    rng = np.random.default_rng(draw(st.integers(0, 9)))
    x = rng.normal(size=n)
    delay = np.where(x > draw(st.sampled_from([-9, 0])), np.abs(x), np.inf)
    variables = {
        "delay": ("scenario", delay, {"role": "score", "units": "s"}), "x": ("scenario", x, {"role": "input"}),
        "ok": ("scenario", delay < 1, {"role": "score"}), "status": ("scenario", np.zeros(n, np.int8), {"role": "status"}),
        "last": (("axis", "scenario"), np.stack([x, x]), {"role": "score"}),
    }  # fmt: skip
    for name in draw(st.lists(st.sampled_from(list(variables)), max_size=2, unique=True)):
        dims, values, attributes = variables[name]
        variables[name] = draw(st.sampled_from([
            (dims, values.astype(str), attributes), (dims, values * np.nan, attributes), (dims, values, {}), ((), 3.0, attributes),
            (dims, values.astype(object), attributes), (dims, values + 1j, attributes), ("other", np.arange(5.0), attributes),
            (dims, np.zeros(np.shape(values), "datetime64[s]"), attributes), (dims, values, {"role": "score", "units": 3}),
        ]))  # fmt: skip
    for name in draw(st.lists(st.sampled_from(list(variables)), max_size=1)):
        del variables[name]
    return xr.Dataset(variables, {"scenario": np.arange(n)} if draw(st.integers(0, 9)) else {})


shares = st.one_of(st.sampled_from([0.95, 0.5]), plain())
data = st.one_of(datasets(), datasets(), junk, st.just({"delay": np.zeros(3)}))
samples = st.one_of(arrays([(120,), (120,), (120, 2), (3,)]), plain())
reading = st.one_of(arrays([(4,)]).map(lambda a: Reading(a, np.isfinite(a))), tuples(Reading))
series = st.one_of(arrays([(5,), (5, 2)]), plain())
curves = st.one_of(arrays([(3, 4)]).map(lambda a: Roc(*a)), tuples(Roc), plain())
blamed = st.one_of(
    st.lists(st.integers(0, 4), min_size=3, max_size=3), st.lists(st.integers(-1, 9), max_size=4), plain()
)
names = st.sampled_from([["a"], ["a", "b"], [], ["c"], "ab", 3, None, [["a"]]])


class Computer(NamedTuple):
    x: Any
    w: Any


def decide(params, now, computer, readings):
    return computer._replace(x=computer.x + jnp.mean(jax.tree.leaves(readings)[0])), (computer.w, now.t)


DATA = {
    "iid": (iid, dict(dims=whole)),
    "latin": (latin, dict(n=st.one_of(whole, st.sampled_from([60, 100, 2**31 - 1])), dims=whole)),
    "sobol": (sobol, dict(dims=st.one_of(whole, st.just(21202)))),
    "factorial": (factorial, dict(index=st.integers(0, 9), counts=st.one_of(st.lists(whole, max_size=3), st.just((2, 3)), plain()))),
    "subsets": (subsets, dict(channels=st.one_of(whole, st.sampled_from([40, 2**31 - 1])), most=st.one_of(st.none(), whole))),
    "rate_of": (rate_of, dict(successes=whole, trials=whole, level=shares)),
    "narrowed": (narrowed, dict(counts=st.one_of(st.lists(whole, max_size=3), st.just([1, 2]), junk), half_width=shares,
                                looks=st.one_of(st.lists(whole, max_size=3), st.just([4, 6]), junk), level=shares)),
    "rates": (rates, dict(dataset=data, level=shares)),
    "quantiles": (quantiles, dict(dataset=data, levels=st.one_of(st.just((0.1, 0.9)), plain()))),
    "first_order": (first_order, dict(x=samples, y=samples)),
    "sensitivity": (sensitivity, dict(dataset=data)),
    "failing": (failing, dict(dataset=data)),
    "describe": (describe, dict(dataset=data)),
    "columns": (lambda dataset, role: dict(columns(dataset, role)), dict(dataset=data, role=st.sampled_from(["score", 3]))),
    "checked": (checked, dict(t=st.one_of(st.just(np.arange(4.0)), plain()), columns=st.one_of(
        st.dictionaries(st.sampled_from("ab"), st.one_of(arrays([(4,)]), plain())), junk))),
    "resample": (lambda t, columns, dt, ticks: resample(t, columns, dt=dt, ticks=ticks), dict(
        t=st.one_of(st.just(np.arange(4.0)), st.just(np.array([0.0, 1.0, 1e9])), plain()), ticks=st.one_of(st.none(), whole, st.just(2**31 - 1)),
        columns=st.one_of(st.dictionaries(st.sampled_from("ab"), arrays([(4,)])), junk), dt=st.one_of(good(0.1, 2), plain()))),
    "together": (together, dict(readings=st.one_of(st.dictionaries(st.sampled_from("ab"), reading), junk), names=names)),
    "export": (lambda path, decide, params, computer, readings, dt, flow, substeps, platforms: str(export(
        path, decide, params, computer, readings, dt=dt, flow=flow, substeps=substeps, platforms=platforms)) and None,
        dict(path=st.sampled_from([3, "a\0", "", "none/a.zip"]), params=st.one_of(st.just(()), plain()),
             decide=st.sampled_from([decide, decide, None, 3]),  # no path is one, so that nothing is compiled
             computer=st.one_of(st.just(Computer(0.0, 0.5)), tuples(Computer)), readings=st.one_of(arrays([(), (2,)]), reading, junk),
             dt=st.one_of(good(0.1, 1), plain()), substeps=st.one_of(st.just(1), whole),
             flow=st.sampled_from([None, None, lambda p, computer, y: {"w": -computer.w}, lambda p, computer, y: computer, 3]),
             platforms=st.sampled_from([("cpu",), ("cpu",), ("cpu", "cuda"), (), "cpu", ("abacus",), 3, [None]]))),
    "replay": (lambda decide, params, computer, readings, dt, flow, substeps, between: replay(
        decide, params, computer, readings, dt=dt, flow=flow, substeps=substeps, between=between),
        dict(decide=st.sampled_from([decide, decide, decide, None, lambda *a: (a[2], None), lambda *a: (0.0, None)]),
             params=st.one_of(st.just(()), plain()), computer=st.one_of(st.just(Computer(0.0, 0.5)), tuples(Computer)),
             readings=st.one_of(arrays([(4,), (4, 2)]), reading, junk), dt=st.one_of(good(0.1, 1), plain()),
             flow=st.sampled_from([None, None, lambda p, computer, y: {"w": -computer.w}, lambda p, computer, y: computer, lambda p, computer, y: {"q": 1.0}, 3]),
             substeps=st.one_of(st.just(1), whole), between=st.one_of(st.none(), st.none(), arrays([(4, 1, 4), (4, 2, 4)]), junk))),
    "roc": (roc, dict(healthy=series, faulty=series, thresholds=st.one_of(st.none(), series))),
    "detection_at": (detection_at, dict(healthy=series, faulty=series, false_alarm=shares)),
    "area": (area, dict(curve=curves)),
    "first_alarm": (first_alarm, dict(alarms=st.one_of(st.just(np.arange(5) > 2), series), t=series, since=plain())),
    "detected_by": (detected_by, dict(delays=series, times=series)),
    "chance": (chance, dict(false_alarm=shares, samples=st.one_of(st.just(10), plain()))),
    "interval": (interval, dict(successes=whole, trials=whole, level=shares)),
    "quantile_interval": (quantile_interval, dict(values=series, shares=st.one_of(st.just((0.1, 0.9)), plain()), level=shares)),
    "indices": (indices, dict(error=series, dt=st.one_of(st.just(1.0), plain()), window=st.one_of(st.just(2.0), plain()),
                              apart=st.one_of(st.none(), st.just(3.0), plain()))),
    "interpret": (interpret, dict(values=st.one_of(arrays([(5, 2), (5, 3, 2), (5,), (0, 2)]), plain()), level=shares,
                                  how=st.sampled_from(["ensemble", "temporal", "mixed", "worst", None, 3]))),
    "runs_needed": (runs_needed, dict(level=shares, confidence=shares, rank=whole)),
    "upper_bound": (upper_bound, dict(values=series, level=shares, confidence=shares)),
    "confusion": (confusion, dict(truth=blamed, verdict=blamed, causes=whole)),
}  # fmt: skip
ALSO = {"time", "a", "b", "q", "scenarios"}  # the channels and times that a message names


fitting = GOOD | dict(
    dims=2, counts=[1, 2], looks=[4, 6], channels=3, most=None, successes=1, trials=3, level=0.95, levels=(0.1, 0.9), role="score",
    half_width=0.3, t=np.arange(4.0), columns={"a": np.arange(4.0)}, dt=1.0, names=["a", "b"], decide=decide, flow=None, substeps=1,
    computer=Computer(0.0, 0.5), between=None, n=60, x=np.ones(120),
    y=np.ones(120), healthy=np.arange(5.0), faulty=np.arange(5.0), thresholds=None, false_alarm=0.1, curve=Roc(*np.ones((3, 4))),
    alarms=np.arange(5) > 2, since=0.0, delays=np.ones(5), times=np.ones(5), samples=10, shares=0.5, truth=[0, 1, 2], verdict=[0, 2, 2], causes=5,
    path="none/a.zip", platforms=("cpu",), error=np.arange(5.0), window=2.0, apart=None, values=np.ones((5, 2)), how="mixed", confidence=0.5, rank=1,
)  # fmt: skip


@pytest.mark.parametrize("name", DATA)
def test_data(name):
    f, strategies = DATA[name]

    @fuzzed
    @given(nearly(fitting, strategies))
    def run(arguments):
        judged(f, {name, f"_{name}", *strategies, *ALSO}, **arguments)

    run()
    tidy()


# figures


TABLE = {
    "delay [s]": np.array([1.0, np.inf, 2.0]),
    "size [1]": np.arange(1.0, 4.0),
    "ok [1]": np.array([True, False, True]),
}
tables = st.one_of(
    st.just(TABLE),
    datasets(),
    junk,
    st.just(pandas.DataFrame(TABLE)),
    st.dictionaries(st.sampled_from(list(TABLE)), plain(), max_size=3),
)
labels = st.sampled_from(["delay [s]", "size [1]", "ok [1]", "delay", "x", "", None, 3])
label_words = st.one_of(st.none(), st.dictionaries(labels, labels, max_size=2), junk)
ax = st.sampled_from([None, None, 3, "a"])
GIMBALS = cmg_axes(np.radians(54.7), np.radians([0.0, 90.0, 180.0, 270.0]))
FIGURES = {
    "column": dict(data=tables, name=labels),
    "label_of": dict(data=tables, name=labels, labels=label_words),
    "fault_times": dict(scenario=st.one_of(fault, plain(), st.just(observer_pd.scenario))),
    "overview": dict(t=st.one_of(st.just(np.arange(3.0)), plain()), panels=st.one_of(st.dictionaries(labels, st.one_of(plain(), vectors)), junk),
                     faults=st.one_of(st.none(), st.dictionaries(labels, plain(), max_size=2), junk), alarm=st.one_of(st.none(), plain()),
                     thresholds=st.one_of(st.none(), st.dictionaries(labels, plain(), max_size=2), junk), axes=ax),
    "heat_map": dict(data=tables, x=labels, y=labels, value=labels, bins=whole, log=st.sampled_from([(), ("size [1]",), "a", 3]),
                     labels=label_words, chance=st.one_of(st.none(), plain()), ax=ax),
    "sweep_summary": dict(data=tables, names=st.one_of(st.none(), st.lists(labels, max_size=2), junk), labels=label_words, axes=ax),
    "roc": dict(curves=st.one_of(st.dictionaries(labels, curves, max_size=2), junk), samples=whole, least=plain(), ax=ax),
    "front": dict(costs=st.one_of(arrays([(3, 2), (3,)]), plain())),
    "pareto": dict(data=tables, x=labels, y=labels, labels=label_words, marked=st.one_of(
        st.none(), st.dictionaries(labels, whole, max_size=2), junk), ax=ax),
    "subsets": dict(out=st.one_of(arrays([(4, 2)]), plain()), values=st.one_of(st.dictionaries(labels, plain(), max_size=2), junk),
                    names=st.sampled_from(["AB", "A", "", 3, None]), what=labels, axes=ax),
    "singular_surface": dict(gimbals=tuples(GimbalAxes, vectors), reversed=whole, ax=ax, fine=st.one_of(st.just(4), whole)),
}  # fmt: skip
DRAWN = dict(data=TABLE, name="size [1]", x="size [1]", y="delay [s]", value="ok [1]", labels=None, scenario=observer_pd.scenario,
             t=np.arange(3.0), panels={"size [1]": np.arange(3.0)}, faults={"gyro": 1.0}, thresholds=None, alarm=None, axes=None, ax=None,
             bins=3, log=(), chance=None, names=None, curves={"a": Roc(*np.ones((3, 4)))}, samples=1, least=1e-3, costs=np.ones((3, 2)),
             marked=None, out=np.eye(2) > 0, values={"size [1]": np.ones(2)}, what="units", gimbals=GIMBALS, reversed=0, fine=4)  # fmt: skip


@pytest.mark.parametrize("name", FIGURES)
def test_figures(name):
    strategies = FIGURES[name]

    @fuzzed
    @given(nearly(DRAWN | {"names": "AB"} if name == "subsets" else DRAWN, strategies))
    def run(arguments):
        judged(
            lambda **how: (getattr(plot, name)(**how), None)[1],
            {name, "label", "name", *strategies, *ALSO, *map(str, TABLE)},
            **arguments,
        )
        plt.close("all")

    run()


LOG = {"t": np.arange(3.0), "q": Vec3(*np.zeros((3, 3))), "alarm": np.ones(3, bool)}
attitudes = st.one_of(st.sampled_from(["q", "alarm", "x"]), st.none(), tuples(Vec3, st.one_of(arrays([(3,)]), plain())))
VIEWED = dict(
    log=st.one_of(st.dictionaries(st.sampled_from(["t", "q", "alarm", "estimate"]), st.one_of(plain(), vectors)), datasets(), junk),
    attitude=attitudes, estimate=attitudes, alarm=st.one_of(attitudes, arrays([(3,)])), size=st.one_of(arrays([(3,)]), plain()),
    directions=st.one_of(st.none(), st.dictionaries(st.just("Sun"), tuples(Vec3), max_size=1), junk),
)  # fmt: skip
VIEWS = {
    "picture": (picture, VIEWED | dict(at=st.one_of(st.none(), plain()), ax=ax)),
    "movie": (movie, VIEWED | dict(path=st.sampled_from(["a.png", "none/a.gif", "", None, 3]), frames=whole, rate=plain(), pixels=whole)),
}  # fmt: skip


@pytest.mark.parametrize("name", VIEWS)
def test_views(name):
    f, strategies = VIEWS[name]
    good = dict(log=LOG, attitude="q", estimate=None, alarm=None, size=(1, 1, 1), directions=None, at=None, ax=None)

    @fuzzed
    @given(nearly(good | dict(frames=2, rate=1.0, pixels=40), strategies))
    def run(arguments):
        judged(lambda **how: (f(**how), None)[1], {*strategies, "Sun", "t"}, **arguments)
        plt.close("all")

    run()


# runs that no memory would hold


def test_two_thousand_million_ticks_with_a_full_log_are_refused_with_the_way_out(monkeypatch):
    run = lambda every: simulate(LOOP, Params(), Scenario(), KEY, ticks=2_000_000_000, every=every)
    _ = jnp.zeros(()) + 0  # asking whether the caller is traced is a program of its own, once in a process
    before = len(compilations)
    with pytest.raises(
        ValueError,
        match=r"`ticks` = 2000000000 with `every` = 1 takes 32 GB, .* are free: keep fewer records, by `every`",
    ):
        run(1)
    monkeypatch.setattr(check, "free_memory", lambda: 2e6)
    with pytest.raises(ValueError, match=r"`ticks` = 300000 takes .* GB, but 0.002 GB of memory are free"):
        noise_of(LOOP, KEY, 0, 300_000)
    with pytest.raises(ValueError, match=r"`ticks` = 300000 takes .* GB"):
        rerun(LOOP, Params(), repeated(Scenario(), 2), KEY, 1, ticks=300_000)
    with pytest.raises(ValueError, match=r"`ticks` = 300000 with `every` = 1 takes 0.0048 GB"):
        simulate(LOOP, Params(), Scenario(), KEY, ticks=300_000)
    assert len(compilations) == before
    log = simulate(LOOP, Params(), Scenario(), KEY, ticks=300_000, every=1000)
    assert log.u.shape == (300,) and np.isfinite(log).all()
