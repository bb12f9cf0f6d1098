"""Recorded readings through on-board code: the computer knows what it knew in the closed loop; files."""

from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas
import pytest
from scipy.spatial.transform import Rotation

from jaxatt import Now, Reading, Vec3, plot, simulate, tables
from jaxatt.faults import dead_where
from jaxatt.loops import cmg_loss, gyro_ekf, microsat, observer_pd, star_isolation, wheel_mrac
from jaxatt.observers import AttitudeRate
from jaxatt.replay import checked, load, replay, resample, together, unit_quaternions
from jaxatt.sensors import read_triad

KEY = jax.random.key(4)
TICKS = 120

# replay is the run


class Case(NamedTuple):
    """A closed loop, and what its sensors say."""

    loop: Any  # module
    system: Any
    decide: Any
    scenario: Any
    told: Any  # (scenario, now, x, z before, z after, noise) -> readings of a tick
    flow: Any = None
    read: Any = None  # (scenario, x, z) -> readings between ticks


def observer_reads(scenario, x, z):
    values = read_triad(z.sensors.star, x.q), read_triad(z.sensors.gyro, x.w)
    return AttitudeRate(*(told._replace(value=a) for told, a in zip(z.sensors.y, values)))


def wheel_reads(scenario, x, z):
    y = wheel_mrac.tachometer(scenario, z.sensors.tacho, x.y)
    theta, told = z.sensors.readings
    return wheel_mrac.Readings(theta, told._replace(value=y))


OBSERVER = observer_pd.scenario._replace(
    gyro=Vec3(*(f._replace(onset=4.0) for f in observer_pd.scenario.gyro)),
    star=Vec3(*(f._replace(onset=8.0) for f in observer_pd.scenario.star)),
)
EKF = gyro_ekf.scenario._replace(gyro=dead_where([False, True, False, False], 5.0))
STAR = star_isolation.scenario._replace(
    star=jax.tree.map(lambda a: np.where(a == 100.0, 6.0, a), star_isolation.scenario.star)
)
CMG = cmg_loss.scenario._replace(std_w=1e-4)
WHEEL = wheel_mrac.scenario._replace(tacho_noise=1.0, drive=wheel_mrac.Fault(onset=1.0, scale=0.5))
SURE = gyro_ekf.consistent(gyro_ekf.params)
P0 = np.where(np.arange(17) // 3 == 1, 1.0, SURE.P0)  # it does not know its angles at the start
Spinning = SimpleNamespace(params=SURE._replace(P0=P0), computer_of=gyro_ekf.computer_of)
CASES = {
    "observer_pd": Case(observer_pd, observer_pd.system, observer_pd.decide, OBSERVER,
                        lambda s, now, x, z, after, noise: after.sensors.y, observer_pd.computer_flow, observer_reads),
    "gyro_ekf": Case(gyro_ekf, gyro_ekf.system, gyro_ekf.decide, EKF,
                     lambda s, now, x, z, after, noise: gyro_ekf.sense(gyro_ekf.params, s, now, x, z, noise)),
    "cmg_loss": Case(cmg_loss, cmg_loss.system, cmg_loss.decide, CMG,
                     lambda s, now, x, z, after, noise: cmg_loss.sense(cmg_loss.params, s, now, x, z, noise)),
    "star_isolation": Case(star_isolation, star_isolation.system, star_isolation.decide, STAR,
                           lambda s, now, x, z, after, noise: after.sensors.readings),
    "wheel_mrac": Case(wheel_mrac, wheel_mrac.system, wheel_mrac.decide, WHEEL,
                       lambda s, now, x, z, after, noise: after.sensors.readings, wheel_mrac.computer_flow, wheel_reads),
    "wheel_mrac, sampled": Case(wheel_mrac, wheel_mrac.sampled, wheel_mrac.decide_sampled, WHEEL,
                                lambda s, now, x, z, after, noise: after.sensors.readings,
                                wheel_mrac.computer_flow_sampled, wheel_reads),
    "microsat": Case(microsat, microsat.system, microsat.decide, microsat.scenario,
                     lambda s, now, x, z, after, noise: after.sensors.readings),
}  # fmt: skip


class Run(NamedTuple):
    """What a closed loop was told and remembered."""

    start: Any  # the computer before the first tick
    told: Any  # readings at the ticks
    between: Any  # at every stage of RK4; None where nothing moves on board
    computers: Any  # after each decide
    log: Any


def recorded(case, ticks=TICKS) -> Run:
    """A closed loop run by the engine; where the computer flows, written down once more to see its readings there."""
    system, params, scenario = case.system, case.loop.params, jax.tree.map(jnp.asarray, case.scenario)
    noise = jax.random.normal(KEY, (ticks, system.normals))

    def tick(params, scenario, now, x, z, n):
        x_after, after, log = system.tick(params, scenario, now, x, z, n)
        return x_after, after, (case.told(scenario, now, x, z, after, n), case.loop.computer_of(x_after, after), log)

    start = jax.tree.map(lambda a: jnp.asarray(a, jnp.result_type(a)), system.init(params, scenario))
    known = case.loop.computer_of(*start)
    if not case.flow:
        told, computers, log = simulate(system._replace(tick=tick), params, scenario, noise, ticks=ticks)
        return Run(known, told, None, computers, log)
    h = system.dt / system.substeps

    def step(state, kn):
        now = Now(kn[0], kn[0] * system.dt, system.dt)
        x, z, out = tick(params, scenario, now, *state, n=kn[1])

        def substep(x, t):
            ahead = lambda k, by: jax.tree.map(lambda a, b: a + by * h * b, x, k)
            seen, slopes, k = [], [], jax.tree.map(jnp.zeros_like, x)
            for by in (0, 0.5, 0.5, 1):
                there = ahead(k, by)
                seen.append(case.read(scenario, there, z))
                k = system.flow(params, scenario, t + by * h, there, z)
                slopes.append(k)
            mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, *slopes)
            return ahead(mean, 1), jax.tree.map(lambda *a: jnp.stack(a), *seen)

        x, between = jax.lax.scan(substep, x, now.t + h * jnp.arange(system.substeps))
        return (x, z), (*out, between)

    told, computers, log, between = jax.jit(lambda: jax.lax.scan(step, start, (jnp.arange(ticks), noise))[1])()
    return Run(known, told, between, computers, log)


