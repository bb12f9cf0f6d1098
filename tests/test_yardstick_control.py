"""The control track of the yardstick: its laws against closed forms, its draws, its gate, its board and its refusals."""

import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt import noise_of, simulate
from jaxatt.contract import Now
from jaxatt.vec import Vec3, array, norm
from jaxatt.yardstick import (
    CELLS,
    CONTROLLERS,
    ControlBoard,
    Controller,
    control,
    driven,
    episodes,
    leo4,
    rules,
    worlds,
)
from jaxatt.yardstick import controllers as laws
from jaxatt.yardstick.__main__ import main
from jaxatt.yardstick.board import differences
from jaxatt.yardstick.control import GATE, PACKETS, Outcome, Params, cell, example, run

pytestmark = pytest.mark.short
KEY = jax.random.key(5)
W = np.array(leo4.AXES)  # wheels' axes in columns
J = np.array(leo4.INERTIA)


def mine_init(params):
    return jnp.zeros(3), jnp.zeros(())


def mine_step(params, z, reading):
    """PID without a limit that despairs, with commands that are no numbers, of turns beyond ``most`` [rad]."""
    (integral, worst), (e, w) = z, laws.errors(reading)
    integral = integral + leo4.DT * array(e)
    pull = params["kp"] * e + params["kd"] * w + params["ki"] * Vec3.of(integral)
    torque = leo4.shared_out(-(leo4.INERTIA @ pull))
    worst = jnp.maximum(worst, norm(e))
    return (integral, worst), jnp.where(worst < params["most"], torque, jnp.nan)


GAINS = {"kp": 0.01, "kd": 0.18, "ki": 0.0, "most": np.inf}
MINE = Controller("mine", mine_init, mine_step, GAINS, 2)
SYSTEM = driven(mine_init, mine_step)
QUIET = jnp.zeros((PACKETS, leo4.system.normals))


def alone(scenarios, i=0, kind: Any = float):
    return jax.tree.map(lambda a: np.asarray(a[i], kind), scenarios)


def logged(day, noise, **gains):
    """A run in float32, all of one program."""
    params = jax.tree.map(np.float32, Params(leo4.params, GAINS | gains))
    return simulate(SYSTEM, params, day, noise, ticks=PACKETS)


# theory


@pytest.mark.parametrize("gain", [0.6, 0.0, -0.3, -1.0])
def test_a_wheel_of_gain_g_leaves_its_axis_1_less_three_quarters_of_its_loss(gain):
    left = 1 - 0.75 * (1 - gain)
    for i in range(4):
        gains = np.where(np.arange(4) == i, gain, 1.0)
        loop = np.stack([array(leo4.summed(gains * leo4.shared_out(Vec3.of(u)))) for u in np.eye(3)], axis=1)
        np.testing.assert_allclose(loop @ W[:, i], left * W[:, i], atol=1e-12)
        np.testing.assert_allclose(np.linalg.eigvalsh(loop), np.sort([left, 1, 1]), atol=1e-12)


def test_a_bias_leaves_pd_at_its_closed_form_and_an_integral_takes_it_away():
    """J kp e = W b; with J diagonal that is .577 b / (J kp) about each axis.

    Less at most kd DT / 2 = .9 %: the MEKF, which expects no such acceleration, takes half a tick of it for a bias.
    """
    day = alone(episodes(CELLS["none"], KEY, np.arange(1)), kind=np.float32)
    day = day._replace(wheel=day.wheel._replace(bias=np.array([0.0, 4e-3, 0.0, 0.0], np.float32)))
    still = {name: jax.tree.map(lambda a: 0 * a, getattr(day, name)) for name in ("bias", "scale", "constant", "turn", "bias_error")}  # fmt: skip
    day, found = day._replace(stretch=Vec3(*np.ones(3, np.float32)), **still), {}
    for ki in (0.0, 2e-4):
        log = logged(day, QUIET.astype(np.float32), ki=ki)
        found[ki] = 2 * np.array(log.q)[1:, -1]
    np.testing.assert_allclose(found[0.0], np.linalg.solve(J, W[:, 1] * 4e-3) / 0.01, rtol=0.009)
    assert np.linalg.norm(found[0.0]) > GATE > 20 * np.linalg.norm(found[2e-4])
    about_x = 3**-0.5 * np.array([2e-3, 10e-3]) / (15 * 0.01)
    np.testing.assert_allclose(np.rad2deg(about_x), [0.44, 2.2], atol=0.01)


