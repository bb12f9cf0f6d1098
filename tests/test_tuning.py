"""Tuning by gradient: the search itself, on costs with known minima."""

import importlib
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxatt import Fault, System, Vec3, on_axes, scores, simulate, sweep
from jaxatt.cmg import Steering
from jaxatt.loops import cmg_loss as cmg
from jaxatt.loops import gyro_ekf as ge
from jaxatt.loops import observer_pd as op
from jaxatt.loops import star_isolation as si
from jaxatt.loops import wheel_mrac as wm
from jaxatt.soft_scores import soft_alarm, weighted
from jaxatt.tuning import (
    FEW,
    averaged,
    best_of,
    bounded,
    gradient_check,
    multi_start,
    tune,
    value_and_gradient,
    worst_case,
)

ROOT = Path(__file__).parents[1]
KEY = jax.random.key(11)


def bowl(theta, key):
    return jnp.sum((theta["a"] - 3.0) ** 2) + jnp.sum(theta["b"] ** 2) + jax.random.uniform(key)


def test_tune_finds_the_minimum_and_records_the_way():
    theta, history = tune(bowl, {"a": 0.0, "b": np.ones(2)}, optax.adam(0.3), 200, KEY)
    assert theta["a"] == pytest.approx(3, abs=1e-2) and np.abs(theta["b"]).max() < 1e-2
    assert history.cost.shape == (200,) and history.theta["b"].shape == (200, 2)
    assert history.cost[-1] < history.cost[0] and (history.step == 1).all()
    assert history.gradient[0] == pytest.approx(np.sqrt(36 + 8))


def test_forward_and_reverse_mode_agree_and_a_cost_must_be_a_scalar():
    quartic = lambda theta, key: jnp.sum(jnp.sin(theta) ** 4) + theta[0] * theta[-1]
    for n in (2, FEW, FEW + 1):
        theta = jnp.linspace(0.1, 2.0, n)
        value, gradient = value_and_gradient(quartic, theta, KEY)
        assert value == pytest.approx(float(quartic(theta, KEY)))
        np.testing.assert_allclose(gradient, jax.grad(quartic)(theta, KEY), rtol=1e-12)
    with pytest.raises(TypeError, match=r"`cost` must be a scalar, but its shape is \(2,\)"):
        tune(lambda theta, key: theta, np.ones(2), optax.sgd(0.1), 2, KEY)


def test_tune_takes_any_optax_optimizer():
    theta, _ = tune(bowl, {"a": 0.0, "b": 1.0}, optax.lbfgs(), 15, KEY)
    assert theta["a"] == pytest.approx(3, abs=1e-4)


def test_tune_survives_a_step_into_nan_and_keeps_the_best():
    cliff = lambda theta, key: jnp.where(theta < 4, (theta - 3.9) ** 2, jnp.nan)
    theta, history = tune(cliff, 0.0, optax.sgd(0.6), 60, KEY)
    assert np.isnan(history.cost).any() and history.step[-1] < 1
    assert np.nanmin(history.cost) == cliff(theta, KEY) and theta == pytest.approx(3.9, abs=1e-3)


def test_tune_refuses_a_cost_that_is_nan_from_the_start():
    with pytest.raises(ValueError, match="`cost` must be finite, with a finite gradient, at the start, but it is nan"):
        tune(lambda theta, key: theta * jnp.nan, 1.0, optax.sgd(0.1), 3, KEY)
    with pytest.raises(ValueError, match="`steps` must be a whole number of at least 1, but it is 0"):
        tune(bowl, 1.0, optax.sgd(0.1), 0, KEY)


def wavy(theta, key):
    """Two basins, the deeper one at +1, on both sides of a ridge at 0; a little noise in the cost."""
    x = theta["x"]
    return (x * x - 1) ** 2 - 0.2 * x + 0.3 * jnp.sum(theta["y"] ** 2) + 1e-3 * x * jax.random.normal(key)


def start(x=-0.7):
    return {"x": x, "y": np.array([0.5, -0.2])}


# fresh scenarios