@pytest.fixture(scope="module", params=CASES)
def run(request):
    """A case, its run, and the computers and logs of the replay."""
    case = CASES[request.param]
    run = recorded(case)
    grid = dict(dt=case.system.dt, flow=case.flow, substeps=case.system.substeps, between=run.between)
    return case, run, *replay(case.decide, case.loop.params, run.start, run.told, **grid)


def close(a, b, rtol=1e-9):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        if x.dtype.kind in "bi":
            np.testing.assert_array_equal(x, y)
        else:
            np.testing.assert_allclose(x, y, rtol=rtol, atol=rtol * max(np.abs(x).max(), 1e-30))


def test_the_computer_of_a_replay_is_that_of_the_closed_loop(run):
    _, run, computers, _ = run
    close(run.computers, computers)


def test_so_is_what_it_says(run):
    case, (*_, log), computers, said = run
    if case.loop is observer_pd:
        close((log.xi, log.alarm), said)
        assert log.alarm[40:].all() and not log.alarm[:40].all()
    elif case.loop is star_isolation:
        close(log.verdict, said)
        assert log.verdict.latched[-1].tolist() == [True, False]
    elif case.loop is wheel_mrac:
        close((log.residual, log.alarm, log.flipped), said)
        assert log.alarm[60:].any() and log.alarm[:25].sum() < 25
    elif case.decide is gyro_ekf.decide:
        (met, suspicion), f = said, log.filter
        close(
            (f.nis, f.rows, f.nll, f.statistic, f.parity),
            (met.nis, met.rows, met.nll, suspicion.gyro, suspicion.parity),
        )
    elif case.loop is microsat:
        close(log.statistics, said)
    else:
        close(log.u, jnp.clip(computers.u, -1, 1) * np.array([1, 1, 1, 0]))


def brought_back(folder, kind, tree, dt):
    """A tree of the ticks, written and read again; its units and times are compared on the way."""
    data, like = tables.dataset(tree, dt=dt), jax.tree.map(lambda a: a[0], tree)
    tables.write(folder / f"run{kind}", data)
    there = tables.read(folder / f"run{kind}")
    units = lambda table: {name: a.attrs.get("units") for name, a in table.variables.items()}
    assert units(there) == units(data) and there.time.values.tolist() == data.time.values.tolist()
    return tables.tree_of(there, like)


