"""Abuse: whatever a public entry is given, it answers with a result or with one line that names the argument.

50 examples per entry here; ``JAXATT_FUZZ=2000 pytest -n 2 tests/test_fuzz.py`` is the long run. What is refused is
refused by our own code, with no word from inside JAX, and the verbs refuse before anything is compiled.
"""

import inspect
import os
import re
import traceback
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jaxatt
from jaxatt import attitude, check, detection, faults, linear, mounting, objectives, scores, singularity, vec
from jaxatt.engine import Now, System, admit, noise_of, simulate, vmapped
from jaxatt.faults import Fault
from jaxatt.mounting import GimbalAxes, cmg_axes
from jaxatt.study import batch, rerun, sweep, varied
from jaxatt.systems import cmg_loss, gyro_ekf, observer_pd, star_isolation, wheel_mrac
from jaxatt.tuning import tune
from jaxatt.vec import Mat3, Quat, Vec3

EXAMPLES = int(os.environ.get("JAXATT_FUZZ", "50"))
HOME = str(Path(jaxatt.__file__).parent)
fuzzed = settings(
    max_examples=EXAMPLES, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)
compiled = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, *_, **__: compiled.append(event) if "backend_compile" in event else None
)


def judged(f, names, *args, **kwargs):
    """Call f; True for a result, False for a refusal that is as it must be."""
    before = len(compiled)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            jax.block_until_ready(jax.tree.leaves(f(*args, **kwargs)))
        return True
    except (ValueError, TypeError) as error:
        said = str(error)
        assert "\n" not in said and len(said) < 1000, said
        named = {word for words in re.findall(r"`([^`]+)`", said) for word in re.findall(r"\w+", words)}
        assert named & set(names), (said, names)
        assert traceback.extract_tb(error.__traceback__)[-1].filename.startswith(HOME), said
        assert error.__suppress_context__ or error.__context__ is None, said
        f.compiled = len(compiled) - before if hasattr(f, "compiled") else None
        return False


# what a user may hand in

ODD = [
    float("nan"), float("inf"), -float("inf"), 0.0, -0.0, 1e308, -1e308, 5e-324, 1e-200, 1.0, -1.0, 0.5, 2.0, 1, 0, -3, True,
    10**400, np.float32(1e38), np.float64(3.0), np.int8(7),
]  # fmt: skip
JUNK = [
    "a", None, 1j, b"x", {}, [], object(), np.array("a"), np.array([1j, 2]), np.zeros((0,)), np.array([None, 1]),
    np.float16(1.0), np.zeros((2, 3, 4)), [1.0, "b"], {"q": 1.0}, jnp.zeros(2, jnp.complex64), jax.random.key(0),
    np.array(["2020-01-01"], "datetime64[D]"), lambda x: x,
]  # fmt: skip
SHAPES = [(), (1,), (2,), (3,), (2, 3)]
odd = st.sampled_from(ODD)
junk = st.sampled_from(JUNK)


@st.composite
def arrays(draw, shapes=None):
    shape = draw(st.sampled_from(SHAPES if shapes is None else shapes))
    kind = draw(st.sampled_from(["float64", "float64", "float32", "int32", "bool", "float16"]))
    values = [0.3, -1.2, 1.0, 0.0, 2.5, float("nan"), float("inf"), 1e30]
    size = int(np.prod(shape))
    flat = draw(st.lists(st.sampled_from(values), min_size=size, max_size=size))
    with np.errstate(all="ignore"):
        return np.asarray(flat, float).reshape(shape).astype(kind)


def plain(shapes=None):
    """A number or an array, now and then something else."""
    return st.one_of(arrays(shapes), odd, arrays(shapes), junk)


def good(low, high):
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)  # which XLA flushes to zero


def tuples(kind, part=None, n=None):
    part = plain() if part is None else part
    n = len(kind._fields) if n is None else n
    whole = st.tuples(*[part] * n).map(lambda parts: kind(*parts))
    same = arrays([(n,), (n, 2)]).map(lambda a: kind(*a))  # lanes that agree
    return st.one_of(same, whole, same, junk)


