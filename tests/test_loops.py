"""What every shipped loop must do, whatever it is: one table. Two programs a loop, and of some a third."""

import ast
import importlib
import inspect
import pkgutil
from functools import cache
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from made_up import compilations, repeated, scores_and_last, wide

import jaxatt.loops
from jaxatt import fields
from jaxatt.engine import simulate, validated
from jaxatt.loops import microsat
from jaxatt.noise import noise_of
from jaxatt.sweeping import rerun, scored, sweep, varied

NAMES = [module.name for module in pkgutil.iter_modules(jaxatt.loops.__path__)]
KEY = jax.random.key(8)
TICKS = 30
MAPPED = (
    "observer_pd",
    "gyro_ekf",
    "wheel_mrac",
)  # a flow alone, a covariance in lanes, a sampled computer: all that vmap meets
# compiles in two thirds of the time what no optimisation should change
QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}

pytestmark = pytest.mark.parametrize("name", NAMES, scope="module")  # loop by loop: a worker compiles each once


@pytest.fixture
def loop(name):
    return importlib.import_module(f"jaxatt.loops.{name}")


def scenarios_of(loop, n):
    """Equal scenarios, the wheel faults of microsat four each, as in its own tests, which run the same program."""
    return repeated(wide(loop.scenario) if loop is microsat else loop.scenario, n)


@cache
def swept(name):
    """Four equal scenarios: scores and last logs."""
    loop = importlib.import_module(f"jaxatt.loops.{name}")
    score = scores_and_last(loop.score)
    found = sweep(loop.system, loop.params, scenarios_of(loop, 4), KEY, ticks=TICKS, score=score)
    return SimpleNamespace(scores=found[0], log=found[1])


def paths(tree):
    return {jax.tree_util.keystr(p, simple=True, separator=".") for p, _ in jax.tree_util.tree_leaves_with_path(tree)}


# how it is written


def test_it_ends_in_its_three_names_and_is_hashable(loop):
    body = ast.parse(inspect.getsource(loop)).body
    end = body[max(i for i, node in enumerate(body) if isinstance(node, (ast.FunctionDef, ast.ClassDef))) + 1 :]
    targets = [node.targets[0] for node in end if isinstance(node, ast.Assign)]
    names = [target.id for target in targets if isinstance(target, ast.Name)]
    assert [name for name in names if name in ("system", "params", "scenario")] == ["system", "params", "scenario"]
    assert hash(loop.system) == hash(loop.system._replace())
    assert type(loop.params) is loop.Params and type(loop.scenario) is loop.Scenario


def test_every_number_has_a_unit(name, loop):
    for tree in (loop.params, loop.scenario, swept(name).scores):
        assert paths(tree) <= set(fields.units(tree)), paths(tree) - set(fields.units(tree))


def test_on_board_code_cannot_see_the_truth(loop):
    assert list(inspect.signature(loop.sense).parameters) == ["params", "scenario", "now", "x", "z", "noise"]
    assert list(inspect.signature(loop.decide).parameters)[:3] == ["params", "now", "computer"]
    assert list(inspect.signature(loop.computer_of).parameters) == ["x", "z"]
    for f in (loop.decide, getattr(loop, "computer_flow", loop.decide)):
        assert not {"x", "scenario", "truth"} & set(inspect.signature(f).parameters)


# how it runs


def test_vmap_of_single_runs_design_study_and_rerun_agree(name, loop):
    again = rerun(loop.system, loop.params, scenarios_of(loop, 4), KEY, 1, ticks=TICKS)
    np.testing.assert_allclose(again.t, loop.system.dt * np.arange(TICKS), rtol=1e-12)
    if name not in MAPPED:
        return
    noise = np.stack([noise_of(loop.system, KEY, i, TICKS) for i in range(2)])
    pairs = repeated((loop.params, loop.scenario), 2)
    study = jax.vmap(lambda pair, n: simulate(varied(loop.system), (), pair, n, ticks=TICKS))
    many = jax.tree.map(lambda a: a[1], jax.jit(study, compiler_options=QUICK)(pairs, noise))
    for a, b in zip(*map(jax.tree.leaves, (again, many)), strict=True):
        # A leaf below 1e-5 may be all rounding, as the drift of a conserved momentum is: it has no scale of its own.
        scale = np.nanmax(np.abs(np.where(np.isfinite(a), a, 0)), initial=1e-5)
        np.testing.assert_allclose(b, a, rtol=1e-10, atol=1e-10 * scale)


def test_a_rerun_is_what_was_scored_bit_for_bit(name, loop):
    log = rerun(loop.system, loop.params, scenarios_of(loop, 4), KEY, 1, ticks=TICKS)
    for a, b in zip(jax.tree.leaves(log), jax.tree.leaves(swept(name).log), strict=True):
        np.testing.assert_array_equal(a[-1], b[1])


def test_other_params_scenarios_key_n_and_ticks_compile_nothing(name, loop):
    swept(name)
    key = jax.random.key(9)
    other = lambda a: a if np.asarray(a).dtype.kind != "f" else np.where(np.isin(a, (0, 1)), a, np.asarray(a) * (1 + 1e-9))  # fmt: skip
    params, scenarios = jax.tree.map(other, (loop.params, scenarios_of(loop, 200)))
    before = len(compilations)
    sweep(loop.system, params, scenarios, key, ticks=TICKS - 7, score=scores_and_last(loop.score))
    assert len(compilations) == before


def test_its_scores_are_finite_or_tell_that_nothing_happened(name):
    found = swept(name).scores
    assert found.ok.shape == (4,) and found.ok.dtype == bool and found.ok.all()
    assert all(len(a) == 4 for a in jax.tree.leaves(found))


def test_nan_in_one_scenario_is_flagged_there_alone(name, loop):
    params, scenarios = validated(loop.system, loop.params, scenarios_of(loop, 4), 4)
    scenarios = jax.tree.map(np.array, scenarios)
    bad = next(leaf for leaf in jax.tree.leaves(scenarios) if leaf.dtype.kind == "f")
    bad[2] = np.nan
    hurt, _ = scored(loop.system, params, scenarios, jax.random.key_data(KEY), TICKS, scores_and_last(loop.score))
    assert hurt.ok.tolist() == [True, True, False, True]
    for a, b in zip(jax.tree.leaves(swept(name).scores), jax.tree.leaves(hurt), strict=True):
        np.testing.assert_array_equal(a[[0, 1, 3]], b[[0, 1, 3]])


@pytest.mark.parametrize("part", ["params", "scenario"])
def test_every_number_must_be_one(loop, part):
    given = dict(params=loop.params, scenario=loop.scenario)
    leaves, structure = jax.tree.flatten(given[part])
    for i, (path, leaf) in enumerate(jax.tree_util.tree_leaves_with_path(given[part])):
        if np.asarray(leaf).dtype.kind == "f":
            spoiled = jax.tree.unflatten(structure, [*leaves[:i], np.full(np.shape(leaf), np.nan), *leaves[i + 1 :]])
            with pytest.raises(ValueError) as error:
                validated(loop.system, **given | {part: spoiled})
            assert f"{part}.{path[0].name}" in str(error.value) and "nan" in str(error.value)