def test_a_file_brings_back_the_readings_and_with_them_the_computer_of_the_closed_loop(run, tmp_path):
    case, run, known, _ = run
    between = None if run.between is None else brought_back(tmp_path, ".nc", {"between": run.between}, 0.1)["between"]
    for kind in tables.FORMATS:
        told = brought_back(tmp_path, kind, run.told, case.system.dt)
        for a, b in zip(jax.tree.leaves((run.told, run.between)), jax.tree.leaves((told, between)), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b, kind)
    grid: dict[str, Any] = dict(dt=case.system.dt, flow=case.flow, substeps=case.system.substeps, between=between)
    computers, _ = replay(case.decide, case.loop.params, run.start, told, **grid)
    # what microsat states in units of its sensors' noise, 1e-6 and less, has the rounding of two programs so much larger
    counted = {"wheel", "gyro", "nis"} if case.loop is microsat else set()
    parts = jax.tree_util.tree_leaves_with_path(run.computers)
    for (path, a), b, c in zip(parts, jax.tree.leaves(computers), jax.tree.leaves(known), strict=True):
        np.testing.assert_array_equal(b, c)
        atol = 1e-10 if path[0].name in counted else 1e-12
        np.testing.assert_allclose(np.asarray(a, float), np.asarray(b, float), rtol=1e-12, atol=atol)


def test_the_log_of_every_loop_is_a_table_in_units_as_a_figure_needs_it(run):
    case, run, *_ = run
    data = tables.dataset(run.log)
    assert all(a.attrs["units"] for a in data.variables.values()) and len(data.time) == TICKS
    if case.loop is cmg_loss:
        labels = [ax.get_ylabel() for ax in plot.overview(data)]
        plt.close("all")
        assert labels[0].endswith("]") and "w [rad/s]" in labels


def test_the_loop_written_down_once_more_is_the_shipped_one():
    case = CASES["observer_pd"]
    noise = jax.random.normal(KEY, (TICKS, case.system.normals))
    close(simulate(case.system, case.loop.params, case.scenario, noise, ticks=TICKS), recorded(case).log)


def test_angles_that_wrap_at_180_deg_are_the_angles_that_do_not():
    """A body that turns through 180 deg: its log jumps from +180 to -180 deg, and the filter must not see it."""
    case = CASES["gyro_ekf"]
    spinning = case.scenario._replace(angle=Vec3(0.1, 0.02, 2e-4 - np.pi), w=Vec3(3e-4, 0.0, -4e-4))
    case = case._replace(scenario=spinning, loop=Spinning)
    run = recorded(case)
    angle = run.told.angle
    jumping = angle._replace(value=np.mod(angle.value + np.pi, 2 * np.pi) - np.pi)
    assert np.ptp(jumping.value[:, 2]) > 6 and np.ptp(angle.value, axis=0).max() < 2
    computers, (met, _) = replay(
        case.decide, Spinning.params, run.start, run.told._replace(angle=jumping), dt=gyro_ekf.DT
    )
    close(run.computers.belief.mean, computers.belief.mean)
    close(run.log.filter.nis[:12], met.nis[:12], 1e-6)
    close(run.log.filter.nis, met.nis, 1e-5)  # so far do readings changed in their last place move it in this run, too
    assert met.nis[3:].max() < 60 and np.abs(run.log.filter.error[8:, gyro_ekf.ANGLE]).max() < 1e-3


class Lag(NamedTuple):
    x: Any


def lag(k, **how):
    """A lag of 1 s behind sin(k t), told every 0.1 s for 3 s."""
    t = 0.1 * np.arange(31)
    flow = lambda params, computer, y: dict(x=y - computer.x)
    computers, _ = replay(
        lambda params, now, computer, y: (computer, ()), (), Lag(0.0), np.sin(k * t), dt=0.1, flow=flow, **how
    )
    return t, np.asarray(computers.x)


def test_readings_are_held_between_ticks():
    t, x = lag(3.0)
    expected = [0.0]
    for y in np.sin(3 * t[:-1]):
        expected.append(y + (expected[-1] - y) * (1 - 0.1 + 0.1**2 / 2 - 0.1**3 / 6 + 0.1**4 / 24))  # RK4's exp(-0.1)
    np.testing.assert_allclose(x, expected, atol=1e-12)


def test_finer_readings_are_used_where_there_are_some():
    stages = 0.1 * np.arange(31)[:, None, None] + 0.05 * (np.arange(2)[:, None] + np.array([0, 0.5, 0.5, 1]))
    t, x = lag(3.0, substeps=2, between=np.sin(3 * stages))
    np.testing.assert_allclose(x, (np.sin(3 * t) - 3 * np.cos(3 * t) + 3 * np.exp(-t)) / 10, atol=1e-6)


