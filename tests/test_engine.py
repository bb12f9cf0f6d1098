"""The engine on a loop small enough to be written out in NumPy: a noisy oscillator under sampled feedback."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtri
from toy import SYSTEM, Params, Scenario

import jaxatt
from jaxatt import scores
from jaxatt.engine import BLOCK, System, _normal, noise_of, simulate, vmapped
from jaxatt.study import rerun, sweep

KEY = jax.random.key(5)


def plain(params, scenario, noise):
    """The same loop in NumPy, one scenario."""
    x, z, h, out = np.array([scenario.start, 0.0]), 0.0, 0.2 / 3, []
    for k, n in enumerate(noise):
        if k % 3 == 0:
            z = -params.gain * (x[1] + 0.1 * n[0]) + 0.01 * n[1]
        out.append((x[0], z))
        f = lambda t, x, z=z: np.array([x[1], -scenario.stiffness * x[0] + z + 0.05 * np.sin(t)])
        for j in range(3):
            t = 0.2 * k + j * h
            k1 = f(t, x)
            k2 = f(t + h / 2, x + h / 2 * k1)
            k3 = f(t + h / 2, x + h / 2 * k2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(t + h, x + h * k3))
    return np.array(out).T


def many(n):
    starts = np.linspace(-1, 1, n)
    return Scenario(starts, 4 + starts)


@pytest.mark.parametrize("ticks", [1, 10, 37])
def test_simulate_is_the_loop_written_out(ticks):
    noise = np.random.default_rng(0).normal(size=(ticks, 2))
    log = simulate(SYSTEM, Params(), Scenario(), noise, ticks=ticks)
    np.testing.assert_allclose(log, plain(Params(), Scenario(), noise), rtol=1e-12, atol=1e-14)


def test_decimation_keeps_every_nth_record_and_changes_nothing_else():
    for source in (np.random.default_rng(0).normal(size=(37, 2)), KEY):
        full = simulate(SYSTEM, Params(), Scenario(), source, ticks=37)
        some = simulate(SYSTEM, Params(), Scenario(), source, ticks=37, every=5)
        np.testing.assert_allclose(some.position, full.position[::5], rtol=1e-13)


def test_lanes_vmap_and_single_runs_agree():
    keys, scenarios = jax.random.split(KEY, 6), many(6)
    lanes = simulate(SYSTEM, Params(), scenarios, keys, ticks=40)
    mapped = jax.vmap(lambda s, k: simulate(SYSTEM, Params(), s, k, ticks=40), out_axes=-1)(scenarios, keys)
    np.testing.assert_allclose(lanes, mapped, rtol=1e-12, atol=1e-14)
    for i in range(6):
        one = simulate(SYSTEM, Params(), jax.tree.map(lambda a, i=i: a[i], scenarios), keys[i], ticks=40)
        np.testing.assert_allclose(np.asarray(lanes)[..., i], one, rtol=1e-12, atol=1e-14)


def arrays_tick(params, scenario, now, x, z, noise):
    u = -params.gain * (x[1] + 0.1 * noise[0])
    return x, u, {"x": x, "u": u}


ARRAYS = System(
    init=lambda params, scenario: (jnp.stack([scenario.start, 0.0]), 0.0),
    tick=arrays_tick,
    flow=lambda params, scenario, t, x, z: jnp.array([[0.0, 1.0], [-4.0, 0.0]]) @ x + jnp.stack([0.0, z]),
    dt=0.1,
    normals=1,
)


@pytest.mark.parametrize("system", [SYSTEM, vmapped(ARRAYS)], ids=["lanes", "vmapped"])
def test_two_axes_of_lanes_are_one_folded(system):
    fold = lambda tree: jax.tree.map(lambda a: a.reshape(*a.shape[:-1], 2, 3), tree)
    keys, scenarios = jax.random.split(KEY, 6), many(6)
    one = simulate(system, Params(), scenarios, keys, ticks=12)
    two = simulate(system, Params(), fold(scenarios), keys.reshape(2, 3), ticks=12)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(b, a, rtol=1e-12, atol=1e-14), fold(one), two)


def test_simulate_works_under_jit_and_grad():
    loss = lambda gain: jnp.sum(simulate(SYSTEM, Params(gain), Scenario(), KEY, ticks=25).position ** 2)
    assert jax.jit(loss)(0.3) == pytest.approx(float(loss(0.3)), rel=1e-12)
    central = (loss(0.3 + 1e-5) - loss(0.3 - 1e-5)) / 2e-5
    assert jax.grad(loss)(0.3) == pytest.approx(float(central), rel=1e-7)
    assert jax.jacfwd(jax.jit(loss))(0.3) == pytest.approx(float(central), rel=1e-7)


def test_a_loop_on_plain_arrays_runs_in_lanes_through_vmapped():
    keys, scenarios = jax.random.split(KEY, 4), many(4)
    lanes = simulate(vmapped(ARRAYS), Params(), scenarios, keys, ticks=30)
    assert lanes["x"].shape == (30, 2, 4)
    for i in range(4):
        one = simulate(ARRAYS, Params(), jax.tree.map(lambda a, i=i: a[i], scenarios), keys[i], ticks=30)
        np.testing.assert_allclose(lanes["x"][..., i], one["x"], rtol=1e-12)
    score = lambda params, scenario, now, log: scores.rms(log["u"] ** 2)
    swept = sweep(vmapped(ARRAYS), Params(), many(140), KEY, ticks=30, score=score)
    single = simulate(
        ARRAYS, Params(), jax.tree.map(lambda a: a[139], many(140)), noise_of(ARRAYS, KEY, 139, 30), ticks=30
    )
    assert swept[139] == pytest.approx(float(np.sqrt(np.mean(single["u"] ** 2))), rel=1e-10)


def test_noise_is_standard_normal_and_its_own_for_every_scenario_tick_and_number():
    noise = np.concatenate([noise_of(SYSTEM, KEY, i, 4000).ravel() for i in (0, 1, BLOCK, 5 * BLOCK + 3)])
    assert noise.dtype == np.float32
    assert stats.kstest(noise, "norm").pvalue > 1e-3
    assert len(np.unique(noise)) > 0.99 * noise.size


def test_the_normal_quantile_is_exact_to_float32_rounding_over_its_range():
    words = jnp.concatenate([jnp.arange(200), 2**22 + jnp.arange(-100, 100), 2**23 - 1 - jnp.arange(200)])
    words = jnp.concatenate([words, jax.random.bits(KEY, (10_000,), jnp.uint32) >> 9]).astype(jnp.uint32)
    u = (np.asarray(words, float) + 0.5) / 2**23
    np.testing.assert_allclose(_normal(words << 9), ndtri(u), rtol=2e-6)


def test_every_keeps_its_value_between_runs():
    log = simulate(SYSTEM, Params(), Scenario(), KEY, ticks=10)
    u = np.asarray(log.u)
    assert (u[[1, 2, 4, 5, 7, 8]] == u[[0, 0, 3, 3, 6, 6]]).all() and u[0] != u[3]


def test_numbers_compile_once():
    def score(params, scenario, now, log):
        score.traces += 1
        return scores.mean(log.u)

    score.traces = 0
    for gain in (0.1, np.float64(0.2), 1, np.array(0.4)):
        sweep(SYSTEM, Params(gain), many(3), jax.random.key(1), ticks=20, score=score)
    first = score.traces
    sweep(SYSTEM, Params(0.5), many(500), jax.random.key(2), ticks=20, score=score)
    assert score.traces == first


def test_a_run_in_float32_stays_in_float32_under_x64():
    params, scenario = jax.tree.map(np.float32, (Params(), Scenario()))
    log = simulate(SYSTEM, params, scenario, KEY, ticks=12)
    assert log.position.dtype == np.float32
    wide = simulate(SYSTEM, Params(), Scenario(), KEY, ticks=12)
    np.testing.assert_allclose(log.position, wide.position, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(ticks=0), ValueError, "`ticks` must be a whole number of at least 1, but it is 0"),
        (dict(ticks=2.5), ValueError, "`ticks` must be a whole number of at least 1, but it is 2.5"),
        (dict(every=0), ValueError, "`every` must be a whole number of at least 1, but it is 0"),
        (
            dict(noise_or_key=np.zeros((3, 2))),
            ValueError,
            r"`noise` must have shape \(10, 2, \*lanes\), but it is \(3, 2\)",
        ),
        (dict(noise_or_key=7), TypeError, r"`key` must be a key of jax.random.key\(seed\), but it is 7"),
        (dict(params=Params("a")), TypeError, "`params.gain` must be a number or an array, but it is 'a'"),
        (dict(noise_or_key=jax.random.split(KEY, 3)), ValueError, r"`scenario.start` must carry the lanes \(3,\)"),
    ],
)
def test_bad_input_is_refused(change, error, message):
    arguments = dict(params=Params(), scenario=Scenario(), noise_or_key=KEY, ticks=10) | change
    with pytest.raises(error, match=message):
        simulate(SYSTEM, **arguments)


def test_a_tick_that_changes_the_state_is_told_so():
    bad = SYSTEM._replace(tick=lambda p, s, now, x, z, noise: (x, (z, z), None))
    with pytest.raises(TypeError, match="`tick` must return the structure"):
        simulate(bad, Params(), Scenario(), KEY, ticks=3)
    bad = SYSTEM._replace(tick=lambda p, s, now, x, z, noise: (x, 1j * z, None))
    with pytest.raises(TypeError, match=r"`tick` must return the state's type float64, but it is complex128"):
        simulate(bad, Params(), Scenario(), KEY, ticks=3)
    bad = SYSTEM._replace(tick=lambda p, s, now, x, z, noise: (x, jnp.zeros(3), None))
    with pytest.raises(TypeError, match=r"`tick` must return shape \(\) where the state has it, but it is \(3,\)"):
        simulate(bad, Params(), Scenario(), KEY, ticks=3)


def test_fast_cpu_comes_before_the_first_computation():
    jnp.zeros(1).block_until_ready()
    with pytest.raises(RuntimeError, match="`fast_cpu` must be called before the first computation"):
        jaxatt.fast_cpu()


def test_rerun_is_the_sweep_of_that_scenario():
    score = lambda params, scenario, now, log: scores.final(log.position)
    swept = sweep(SYSTEM, Params(), many(300), KEY, ticks=33, score=score)
    for i in (0, 127, 128, 299):
        assert rerun(SYSTEM, Params(), many(300), KEY, i, ticks=33).position[-1] == swept[i]
