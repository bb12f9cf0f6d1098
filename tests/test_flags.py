"""The verbs under the switches of JAX: without jit, and with its checks."""

import importlib
import pkgutil

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxatt.loops
from jaxatt import campaign, scores
from jaxatt.contract import System
from jaxatt.engine import simulate
from jaxatt.sweeping import rerun, sweep
from jaxatt.tuning import gradient_check, multi_start, tune

KEY = jax.random.key(0)
LOOP = System(  # small: without jit every number is a call
    init=lambda params, start: (start, ()),
    tick=lambda params, start, now, x, z, noise: (x, z, x),
    flow=lambda params, start, t, x, z: -params * x,
    dt=0.2,
)
STARTS = np.linspace(1, 2, 3)
bowl = lambda theta, key: jnp.sum((theta - 1) ** 2)


def score(params, scenario, now, log):
    return dict(rms=scores.rms(log * log), ok=scores.always(scores.finite(log)))


def study():
    sample = lambda key, index: 1 + 0.1 * index.astype(float)
    return campaign.Campaign(LOOP, 0.5, sample, KEY, 3, score, record=lambda log: log)


def verbs(path):
    """What the verbs give of three ticks."""
    best, history = tune(bowl, 0.3, optax.sgd(0.1), 2, KEY)
    data = campaign.run(path, study(), 2)
    return dict(
        simulate=simulate(LOOP, 0.5, 1.0, KEY, ticks=3),
        sweep=sweep(LOOP, 0.5, STARTS, KEY, ticks=3, score=score),
        rerun=rerun(LOOP, 0.5, STARTS, KEY, 1, ticks=3),
        tune=(best, history),
        multi_start=multi_start(bowl, np.array([0.3, 2.0]), optax.sgd(0.1), 2, KEY),
        gradient_check=gradient_check(bowl, 0.3, KEY),
        campaign=[data[name].values for name in ("rms", "ok", "record", "status") if name in data],
    )


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return verbs(tmp_path_factory.mktemp("plain") / "x.zarr")


FLAGS = {
    "jit": lambda: jax.disable_jit(),
    "nans": lambda: jax.debug_nans(True),
    "infs": lambda: jax.debug_infs(True),
    "leaks": lambda: jax.checking_leaks(),
    "promotion": lambda: jax.numpy_dtype_promotion("strict"),
}


@pytest.mark.parametrize("flag", FLAGS)
def test_the_verbs_give_the_same_under_every_switch(flag, plain, tmp_path):
    with FLAGS[flag]():
        found = verbs(tmp_path / "x.zarr")
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-12), found, plain)


def test_x64_switched_after_the_import_gives_the_same_to_float32(plain, tmp_path):
    with jax.enable_x64(False):
        found = verbs(tmp_path / "x.zarr")
    assert found["simulate"].dtype == found["sweep"]["rms"].dtype == found["tune"][1].cost.dtype == np.float32
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6)
    rough = found.pop("gradient_check")
    jax.tree.map(close, found, {name: value for name, value in plain.items() if name != "gradient_check"})
    assert rough.relative.max() < 1e-3
    assert same_types(verbs(tmp_path / "y.zarr"), plain)  # back again


def same_types(a, b):
    return jax.tree.map(lambda x: np.asarray(x).dtype, a) == jax.tree.map(lambda x: np.asarray(x).dtype, b)


LOOPS = [module.name for module in pkgutil.iter_modules(jaxatt.loops.__path__)]


# the leak checker traces everything anew, a minute for the larger loops: one stands for all
@pytest.mark.parametrize("name, flag", [(name, "promotion") for name in LOOPS] + [("observer_pd", "leaks")])
def test_every_loop_and_its_derivatives_are_traced_under_strict_checks(name, flag):
    loop = importlib.import_module(f"jaxatt.loops.{name}")
    floats = lambda tree: [a for a in jax.tree.leaves(tree) if jnp.issubdtype(a.dtype, jnp.floating)]

    def cost(params, scenario):
        log = simulate(loop.system, params, scenario, KEY, ticks=10)  # a whole chunk takes the least tracing
        return sum(jnp.mean(a * a).astype(float) for a in floats(log))

    def found(params, scenarios):
        return sweep(loop.system, params, scenarios, KEY, ticks=3, score=loop.score)

    params, scenario = jax.tree.map(np.float32, (loop.params, loop.scenario))
    many = jax.tree.map(lambda a: np.stack([a, a]), scenario)
    along = lambda params, scenario: jax.jvp(lambda p: cost(p, scenario), (params,), (params,))
    with FLAGS[flag]():
        jax.eval_shape(along, params, scenario)
        jax.eval_shape(found, params, many)
