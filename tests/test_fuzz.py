"""Abuse of parts and numbers: a public entry answers with a result or with one line that names the argument.

What is refused is refused by our own code, with no word from inside JAX. Of the shipped loops' functions those that
are called by hand are here; the others run behind the door of the verbs, which is `test_numbers_of_the_shipped_loops`.
"""

import inspect
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_fuzz_files
import test_fuzz_verbs
from abuse import (
    EXAMPLES,
    arrays,
    compiled,
    fault,
    fuzzed,
    good,
    judged,
    junk,
    matrices,
    odd,
    plain,
    quaternions,
    tidy,
    tuples,
    vectors,
    whole,
)  # fmt: skip
from hypothesis import given
from hypothesis import strategies as st

from jaxatt import (
    attitude,
    bodies,
    check,
    controllers,
    detection,
    estimators,
    faults,
    kalman,
    linear,
    lmmse,
    mounting,
    objectives,
    plot,
    scores,
    sensors,
    singularity,
    vec,
)  # fmt: skip
from jaxatt.engine import Now, admit, simulate
from jaxatt.mounting import GimbalAxes, cmg_axes
from jaxatt.systems import cmg_loss, gyro_ekf, observer_pd, star_isolation, wheel_mrac
from jaxatt.vec import Quat, Vec3

KEY = jax.random.key(0)
gimbals = st.one_of(
    st.sampled_from([4, 4, 3, 5, 2, 1]).map(lambda n: cmg_axes(np.radians(54.7), 2 * np.pi / n * np.arange(n))),
    st.just(cmg_axes(np.radians(90.0), np.radians([0.0, 90.0, 180.0]))),
    tuples(GimbalAxes, vectors),
    st.just(cmg_axes(np.zeros(4), np.arange(4.0))),
)
now = st.sampled_from([Now(0, 0.0, 0.1), Now(jnp.asarray(3), jnp.asarray(0.3), 0.1)])
angles = st.one_of(arrays([(4,), (3,), (4, 2)]), plain())
series = st.one_of(arrays([(5,), (5, 2)]), plain())
squares = st.one_of(arrays([(3, 3), (4, 4), (7, 7), (3, 4)]), junk)
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
    "P": st.one_of(squares, plain()), "W": st.one_of(squares, plain()), "S": st.one_of(squares, plain()), "rows": squares,
    "Q": st.one_of(arrays([(3,), (4,)]), plain()), "R": st.one_of(arrays([(3,), (1,)]), plain()), "steady": st.one_of(
        arrays([(0,), (1,), (3,)]), plain()), "value": st.one_of(arrays([(3,), (1,)]), plain()), 
    "rate": angles, "spin": angles, "servo": angles, "brake": angles, "free": angles, "friction": angles, "up": angles,
    "x": st.one_of(plain(), vectors, quaternions), "v": st.one_of(plain(), vectors), "number": st.sampled_from([0, 1, 1, 2, "a"]),
    "module": whole, "mask": st.one_of(arrays([(4,), (4, 2)]), plain()), "normals": st.one_of(arrays([(3,), (3, 2)]), plain()),
    "window": whole, "substeps": whole, "limit": st.one_of(good(0.01, 0.3), plain()), "step": st.one_of(good(0.01, 0.3), plain()),
}  # fmt: skip
by_kind = {"Vec3": vectors, "Quat": quaternions, "Mat3": matrices, "Fault": fault, "GimbalAxes": gimbals, "int": whole}
SLOW = {"clearance", "reach", "envelope", "singular_area", "rearrange_by_gradient"}  # entries of their own, below


def public(module, *but):
    here = [f for f in vars(module).values() if inspect.isfunction(f) and f.__module__ == module.__name__]
    return [f for f in here if not f.__name__.startswith("_") and f.__name__ not in {*but, *SLOW}]


BY_TRACE = [f for m in (kalman, lmmse, estimators, controllers, bodies, sensors) for f in public(m)]  # pure JAX
FITTED = [
    *BY_TRACE, cmg_loss.classify, cmg_loss.lost, gyro_ekf.consistent, gyro_ekf.failed, gyro_ekf.worst, observer_pd.margins,
    star_isolation.on_sensor, star_isolation.orbit_rate, star_isolation.quaternion_error, star_isolation.system_of,
    star_isolation.tangential, wheel_mrac.loop, wheel_mrac.normals_of, wheel_mrac.slew,
]  # fmt: skip
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
    *FITTED,
]


def argument(f, name, note):
    if name == "name":
        return st.just("axes" if f is mounting.check_gimbal_axes else "fault")
    if f.__module__ == "jaxatt.singularity" and name == "m":
        return whole
    if f.__module__ != "jaxatt.singularity" and name == "t":
        return plain()
    if note == "Vec3" and name == "faults":
        return st.one_of(st.just(faults.on_axes(faults.Fault())), tuples(Vec3, fault))
    if note == "Callable":
        return st.sampled_from([lambda x: x[:3], lambda x: x[:3], lambda x: x[:1], lambda x: x, None, 3])
    kind = vars(sys.modules[f.__module__]).get(note)
    if note not in by_kind and hasattr(kind, "_fields"):
        return tuples(kind)
    return by_kind.get(note, by_name.get(name, plain()))


# arguments that fit each other, without lanes: four units, a filter of ``n`` states


def numbers(*shape):
    return st.integers(0, 9).map(lambda seed: np.random.default_rng(seed).normal(size=shape))


