"""The second world of the yardstick: its packets, its days, its rows, and a ranking of made-up days.

The packets against the loop itself: `experiments.yardstick_microsat`, for the loop takes long to compile.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_yardstick import made_up

from jaxatt import simulate
from jaxatt.attitude import quat_to_body
from jaxatt.contract import System
from jaxatt.environment import at
from jaxatt.faults import Reading
from jaxatt.vec import Quat, Vec3, array
from jaxatt.yardstick import (  # fmt: skip
    CONTROLLERS,
    MICROSAT_ROWS,
    WORLDS,
    Detector,
    Verdict,
    calibration,
    control,
    microsat,
    microsat_days,
    rank,
    ranking,
    rules,
    worlds,
)
from jaxatt.yardstick import __main__ as command
from jaxatt.yardstick import microsat_rows as rows
from jaxatt.yardstick.kinds import UNIT

WORLD = WORLDS["microsat"]
KEY = jax.random.key(3)
loop = microsat.loop


def days(cell, n=32):
    return worlds.days(WORLD, KEY, np.arange(n), cell)


# packets


def stand_in(params, scenario, now, x, z, noise):
    """A tick of the loop whose numbers say which tick it is: its sensors read k, its computer k + 1 000."""
    k = 1.0 * now.k
    gyro, tacho = Vec3(k, noise[0], now.t), jnp.full(4, k)
    y = z.sensors.readings._replace(gyro=Reading(gyro, True), tacho=Reading(tacho, jnp.ones(4, bool)))
    star = Reading(Quat(jnp.cos(k), jnp.sin(k), 0 * k, 0 * k), (now.k % 5 == 0) & (now.k > 0) | (now.k % 5 == 2))
    sensors = z.sensors._replace(readings=y._replace(arrived=y.arrived._replace(star=star)))
    belief = z.computer.belief._replace(clone=star.value, q=star.value)
    computer = z.computer._replace(torque=jnp.full(4, k + 1000), w=x.w, belief=belief)
    told = loop.Statistics(jnp.full(4, k), -k, k, star.valid, k, k, 0 * k)
    return x, z._replace(sensors=sensors, computer=computer), Log(k, told)


class Log(tuple):
    """The two fields of a log that a packet uses."""

    def __new__(cls, pointing, statistics):
        return super().__new__(cls, (pointing, statistics))

    pointing, statistics = property(lambda self: self[0]), property(lambda self: self[1])


@pytest.mark.short
def test_a_packet_is_five_ticks_of_the_loop_with_its_own_noise(monkeypatch):
    """Which tick and noise goes where, when samples arrive, what stays; the plant flows between ticks, w' = 1."""
    monkeypatch.setattr(loop, "tick", stand_in)
    one = lambda params, scenario, t, x, z: jax.tree.map(jnp.zeros_like, x)._replace(w=Vec3(*(jnp.ones_like(a) for a in x.w)))  # fmt: skip
    monkeypatch.setattr(loop, "flow", one)
    scenario = jax.tree.map(lambda a: np.asarray(a, float), loop.scenario)
    noise, init = np.arange(4 * 95.0).reshape(4, 95), loop.init(microsat.params, scenario)
    monkeypatch.setattr(loop, "init", lambda params, scenario: init)
    system = System(microsat.init, microsat.tick, microsat.flow, dt=0.5, normals=95)
    log = simulate(system, microsat.params, scenario, noise, ticks=4)
    k, told = np.arange(20.0), log.telemetry
    np.testing.assert_array_equal(told.gyro[..., 0].ravel(), k)
    np.testing.assert_array_equal(told.gyro[..., 1].ravel(), noise.reshape(20, 19)[:, 0])
    np.testing.assert_allclose(told.gyro[..., 2].ravel(), 0.1 * k)
    np.testing.assert_array_equal(told.torque[..., 3].ravel(), k + 1000)
    np.testing.assert_allclose(told.momentum_rate[..., 0].ravel(), init[0].w.x + 0.1 * k, atol=1e-12)
    np.testing.assert_array_equal(log.pointing.ravel(), k)
    np.testing.assert_array_equal(told.star_valid, [[False, True], [True, True], [True, True], [True, True]])
    arrived = np.stack([5 * np.arange(4.0), 5 * np.arange(4.0) + 2], 1)
    np.testing.assert_allclose(told.star[..., 0], np.cos(arrived), atol=1e-12)
    np.testing.assert_array_equal(told.nis, arrived)
    # innovation: from the clone of the tick before to the sample, a turn of 2 rad about x; none without a sample
    turn = np.where(told.star_valid, 2 - 0 * arrived, 0)
    np.testing.assert_allclose(np.ravel(told.innovation[..., 0])[2:], np.ravel(turn)[2:], atol=1e-9)
    assert not told.innovation[0, 0].any()
    np.testing.assert_array_equal(told.wheel_cusum[:, 0], [4, 9, 14, 19])  # the largest of the packet
    np.testing.assert_array_equal(told.gyro_cusum, [0, -5, -10, -15])
    np.testing.assert_allclose(told.attitude[1:, 0], np.cos([4.0, 9, 14]), atol=1e-12)  # before the packet