vectors, quaternions = tuples(Vec3), tuples(Quat)
matrices = st.one_of(arrays([(3, 3), (3, 3, 2)]).map(vec.mat3), tuples(Mat3, vectors), junk)
fault = st.one_of(tuples(Fault), st.tuples(plain(), plain()).map(lambda a: Fault(onset=a[0], bias=a[1])), junk)
gimbals = st.one_of(
    st.sampled_from([4, 4, 3, 5, 2, 1]).map(lambda n: cmg_axes(np.radians(54.7), 2 * np.pi / n * np.arange(n))),
    st.just(cmg_axes(np.radians(90.0), np.radians([0.0, 90.0, 180.0]))),
    tuples(GimbalAxes, vectors),
    st.just(cmg_axes(np.zeros(4), np.arange(4.0))),
)
now = st.sampled_from([Now(0, 0.0, 0.1), Now(jnp.asarray(3), jnp.asarray(0.3), 0.1)])
whole = st.one_of(st.integers(-3, 6), st.sampled_from([2**31, 10**30, 2.0, 1.5, True, "3", None, np.int64(2), np.nan]))
angles = st.one_of(arrays([(4,), (3,), (4, 2)]), plain())
series = st.one_of(arrays([(5,), (5, 2)]), plain())
by_name = {
    "m": matrices, "d": st.one_of(arrays([(3,), (3, 2)]), plain(), vectors), "axes": gimbals, "curve": st.one_of(
        arrays([(3, 4)]).map(lambda a: detection.Roc(*a)), tuples(detection.Roc)), "now": now, "n": whole, "longest": whole,
    "fault": fault, "faults": st.one_of(fault, st.lists(fault, max_size=3)), "c": tuples(faults.Channel), "m_": whole,
    "t": tuples(Vec3), "points": st.one_of(st.integers(-2, 4), junk), "threshold": st.one_of(good(2, 200), plain()),
    "gamma": angles, "evaluation": series, "alarms": series, "causes": whole, "tree": st.one_of(plain(), vectors, junk),
    "matrix": st.one_of(arrays([(2, 2), (3, 3), (4, 3, 3)]), plain()), "A": st.one_of(arrays([(2, 2)]), plain()),
    "H": st.one_of(arrays([(1, 2), (2, 2)]), plain()), "scale": st.one_of(arrays([(2,)]), plain()),
    "duration": st.one_of(good(0.1, 10), plain()), "samples": st.one_of(st.integers(-2, 20), junk),
    "healthy": series, "faulty": series, "thresholds": st.one_of(st.none(), series), "which": st.one_of(
        st.lists(st.integers(-1, 4), max_size=5), plain()), "signs": st.one_of(arrays([(4,), (3,)]), plain()),
    "truth": st.one_of(st.lists(st.integers(0, 3), max_size=4), plain()),
    "verdict": st.one_of(st.lists(st.integers(0, 5), max_size=4), plain()), "rank": st.sampled_from(
        [None, lambda options: options.sum(1), "a", 3]), "tol": plain(), "h": st.one_of(arrays([(3,)]), plain()),
    "limit": st.one_of(good(0.01, 0.3), plain()), "step": st.one_of(good(0.01, 0.3), plain()),
}  # fmt: skip
by_kind = {"Vec3": vectors, "Quat": quaternions, "Mat3": matrices, "Fault": fault, "GimbalAxes": gimbals, "int": whole}
SLOW = {"clearance", "reach", "envelope", "singular_area", "rearrange_by_gradient"}  # entries of their own, below


def public(module, *but):
    here = [f for f in vars(module).values() if inspect.isfunction(f) and f.__module__ == module.__name__]
    return [f for f in here if not f.__name__.startswith("_") and f.__name__ not in {*but, *SLOW}]


PARTS = [
    *public(attitude),
    *public(vec, "once"),
    *public(mounting),
    *public(faults),
    *public(detection),
    *public(objectives, "weighted"),
    *public(scores, "is_tally", "empty", "add", "values"),
    *public(singularity),
    linear.growth_rates,
    linear.observability_rank,
]


def argument(f, name, note):
    if name == "name":
        return st.just("axes" if f is mounting.check_gimbal_axes else "fault")
    if f.__module__ == "jaxatt.singularity" and name == "m":
        return whole
    if f.__module__ != "jaxatt.singularity" and name == "t":
        return plain()
    return by_kind.get(note, by_name.get(name, plain()))