def test_maps_and_gradients_go_through():
    told = np.random.default_rng(1).normal(size=(3, 20))
    decide = lambda params, now, computer, y: (computer + params * (y - computer), now.t)
    run = lambda told, params=0.3: replay(decide, params, 0.0, told, dt=0.1)
    mapped, t = jax.vmap(run)(told)
    for one, times, y in zip(mapped, t, told):
        np.testing.assert_allclose(run(y)[0], one, rtol=1e-14)
        np.testing.assert_allclose(times, 0.1 * np.arange(20), atol=1e-15)
    end = lambda params: run(told[0], params)[0][-1]
    assert jax.grad(end)(0.3) == pytest.approx(float(end(0.3 + 1e-6) - end(0.3 - 1e-6)) / 2e-6, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(dt=0.0), "`dt` must be a positive number"),
        (dict(substeps=0), "`substeps` must be a whole number"),
        (dict(readings={"a": np.ones(3), "b": np.ones(4)}), r"`readings\['b'\]` must lead with the ticks.*\(4,\)"),
        (dict(readings=()), "`readings` must hold at least one array"),
        (dict(readings={"a": np.ones(0)}), "at least one"),
        (dict(between={"a": np.ones((3, 1, 3))}), r"`between\['a'\]` must have shape \(3, 1, 4"),
    ],
)  # fmt: skip
def test_bad_recordings_are_refused(change, message):
    given = dict(readings={"a": np.ones(3)}, dt=0.1) | change
    decide = lambda params, now, computer, y: (computer + y["a"], computer)
    with pytest.raises(ValueError, match=message):
        replay(decide, (), 0.0, **given)


def test_a_computer_that_changes_its_kind_is_refused():
    with pytest.raises(TypeError, match="`decide` must return"):
        replay(lambda params, now, computer, y: ((computer, y), ()), (), 0.0, np.ones(3), dt=0.1)


# samples


def test_samples_go_to_the_nearest_tick_and_gaps_are_not_valid():
    t = np.array([10.0, 10.11, 10.19, 10.22, 10.7, 10.81])
    got = resample(t, {"a": np.arange(6.0)}, dt=0.1)["a"]
    assert got.value.tolist() == [0, 1, 2, 2, 2, 2, 2, 4, 5]
    assert got.valid.tolist() == [True, True, True, False, False, False, False, True, True]


def test_missing_samples_are_gaps_of_their_channel():
    t, nan = 0.5 * np.arange(4), np.nan
    got = resample(t, {"a": np.array([nan, 1.0, nan, 3.0]), "b": np.arange(4.0)}, dt=0.5)
    assert got["a"].value.tolist() == [1, 1, 1, 3] and got["a"].valid.tolist() == [False, True, False, True]
    assert got["b"].valid.all()
    both = together(got, ["b", "a"])
    assert both.value.tolist() == [[0, 1], [1, 1], [2, 1], [3, 3]] and both.valid.shape == (4, 2)


@pytest.mark.parametrize("seed", range(3))
def test_jitter_within_half_a_tick_loses_no_sample(seed):
    rng = np.random.default_rng(seed)
    ticks = np.arange(200)
    t = 1e6 + 0.02 * (ticks + rng.uniform(-0.49, 0.49, 200) * (ticks > 0))
    got = resample(t, {"a": 1.0 * ticks}, dt=0.02, ticks=200)["a"]
    assert got.valid.all() and got.value.tolist() == ticks.tolist()


def test_more_samples_than_ticks_and_fewer():
    t = 0.01 * np.arange(100)
    got = resample(t, {"a": t}, dt=0.1, ticks=5)["a"]
    np.testing.assert_allclose(got.value, 0.1 * np.arange(5), atol=1e-12)
    assert resample(t, {"a": t}, dt=0.1, ticks=30)["a"].valid.tolist() == [True] * 11 + [False] * 19