def test_a_packet_of_the_loop_has_the_fields_of_the_example_and_nothing_of_the_truth():
    short = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), tree)
    kind = lambda a: jnp.float32 if a.dtype.kind == "f" else a.dtype
    state = jax.eval_shape(microsat.init, short(microsat.params), short(loop.scenario))
    state = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, kind(a)), state)  # as the engine starts it
    now = microsat.Now(jnp.int32(0), jnp.float32(0), 0.5)
    tick = lambda *a: microsat.tick(short(microsat.params), short(loop.scenario), now, *a)
    after, log = jax.eval_shape(lambda s, n: (lambda x, z, log: ((x, z), log))(*tick(*s, n)), state, jnp.zeros(95, jnp.float32))  # fmt: skip
    kinds = lambda tree: [(a.shape, np.dtype(a.dtype)) for a in jax.tree.leaves(tree)]
    assert kinds(log.telemetry) == kinds(WORLD.example()) and kinds(after) == kinds(state)
    truth = {"t", "k", "onset", "q", "h", "knowledge", "nees", "rate_error", "fault"}
    assert not truth & set(microsat.Telemetry._fields)


# days


@pytest.mark.short
def test_days_are_the_same_in_all_cells_and_run_in_light_or_in_shadow():
    healthy = days(None)
    assert np.isinf(worlds.onset_of(WORLD, healthy)).all() and not healthy.act.any()
    lit = jax.jit(jax.vmap(lambda t: at(loop.params.table, t).lit))
    for seconds in np.linspace(0, microsat_days.WARMUP + microsat_days.WINDOW, 9):
        there = np.asarray(lit(healthy.t0.astype(float) + seconds))
        assert (there[::2] > loop.SEEN).all() and (there[1::2] <= 0).all()
    for cell in [("gyro_bias", 30.0), ("star_noise", 3.0), ("wheel_friction", 2.0), ("sun_noise", 2.0), ("field_bias", 500.0), ("gyro_bias+star_bias", (1.0, 2.0)), ("star_frozen", 1.0), ("wheel_seized", 1.0)]:  # fmt: skip
        day, parts = days(cell), cell[0].split("+")
        for name in day._fields:
            if name not in ("gyro", "star", "wheel", "box", "sun", "field"):
                assert all(np.array_equal(a, b) for a, b in zip(*(jax.tree.leaves(getattr(d, name)) for d in (healthy, day)))), name  # fmt: skip
        onset, truth = worlds.onset_of(WORLD, day), worlds.true_channels(WORLD, day)
        assert (onset >= 0).all() and (onset < 240).all() and np.ptp(onset) > 180
        whole = "noise" in cell[0] or "frozen" in cell[0]
        assert set(truth.sum(1)) == {3 if whole else len(parts)}
        units = np.repeat(list(WORLD.units), list(WORLD.units.values()))
        assert all({kind.split("_")[0] for kind in parts} == set(units[row]) for row in truth)


