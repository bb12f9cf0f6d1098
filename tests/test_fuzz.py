"""Abuse of the numbers of the shipped loops: every spoiled leaf is refused, or taken, before anything is compiled.

And whether every public function that meets a user's data is abused at all, here or in ``test_fuzz_*``.
"""

import importlib
import inspect
import pkgutil

import jax
import numpy as np
import pytest
import test_fuzz_files
import test_fuzz_identify
import test_fuzz_rare
import test_fuzz_verbs
from abuse import EXAMPLES, fuzzed, good, judged, odd, plain, tidy
from hypothesis import given
from hypothesis import strategies as st
from made_up import compilations, repeated

import jaxatt.loops
from jaxatt import check, plot, rare
from jaxatt.contract import System
from jaxatt.engine import simulate, validated

KEY = jax.random.key(0)


# is it all of them?


MEETING = [
    "campaign",
    "design_point",
    "evaluation",
    "exporting",
    "identify",
    "innovations",
    "loss",
    "plot",
    "pointing",
    "rare",
    "reliability",
    "replay",
    "sweeping",
    "tables",
    "tuning",
    "view",
    "campaign.designs",
    "campaign.summary",
]
# public for the modules of the house: what they get has been checked before
HOUSE = {
    "sweeping": "block_log block_of block_records block_scores by_block logged progress_bar recorded score_shapes scored scores_of",
    "design_point": "sloped",
    "identify": "posterior",
    "innovations": "likelihood surprise",
    "loss": "log_t said wilson",
    "reliability": "score_slopes",
}


def public(module):
    """Its public functions: those that it lists, or all that it defines."""
    names = getattr(module, "__all__", [name for name in vars(module) if not name.startswith("_")])
    found = [getattr(module, name) for name in names]
    mine = lambda f: inspect.isfunction(f) and f.__module__.startswith(module.__name__)
    return {inspect.unwrap(f) for f in found if mine(f)}


@pytest.mark.parametrize("name", MEETING)
def test_every_public_function_that_meets_data_is_abused(name):
    here = [f for module in (test_fuzz_files, test_fuzz_verbs, test_fuzz_identify) for f in vars(module).values()]
    abused = {inspect.unwrap(f) for f in here if inspect.isfunction(f)}
    abused |= {inspect.unwrap(getattr(plot, figure)) for figure in test_fuzz_verbs.FIGURES}
    abused |= {getattr(rare, verb) for verb in test_fuzz_rare.VERBS}
    forgotten = {f.__name__ for f in public(importlib.import_module(f"jaxatt.{name}")) - abused}
    assert forgotten == set(HOUSE.get(name, "").split())


# the shipped loops: their numbers, spoiled


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
    name = getattr(path[0], "name", None)
    return tree if name is None else tree._replace(**{name: replaced(getattr(tree, name), path[1:], value)})


def many_of(system, params, scenarios):
    """What `sweep` does first."""
    return validated(system, params, scenarios, check.batch_size("scenarios", scenarios))


@pytest.mark.parametrize("name", [module.name for module in pkgutil.iter_modules(jaxatt.loops.__path__)])
def test_numbers_of_the_shipped_loops(name):
    loop, traced = importlib.import_module(f"jaxatt.loops.{name}"), set()
    systems = [system for system in vars(loop).values() if isinstance(system, System)]

    @fuzzed
    @given(st.data())
    def run(data):
        many = data.draw(st.sampled_from([False, False, True]))
        kind = data.draw(st.sampled_from([np.float64, np.float64, np.float32]))
        scenario = repeated(loop.scenario, 2) if many else loop.scenario
        params, scenario = (data.draw(spoiled(jax.tree.map(kind, tree))) for tree in (loop.params, scenario))
        system = data.draw(st.sampled_from(systems))
        before = len(compilations)
        said = judged(many_of if many else validated, {"params", "scenarios"}, system, params, scenario)
        assert len(compilations) == before, "compiled, before all was checked"
        if said or many or EXAMPLES == 50:
            return
        made = check.converted(params, scenario)
        if (case := (system, str(check.float_type(made)))) not in traced:  # numbers cannot make it fail: once is enough
            traced.add(case)
            jax.eval_shape(lambda p, s: simulate(system, p, s, KEY, ticks=3), *made)

    run()
    tidy()
