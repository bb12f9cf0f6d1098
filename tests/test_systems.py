"""What every shipped loop must do, whatever it is: one table."""

import importlib
import inspect
import pkgutil
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxatt.systems
from jaxatt import scores, simulate, sweep
from jaxatt.study import batch, varied

NAMES = [module.name for module in pkgutil.iter_modules(jaxatt.systems.__path__)]
KEY = jax.random.key(8)
TICKS = 30
# compiles in two thirds of the time what no optimisation should change
QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}

pytestmark = pytest.mark.parametrize("name", NAMES)


@pytest.fixture
def loop(name):
    return importlib.import_module(f"jaxatt.systems.{name}")


def test_it_ends_in_its_three_names_and_is_hashable(loop):
    hash(loop.system)
    assert {"system", "params", "scenario"} <= set(vars(loop))
    for data in (loop.params, loop.scenario):
        assert data._fields


def test_on_board_code_cannot_see_the_truth(loop):
    assert list(inspect.signature(loop.sense).parameters)[:5] == ["params", "scenario", "now", "x", "z"]
    seen = list(inspect.signature(loop.decide).parameters)
    assert seen[:2] == ["params", "now"] and not {"x", "scenario", "truth"} & set(seen)


def test_single_runs_lanes_vmap_and_a_design_study_agree(loop):
    keys = jax.random.split(KEY, 3)
    quick = partial(jax.jit, compiler_options=QUICK)
    run = lambda scenario, key: simulate(loop.system, loop.params, scenario, key, ticks=TICKS)
    one, lanes = (quick(run)(*given) for given in ((loop.scenario, keys[1]), (batch(loop.scenario, 3), keys)))
    mapped = quick(jax.vmap(lambda key: run(loop.scenario, key)))(keys)
    study = quick(lambda pairs: simulate(varied(loop.system), (), pairs, keys, ticks=TICKS))
    designs = study(batch((loop.params, loop.scenario), 3))
    for a, b, c, d in zip(*map(jax.tree.leaves, (one, lanes, mapped, designs))):
        b, d = (jnp.broadcast_to(leaf, (*a.shape, 3))[..., 1] for leaf in (b, d))
        # A leaf below 1e-6 may be all rounding, as the drift of a conserved momentum is: it has no scale of its own.
        scale = np.nanmax(np.abs(np.where(np.isfinite(a), a, 0)), initial=1e-6)
        np.testing.assert_allclose(b, a, rtol=1e-10, atol=1e-10 * scale)
        np.testing.assert_allclose(c[1], a, rtol=1e-10, atol=1e-10 * scale)
        np.testing.assert_allclose(d, a, rtol=1e-10, atol=1e-10 * scale)


def test_two_sets_of_numbers_compile_once(loop):
    def score(params, scenario, now, log):
        score.traces += 1
        return scores.always(True)

    score.traces = 0
    leaves = jax.tree.map(lambda a: a * 1.0 if isinstance(a, float) else a, loop.params)
    sweep(loop.system, leaves, batch(loop.scenario, 2), KEY, ticks=10, score=score)
    before = score.traces
    other = batch(loop.scenario, 200)
    sweep(loop.system, jax.tree.map(jnp.asarray, loop.params), other, jax.random.key(9), ticks=10, score=score)
    assert score.traces == before


def test_its_scores_are_tallies_and_nan_in_one_scenario_is_flagged_there_alone(loop):
    scenario = jax.tree.map(lambda a: np.array(a), batch(loop.scenario, 4))
    system = loop.system._replace(check=lambda params, scenario: None)
    clean = sweep(system, loop.params, scenario, KEY, ticks=TICKS, score=loop.score)
    assert clean.ok.shape == (4,) and clean.ok.dtype == bool and clean.ok.all()
    assert all(a.shape[-1] == 4 for a in jax.tree.leaves(clean))
    bad = next(leaf for leaf in jax.tree.leaves(scenario) if leaf.dtype.kind == "f")
    bad[..., 2] = np.nan
    hurt = sweep(system, loop.params, scenario, KEY, ticks=TICKS, score=loop.score)
    assert hurt.ok.tolist() == [True, True, False, True]
    for a, b in zip(jax.tree.leaves(clean), jax.tree.leaves(hurt)):
        np.testing.assert_array_equal(a[..., [0, 1, 3]], b[..., [0, 1, 3]])


def test_every_number_of_the_scenario_must_be_one(loop):
    nan = jax.tree.map(lambda a: a if isinstance(a, (bool, np.bool_)) else np.nan, loop.scenario)
    with pytest.raises(ValueError, match=r"`scenario[.\[\]\w]*`? must|`scenario"):
        simulate(loop.system, loop.params, nan, KEY, ticks=3)