def fitting(f, name, note, n):
    kind = vars(sys.modules[f.__module__]).get(note)
    states = {3: lambda a: Vec3(*a), 4: lambda a: Quat(*a), 7: lambda a: lmmse.AttitudeBias(*a)}[n]
    if (f.__name__, name) in FITTING:
        return FITTING[f.__name__, name]
    if kind is kalman.Belief:
        return st.tuples(numbers(n), numbers(n, n)).map(lambda a: kind(*a))
    if kind is lmmse.Estimate:
        return st.tuples(numbers(n).map(states), numbers(n, n)).map(lambda a: kind(*a))
    if name in ("P", "rows", "W") and note != "Vec3":
        return numbers(n, n)
    if name == "x" and "empty" in note:
        return numbers(n).map(states)
    for key in (note, name):
        if key in FITTING:
            return FITTING[key]
    return numbers(len(kind._fields)).map(lambda a: kind(*a)) if hasattr(kind, "_fields") else good(0.1, 2)


turn = st.tuples(numbers(4), numbers(3, 3)).map(lambda a: lmmse.Estimate(Quat(*a[0]), a[1]))
FITTING: dict = {
    "Vec3": numbers(3).map(lambda a: Vec3(*a)), "Mat3": numbers(3, 3).map(vec.mat3), "Fault": st.just(faults.Fault()),
    "Moments": numbers(9, 4).map(lambda a: lmmse.Moments(Quat(*a[0]), a[1:5], a[5:])), "S": numbers(4, 4), "Q": numbers(4, 4),
    "Triads": numbers(3, 3, 4).map(lambda a: mounting.Triads(*(Vec3(*v) for v in a))), "value": numbers(3), "R": numbers(3),
    "AttitudeRate": numbers(2, 3).map(lambda a: estimators.AttitudeRate(*(Vec3(*v) for v in a))), "gamma": numbers(4),
    "GimbalAxes": st.just(cmg_axes(np.radians(54.7), np.radians([0.0, 90.0, 180.0, 270.0]))), "healthy": numbers(4),
    "Reading": numbers(3).map(lambda a: faults.Reading(a, a > 0)), "Callable": st.just(lambda x: x[:3]), "normals": numbers(3),
    ("allocation", "axes"): st.just([Vec3(*a) for a in np.eye(4, 3)]), "up": numbers(4), "rate": numbers(4), "spin": numbers(4),
    "servo": numbers(4), "brake": numbers(4), "free": numbers(4), "friction": numbers(4), "h": numbers(4), "window": st.just(2),
    ("ekf_predict", "Q"): st.just(np.ones(1)), ("ekf_predict", "steady"): st.just(np.ones(1)),
    ("damping", "T"): numbers(3, 4).map(lambda a: Vec3(*a)), ("read_triad", "channels"): st.just(Vec3(*[faults.Channel(0.0, 1.0)] * 3)),
    ("triad", "faults"): st.just(faults.on_axes(faults.Fault())), ("turn_predict", "e"): turn, ("turn_update", "e"): turn,
    ("on_sensor", "faults"): st.just(faults.on_axes(faults.Fault())), "number": st.just(1), "module": st.just(1), "mask": numbers(4), "substeps": st.just(2), "sampled": st.booleans(),
}  # fmt: skip


@st.composite
def nearly_fitting(draw, f, wild):
    """Arguments that fit, none, one or two of them spoiled."""
    n = draw(st.sampled_from([3, 4, 7]))
    notes = {name: str(p.annotation) for name, p in inspect.signature(f).parameters.items()}
    made = {name: draw(fitting(f, name, notes[name], n)) for name in wild}
    for name in draw(st.lists(st.sampled_from(list(wild)), max_size=2)):
        made[name] = draw(wild[name])
    return made


@pytest.mark.parametrize("f", PARTS, ids=lambda f: f"{f.__module__.split('.')[1]}.{f.__name__}")
def test_parts(f):
    wanted = inspect.signature(f).parameters
    strategies = {
        name: argument(f, name, str(p.annotation)) for name, p in wanted.items() if p.kind is not p.VAR_KEYWORD
    }

    def traced(**arguments):
        jax.eval_shape(lambda: (f(**arguments), None)[1])

    @fuzzed
    @given(nearly_fitting(f, strategies) if f in FITTED else st.fixed_dictionaries(strategies))
    def run(arguments):
        judged(traced if f in BY_TRACE else f, [*wanted, f.__name__], **arguments)

    run()
    tidy()


# is it all of them?


HOUSE = {  # public for the modules of the house; a user's input has been through a door before
    "engine": "admit block_log block_records block_scores compiled fast_cpu fit_alone like one_key raw_key traced tree_bytes",
    "study": "logged score_shapes scored",
}


def test_every_public_function_is_abused():
    by_hand = {
        f for module in (test_fuzz_files, test_fuzz_verbs) for f in vars(module).values() if inspect.isfunction(f)
    }
    abused = {*by_hand, *PARTS, *(getattr(singularity, name) for name in SLOW)}
    abused |= {getattr(plot, name) for name in test_fuzz_verbs.FIGURES}
    for name in ("campaign", "designs", "engine", "linear", "plot", "replay", "study", "summary", "tuning"):
        module = sys.modules[f"jaxatt.{name}"]
        forgotten = {f.__name__ for f in public(module) if f not in abused} - set(HOUSE.get(name, "").split())
        assert not forgotten, f"{name}: {forgotten}"


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
        if not judged(door, {"params", "scenario"}, *given_):
            made = admitted(system, *given_)
            dtype = str(check.float_type(made))
            if (n, dtype) not in traced and EXAMPLES > 50:  # numbers cannot make it fail: one trace serves all
                keys = jax.random.split(KEY, n) if n else KEY
                traced[n, dtype] = jax.eval_shape(lambda p, s: simulate(system, p, s, keys, ticks=3), *made)
        else:
            assert len(compiled) == before, "refused, but something was compiled"

    run()
    tidy()


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