@pytest.mark.short
def test_a_fault_acts_as_its_kind_says():
    put = lambda cell, unit: jax.tree.map(lambda *a: np.stack(a, -1), *getattr(days(cell), unit))
    bias = put(("gyro_bias", 36.0), "gyro")
    np.testing.assert_allclose(np.abs(bias.bias).max(1), 0.01 * np.pi / 180, rtol=1e-5)
    assert set(np.sign(bias.bias[np.isfinite(bias.onset)])) == {-1.0, 1.0}
    arw = 0.15 * np.pi / 180 / 60 / np.sqrt(0.1)
    np.testing.assert_allclose(put(("gyro_noise", 3.0), "gyro").random.max(1), 2 * arw, rtol=1e-5)
    assert not put(("gyro_dead", 1.0), "gyro").random.any() and not put(("gyro_dead", 1.0), "gyro").scale.min(1).any()
    np.testing.assert_allclose(put(("sun_noise", 2.0), "sun").random, 0.05 * np.pi / 180, rtol=1e-5)
    np.testing.assert_allclose(np.abs(put(("field_bias", 500.0), "field").bias).max(1), 5e-7, rtol=1e-5)
    on = lambda wheel: np.isfinite(wheel.onset)
    lost, worn, seized = (
        days(cell).wheel for cell in (("wheel_loss", 0.3), ("wheel_friction", 2.0), ("wheel_seized", 1.0))
    )
    np.testing.assert_allclose(lost.drive[on(lost)], 0.7, rtol=1e-6)
    np.testing.assert_allclose(worn.wear[on(worn)], 3.0, rtol=1e-6)
    assert (seized.seized[on(seized)] == 1).all() and (lost.seized == 0).all() and (on(lost).sum(1) == 1).all()


def test_kinds_of_another_world_are_refused():
    with pytest.raises(ValueError, match="`cell` must be of a kind that microsat has"):
        worlds.days(WORLD, KEY, np.arange(4), ("wheel_offset", 1.0))
    with pytest.raises(ValueError, match="`cell` must be of a kind that leo4 has"):
        worlds.days(WORLDS["leo4"], KEY, np.arange(4), ("sun_bias", 1.0))
    with pytest.raises(ValueError, match="`world` must be a world of leo4's"):
        control([CONTROLLERS["pd"]], WORLD, n=4)
    assert all(
        set(part for kind in world.catalogue for part in kind.split("+")) <= set(UNIT) for world in WORLDS.values()
    )


# rows


