"""Many runs in memory. The blocks hold 128 scenarios, hence the sizes."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_up import compilations, repeated
from toy import SYSTEM, Params, Scenario

from jaxatt import check, scores
from jaxatt.compiling import configure
from jaxatt.engine import prepared, simulate
from jaxatt.noise import noise_of, one_key
from jaxatt.sweeping import block_of, block_records, rerun, scored, sweep, varied

ROOT = Path(__file__).parents[1]
KEY = jax.random.key(11)
TICKS = 23


def many(n, dtype: Any = np.float64):
    """n scenarios that differ in every leaf; the first ones are the same for every n."""
    stiffness, start = np.random.default_rng(4).uniform(size=(n, 2)).astype(dtype).T
    return Scenario(2 * start - 1, 3 + 2 * stiffness)


def score(params, scenario, now, log):
    return dict(
        rms=scores.rms(log.position**2),
        last=scores.final(jnp.stack([log.position, log.u])),
        ok=scores.always(scores.finite(log)),
    )


def swept(scenarios, params=Params(), key=KEY, ticks=TICKS):  # noqa: B008
    return sweep(SYSTEM, params, scenarios, key, ticks=ticks, score=score)


def taken(tree, which):
    return jax.tree.map(lambda a: a[which], tree)


def same_bits(a, b):
    return all(
        np.array_equal(x, y, equal_nan=True) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


@pytest.fixture(scope="module")
def three_hundred():
    return swept(many(300))


def test_scores_lead_with_the_scenarios(three_hundred):
    assert jax.tree.map(np.shape, three_hundred) == dict(rms=(300,), last=(300, 2), ok=(300,))
    assert isinstance(three_hundred["rms"], np.ndarray) and three_hundred["ok"].all()


@pytest.mark.parametrize("i", [0, 127, 128, 299])
def test_a_score_is_that_of_the_single_run_with_the_noise_of_the_scenario(three_hundred, i):
    noise = noise_of(SYSTEM, KEY, i, TICKS)
    log = simulate(SYSTEM, Params(), taken(many(300), i), noise, ticks=TICKS)
    assert three_hundred["rms"][i] == pytest.approx(np.sqrt(np.mean(log.position**2)), rel=1e-12)
    np.testing.assert_allclose(three_hundred["last"][i], [log.position[-1], log.u[-1]], rtol=1e-12)


def test_a_scenario_does_not_depend_on_how_many_are_swept(three_hundred):
    assert same_bits(swept(many(1)), taken(three_hundred, slice(1)))
    twice = jax.tree.map(lambda a: np.concatenate([a, a]), many(300))
    six_hundred = swept(twice)
    assert same_bits(taken(six_hundred, slice(300)), three_hundred)
    assert not same_bits(taken(six_hundred, slice(300, 600)), three_hundred)  # other noise


@pytest.mark.parametrize("i", [0, 127, 128, 299])
def test_rerun_is_the_sweep_of_that_scenario_bit_for_bit(three_hundred, i):
    log = rerun(SYSTEM, Params(), many(300), KEY, i, ticks=TICKS)
    assert jax.tree.map(np.shape, log) == type(log)((TICKS,), (TICKS,))
    assert [log.position[-1], log.u[-1]] == three_hundred["last"][i].tolist()


ELSEWHERE = """
import sys
sys.path.insert(0, "tests")
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
from test_sweeping import many, swept
assert jax.local_device_count() == 3
found = [swept(many(600, kind)) for kind in (np.float32, np.float64)]
np.savez(sys.argv[1], *jax.tree.leaves(found))
"""


def test_one_device_or_three_give_the_same_bits(tmp_path):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=3"
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", ELSEWHERE, tmp_path / "x.npz"], env=environment, cwd=ROOT, check=True)
    here = jax.tree.leaves([swept(many(600, kind)) for kind in (np.float32, np.float64)])
    there = list(np.load(tmp_path / "x.npz").values())
    assert same_bits(here, there)
    assert [a.dtype for a in there[2::3]] == [np.float32, np.float64]


def test_one_core_or_three_give_the_same_bits(three_hundred):
    with jax.enable_x64(False):
        short = swept(many(300, np.float32))
    for cores in (1, 3):
        configure(cores=cores)
        assert same_bits(swept(many(300)), three_hundred)
        with jax.enable_x64(False):  # which holds in this thread only
            found = swept(many(300, np.float32))
        assert same_bits(found, short) and found["rms"].dtype == np.float32
    configure()


def test_an_error_in_one_block_ends_the_sweep():
    def fail(n):
        raise RuntimeError(f"{n} more")

    configure(cores=2)
    with pytest.raises(RuntimeError, match="128 more"):
        scored(SYSTEM, *prepared(SYSTEM, Params(), many(900)), one_key(KEY), TICKS, score, advance=fail)
    configure()


def test_another_number_of_scenarios_key_params_and_ticks_compile_nothing(three_hundred):
    one, other = jax.random.key(1), jax.random.key(2)
    scenarios = jax.tree.map(jnp.asarray, many(300))
    before = len(compilations)
    swept(many(500), Params(np.float64(0.5)), one, TICKS + 8)
    swept(scenarios, Params(1), other, 1)
    assert len(compilations) == before


@pytest.mark.parametrize("ticks", [1, 10, 11])
def test_a_sweep_runs_as_many_ticks_as_it_is_told(ticks):
    count = lambda params, scenario, now, log: (scores.total(1.0), scores.final(now.t))
    total, last = sweep(SYSTEM, Params(), many(2), KEY, ticks=ticks, score=count)
    assert total.tolist() == [ticks] * 2
    np.testing.assert_allclose(last, 0.2 * (ticks - 1), rtol=1e-15)


def test_a_traced_sweep_gives_the_same_numbers(three_hundred):
    traced = jax.jit(lambda gain: swept(many(150), Params(gain)))(0.3)
    for a, b in zip(jax.tree.leaves(traced), jax.tree.leaves(taken(three_hundred, slice(150)))):
        np.testing.assert_allclose(a, b, rtol=1e-9)


def test_the_gradient_of_a_sweep_is_the_difference_quotient():
    loss = lambda gain: jnp.mean(swept(many(5), Params(gain))["rms"])
    central = (loss(0.3 + 1e-5) - loss(0.3 - 1e-5)) / 2e-5
    assert jax.jit(jax.grad(loss))(0.3) == pytest.approx(float(central), rel=1e-6)


def test_a_bad_scenario_leaves_the_others_alone(three_hundred):
    scenarios = many(300)
    scenarios.stiffness[3] = 1e300  # overflows
    found, others = swept(scenarios), np.arange(300) != 3
    assert not found["ok"][3] and found["ok"][others].all()
    assert same_bits(taken(found, others), taken(three_hundred, others))


def test_varied_params_are_a_sweep_of_pairs(three_hundred):
    gains = np.where(np.arange(140) < 130, 0.3, 0.9)
    pairs = Params(gains), many(140)
    found = sweep(varied(SYSTEM), (), pairs, KEY, ticks=TICKS, score=varied(score))
    np.testing.assert_allclose(found["rms"][:130], three_hundred["rms"][:130], rtol=1e-13)
    other = swept(many(140), Params(0.9))
    np.testing.assert_allclose(found["rms"][130:], other["rms"][130:], rtol=1e-13)
    assert not np.isclose(found["rms"][130:], three_hundred["rms"][130:140], rtol=1e-6).any()


def test_varied_of_one_pair_is_the_single_run():
    one = simulate(SYSTEM, Params(0.7), Scenario(), KEY, ticks=TICKS)
    pair = simulate(varied(SYSTEM), (), (Params(0.7), Scenario()), KEY, ticks=TICKS)
    np.testing.assert_allclose(pair, one, rtol=1e-13)


def test_varied_of_equal_systems_is_one_object():
    assert varied(SYSTEM) is varied(SYSTEM._replace()) and varied(score) is varied(score)
    with pytest.raises(TypeError, match=r"^`loop` must be a function, but it is 3\.$"):
        varied(3)  # pyright: ignore[reportCallIssue, reportArgumentType]


def test_scores_may_have_axes_of_their_own_and_any_tree():
    one = lambda params, scenario, now, log: [scores.peak(jnp.arange(6.0).reshape(2, 3) * log.u), (scores.mean(True),)]
    peak, (mean,) = sweep(SYSTEM, Params(), many(5), KEY, ticks=TICKS, score=one)
    assert peak.shape == (5, 2, 3) and mean.tolist() == [1.0] * 5


def test_records_of_a_block_are_the_reruns():
    here = block_of(many(130), 1)
    assert here.start.shape == (128,) and (here.start[1:] == many(130).start[-1]).all()
    key = jax.random.key_data(KEY)
    kept = block_records(SYSTEM, lambda log: log.u, TICKS, 4, Params(), here, key, 1)
    assert kept.shape == (6, 128)
    log = rerun(SYSTEM, Params(), many(130), KEY, 129, ticks=TICKS)
    np.testing.assert_allclose(kept[:, 1], log.u[::4], rtol=1e-12)


def test_the_bar_is_shown_when_asked_for(capsys):
    sweep(SYSTEM, Params(), many(3), KEY, ticks=TICKS, score=score, progress=True)
    assert "scenarios" in capsys.readouterr().err
    sweep(SYSTEM, Params(), many(3), KEY, ticks=TICKS, score=score)
    assert capsys.readouterr().err == ""


# what is refused


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(scenarios=()), ValueError, "`scenarios` must hold at least one array, but it is empty"),
        (dict(scenarios=taken(many(3), slice(0))), ValueError, "`scenarios` must hold at least one scenario, but it is empty"),
        (dict(scenarios=Scenario(np.ones(10))), ValueError, r"`scenarios\.stiffness` must lead with the scenarios, shape \(n, \.\.\.\), but it is a single number"),
        (dict(scenarios=Scenario(np.ones(9), np.ones(10))), ValueError, r"`scenarios\.start` must lead with the same 10 scenarios as the other leaves, but it is of shape \(9,\)"),
        (dict(scenarios=Scenario(np.ones(9), -np.arange(9.0))), ValueError, r"`scenario\.stiffness` must not be negative, but it is -1 in scenario 1"),
        (dict(scenarios=Scenario(np.ones(9), np.ones((9, 2)))), ValueError, r"`scenario\.stiffness` must have shape \(\) in each scenario, but it is of shape \(9, 2\)"),
        (dict(params=Params(np.ones(10))), ValueError, r"`params\.gain` must have shape \(\)"),
        (dict(ticks=0), ValueError, "`ticks` must be a whole number of at least 1, but it is 0"),
        (dict(key=3), TypeError, "`key` must be a key of jax"),
        (dict(key=jax.random.split(KEY, 2)), ValueError, r"`key` must be one key, but it is of shape \(2,\)"),
        (dict(score=None), TypeError, "`score` must be a function, but it is None"),
        (dict(score=lambda p, s, now, log: log.u), TypeError, "`score` must return a tree of tallies"),
        (dict(system=None), TypeError, "`system` must be a System, but it is None"),
    ],
)  # fmt: skip
def test_bad_sweeps_are_refused(change, error, message):
    arguments = dict(system=SYSTEM, params=Params(), scenarios=many(10), key=KEY, ticks=TICKS, score=score) | change
    with pytest.raises(error, match=f"^{message}"):
        sweep(**arguments)


def test_rerun_refuses_an_index_that_is_none():
    with pytest.raises(ValueError, match=r"^`index` must be less than the 10 scenarios, but it is 10\.$"):
        rerun(SYSTEM, Params(), many(10), KEY, 10, ticks=TICKS)
    with pytest.raises(ValueError, match=r"^`index` must be a whole number of at least 0, but it is -1\.$"):
        rerun(SYSTEM, Params(), many(10), KEY, -1, ticks=TICKS)


def test_the_check_of_the_system_sees_the_scenarios_last():
    seen = []
    system = SYSTEM._replace(
        init=lambda params, scenario: SYSTEM.init(params, Scenario(scenario["start"][0])),
        flow=lambda params, scenario, t, x, z: x,
        check=lambda params, scenario: seen.append(scenario["start"].shape),
    )
    sweep(system, Params(), dict(start=np.ones((7, 2))), KEY, ticks=1, score=score)
    assert seen == [(2, 7)]


def test_equal_scenarios_of_a_repeated_one_meet_other_noise():
    found = swept(repeated(Scenario(), 130))
    assert len(np.unique(found["rms"])) == 130


def test_params_and_pairs_are_not_mixed_up():
    """A varied loop takes its params from pairs alone; another loop takes no pairs, and one set of params."""
    pairs = repeated((Params(0.7), Scenario()), 2)
    with pytest.raises(ValueError, match=r"`params` must be \(\) for a varied loop, whose scenarios are pairs"):
        sweep(varied(SYSTEM), Params(0.3), pairs, KEY, ticks=TICKS, score=varied(score))
    checked = SYSTEM._replace(check=lambda params, scenario: check.kinds(params, Params, scenario, Scenario))
    with pytest.raises(TypeError, match=r"it is a pair \(params, scenario\): `jaxatt\.varied` takes pairs\."):
        sweep(checked, Params(), pairs, KEY, ticks=TICKS, score=score)
    with pytest.raises(
        ValueError, match=r"have shape \(\): the same in all scenarios; `jaxatt\.varied` takes others, but"
    ):
        sweep(SYSTEM, Params(np.ones(2)), repeated(Scenario(), 2), KEY, ticks=TICKS, score=score)
