"""The engine on a loop small enough to be written out in NumPy: a noisy oscillator under sampled feedback."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_up import compilations
from toy import SYSTEM, Params, Scenario, X

from jaxatt.contract import Now
from jaxatt.engine import every, match_state, rk4, simulate
from jaxatt.vec import Vec3

KEY = jax.random.key(5)
NOISE = np.random.default_rng(0).normal(size=(37, 2))


def plain(params, scenario, noise):
    """The same loop in NumPy."""
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


# parts


def test_rk4_is_the_classical_step_of_a_tree():
    flow = lambda t, x: X(x.speed * t, -jnp.sin(x.position))
    t, h, x = 0.3, 0.1, np.array([1.0, -0.5])
    f = lambda t, x: np.array([x[1] * t, -np.sin(x[0])])
    k1 = f(t, x)
    k2 = f(t + h / 2, x + h / 2 * k1)
    k3 = f(t + h / 2, x + h / 2 * k2)
    expected = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(t + h, x + h * k3))
    np.testing.assert_allclose(rk4(flow, t, X(*x), h), expected, rtol=1e-14)


def test_rk4_converges_with_the_fourth_power_of_the_step():
    def error(steps):
        x = 1.0
        for k in range(steps):
            x = rk4(lambda t, x: x * jnp.cos(t), 2.0 * k / steps, x, 2.0 / steps)
        return abs(float(x) - np.exp(np.sin(2.0)))

    assert np.log2(error(8) / error(16)) == pytest.approx(4, abs=0.3)


def test_rk4_keeps_the_type_of_every_leaf():
    x = dict(a=jnp.float32(1.0), b=jnp.zeros(3))
    moved = rk4(lambda t, x: jax.tree.map(jnp.ones_like, x), 0.0, x, 0.1)
    assert moved["a"].dtype == jnp.float32 and moved["b"].dtype == jnp.float64


def test_rk4_hands_each_stage_what_is_known_of_it():
    known = np.array([1.0, 3.0, 3.5, 6.0])
    step = rk4(lambda t, x, seen: dict(a=seen["u"] + 0 * t), 0.0, dict(a=1.0), 0.2, dict(u=known))
    assert step["a"] == pytest.approx(1 + 0.2 / 6 * (1 + 2 * 3 + 2 * 3.5 + 6), rel=1e-14)


def test_an_error_in_a_function_that_is_handed_in_is_seen_whole():
    with pytest.raises(ZeroDivisionError, match=r"^division by zero"):
        rk4(lambda t, x: 1 / 0, 0.0, 1.0, 0.1)


def test_every_runs_on_every_kth_tick():
    ran = [bool(every(4, Now(k, 0.1 * k, 0.1), lambda: True, False)) for k in range(9)]
    assert ran == [k % 4 == 0 for k in range(9)]


def test_every_refuses_another_structure_and_a_rate_below_one():
    now = Now(0, 0.0, 0.1)
    with pytest.raises(ValueError, match=r"^`k` must be a whole number of at least 1, but it is 0\.$"):
        every(0, now, lambda: 1.0, 1.0)
    with pytest.raises(TypeError, match=r"^`run` must return .* of shape \(\), but it is \(3,\)\.$"):
        every(2, now, lambda: np.ones(3), 1.0)


def test_match_state_takes_over_the_types_of_the_example():
    held = dict(a=jnp.float32(0.0), b=jnp.zeros(2), c=False)
    taken = match_state(dict(a=np.float64(1.5), b=jnp.arange(2), c=True), held, "run")
    assert [leaf.dtype for leaf in jax.tree.leaves(taken)] == [jnp.float32, jnp.float64, bool]
    assert taken["a"] == 1.5 and taken["b"].tolist() == [0, 1] and taken["c"]


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        (dict(a=0.0), r"^`run` must return the structure PyTreeDef.*, but it is without \['b'\]\.$"),
        (
            dict(a=0.0, b=Vec3(1.0, 1.0, 1.0)),
            r"^`run` must return the structure .* without \['b'\] and with \['b'\]\.x, ",
        ),
        (dict(a=0.0, b=np.zeros((2, 1))), r"^`run` must return \['b'\] of shape \(2,\), but it is \(2, 1\)\.$"),
        (dict(a=1j, b=np.zeros(2)), r"^`run` must return \['a'\] of type float64, but it is complex128\.$"),
        (dict(a=0.0, b=None), r"^`run` must return the structure "),
    ],
)
def test_match_state_names_the_leaf_that_differs(tree, message):
    with pytest.raises(TypeError, match=message):
        match_state(tree, dict(a=jnp.zeros(()), b=jnp.zeros(2)), "run")


# one run


@pytest.mark.parametrize("ticks", [1, 10, 37])
def test_simulate_is_the_loop_written_out(ticks):
    log = simulate(SYSTEM, Params(), Scenario(), NOISE[:ticks], ticks=ticks)
    np.testing.assert_allclose(log, plain(Params(), Scenario(), NOISE[:ticks]), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("source", [NOISE, KEY], ids=["noise", "key"])
def test_decimation_keeps_every_nth_record_and_changes_nothing_else(source):
    full = simulate(SYSTEM, Params(), Scenario(), source, ticks=37)
    some = simulate(SYSTEM, Params(), Scenario(), source, ticks=37, every=5)
    np.testing.assert_allclose(some, np.asarray(full)[:, ::5], rtol=1e-13, atol=1e-15)


def test_decimation_by_more_than_the_ticks_keeps_the_first_record():
    assert simulate(SYSTEM, Params(), Scenario(), NOISE[:3], ticks=3, every=5).position.tolist() == [1.0]


def test_vmap_of_simulate_is_the_single_runs():
    keys, starts = jax.random.split(KEY, 3), np.linspace(-1, 1, 3)
    run = lambda start, key: simulate(SYSTEM, Params(), Scenario(start), key, ticks=40)
    many = jax.vmap(run)(starts, keys)
    assert many.position.shape == (3, 40)
    for i in range(3):
        one = run(starts[i], keys[i])
        np.testing.assert_allclose([many.position[i], many.u[i]], one, rtol=1e-12, atol=1e-14)


def test_jit_grad_and_jacfwd_of_simulate():
    loss = lambda gain: jnp.sum(simulate(SYSTEM, Params(gain), Scenario(), NOISE[:25], ticks=25).position ** 2)
    assert jax.jit(loss)(0.3) == pytest.approx(float(loss(0.3)), rel=1e-12)
    central = (loss(0.3 + 1e-5) - loss(0.3 - 1e-5)) / 2e-5
    assert jax.grad(loss)(0.3) == pytest.approx(float(central), rel=1e-7)
    assert jax.jacfwd(jax.jit(loss))(0.3) == pytest.approx(float(central), rel=1e-7)


def test_a_run_in_float32_stays_in_float32_under_x64():
    params, scenario = jax.tree.map(np.float32, (Params(), Scenario()))
    log = simulate(SYSTEM, params, scenario, NOISE[:12], ticks=12)
    assert log.position.dtype == np.float32
    np.testing.assert_allclose(log, plain(Params(), Scenario(), NOISE[:12]), rtol=1e-4, atol=1e-5)


def test_whole_numbers_at_the_start_flow_like_others():
    log = simulate(SYSTEM, Params(), Scenario(np.int32(1), np.int64(4)), NOISE[:12], ticks=12)
    np.testing.assert_allclose(log, plain(Params(), Scenario(), NOISE[:12]), rtol=1e-12, atol=1e-14)


def test_other_numbers_of_any_type_compile_nothing():
    run = lambda gain, key: simulate(SYSTEM, Params(gain), Scenario(), key, ticks=20)
    other = jax.random.key(1)
    run(0.1, KEY)
    before = len(compilations)
    for gain in (np.float64(0.2), 1, np.array(0.4)):
        run(gain, other)
    assert len(compilations) == before


def test_the_state_may_be_arrays_with_axes_of_their_own():
    matrix = np.array([[0.0, 1.0], [-4.0, -0.1]])
    system = SYSTEM._replace(
        init=lambda params, scenario: (jnp.stack([scenario.start, 0.0]), ()),
        tick=lambda params, scenario, now, x, z, noise: (x, z, dict(x=x, rows=jnp.outer(x, noise))),
        flow=lambda params, scenario, t, x, z: matrix @ x,
    )
    log = simulate(system, Params(), Scenario(), NOISE[:8], ticks=8)
    assert log["x"].shape == (8, 2) and log["rows"].shape == (8, 2, 2)
    np.testing.assert_allclose(log["rows"], log["x"][:, :, None] * NOISE[:8, None], rtol=1e-14)


# what is refused


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(ticks=0), ValueError, "`ticks` must be a whole number of at least 1, but it is 0"),
        (dict(ticks=2.5), ValueError, "`ticks` must be a whole number of at least 1, but it is 2.5"),
        (dict(every=0), ValueError, "`every` must be a whole number of at least 1, but it is 0"),
        (dict(noise_or_key=np.zeros((3, 2))), ValueError, r"`noise` must have shape \(10, 2\), but it is \(3, 2\)"),
        (dict(noise_or_key=7), TypeError, r"`key` must be a key of jax.random.key\(seed\), but it is 7"),
        (dict(noise_or_key=jax.random.split(KEY, 3)), ValueError, r"`key` must be one key, but it is of shape \(3,\)"),
        (dict(params=Params("a")), TypeError, "`params.gain` must be a number or an array, but it is 'a'"),
        (dict(params=Params(np.float16(1))), TypeError, "`params.gain` must be float32 or float64, but it is float16"),
        (dict(system=3), TypeError, "`system` must be a System, but it is 3"),
    ],
)
def test_bad_input_is_refused(change, error, message):
    arguments = dict(system=SYSTEM, params=Params(), scenario=Scenario(), noise_or_key=KEY, ticks=10) | change
    with pytest.raises(error, match=f"^{message}\\.$"):
        simulate(**arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(init=lambda p, s: 1.0), r"^`init` must return x, z, but it is 1\.0\.$"),
        (dict(tick=lambda p, s, now, x, z, n: (x, z)), r"^`tick` must return x, z, log, but it is \("),
        (dict(tick=lambda p, s, now, x, z, n: (x, (z, z), None)), r"^`tick` must return the structure .* without z and with z\[0\], z\[1\]\.$"),
        (dict(tick=lambda p, s, now, x, z, n: (x, 1j * z, None)), r"^`tick` must return z of type float64, but it is complex128\.$"),
        (dict(tick=lambda p, s, now, x, z, n: (x._replace(speed=n), z, None)), r"^`tick` must return x\.speed of shape \(\), but it is \(2,\)\.$"),
        (dict(flow=lambda p, s, t, x, z: (x.speed, z)), r"^`flow` must return the structure .* without x\.position, x\.speed and with x\[0\], x\[1\]\.$"),
        (dict(flow=lambda p, s, t, x, z: x._replace(speed=jnp.ones(3))), r"^`flow` must return x\.speed of shape \(\), but it is \(3,\)\.$"),
    ],
)  # fmt: skip
def test_a_function_that_returns_the_wrong_thing_is_told_which_leaf(change, message):
    with pytest.raises(TypeError, match=message):
        simulate(SYSTEM._replace(**change), Params(), Scenario(), KEY, ticks=3)


def test_the_check_of_the_system_sees_arrays_before_anything_is_compiled():
    def refuse(params, scenario):
        assert isinstance(params.gain, np.ndarray) and scenario.start.shape == ()
        raise ValueError("no")

    before = len(compilations)
    with pytest.raises(ValueError, match=r"^no$"):
        simulate(SYSTEM._replace(check=refuse), Params(), Scenario(), KEY, ticks=3)
    assert len(compilations) == before