def packets(n, seed=0):
    """Packets, n in front, of wheels that follow their torques and of sensors that agree, with the noise of sheets."""
    rng, p = np.random.default_rng(seed), microsat.params
    std_gyro = 0.15 * np.pi / 180 / 60 / np.sqrt(0.1)
    torque, tacho = np.zeros((5 * n, 4)), np.tile(0.1 * loop.NULL, (5 * n, 1))
    for k in range(5 * n):
        push, speed = 1e-3 * rng.normal(size=4), tacho[k] / p.wheel.J
        torque[k] = push + np.sign(speed) * p.wheel.friction.coulomb + p.wheel.friction.viscous * speed
        tacho[min(k + 1, 5 * n - 1)] = tacho[k] + 0.1 * push
    torque, tacho = torque.reshape(n, 5, 4), tacho.reshape(n, 5, 4)
    q = np.array([0.5, 0.5, -0.5, 0.5])
    there = np.array([1.0, 2.0, 2.0]) / 3
    body = np.asarray(array(quat_to_body(Quat.of(q), Vec3.of(there))))
    wide = lambda a: np.broadcast_to(a, (n, 2, *np.shape(a)))
    sun, field = (size * wide(body) + std * rng.normal(size=(n, 2, 3)) for size, std in ((1.0, p.std_sun), (4e-5, p.std_field)))  # fmt: skip
    rate = 1e-3 * rng.normal(size=(n, 5, 3))
    like = jax.tree.map(lambda a: np.repeat(a[None], n, 0), WORLD.example())
    return like._replace(
        gyro=rate + std_gyro * rng.normal(size=rate.shape), momentum_rate=rate, torque=torque,
        tacho=tacho + p.std_tacho * rng.normal(size=tacho.shape), star=wide(q), sun=sun, field=field, sun_there=wide(there),
        field_there=wide(4e-5 * there), innovation=np.array([10.6, 65.0, 10.6]) * loop.DEG / 3600 * rng.normal(size=(n, 2, 3)),
        nis=rng.chisquare(3, size=(n, 2)),
    )  # fmt: skip


def residuals(told):
    return np.asarray(jax.lax.scan(rows.residuals_step, jax.tree.map(lambda a: a.astype(float), rows.residuals_init()), told)[1])  # fmt: skip


@pytest.mark.short
def test_residuals_are_of_unit_size_and_see_what_they_are_for():
    told = packets(400)
    r = residuals(told)
    std = r[50:].std(0)
    # about a mean of memory N, sqrt(1 + 1 / (2 N)); the noise of tachometers is that of a difference
    np.testing.assert_allclose(std, 1.0, atol=0.12)
    moved = lambda change: (residuals(change) - r)[300:].mean(0)
    late = np.arange(400)[:, None, None] >= 300
    bias = moved(told._replace(gyro=told.gyro + late * np.array([0, 1e-4, 0])))
    assert np.abs(bias[1]) > 0.5 and np.abs(np.delete(bias, 1)).max() < 1e-9
    slip = np.cumsum((late * np.ones((400, 5, 1))).reshape(2000, 1), 0).reshape(400, 5, 1) * 1e-5
    wheel = moved(told._replace(tacho=told.tacho + slip * np.eye(4)[2]))
    assert np.abs(wheel[8]) > 0.5 and np.abs(np.delete(wheel, 8)).max() < 1e-9
    star = moved(told._replace(innovation=told.innovation + late * np.array([1e-4, 0, 0])))
    assert np.argmax(np.abs(star)) == 4  # about x is the second of z, x, y
    dark = residuals(told._replace(mode=np.ones(400, int)))
    assert not dark[:, rows.SUN].any() and np.array_equal(dark[:, rows.FIELD], r[:, rows.FIELD])


@pytest.mark.short
def test_the_logic_of_the_computer_blames_as_the_loop_does():
    calm = packets(1)
    calm = jax.tree.map(lambda a: np.asarray(a[0], float) if a.dtype.kind == "f" else a[0], calm)
    step = jax.jit(rows.fdir_step)
    units = np.repeat(np.arange(5), list(WORLD.units.values()))

    def told(since=1e6, **changed):
        _, verdict = step(MICROSAT_ROWS["fdir"].params, jnp.float64(since), calm._replace(**changed))
        return float(verdict.score), {int(u) for u in units[np.asarray(verdict.blame) > 0]}

    assert told(nis_sum=np.float64(70.0)) == (0.5, {1})
    assert told(rejected=np.float64(8.0)) == (2.0, {1})
    assert told(rejected=np.float64(8.0), gyro_cusum=np.float64(13.0)) == (2.0, {0})
    assert told(since=50.0, rejected=np.float64(8.0)) == (2.0, {0}) and told(since=61.0, rejected=np.float64(8.0))[
        1
    ] == {1}
    assert told(wheel_cusum=np.array([0, 0, 16.0, 0])) == (2.0, {2})
    assert told(cross=np.float64(3.0), sun=calm.sun + 0.01) == (3.0, {3})
    assert told(cross=np.float64(3.0), field=calm.field + 5e-6) == (3.0, {4})
    assert told(cross=np.float64(3.0), sun=calm.sun + 0.01, field=calm.field + 5e-6) == (3.0, {1})


