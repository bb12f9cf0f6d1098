import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt import scores
from jaxatt.study import rerun, sweep
from jaxatt.systems import observer_pd as op

ROOT = Path(__file__).parents[1]
KEY = jax.random.key(11)
TICKS = 23


def many(n):
    """n scenarios that differ in every leaf but the flags."""
    rng = np.random.default_rng(4)
    spread = lambda a: np.full(n, a) * (1 + 0.01 * rng.uniform(size=n))
    scenarios = jax.tree.map(spread, op.scenario)
    flags = jax.tree.map(lambda f: np.full(n, f), (op.scenario.sign, op.scenario.star, op.scenario.gyro))
    J = jax.tree.map(lambda a: np.full(n, a), op.scenario.J)
    star, gyro = (f._replace(x=f.x._replace(onset=np.full(n, 1.0))) for f in flags[1:])
    return scenarios._replace(sign=flags[0], star=star, gyro=gyro, J=J)


def first(scenarios, n):
    return jax.tree.map(lambda a: a[..., :n], scenarios)


def same_bits(a, b):
    return all(np.array_equal(x, y, equal_nan=True) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b)))


SWEEP = """
import sys, jax, numpy as np
jax.config.update("jax_enable_x64", sys.argv[2] == "float64")
sys.path.insert(0, "tests")
from test_study import KEY, TICKS, many, op, sweep
assert jax.local_device_count() == int(sys.argv[3])
scores = sweep(op.system, op.params, many(1000), KEY, ticks=TICKS, score=op.score, progress=False)
np.savez(sys.argv[1], *scores)
"""


@pytest.fixture(scope="module")
def thousand():
    return sweep(op.system, op.params, many(1000), KEY, ticks=TICKS, score=op.score)


def test_a_scenario_does_not_depend_on_how_many_are_swept_nor_on_being_rerun(thousand):
    one = sweep(op.system, op.params, first(many(1000), 1), KEY, ticks=TICKS, score=op.score)
    assert same_bits(one, first(thousand, 1))
    tenfold = jax.tree.map(lambda a: np.concatenate([a] * 10, axis=-1), many(1000))
    ten_thousand = sweep(op.system, op.params, tenfold, KEY, ticks=TICKS, score=op.score)
    assert same_bits(first(ten_thousand, 1000), thousand)
    assert not same_bits(jax.tree.map(lambda a: a[1000:2000], ten_thousand), thousand)  # other noise
    for i in (0, 500, 999):
        log = rerun(op.system, op.params, many(1000), KEY, i, ticks=TICKS)
        scenario = jax.tree.map(lambda a, i=i: jnp.asarray(a[i]), many(1000))
        onset = float(op.first_onset((*scenario.star, *scenario.gyro)))
        times = np.arange(TICKS) * op.DT
        alarms = times[np.asarray(log.alarm) & (times >= onset)]
        assert thousand.delay[i] == (alarms[0] - onset if len(alarms) else np.inf)
        peak = jnp.max(jnp.stack([op.norm(u) for u in zip_vec(log.u)]))
        assert thousand.peak_u[i] == pytest.approx(float(peak), rel=1e-15)


def zip_vec(u):
    return [type(u)(*row) for row in zip(*u)]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_one_device_or_two_give_the_same_bits(dtype, tmp_path):
    results = []
    for devices in (1, 2):
        env = os.environ | {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}", "PYTHONPATH": str(ROOT)}
        out = tmp_path / f"{devices}.npz"
        subprocess.run([sys.executable, "-c", SWEEP, out, dtype, str(devices)], env=env, cwd=ROOT, check=True)
        results.append(dict(np.load(out)))
    assert same_bits(*results)
    assert results[0]["arr_5"].dtype == np.dtype(dtype)


def test_a_traced_sweep_gives_the_same_numbers(thousand):
    f = jax.jit(lambda params: sweep(op.system, params, first(many(1000), 150), KEY, ticks=TICKS, score=op.score))
    for a, b in zip(f(op.params), first(thousand, 150)):
        np.testing.assert_allclose(a, b, rtol=1e-9)


def test_a_bad_scenario_leaves_the_others_alone(thousand):
    scenarios = many(1000)
    scenarios.w.x[3] = 1e200  # overflows
    swept = sweep(op.system, op.params, scenarios, KEY, ticks=TICKS, score=op.score)
    others = np.arange(1000) != 3
    assert not swept.ok[3] and swept.ok[others].all()
    assert same_bits(jax.tree.map(lambda a: a[others], swept), jax.tree.map(lambda a: a[others], thousand))


@pytest.mark.parametrize(
    ("scenarios", "message"),
    [
        (lambda s: s._replace(std_q=0.1), r"`scenarios\.std_q` must carry the scenarios in its last axis"),
        (
            lambda s: s._replace(std_q=np.zeros(9)),
            r"`scenarios\.std_q` must hold 10 scenarios in its last axis, but its",
        ),
        (lambda s: first(s, 0), "`scenarios` must hold at least one scenario"),
        (
            lambda s: s._replace(std_w=np.full(10, -1.0)),
            r"`scenario\.std_w` must not be negative, but it is -1 in scenario 0",
        ),
    ],
)
def test_bad_sweeps_are_refused(scenarios, message):
    with pytest.raises(ValueError, match=message):
        sweep(op.system, op.params, scenarios(many(10)), KEY, ticks=TICKS, score=op.score)


def test_rerun_refuses_an_index_that_is_none():
    with pytest.raises(ValueError, match="`index` must be less than the 10 scenarios, but it is 10"):
        rerun(op.system, op.params, many(10), KEY, 10, ticks=TICKS)


def test_the_bar_is_shown_when_asked_for(capsys):
    sweep(op.system, op.params, first(many(1000), 3), KEY, ticks=TICKS, score=op.score, progress=True)
    assert "scenarios" in capsys.readouterr().err


def test_scores_of_a_user(thousand):
    swept = sweep(op.system, op.params, first(many(1000), 5), KEY, ticks=TICKS, score=lambda p, s, now, log: {
        "all": scores.mean(True), "gain": scores.final(log.k_w)})  # fmt: skip
    assert (swept["all"] == 1).all() and swept["gain"].shape == (5,)