# laws


def test_laws_are_their_equations():
    rng = np.random.default_rng(0)
    turn, rate = 0.01 * rng.normal(size=3), 1e-3 * rng.normal(size=3)
    q = np.array([np.sqrt(1 - turn @ turn / 4), *(turn / 2)])
    seen = example()._replace(attitude=jnp.asarray(q), rate=jnp.asarray(rate))
    given = {
        "pd": (), "pid": jnp.array([1.0, -2.0, 2.99999]), "nussbaum": jnp.full(3, 1.88),
        "adaptive": laws.Adapted(jnp.array([1.0, 0.20001, 9.99999]), jnp.zeros(3)),
    }  # fmt: skip
    told = jax.jit(lambda seen: {name: CONTROLLERS[name].step(CONTROLLERS[name].params, z, seen) for name, z in given.items()})  # fmt: skip
    (e, w), told = jax.jit(lambda seen: [array(v) for v in laws.errors(seen)])(seen), told(seen)
    np.testing.assert_allclose(e, turn, rtol=1e-12)
    np.testing.assert_allclose(w, rate)
    u = J @ (-0.01 * turn - 0.18 * rate) + np.cross(rate, J @ rate)
    s = rate + 0.01 / 0.18 * turn
    body = lambda torque: W @ np.array(torque)
    np.testing.assert_allclose(body(told["pd"][1]), u, rtol=1e-12)
    integral, torque = told["pid"]
    np.testing.assert_allclose(integral, np.minimum([1.0, -2.0, 2.99999] + 0.1 * turn, 3.0), rtol=1e-12)
    np.testing.assert_allclose(body(torque), u - 2e-4 * J @ integral, rtol=1e-12)
    p = CONTROLLERS["adaptive"].params
    z, torque = told["adaptive"]
    np.testing.assert_allclose(z.rho, np.clip([1.0, 0.20001, 9.99999] - 0.1 * p.gain_rate * s * u, 0.2, 10), rtol=1e-12)
    np.testing.assert_allclose(z.eta, -0.1 * p.bias_rate * s, rtol=1e-12)
    np.testing.assert_allclose(body(torque), z.rho * u + z.eta, rtol=1e-12)
    p = CONTROLLERS["nussbaum"].params
    k, torque = told["nussbaum"]
    np.testing.assert_allclose(k, 1.88 - 0.1 * p.rate * s * u, rtol=1e-12)
    np.testing.assert_allclose(body(torque), -(k**2) * np.cos(k) * u, rtol=1e-12)


def test_structured_finds_gains_and_torque_and_shares_out_by_them():
    """A body that spins by its wheels' true gains alone, without noise, played to the law."""
    c, gains, bias = CONTROLLERS["structured"], np.array([1.0, -0.5, 0.1, 0.8]), np.array([2e-3, 0.0, -1e-3, 3e-3])
    u, w = np.array([3e-3, -1e-3, 2e-3]), np.zeros(3)
    tau = np.array(laws.reallocated(c.params, gains, Vec3.of(u)))
    B = W * gains
    np.testing.assert_allclose(tau, B.T @ np.linalg.solve(B @ B.T + 0.02 * np.eye(3), u), rtol=1e-12)
    step, z, rng = jax.jit(c.step), c.init(c.params), np.random.default_rng(1)
    torque = np.zeros(4)
    for k in range(400):
        seen = example()._replace(rate=jnp.asarray(w), torque=jnp.asarray(torque), star_valid=jnp.asarray(k % 5 == 0))
        z, _ = step(c.params, z, jax.tree.map(lambda a: a.astype(float) if a.dtype != bool else a, seen))
        torque = 0.01 * rng.normal(size=4)
        w = w + 0.1 * np.linalg.solve(J, W @ (gains * torque + bias) - np.cross(w, J @ w))
    np.testing.assert_allclose(z.belief.mean[:4], gains, atol=0.02)
    np.testing.assert_allclose(z.belief.mean[4:], W @ bias, atol=2e-4)