@pytest.mark.short
def test_flat_readings_and_the_largest_sum_are_told():
    flat = WORLD.references[-1]
    told = packets(8)
    told = told._replace(gyro=np.where(np.arange(3) == 1, told.gyro[0, 0, 1], told.gyro), star=told.star * np.linspace(1, 2, 16).reshape(8, 2, 1))  # fmt: skip
    scan = lambda row, told: jax.lax.scan(lambda z, t: row.step(row.params, z, t), rules.state_of(row), jax.tree.map(lambda a: a.astype(np.float32) if a.dtype.kind == "f" else a, told))[1]  # fmt: skip
    found = scan(flat, told)
    np.testing.assert_array_equal(found.score, 4 + 5 * np.arange(8.0))
    assert (np.argmax(found.blame, 1) == 1).all()
    many = packets(60)
    late = np.arange(60)[:, None, None] >= 40
    found = scan(MICROSAT_ROWS["cusum"], many._replace(field=many.field + late * np.array([0, 0, 1e-6])))
    assert found.score[-1] > 20 and np.argmax(found.blame[-1]) == 15 and found.blame.shape == (60, WORLD.channels)


# a board


def step(params, z, telemetry):
    z = 0.9 * z + jnp.sum(telemetry.nis)
    return z, Verdict(z, jnp.ones(16, z.dtype))


MINE = Detector("mine", lambda params: jnp.zeros(()), step)


@pytest.mark.short
def test_a_ranking_of_made_up_days_has_the_units_and_modes_of_the_world(monkeypatch, tmp_path, capsys):
    for module in (ranking, calibration):
        monkeypatch.setattr(module, "run", made_up)
    monkeypatch.setattr(rules, "records", lambda world: None)
    monkeypatch.setattr(rules, "checked", lambda *_: rules.Checks(True, True, True, True, True, 10.0))
    board = rank([MINE, MICROSAT_ROWS["fdir"]], WORLD, days=8, hours=200)
    mine, fdir = board.rows[:2]
    assert (mine["name"], fdir["name"], set(mine["units"])) == ("mine", "fdir", set(WORLD.units))
    assert all(value == pytest.approx(5, abs=0.5) for value in mine["units"].values())
    assert list(mine["rate"]) == ["sunlit", "eclipse"] and mine["rate"]["sunlit"][1] < 0.1 < mine["rate"]["sunlit"][2]
    assert len(board.cells) == 12 * 8 + 4 + 16 and fdir["macro"] == pytest.approx(50, abs=0.5)
    assert all(worlds_name.startswith("microsat ") for worlds_name in fdir["robustness"]["all"])
    assert "field" in board.table() and "sunlit eclipse" in board.table() and len(board.figure().axes) == 2
    path, cells = tmp_path / "b.json", [("sun_bias", 0.1), ("wheel_seized", 1.0)]
    rank([MICROSAT_ROWS[name] for name in ("fdir", "wheels")], WORLD, days=8, hours=100, cells=cells).to_json(path)
    monkeypatch.setattr(command, "configure", lambda: None)
    assert command.main([str(path)]) == 0 and "the same to the bit" in capsys.readouterr().out
    with pytest.raises(TypeError, match=r"a blame of shape \(16,\)"):
        rank([MINE._replace(step=lambda p, z, t: (z, Verdict(z, jnp.ones(11))))], WORLD)
    with pytest.raises(ValueError, match="`cell` must be of a kind that microsat has"):
        rank([MINE], WORLD, cells=[("wheel_offset", 1.0)])