@pytest.mark.parametrize(
    ("t", "a", "message"),
    [
        ([0, 1, 1, 2], None, "`time` must increase from row to row, but it is 1 after 1 in row 2"),
        ([0, 2, 1, 3], None, "`time` must increase from row to row, but it is 1 after 2 in row 2"),
        ([0, 1, np.nan, 3], None, "`time` must be finite, but it is nan in row 2"),
        ([], None, "`time` must have shape"),
        (None, [0, 1, np.inf, 3], "`a` must be finite, or NaN where a sample is missing, but it is inf in row 2"),
        (None, [np.nan] * 4, "`a` must hold at least one sample"),
        (None, [1.0, 2.0], r"`a` must have the shape \(4,\) of the times"),
        ([0, 1e3, 2e3, 3e6], None, "`time` must span at most 1000 ticks"),
    ],
)  # fmt: skip
def test_times_and_samples_that_cannot_be_are_refused(t, a, message):
    t = np.arange(4.0) if t is None else np.array(t, float)
    with pytest.raises(ValueError, match=message) as refusal:
        resample(t, {"a": np.ones(len(t)) if a is None else a}, dt=0.5)
    assert "\n" not in str(refusal.value)


# files

TABLE = {"time [s]": [0.0, 0.5, 1.0], "gyro_a [rad/s]": [0.1, 0.2, 0.30000000000000004], "note": ["x", "y", "z"]}


def written(path, columns):
    frame = pandas.DataFrame(columns)
    frame.to_csv(path, index=False) if path.suffix == ".csv" else frame.to_parquet(path)
    return path


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_files_are_read_to_the_last_bit(tmp_path, kind):
    t, columns = load(written(tmp_path / f"a.{kind}", TABLE), {"gyro_a": "rad/s"})
    assert t.tolist() == TABLE["time [s]"] and list(columns) == ["gyro_a"]
    assert columns["gyro_a"].tolist() == TABLE["gyro_a [rad/s]"]