def test_a_packet_tells_a_law_what_it_is_to_know_and_limits_it():
    def law(memory, reading):
        k, told = memory
        told = jax.tree.map(lambda all_, a: all_.at[k].set(a), told, reading)
        return (k + 1, told), 0.01 * (k + 1) * jnp.array([1.0, -1.0, 10.0, 0.0])

    day = jax.tree.map(lambda a: np.asarray(a, float), leo4.scenario)
    told = jax.tree.map(lambda a: jnp.zeros((5, *a.shape), bool if a.dtype == bool else float), example())
    _, z = leo4.init(leo4.params, day)
    play = jax.jit(lambda z: leo4.packet(leo4.params, day, Now(0, 0.0, 0.5), z, QUIET[0], law, (0, told), jnp.ones(4)))
    _, (count, told), log = play(z)
    wanted = np.clip(0.01 * np.outer(np.arange(1, 6), [1.0, -1.0, 10.0, 0.0]), -0.03, 0.03)
    np.testing.assert_allclose(log.telemetry.torque, wanted)
    np.testing.assert_allclose(told.torque, np.concatenate([np.ones((1, 4)), wanted[:4]]))
    np.testing.assert_array_equal(told.star_valid, [True, False, False, False, False])
    np.testing.assert_allclose(told.gyro, log.telemetry.gyro)
    np.testing.assert_allclose(told.rate, 0.75 * np.array(told.gyro) @ W.T, atol=1e-12)
    assert int(count) == 5 and np.abs(told.rate[4]).max() > 1e-4


# episodes


def test_episodes_differ_in_their_wheels_alone_and_the_tested_tenths_are_not_those_to_tune_on():
    numbers = np.arange(256)
    drawn = {(name, d): episodes(CELLS[name], KEY, numbers, deciles=d) for name in CELLS for d in ("odd", "even")}
    for (name, d), day in drawn.items():
        assert all(a.dtype == np.float32 for a in jax.tree.leaves(day))
        same = [np.array_equal(a, b) for field in set(day._fields) - {"wheel"}
                for a, b in zip(*(jax.tree.leaves(getattr(x, field)) for x in (day, drawn["none", d])))]  # fmt: skip
        assert all(same) and not day.mode.any()
        gain, bias, of = day.wheel.scale, 1e3 * day.wheel.bias, CELLS[name]
        faulty = np.sum((of.low < 1) | (of.flipped > 0)), np.sum(of.most > 0)
        assert set(np.sum(gain != 1, 1)) <= {faulty[0]} and set(np.sum(np.abs(bias) > 0, 1)) <= {faulty[1]}
    tenths = lambda a, low, high: np.ravel(10 * (np.abs(a) - low) / (high - low))
    every_other = lambda a, first: np.all((a - first + 1e-3) % 2 <= 1.002) and len(set(np.floor(a + 1e-3))) >= 5
    angle = lambda d: np.rad2deg(np.linalg.norm(np.array(drawn["none", d].off), axis=0))
    for d, first in (("odd", 0), ("even", 1)):
        assert every_other(tenths(angle(d), 1, 10), first)
        wild, late = drawn["wild", d].wheel, drawn["late", d].wheel
        assert every_other(tenths(wild.scale, 0.1, 1), first) and every_other(tenths(wild.bias, 0, 5e-3), first)
        assert every_other(tenths(late.onset[:, 0], 60, 180), first)
        assert 0.4 < np.mean(wild.scale < 0) < 0.6 and 0.4 < np.mean(wild.bias < 0) < 0.6
        turned = drawn["sign", d].wheel.scale < 0
        assert (turned.sum(1) == 1).all() and turned.mean(0).min() > 0.15
        one = drawn["all", d].wheel
        assert not np.any((one.scale != 1) & (one.bias != 0))
        flip = np.sort(drawn["dead_flip", d].wheel.scale, 1)
        assert (flip[:, 0] <= -0.1).all() and (flip[:, 1] == 0).all() and (flip[:, 2:] == 1).all()
    whole = episodes(CELLS["gain"], KEY, numbers, deciles="all").wheel.scale
    assert set(np.floor(tenths(whole[whole != 1], 0, 0.6))) == set(range(10))


