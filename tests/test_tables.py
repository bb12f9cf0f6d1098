"""Tables of runs: names, units and types survive every format, and what would come back wrong is refused."""

from typing import Annotated, Any, NamedTuple

import jax
import matplotlib.pyplot as plt
import numpy as np
import pandas
import pytest
import xarray
from scipy.io import loadmat

from jaxatt import Quat, Reading, Vec3, plot, tables
from jaxatt.replay import load

RNG = np.random.default_rng(5)
T, N = 7, 3


class Log(NamedTuple):
    t: Annotated[Any, "s"]
    w: Annotated[Vec3, "rad/s"]
    q: Annotated[Quat, "1"]
    h: Annotated[Any, "in-lbf/(rad s)"]  # (2, 2)
    alarm: Annotated[Any, "1"]
    gyro: Annotated[Reading, "mrad/s"]
    count: Any
    nothing: Any = None


def numbers(*shape):
    """Floats of all sizes, with what is not finite."""
    a = RNG.normal(size=shape) * 10.0 ** RNG.integers(-300, 300, shape)
    a.flat[:3] = np.nan, np.inf, -0.0
    return a


def log(*shape):
    some = lambda n: [numbers(*shape) for _ in range(n)]
    t = np.broadcast_to(0.1 * np.arange(T), shape)
    single = RNG.normal(size=(*shape, 2, 2)).astype(np.float32)
    reading = Reading(RNG.normal(size=shape), RNG.random(shape) < 0.5)
    return Log(
        t, Vec3(*some(3)), Quat(*some(4)), single, RNG.random(shape) < 0.5, reading, RNG.integers(0, 2**52, shape)
    )


SCORES = {"delay": np.array([1.5, np.inf, np.nan]), "ok": np.array([True, False, True]), "spans": numbers(N, 2)}
TREES = {"a log": (log(T), ("time",)), "a batch": (log(N, T), ("scenario", "time")), "scores": (SCORES, ("scenario",))}
COLUMNS = [
    "w.x",
    "w.y",
    "w.z",
    "q.w",
    "q.x",
    "q.y",
    "q.z",
    "h.0.0",
    "h.0.1",
    "h.1.0",
    "h.1.1",
    "alarm",
    "gyro.value",
    "gyro.valid",
    "count",
]


def same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)
        np.testing.assert_array_equal(np.signbit(x), np.signbit(y))


@pytest.mark.parametrize("kind", tables.FORMATS)
@pytest.mark.parametrize("what", TREES)
def test_what_is_written_comes_back_to_the_last_bit_with_names_units_and_types(tmp_path, what, kind):
    tree, dims = TREES[what]
    data = tables.dataset(tree, dims=dims, units={"spans": "m"} if what == "scores" else {})
    path = tmp_path / f"run{kind}"
    tables.write(path, data)
    there = tables.read(path)
    same(tree, tables.tree_of(there, jax.tree.map(lambda a: a[(0,) * len(dims)], tree)))
    assert there.sizes == data.sizes and set(there.variables) == set(data.variables)
    for name, a in data.variables.items():
        assert there[name].attrs.get("units") == a.attrs.get("units")
        assert there[name].dtype == a.dtype or (
            kind in (".csv", ".nc") and name in ("count", "scenario", *COLUMNS[7:11])
        )


def test_a_log_is_a_table_named_and_labelled_by_its_fields():
    data = tables.dataset(TREES["a log"][0])
    assert list(data.data_vars) == COLUMNS
    assert data.time.attrs == {"units": "s", "long_name": "time since the first tick"}
    units = [data[name].attrs.get("units") for name in ("w.x", "q.w", "h.1.0", "gyro.value", "gyro.valid", "count")]
    assert units == ["rad/s", "1", "in-lbf/(rad s)", "mrad/s", "1", None]


@pytest.mark.parametrize("what", TREES)
def test_data_frames_hold_the_same_and_lead_back(what):
    tree, dims = TREES[what]
    frame = tables.frame(tables.dataset(tree, dims=dims))
    assert tuple(frame.index.names) == dims and len(frame) == np.prod(np.shape(jax.tree.leaves(tree)[0]))
    assert what == "scores" or (frame.attrs["units"]["w.x"] == "rad/s" and frame.attrs["units"]["time"] == "s")
    same(tree, tables.tree_of(frame, jax.tree.map(lambda a: a[(0,) * len(dims)], tree)))
    assert tables.dataset(frame).equals(tables.dataset(tree, dims=dims))