def test_an_empty_cell_is_a_missing_sample(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time [s],gyro_a [rad/s]\n0,1\n1,\n2,NaN\n")
    _, columns = load(path, {"gyro_a": "rad/s"})
    np.testing.assert_array_equal(columns["gyro_a"], [1, np.nan, np.nan])


BAD = {
    "a missing channel": ("time [s],gyro_b [rad/s]\n0,1\n", r"`gyro_a \[rad/s\]` must be a column of a.csv.*gyro_b"),
    "another quantity": ("time [s],gyro_a [deg]\n0,1\n", r"`gyro_a` must be given in \[rad/s\].*\[deg\]"),
    "no unit": ("time [s],gyro_a\n0,1\n", r"`gyro_a` must be given in \[rad/s\]"),
    "time in ms": ("time [ms],gyro_a [rad/s]\n0,1\n", r"`time` must be given in \[s\]"),
    "no time": ("t [s],gyro_a [rad/s]\n0,1\n", r"`time \[s\]` must be a column"),
    "words": ("time [s],gyro_a [rad/s]\n0,1\n1,off\n", r"`gyro_a \[rad/s\]` must hold numbers, but it is 'off' in row 1"),
    "a column twice": ("time [s],gyro_a [rad/s],gyro_a [rad/s]\n0,1,2\n", "`path` must name every column once"),
    "a row too long": ("time [s],gyro_a [rad/s]\n0,1\n1,2,3\n", "`path` must be a csv file"),
    "nothing": ("", "`time \\[s\\]` must be a column|`path` must be a csv file"),
    "no rows": ("time [s],gyro_a [rad/s]\n", "`time` must have shape|`path` must be a csv file"),
    "a time twice": ("time [s],gyro_a [rad/s]\n0,1\n0,1\n", "`time` must increase"),
    "times out of order": ("time [s],gyro_a [rad/s]\n1,1\n0,1\n", "`time` must increase"),
    "a time missing": ("time [s],gyro_a [rad/s]\n0,1\n,1\n", "`time` must be finite"),
    "an infinity": ("time [s],gyro_a [rad/s]\n0,1\n1,inf\n", "`gyro_a` must be finite"),
    "an empty channel": ("time [s],gyro_a [rad/s]\n0,\n1,\n", "`gyro_a` must hold at least one sample"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_a_bad_file_is_refused_in_one_line(tmp_path, what):
    text, message = BAD[what]
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as refusal:
        load(path, {"gyro_a": "rad/s"})
    assert "\n" not in str(refusal.value)


def test_no_file_runs_code(tmp_path):
    touched = tmp_path / "touched"

    class Trap:
        def __reduce__(self):
            return touched.touch, ()

    for name in ("a.pkl", "a.npy", "a.npz"):
        path = tmp_path / name
        pandas.to_pickle(Trap(), path, compression=None)
        with pytest.raises(ValueError, match=r"`path` must end in \.csv or \.parquet"):
            load(path, {})
    for name in ("a.csv", "a.parquet"):
        (tmp_path / name).write_bytes((tmp_path / "a.pkl").read_bytes())
        with pytest.raises(ValueError, match=r"`time|`path"):
            load(tmp_path / name, {})
    assert not touched.exists()


def test_without_pandas_the_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxatt\[data\]'"):
        load(tmp_path / "a.csv", {})


def test_arrays_need_no_file():
    t, columns = checked([0, 1], {"a": [1, np.nan]})
    assert t.dtype == float and np.isnan(columns["a"][1])
    assert isinstance(resample(t, columns, dt=1.0)["a"], Reading)


# quaternions


def logged(steps=40, scale=1.0, digits=3):
    """A body that turns several times, as a log has it: few digits, the scalar not negative, so that signs jump."""
    turns = Rotation.from_rotvec(np.linspace(0, 15, steps)[:, None] * [2 / 7, -3 / 7, 6 / 7])
    q = np.roll(turns.as_quat(canonical=True), 1, axis=1)
    q = np.round(q * scale, digits)
    return turns, dict(zip("wxyz", q.T))


@pytest.mark.parametrize(("scale", "digits", "off"), [(1.0, 3, 2e-3), (32767, 0, 1e-4), (1.0, 15, 1e-14)])
def test_quaternions_of_few_digits_are_made_unit_and_continuous(scale, digits, off):
    turns, columns = logged(scale=scale, digits=digits)
    columns["y"][7] = np.nan
    got = unit_quaternions(columns, list("wxyz"))
    assert list(got) == list("wxyz")
    q = np.stack(list(got.values()), 1)
    assert np.isnan(q[7]).all()
    q, turns = np.delete(q, 7, axis=0), turns[np.arange(40) != 7]
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-15)
    assert (np.sum(q[1:] * q[:-1], axis=1) > 0).all() and (np.diff(np.sign(columns["w"])) >= 0).any()
    assert (turns.inv() * Rotation.from_quat(q, scalar_first=True)).magnitude().max() < off
    assert (q[:, 0] < 0).any()  # where the log had the other sign


def test_the_order_of_the_names_says_where_the_scalar_is():
    _, columns = logged()
    other = {f"q{i + 1}": columns[name] for i, name in enumerate("xyzw")}
    first, last = unit_quaternions(columns, ["w", "x", "y", "z"]), unit_quaternions(other, ["q4", "q1", "q2", "q3"])
    np.testing.assert_array_equal(list(first.values()), list(last.values()))


@pytest.mark.parametrize(
    ("change", "names", "message"),
    [
        ({}, ["w", "x", "y"], "`names` must be four different channels"),
        ({}, "wxyz", "`names` must be four different channels"),
        ({}, ["w", "x", "y", "q"], "`names` must be four different channels"),
        ({}, ["w", "x", "y", "y"], "`names` must be four different channels"),
        (dict(w=np.zeros(40), x=np.zeros(40), y=np.zeros(40), z=np.zeros(40)), list("wxyz"), "of length 0 in row 0"),
        (dict(w=np.linspace(0, 3, 40)), list("wxyz"), r"`w` must belong to quaternions of one length .* in row \d+"),
        (dict(w=np.full(40, np.nan)), list("wxyz"), "`w` must belong to one complete quaternion at least"),
        (dict(w=np.ones(3)), list("wxyz"), "`names` must be channels of one shape"),
    ],
)
def test_what_is_no_quaternion_is_refused(change, names, message):
    with pytest.raises(ValueError, match=message):
        unit_quaternions(logged()[1] | change, names)


def test_rows_of_one_time_become_one_where_no_channel_is_given_twice():
    t, columns = checked(
        [0, 0, 1, 1, 1, 2], {"a": [1, np.nan, np.nan, 2, np.nan, 3], "b": [np.nan, 4, 5, np.nan, np.nan, 6]}
    )
    assert t.tolist() == [0, 1, 2] and columns["a"].tolist() == [1, 2, 3] and columns["b"].tolist() == [4, 5, 6]
    with pytest.raises(ValueError, match="`time` must increase from row to row, but it is 0 after 0 in row 1"):
        checked([0, 0, 1], {"a": [1, 2, 3], "b": [np.nan, 4, 5]})