def test_fresh_keys_average_out_and_best_is_judged_on_the_searchs_own_key():
    target = lambda theta, key: jnp.sum((theta - jax.random.normal(key, (3,))) ** 2)
    common, _ = tune(target, np.zeros(3), optax.adam(0.05), 300, KEY)
    np.testing.assert_allclose(common, jax.random.normal(KEY, (3,)), atol=0.02)  # fits the one draw it sees
    slow = optax.adam(optax.exponential_decay(0.3, 300, 0.01))
    _, history = tune(target, np.full(3, 4.0), slow, 300, KEY, fresh=True)
    np.testing.assert_allclose(history.theta[-50:].mean(0), 0, atol=0.25)  # the mean over all draws
    assert np.isclose(history.cost, [target(t, KEY) for t in history.theta], rtol=1e-5).all()


# several starts


def test_many_starts_find_the_deeper_basin_and_a_dead_one_costs_nothing():
    cost = lambda theta, key: wavy(theta, key) + jnp.where(theta["x"] > 5, jnp.nan, 0)
    starts = {"x": np.array([-1.3, 9.0, 0.6]), "y": np.ones((3, 2))}
    best, history = multi_start(cost, starts, optax.adam(0.05), 150, KEY)
    assert best["x"] == pytest.approx(1.02, abs=0.02) and history.cost.shape == (150, 3)
    assert np.isnan(history.cost[:, 1]).all() and (history.theta["x"][:, 1] == 9).all()
    alone, single = tune(cost, {"x": -1.3, "y": np.ones(2)}, optax.adam(0.05), 150, KEY)
    np.testing.assert_allclose(history.cost[:, 0], single.cost, rtol=1e-6)
    thetas, costs = best_of(history)
    with pytest.raises(ValueError, match=r"`history.cost` must have shape \(steps, starts\)"):
        best_of(single)
    assert thetas["x"][0] == pytest.approx(float(alone["x"]), abs=1e-6) and costs[1] == np.inf
    with pytest.raises(ValueError, match="`cost` must be finite, with a finite gradient, at the start"):
        multi_start(cost, {"x": np.full(2, 9.0), "y": np.ones((2, 2))}, optax.adam(0.05), 3, KEY)
    with pytest.raises(ValueError, match="`thetas` must lead with the same number of starts in every leaf"):
        multi_start(cost, {"x": np.ones(3), "y": np.ones((2, 2))}, optax.adam(0.05), 3, KEY)


# a long run that is killed


KILLED = """
import os, signal, sys
sys.path.insert(0, "tests")
import conftest, test_tuning as t
from jaxatt import resuming
replaced = []
def die_at_the_ninth(beside, path, replace=os.replace):
    replaced.append(path)
    if len(replaced) == 9:
        os.kill(os.getpid(), signal.SIGKILL)  # the ninth file is written and not yet renamed
    replace(beside, path)
resuming.os.replace = die_at_the_ninth
t.long_run(sys.argv[1])
"""


def long_run(save, steps=40, cost=wavy, key=KEY, x=-0.7, rate=0.1):
    schedule = optax.cosine_decay_schedule(rate, 60)
    return tune(cost, start(x), optax.chain(optax.clip(1.0), optax.adam(schedule)), steps, key, fresh=True, save=save)