@pytest.mark.parametrize("f", PARTS, ids=lambda f: f"{f.__module__.split('.')[1]}.{f.__name__}")
def test_parts(f):
    wanted = inspect.signature(f).parameters
    strategies = {
        name: argument(f, name, str(p.annotation)) for name, p in wanted.items() if p.kind is not p.VAR_KEYWORD
    }

    @fuzzed
    @given(st.fixed_dictionaries(strategies))
    def run(arguments):
        judged(f, [*wanted, f.__name__], **arguments)

    run()


# the verbs, on a loop that compiles at once


class Params(NamedTuple):
    gain: Any = 0.3


class Scenario(NamedTuple):
    start: Any = 1.0
    stiffness: Any = 4.0


class X(NamedTuple):
    position: Any
    speed: Any


def refuse_bad(params, scenario):
    lanes = check.shapes(params, scenario, Params(), Scenario())
    check.finite("params", params)
    return lanes


LOOP = System(
    init=lambda params, scenario: (X(scenario.start, 0.0), 0.0),
    tick=lambda params, scenario, now, x, z, noise: (x, -params.gain * (x.speed + noise[0]), x.position),
    flow=lambda params, scenario, t, x, z: X(x.speed, z - scenario.stiffness * x.position),
    dt=0.1,
    normals=1,
    check=refuse_bad,
)
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
SCORES = [lambda params, scenario, now, log: scores.rms(log**2), None, 3]
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


# the shipped loops: their numbers, spoiled


LOOPS = {
    "observer_pd": (observer_pd.system, observer_pd),
    "gyro_ekf": (gyro_ekf.system, gyro_ekf),
    "gyro_ekf.direct": (gyro_ekf.direct, gyro_ekf),
    "cmg_loss": (cmg_loss.system, cmg_loss),
    "star_isolation": (star_isolation.system, star_isolation),
    "wheel_mrac": (wheel_mrac.system, wheel_mrac),
    "wheel_mrac.sampled": (wheel_mrac.sampled, wheel_mrac),
}


@st.composite
def spoiled(draw, tree):
    """A tree with one to three of its leaves or parts replaced."""
    for _ in range(draw(st.integers(0, 3))):
        paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(tree)]
        if not paths:
            break
        path = list(draw(st.sampled_from(paths)))[: draw(st.sampled_from([1, 2, 9, 9, 9, 9]))]
        tree = replaced(tree, path, draw(st.one_of(plain(), odd, good(-10, 10))))
    return tree


def replaced(tree, path, value):
    if not path:
        return value
    step = path[0]
    name = getattr(step, "name", None)
    if name is not None:
        return tree._replace(**{name: replaced(getattr(tree, name), path[1:], value)})
    return value


@pytest.mark.parametrize("name", LOOPS)
def test_numbers_of_the_shipped_loops(name):
    system, module = LOOPS[name]
    lanes = st.sampled_from([(), (), (2,)])
    traced = {}

    @fuzzed
    @given(st.data())
    def run(data):
        n = data.draw(lanes)
        scenario = jax.tree.map(lambda a: np.broadcast_to(np.asarray(a)[..., None], (*np.shape(a), *n)) if n else a,
                                module.scenario)  # fmt: skip
        kind = data.draw(st.sampled_from([np.float64, np.float64, np.float32]))
        given_ = [data.draw(spoiled(jax.tree.map(kind, t))) for t in (module.params, scenario)]
        before = len(compiled)
        door = lambda params, scenario: admit(system, params, scenario, n)
        if judged(door, {"params", "scenario"}, *given_):
            made = admitted(system, *given_)
            dtype = str(check.float_type(made))
            if (n, dtype) not in traced and EXAMPLES > 50:  # numbers cannot make it fail: one trace serves all
                keys = jax.random.split(KEY, n) if n else KEY
                traced[n, dtype] = jax.eval_shape(lambda p, s: simulate(system, p, s, keys, ticks=3), *made)
        else:
            assert len(compiled) == before, "refused, but something was compiled"

    run()


def admitted(system, params, scenario):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return admit(system, params, scenario)


# entries that cost more


@fuzzed
@given(
    f=st.sampled_from(sorted(SLOW)),
    axes=st.one_of(tuples(GimbalAxes, vectors), junk),
    other=st.one_of(plain(), junk),
)
def test_slow_parts_refuse_what_is_no_cluster(f, axes, other):
    f = getattr(singularity, f)
    names = list(inspect.signature(f).parameters)
    judged(f, [*names, f.__name__], axes, *([other] if len(names) > 1 else []))


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