# the gate


def test_the_gate_is_that_of_the_true_error_and_commands_that_are_no_numbers_lose():
    """Four episodes of each of three cells, some lost by their law, against the logs of their runs."""
    faults = CELLS["gain4"], cell(bias=[(2.0, 10.0)], onset=(60.0, 180.0)), CELLS["sign2"]
    scenarios = jax.tree.map(lambda *a: np.concatenate(a), *(episodes(f, KEY, np.arange(4), deciles="all") for f in faults))  # fmt: skip
    gains = {"ki": 2e-4, "most": 0.14}
    seen = run(MINE._replace(params=GAINS | gains), scenarios, KEY)
    assert {tuple(row) for row in zip(seen.success, seen.lost)} == {(True, False), (False, False), (False, True)}
    t = 0.1 * np.arange(5 * PACKETS)
    for i in range(12):
        day = alone(scenarios, i, np.float32)
        log = logged(day, noise_of(SYSTEM, KEY, i, PACKETS).astype(np.float32), **gains)
        lost = np.isnan(log.telemetry.torque).any()
        assert seen.lost[i] == lost
        if lost:
            assert not seen.success[i] and np.isinf(seen.settled[i]) and np.isnan(seen.peak[i])
            continue
        q = np.array(log.q, float)
        error = 2 * np.arcsin(np.ravel(log.pointing).astype(float) / 2)
        np.testing.assert_allclose(error[::5], 2 * np.arctan2(np.linalg.norm(q[1:], axis=0), abs(q[0])), atol=2e-6)
        beyond, onset = error > np.deg2rad(0.2), float(day.wheel.onset[0])
        assert seen.success[i] == (not beyond[t >= 270].any())
        last = np.flatnonzero(beyond & (t >= onset))
        settled = 0.0 if not len(last) else np.inf if beyond[-1] else t[last[-1]] + 0.1 - onset
        assert seen.settled[i] == pytest.approx(settled, abs=0.11)
        assert seen.peak[i] == pytest.approx(error[t >= onset].max(), rel=1e-3)


# gradients


def test_gradients_through_gains_are_central_differences():
    day = alone(episodes(CELLS["wild"], KEY, np.arange(1)))
    noise = jnp.asarray(noise_of(SYSTEM, KEY, 0, 60), float)

    def cost(kp, kd):
        params = Params(leo4.params, GAINS | {"kp": kp, "kd": kd})
        return jnp.mean(simulate(SYSTEM, params, day, noise, ticks=60).pointing ** 2)

    sloped = jax.jit(lambda gains, along: jax.jvp(cost, gains, along))
    for along, h in (((1.0, 0.0), 1e-8), ((0.0, 1.0), 1e-7)):
        ahead, behind = (sloped((0.01 + s * h * along[0], 0.18 + s * h * along[1]), along) for s in (1, -1))
        slope = float(sloped((0.01, 0.18), along)[1])
        assert np.isfinite(slope) and slope == pytest.approx(float(ahead[0] - behind[0]) / (2 * h), rel=1e-4)


# the board and its door


def made_up(controller, scenarios, key, *, world):
    """Episodes of which the first controller fails one in four, the second those and as many more."""
    n = len(scenarios.mode)
    number = np.arange(n) % 8
    success = {"one": number % 4 > 0, "two": number % 2 > 0, "nan": number < 0}.get(controller.name, number < 4)
    settled = np.where(success, 40.0 + number, np.inf)
    return Outcome(success, settled, ~success, np.full(n, 0.1), np.full(n, controller.name == "nan"))


def named(name, **changes):
    return MINE._replace(name=name, **changes)