def same_bits(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_a_killed_and_resumed_run_equals_an_uninterrupted_one(tmp_path):
    file = tmp_path / "run" / "tune.npz"
    killed = subprocess.run([sys.executable, "-c", KILLED, file], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert killed.returncode == -signal.SIGKILL
    with np.load(file) as held:
        assert len(held["history1"]) == 8
    resumed = long_run(file)
    assert same_bits(resumed, long_run(None)) and same_bits(resumed, long_run(file))
    others: list[dict[str, Any]] = [
        dict(key=jax.random.key(1)), dict(x=0.3), dict(rate=0.2), dict(cost=lambda theta, key: 2 * wavy(theta, key)),
    ]  # fmt: skip
    for other in others:
        with pytest.raises(ValueError, match="`save` must hold a search of the same cost, start, optimizer, key and"):
            long_run(file, **other)
    with pytest.raises(ValueError, match=r"`steps` must not be fewer than the 40 that .* holds, but it is 12"):
        long_run(file, steps=12)


def test_another_table_of_constants_is_another_search(tmp_path):
    data = np.random.default_rng(0).normal(size=20_000)
    run = lambda data: tune(lambda t, _: jnp.mean((t - data) ** 2), 0.0, optax.sgd(0.1), 3, KEY, save=tmp_path / "a")
    run(data)
    data = data.copy()
    data[7777] += 1e-6
    with pytest.raises(ValueError, match="`save` must hold"):
        run(data)


# bounds


def test_bounds_are_a_change_of_variables():
    low = {"gain": 0.0, "share": -1.0, "ratio": 1e-3, "left": -np.inf, "any": -np.inf}
    high = {"gain": np.inf, "share": 3.0, "ratio": 1e3, "left": 2.0, "any": np.inf}
    bounds = bounded(low, high)
    theta = {"gain": np.array([0.5, 20.0]), "share": 2.9, "ratio": 7.0, "left": -5.0, "any": -3.0}
    back = bounds.within(bounds.free(theta))
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(theta)):
        np.testing.assert_allclose(a, b, rtol=1e-5)
    for step in (-30.0, 30.0):
        moved = bounds.within(jax.tree.map(lambda a, step=step: a + step, bounds.free(theta)))
        for name in theta:
            assert (moved[name] >= low[name]).all() and (moved[name] <= high[name]).all()
    middle = bounds.within(jax.tree.map(jnp.zeros_like, theta))
    assert middle["share"] == 1 and middle["ratio"] == pytest.approx(1) and middle["gain"][0] == 1
    box = bounded(np.array([-1.0, 0.0]), np.array([1.0, 5.0]))
    np.testing.assert_allclose(box.within(box.free(np.array([0.5, 4.0]))), [0.5, 4.0], rtol=1e-6)
    np.testing.assert_allclose(bounded(0.0, np.inf).free(jnp.array([1.0, np.e])), [0, 1], atol=1e-6)
    with pytest.raises(ValueError, match=r"`theta\['share'\]` must lie in \(-1\.0, 3\.0\), but it is 3\."):
        bounds.free({**theta, "share": 3.0})
    with pytest.raises(ValueError, match="`low` must be less than high, 1, but it is 2"):
        bounded(2, 1).free(0.5)
    with pytest.raises(ValueError, match="`high` must be finite or infinite throughout"):
        bounded(0.0, np.array([1.0, np.inf])).free(np.array([0.5, 0.5]))


# scenarios as the unknown


def test_the_worst_case_is_found_within_its_box():
    harm = lambda theta, key: jnp.sin(3 * theta["a"]) + 0.1 * theta["a"] - (theta["b"] - 0.2) ** 2
    theta, history = worst_case(harm, dict(a=0.0, b=-1.0), dict(a=4.0, b=1.0), optax.adam(0.2), 80, KEY, starts=6)
    grid = np.linspace(0, 4, 4001)
    assert theta["a"] == pytest.approx(grid[np.argmax(np.sin(3 * grid) + 0.1 * grid)], abs=5e-3)
    assert theta["b"] == pytest.approx(0.2, abs=5e-3)
    assert history.cost.max() == pytest.approx(float(harm(theta, KEY)), abs=1e-5)
    assert (history.theta["a"] > 0).all() and (history.theta["a"] < 4).all()


# devices


TWO_DEVICES = """
import sys, jax, numpy as np
sys.path.insert(0, "tests")
import conftest, test_tuning as t
assert jax.local_device_count() == 2
best, history = t.shared_search()
np.savez(sys.argv[1], best=best, cost=history.cost, gradient=history.gradient)
"""


def shared_search():
    return tune(averaged(swept, 4), np.ones(2), optax.adam(0.1), 3, KEY)


def swept(theta, key):
    """Mean cost of ten noisy oscillators whose damping and stiffness are tuned."""
    loop = System(
        init=lambda params, scenario: ((scenario, 0.0 * scenario), ()),
        tick=lambda params, scenario, now, x, z, noise: ((x[0], x[1] + 0.1 * noise[0]), z, x[0]),
        flow=lambda params, scenario, t, x, z: (x[1], -params[0] * x[0] - params[1] * x[1]),
        dt=0.1,
        normals=1,
    )
    score = lambda params, scenario, now, log: scores.mean(log * log)
    return jnp.mean(sweep(loop, tuple(theta), jax.random.normal(key, (10,)), key, ticks=20, score=score))


def test_draws_are_shared_by_devices_and_average_the_cost(tmp_path):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    env = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", TWO_DEVICES, tmp_path / "two.npz"], env=env, cwd=ROOT, check=True)
    two = np.load(tmp_path / "two.npz")
    best, history = shared_search()
    assert history.cost[0] == pytest.approx(np.mean([swept(np.ones(2), key) for key in jax.random.split(KEY, 4)]))
    for name, one in dict(best=best, cost=history.cost, gradient=history.gradient).items():
        np.testing.assert_allclose(two[name], one, rtol=1e-9)


# whether to believe a gradient


def test_the_gradient_check_knows_a_smooth_cost_from_a_staircase():
    smooth = gradient_check(wavy, start(), KEY)
    assert smooth.relative.max() < 1e-8 and (smooth.doubt < 1e-7).all()
    stairs = lambda theta, key: jnp.floor(20 * theta) / 20 + 0.1 * theta
    lying = gradient_check(stairs, 0.317, KEY, step=0.03)
    assert lying.gradient[0] == pytest.approx(0.1)
    assert abs(lying.central[0] - 0.1) > 0.2 and lying.doubt[0] > 0.2 and lying.relative[0] > 1


def observer_pd(theta, key):
    p = op.params._replace(**{k: getattr(op.params, k) * jnp.exp(v) for k, v in theta.items() if k != "size"})
    scenario = op.scenario._replace(
        q_hat=Vec3(0.35, 0.2, -0.6), gyro=on_axes(Fault(1.0, drift=0.1 * jnp.exp(theta["size"])))
    )
    log = simulate(op.system, p, scenario, key, ticks=40)
    return (
        jnp.mean(log.e_q @ log.e_q)
        + 1e-6 * jnp.mean(log.u @ log.u)
        + 1e-2 * jnp.mean(soft_alarm(log.xi, p.sigma, 0.01))
    )


def gyro_ekf_pid(theta, key):
    """The loop as shipped, its Kalman filter included."""
    scaled = {k: jnp.exp(v) * getattr(ge.params, k) for k, v in theta.items()}
    p = ge.params._replace(**scaled)
    log = simulate(ge.system, p, ge.scenario, key, ticks=16)
    return 1e9 * jnp.mean(log.angle @ log.angle) + 1e6 * jnp.mean(log.w @ log.w)


def cmg_steering(theta, key):
    p = cmg.Params(
        k_p=0.2 * jnp.exp(theta["k_p"]), k_i=0.02 * jnp.exp(theta["k_i"]),
        steering=Steering(lam0=0.01 * jnp.exp(theta["lam0"]), dither=0.1),
    )  # fmt: skip
    turned = cmg.scenario._replace(gamma=cmg.scenario.gamma + theta["turn"] * jnp.array([1.0, -1.0, 1.0, 0.0]))
    log = simulate(cmg.system._replace(substeps=1), p, turned, key, ticks=20)
    return jnp.mean(log.w @ log.w) + 1e-3 * jnp.mean(log.acceleration)


def star_filters(theta, key):
    p = si.params._replace(**{k: getattr(si.params, k) * jnp.exp(v) for k, v in theta.items()})
    log = simulate(si.system, p, si.scenario, key, ticks=16)
    return jnp.mean(log.nees) + 1e4 * jnp.mean(log.w @ log.w)


def wheel_adaptation(theta, key):
    p = wm.params._replace(
        K=jnp.exp(theta["K"]), law=wm.params.law._replace(gamma=1e-6 * jnp.exp(theta["gamma"])),
        P0=1e-6 * jnp.exp(theta["P0"]),
    )  # fmt: skip
    log = simulate(wm.system_of(substeps=8), p, wm.scenario, key, ticks=60)
    return jnp.mean(log.error**2) + 1e-8 * jnp.mean(log.step**2)


@pytest.mark.short
@pytest.mark.parametrize(
    ("cost", "names"),
    [
        (observer_pd, "alpha beta sigma k_q k_w0 size"),
        (gyro_ekf_pid, "k_p k_i k_d R"),
        (cmg_steering, "k_p k_i lam0 turn"),
        (star_filters, "std_gyro std_star bandwidth damping"),
        (wheel_adaptation, "K gamma P0"),
    ],
)
def test_every_loops_gradient_equals_the_central_difference(cost, names):
    found = gradient_check(cost, {name: 0.03 for name in names.split()}, KEY)
    assert (np.abs(found.central) > 0).all()
    assert found.relative.max() < 1e-5, found


# the command


@pytest.mark.parametrize(("words", "wrong"), [(["nothing", "tune"], "nothing"), (["observer_pd", "polish"], "polish")])
def test_the_command_refuses_what_it_does_not_know(words, wrong, monkeypatch, capsys):
    from experiments import __main__ as command

    monkeypatch.setattr(sys, "argv", ["experiments", *words])
    with pytest.raises(SystemExit):
        command.main()
    assert f"but it is {wrong}" in capsys.readouterr().err


def test_every_paper_has_a_study_of_its_gains():
    from experiments.running import LOOPS, STUDIES

    for name in LOOPS:
        assert callable(importlib.import_module(f"{STUDIES['tune']}.{name}").run)


def test_a_check_of_a_gradient_that_is_not_finite_says_so():
    with pytest.raises(ValueError, match=r"^`cost` must be finite at theta, but it is nan\.$"):
        gradient_check(lambda theta, key: theta["a"] * jnp.nan, dict(a=1.0), KEY)
    steep = lambda theta, key: theta["a"] + jnp.sqrt(theta["b"])
    with pytest.raises(
        ValueError, match=r"^`cost` must have a finite gradient at theta, along theta\['b'\] too, but it is inf\.$"
    ):
        gradient_check(steep, dict(a=1.0, b=0.0), KEY, forward=False)


# a cost that is not finite, traced to what it is made of


def gappy(theta, key, pick=lambda found: weighted(found, dict(error=1.0, late=0.5))):
    """Mean costs of five runs of two seconds; ``late`` is a mean over a window that two of them lack."""
    score = lambda params, scenario, now, log: dict(
        error=scores.mean(log * log), late=scores.mean(log * log, now.t >= scenario), unused=scores.mean(log, False)
    )
    loop = System(
        init=lambda params, scenario: (0.0 * scenario + params, ()),
        tick=lambda params, scenario, now, x, z, noise: (x, z, x),
        flow=lambda params, scenario, t, x, z: -x,
        dt=0.1,
    )  # fmt: skip
    begins = jnp.array([0.0, 1.0, 2.5, 1.0, 9.0])
    return pick(sweep(loop, theta, begins, key, ticks=20, score=score))


LATE = r"its term late is nan in 2 of 5 scenarios, first in scenario 2\.$"


@pytest.mark.parametrize("cost", [gappy, jax.jit(gappy, static_argnames="pick"), averaged(gappy, 2)])
def test_a_cost_that_is_nan_is_traced_to_its_term_and_scenario(cost):
    with pytest.raises(ValueError, match="`cost` must be finite, .* at the start, but it is nan, .*; " + LATE):
        tune(cost, 1.0, optax.sgd(0.1), 2, KEY)
    with pytest.raises(ValueError, match="^`cost` must be finite at theta, but it is nan; " + LATE):
        gradient_check(cost, 1.0, KEY)


def test_a_cost_without_terms_is_traced_to_the_scores_of_its_sweep():
    cost = lambda theta, key: gappy(theta, key, lambda found: jnp.mean(found["late"]))
    with pytest.raises(ValueError, match="; its score late is nan in 2 of 5 scenarios, first in scenario 2; its score"):
        multi_start(cost, np.ones(2), optax.sgd(0.1), 2, KEY, fresh=True)
    fine = lambda theta, key: gappy(theta, key, lambda found: jnp.mean(found["error"]))
    assert np.isfinite(tune(fine, 1.0, optax.sgd(0.1), 1, KEY)[1].cost).all()


def test_a_term_that_is_nan_beside_theta_is_found_too():
    terms = lambda theta, key: weighted(dict(plain=theta, root=jnp.sqrt(theta - 1)), dict(plain=1.0, root=1.0))
    with pytest.raises(
        ValueError, match=r"finite beside theta, for theta = 0\.9995.* too, but it is nan; its term root is"
    ):
        gradient_check(terms, 1.0001, KEY, step=1e-3)