def test_recorded_readings_take_a_period_or_times_and_units_of_their_own():
    t, columns = np.array([0.0, 0.1, 0.35]), {"gyro": np.arange(3.0)}
    assert tables.dataset(columns, dt=0.1).time.values.tolist() == [0, 0.1, 0.2]
    data = tables.dataset(columns, t=t, units={"gyro": "deg/s"})
    assert data.time.values.tolist() == t.tolist() and data.gyro.attrs == {"units": "deg/s"}


@pytest.mark.parametrize("kind", [".csv", ".parquet"])
def test_load_reads_a_written_table_too(tmp_path, kind):
    tree = log(T)._replace(w=Vec3(*RNG.normal(size=(3, T))))
    tables.write(tmp_path / f"a{kind}", tables.dataset(tree))
    t, columns = load(tmp_path / f"a{kind}", {"w.y": "rad/s", "gyro.value": "mrad/s", "alarm": "1"})
    assert t.tolist() == tree.t.tolist() and columns["w.y"].tolist() == tree.w.y.tolist()
    assert (
        columns["gyro.value"].tolist() == tree.gyro.value.tolist() and columns["alarm"].tolist() == tree.alarm.tolist()
    )


def test_matlab_finds_variables_that_it_can_name(tmp_path):
    data = tables.dataset({"w": Vec3(*np.eye(3)), "w_x": np.arange(3.0), "end": np.ones(3), "3": np.ones(3)}, dt=1.0)
    tables.write(tmp_path / "a.mat", data)
    found = loadmat(tmp_path / "a.mat")
    assert {"time", "w_x", "w_y", "w_z", "w_x_2", "end_", "x3", "names"} <= set(found)
    assert found["time"].shape == (3, 1) and {name[0] for name in found["names"][:, 1]} == set(data.variables)
    assert tables.read(tmp_path / "a.mat").equals(data)


def test_a_campaign_with_axes_of_its_own_is_a_table(tmp_path):
    store = xarray.Dataset({"h": (("h_0", "scenario"), np.eye(2, 3), {"units": "N m s"}), "ok": ("scenario", [1, 0, 1])},
                           {"scenario": [0, 1, 2]})  # fmt: skip
    tables.write(tmp_path / "a.csv", store)
    assert (tmp_path / "a.csv").read_text().splitlines()[:2] == ["scenario,h.0 [N m s],h.1 [N m s],ok", "0,1.0,0.0,1"]
    same({"h": np.eye(2, 3).T}, tables.tree_of(store, {"h": np.zeros(2)}))


def test_the_overview_takes_a_dataset_and_a_data_frame_as_they_are():
    data = tables.dataset(log(T)._replace(w=Vec3(*np.eye(3, T)), count=None))
    axes = plot.overview(data)
    labels = [
        "w [rad/s]",
        "q [1]",
        "h.0 [in-lbf/(rad s)]",
        "h.1 [in-lbf/(rad s)]",
        "alarm [1]",
        "gyro.value [mrad/s]",
        "gyro.valid [1]",
    ]
    assert [ax.get_ylabel() for ax in axes] == labels and axes[-1].get_xlabel() == "time [s]"
    assert [text.get_text() for text in axes[0].get_legend().get_texts()] == ["x", "y", "z"]
    np.testing.assert_array_equal(axes[0].lines[1].get_ydata(), np.eye(3, T)[1])
    axes = plot.overview(tables.frame(data), ["alarm", "w"], thresholds={"w [rad/s]": 0.5})
    assert [ax.get_ylabel() for ax in axes] == ["alarm [1]", "w [rad/s]"]
    plt.close("all")
    with pytest.raises(ValueError, match=r"`t` must be a table of one run .*isel\(scenario=0\)"):
        plot.overview(tables.dataset(*TREES["a batch"][:1], dims=("scenario", "time")))
    with pytest.raises(ValueError, match=r"`panels` must name quantities of the table \(w, q, .*'a'"):
        plot.overview(data, ["a"])
    with pytest.raises(ValueError, match="`count` must have a unit"):
        plot.overview(tables.dataset({"count": np.arange(3)}, dt=1.0))