def test_a_board_says_what_the_episodes_held(monkeypatch, tmp_path):
    monkeypatch.setattr(importlib.import_module("jaxatt.yardstick.control"), "run", made_up)
    entries = [named("nan"), named("two"), named("one")]
    board = control(entries, n=128)
    assert [(r["name"], r["rank"], r["tied"], r["lost"]) for r in board.rows] == [
        ("one", 1, False, 0), ("two", 2, False, 0), ("nan", 3, False, 128 * len(CELLS))
    ]  # fmt: skip
    share, low, high = board.cells["wild"]["one"]["success"]
    assert share == 0.75 and low == pytest.approx(0.6684, abs=1e-4) and high == pytest.approx(0.8169, abs=1e-4)
    assert board.cells["late"]["two"]["settling"] == [47, None] and board.cells["late"]["one"]["settling"][0] == 45
    names, gap, error = board.pairs("gain")
    one, two = names.index("one"), names.index("two")
    assert gap[one, two] == 0.25 and error[one, two] == pytest.approx(np.sqrt(0.25 * 0.75 / 127)) == error[two, one]
    assert board.row("nan")["tuned"] == 2 and "1408 episodes lost" in board.table() and "75.0 +-7.4" in board.table()
    board.to_json(tmp_path / "board.json")
    again = ControlBoard.from_json(tmp_path / "board.json")
    assert again == board and again.table() == board.table() and differences(again, control(entries, n=128)) == []
    assert len(board.figure().axes) == 2
    other = control([*entries[:2], named("one", params=GAINS | {"kp": 0.02})], n=128)
    assert other.header["seed"] != board.header["seed"] and len(other.header["seed"]) == 16


def test_the_command_rebuilds_a_board_of_baselines_and_says_what_differs(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(importlib.import_module("jaxatt.yardstick.control"), "run", made_up)
    board = control([CONTROLLERS["pd"], CONTROLLERS["pid"]], n=16, deciles="all")
    assert [row["tied"] for row in board.rows] == [True, True]
    for spoiled, code, said in ((board, 0, "the same to the bit"), (board._replace(matrix={}), 1, "board.matrix")):
        spoiled.to_json(tmp_path / "board.json")
        assert main([str(tmp_path / "board.json")]) == code and said in capsys.readouterr().out


@pytest.mark.parametrize(
    "step, said",
    [
        (lambda p, z, r: (z, jnp.zeros(3)), "torques of shape \\(4,\\)"),
        (lambda p, z, r: (z, jnp.zeros(4, int)), "a floating type"),
        (lambda p, z, r: (z, (r.torque, r.torque)), "torques of shape \\(4,\\)"),
        (lambda p, z, r: (z[0], r.torque), "z as it got it"),
        (lambda p, z, r: ((z[0][:2], z[1]), r.torque), "of shape \\(3,\\)"),
        (lambda p, z, r: r.torque, "return z, torque \\(4,\\)"),
    ],
)
def test_a_step_of_the_wrong_shape_is_refused_by_name(step, said):
    with pytest.raises(TypeError, match=f"`mine.step` must .*{said}"):
        control([MINE._replace(step=step)])


def test_the_door_refuses_what_cannot_be_ranked():
    def told(params, z, reading):
        jax.debug.callback(lambda a: None, reading.rate)
        return mine_step(params, z, reading)

    other = worlds.WORLDS["leo4"]._replace(system=leo4.system._replace(dt=1.0), name="other")
    refused: list[tuple[tuple, dict, str]] = [
        (([],), {}, "`controllers` must hold at least one Controller, but it is empty"),
        (([MINE, MINE],), {}, "have names that differ, but it is 'mine' twice"),
        (([MINE],), {"n": 1}, "`n` must"),
        (([MINE],), {"deciles": "some"}, "`deciles` must be one of odd, even, all, but it is 'some'"),
        (([MINE], other), {}, "`world` must be a world of leo4's, but it is other"),
        (([MINE._replace(step=told)],), {}, "be free of callbacks"),
    ]
    for arguments, how, said in refused:
        with pytest.raises(ValueError, match=said):
            control(*arguments, **how)
    with pytest.raises((TypeError, ValueError), match="`key` must"):
        control([MINE], key=3.5)
    with pytest.raises(TypeError, match=r"`controllers\[0\]` must"):
        control([mine_step])  # pyright: ignore[reportArgumentType]
    assert all(rules.pure(c, example()) for c in CONTROLLERS.values())