X = np.arange(3.0)
REFUSED = {
    "no times": (lambda: tables.dataset({"a": X}), "`dt` must be given, for the tree has no field t in seconds"),
    "two sorts of times": (lambda: tables.dataset(log(T), dt=0.1), "`dt` must be None, for the tree has times t, but it is 0.1"),
    "times of scores": (lambda: tables.dataset({"a": X}, dims=("scenario",), dt=0.1), "`dt` must be None for scores"),
    "a batch as a run": (lambda: tables.dataset(log(N, T)), r"`t` must have shape \(3,\), but it is of shape \(3, 7\)"),
    "other axes": (lambda: tables.dataset({"a": X, "b": np.ones(4)}, dt=1.0), r"`tree\.b` must lead with the axes .*\(4,\)"),
    "no dims": (lambda: tables.dataset({"a": X}, dims=("x",), dt=1.0), r"`dims` must be one of .*\('x',\)"),
    "a name twice": (lambda: tables.dataset({"a": {"b": X}, "a.b": X}, dt=1.0), "`tree` must name every number once.*'a.b'"),
    "the name of an axis": (lambda: tables.dataset({"time": X}, dt=1.0), "`tree` must have names .*'time'"),
    "a name with a unit": (lambda: tables.dataset({"a [m]": X}, dt=1.0), r"`tree` must have names .*'a \[m\]'"),
    "a unit of nothing": (lambda: tables.dataset({"a": X}, dt=1.0, units={"b": "m"}), r"`units` must name leaves.*'b'"),
    "a unit with brackets": (lambda: tables.dataset({"a": X}, dt=1.0, units={"a": "[m]"}), r"header can hold.*\[\[m\]\]"),
    "nothing": (lambda: tables.dataset(()), "`tree` must hold at least one array"),
    "another ending": (lambda: tables.write("a.xlsx", tables.dataset({"a": X}, dt=1.0)), r"`path` must end in one of .*'a.xlsx'"),
    "a number that is missing": (lambda: tables.tree_of(tables.dataset({"a": X}, dt=1.0), {"b": 0.0}), "`data` must hold 'b'"),
    "another unit": (lambda: tables.tree_of(tables.dataset({"w": Vec3(X, X, X)}, dt=1.0, units={"w.x": "deg/s"}), Log(0.0, Vec3(0.0, 0.0, 0.0), *[None] * 5)),  # pyright: ignore
                     r"`data\.w\.x` must be given in \[rad/s\], but it is in \[deg/s\]"),
    "a flag that is none": (lambda: tables.tree_of(tables.dataset({"a": X}, dt=1.0), {"a": np.bool_(True)}), "type bool, but it is 2"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_would_be_wrong_is_refused_in_one_line(what):
    call, message = REFUSED[what]
    with pytest.raises(ValueError, match=message) as refusal:
        call()
    assert "\n" not in str(refusal.value)


def test_files_that_are_none_are_refused_and_folders_are_kept(tmp_path):
    data = tables.dataset({"a": X}, dt=1.0)
    for kind in tables.FORMATS:
        path = tmp_path / f"a{kind}"
        with pytest.raises(FileNotFoundError, match="`path` must be a file, but there is nothing"):
            tables.read(path)
        path.write_bytes(b"\x80\x04K\x01." * 3)
        with pytest.raises(ValueError, match=rf"`path` must be a table of jaxatt\.tables, but a{kind} is none"):
            tables.read(path)
    (tmp_path / "a.csv").write_text("time [s],a [m],a [m]\n0.0,1.0,2.0\n")
    with pytest.raises(ValueError, match="a column stands in it twice"):
        tables.read(tmp_path / "a.csv")
    with pytest.raises(ValueError, match="`path` must be a folder that is not there yet"):
        tables.write(tmp_path / "a.zarr", data)
    with pytest.raises(ValueError, match=r"`n` must hold whole numbers that a float can hold, in \.nc"):
        tables.write(tmp_path / "a.nc", tables.dataset({"n": np.array([2**60 + 1])}, dt=1.0))
    cut = tables.frame(tables.dataset(TREES["a batch"][0], dims=("scenario", "time"))).iloc[:-1]
    with pytest.raises(ValueError, match="`frame` must have all times of every scenario"):
        tables.dataset(cut)


def test_without_a_library_the_extra_is_named(monkeypatch, tmp_path):
    data = tables.dataset({"a": X}, dt=1.0)
    for module, kind in (
        ("scipy", ".mat"),
        ("scipy", ".nc"),
        ("pyarrow", ".parquet"),
        ("zarr", ".zarr"),
        ("pandas", ".csv"),
    ):
        with (
            monkeypatch.context() as patch,
            pytest.raises(ImportError, match=rf"needs {module}: pip install 'jaxatt\[tables\]'"),
        ):
            patch.setitem(__import__("sys").modules, module, None)
            tables.write(tmp_path / f"a{kind}", data)
    assert isinstance(tables.frame(data), pandas.DataFrame)
