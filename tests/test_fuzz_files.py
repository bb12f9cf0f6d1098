"""Abuse of files and campaigns: a broken, foreign or hostile file gives one line, and none of them runs code."""

import json
import pickle
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import numpy as np
import optax
import pandas
import pytest
from abuse import JUNK, fuzzed, judged, junk, nearly, plain, whole
from hypothesis import given
from hypothesis import strategies as st

from jaxatt.campaign import dataset, extend, rerun, run, sampling_key, scenarios, until
from jaxatt.replay import Quaternion, load, merged, report, unit_quaternions
from jaxatt.tables import FORMATS, frame, read, tree_of, write
from jaxatt.tables import dataset as table_of
from jaxatt.tuning import tune

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.tiny_campaign import campaign, files, record

exploded = []


def explode():
    exploded.append(1)


class Bomb:
    def __reduce__(self):
        return explode, ()


PICKLE = pickle.dumps(Bomb())
pickle.loads(PICKLE)
assert exploded == [1], "a pickle runs code, if it is read as one"
exploded.clear()


@st.composite
def spoiled(draw, data):
    """Bytes of which some are others, or none at all."""
    for _ in range(draw(st.integers(0, 2))):
        at = draw(st.integers(0, len(data)))
        data = draw(st.sampled_from([
            data[:at], data[at:], b"", PICKLE, data[:at] + PICKLE + data[at:], data + data, data[:at] + b"\xff" + data[at + 1 :],
            data[:at] + draw(st.binary(max_size=9)) + data[at + 4 :], data.replace(b"1", b"9"), data.replace(b"[", b"{"), bytes(99),
        ]))  # fmt: skip
    return data


def answered(f, names, *args, **how):
    said = judged(f, names, *args, also=(RuntimeError, FileNotFoundError), **how)
    assert not exploded, "code of a file was run"
    return said


# recorded readings


TABLE = pandas.DataFrame({"time [s]": np.arange(6.0), "gyro [rad/s]": np.arange(6) / 3, "note": list("abcdef")})
CSV = TABLE.to_csv(index=False).encode()
PARQUET = TABLE.to_parquet()


ODD_ROWS = st.lists(
    st.lists(st.sampled_from(["0", "1", "2", "0,5", "", "nan", "x", '"', "1_0", "2024-03-01T12:00:00Z", "1e3", "#", "\u0663"]), max_size=4),
    max_size=5,
)  # fmt: skip
ODD_HEADS = st.lists(
    st.sampled_from(["time [s]", "gyro [rad/s]", "gyro [deg/s]", "q[0]", "gyro (rad/s)", "note", ""]), max_size=5
)


@st.composite
def odd_logs(draw):
    """Text with the cells of logs, between any separators, with any ends of lines."""
    separator, end = (
        draw(st.sampled_from([",", ";", "\t", " ", "|"])),
        draw(st.sampled_from(["\n", "\r\n", "\r", "\n\n"])),
    )
    head = draw(st.one_of(st.just(["time [s]", "gyro [rad/s]"]), ODD_HEADS))
    return (
        draw(st.sampled_from(["", "\ufeff", "# a log" + end])).encode()
        + end.join(map(separator.join, [head, *draw(ODD_ROWS)])).encode()
    )


@fuzzed
@given(
    data=st.one_of(spoiled(CSV), spoiled(PARQUET), odd_logs()),
    name=st.sampled_from(["a.csv", "a.parquet", "a.csv", "a.parquet", "a.txt", "a.csv.gz", "a"]),
    units=st.sampled_from(
        [{"gyro": "rad/s"}] * 4 + [{}, {"gyro": "deg/s"}, {"star": "1"}, {3: 3}, None, "gyro", {"note": None}, {"q[0]": "1"}]
    ),
    time=st.sampled_from(["time"] * 4 + ["gyro", "note", "", 3, None, ("time", "note"), ("time",)]),
    how=st.fixed_dictionaries({}, optional=dict(
        stamps=st.sampled_from([None, "s", "ms", "ns", "iso", "min", 3, []]),
        separator=st.sampled_from([",", ";", "\t", " ", "|", "", 3, []]), decimal=st.sampled_from([".", ",", "'", None]),
        zone=st.sampled_from([None, "+01:00", "Europe/Berlin", "Mars", "../../etc/passwd", 3]), skip=st.sampled_from([0, 1, -1, "a"]),
        header=st.sampled_from([None, ["time [s]", "gyro [rad/s]", "note"], ["time [s]"], "time", 3, [3]]),
        encoding=st.sampled_from(["utf-8", "latin-1", "utf-16", "rot13", "base64", "klingon", 3]),
        told=st.sampled_from([None, {}, {"note": "deg/s"}, {"gyro [rad/s]": "deg/s"}, {"note": 3}, {3: "s"}, "a"]),
        where=st.sampled_from([None, {"note": "a"}, {"note": 1}, {"gyro [rad/s]": 0}, {"x": 1}, "a"]),
        missing=st.sampled_from([None, [], [-9999], ["a", 0], [None], "a", 3]),
        quaternions=st.sampled_from([None, {"q": Quaternion("note", "wxyz", "body to reference")}, {"q": 3}, "q",
                                     {"q": Quaternion(["time [s]", "gyro", "note", "q[0]"], "xyzw", "reference to body")}]),
    )),
)  # fmt: skip
def test_recorded_files(data, name, units, time, how):
    with TemporaryDirectory() as folder:
        path = Path(folder, name)
        path.write_bytes(data)
        words = {
            "path",
            "units",
            "time",
            "gyro",
            "star",
            "note",
            "rad",
            "s",
            "q",
            *how,
            *map(str, how.values()),
            *map(str, units or ()),
            str(time),
            "where",
            "stamps",
            "x",
        }
        said = answered(lambda: load(path, units, time=time, **how), words)
        assert said == answered(lambda: report(path, units, time=time, **how) and None, words)


times = st.sampled_from([np.arange(3.0), np.arange(3.0) + 0.5, np.arange(3.0) + 9, [0, 0, 1], [np.nan], "a", None])
pairs = st.one_of(
    st.tuples(times, st.sampled_from([{"a": np.ones(3)}, {"b": np.ones(3)}, {"a": np.eye(3)}, {"a": "b"}, {}, 3])), junk
)


@fuzzed
@given(
    recordings=st.one_of(st.dictionaries(st.sampled_from(["a", "b", "imu", 3]), pairs, max_size=3), junk),
    offsets=st.one_of(st.none(), st.dictionaries(st.sampled_from(["a", "imu", 3]), plain(), max_size=2), junk),
)
def test_clocks(recordings, offsets):
    judged(merged, {"recordings", "offsets", "time", "columns", "a", "b", "imu"}, recordings, offsets)


# tables

leaves = st.sampled_from(
    [
        np.arange(3.0),
        np.ones((3, 2)),
        np.arange(3),
        np.array([True, False, True]),
        np.ones(2),
        1.0,
        "a",
        None,
        np.ones(0),
    ]
)
trees = st.one_of(
    st.dictionaries(st.sampled_from(["a", "b", "w.x", "t", "time", "b [m]", "#", ""]), leaves, max_size=3),
    st.tuples(leaves, leaves),
    junk,
)
LABELLED = dict(tree={"a": np.arange(3.0), "w": np.ones((3, 2))}, dt=0.1, t=None, dims=("time",), units={"a": "m"})
ABUSED = dict(
    tree=trees, dt=plain(), t=st.one_of(st.none(), plain()), dims=st.sampled_from([("time",), ("scenario",), ("scenario", "time"), "time", (), None]),
    units=st.sampled_from([None, {}, {"a": "m"}, {"c": "m"}, {"a": 3}, {"a": "[m]"}, {"a": "a\nb"}, "m", 3]),
)  # fmt: skip
HERE = table_of(LABELLED["tree"], dt=0.1, units={"a": "m"})
NAMED = {"tree", "dt", "t", "dims", "units", "value", "a", "b", "w", "x", "data", "like", "frame", "path"}


@fuzzed
@given(
    nearly(LABELLED, ABUSED),
    st.one_of(trees, st.just({"a": 0.0, "w": np.zeros(2)})),
    st.sampled_from([HERE, frame(HERE), 3, None, TABLE]),
)
def test_tables(how, like, data):
    judged(lambda: (table_of(**how), None)[1], NAMED, also=())
    judged(tree_of, NAMED, data, like)
    judged(lambda: (frame(data), None)[1], NAMED)


@pytest.fixture(scope="module")
def tables_on_disk(tmp_path_factory):
    folder, found = tmp_path_factory.mktemp("tables"), {}
    for kind in FORMATS:
        write(folder / f"a{kind}", HERE)
        found[kind] = {"": (folder / f"a{kind}").read_bytes()} if kind != ".zarr" else files(folder / "a.zarr")
    return found


@pytest.mark.parametrize("kind", FORMATS)
def test_spoiled_tables(tables_on_disk, kind):
    whole = tables_on_disk[kind]

    @fuzzed
    @given(st.data())
    def check(data):
        name = data.draw(st.sampled_from(sorted(whole)))
        spoilt = whole | {name: data.draw(spoiled(whole[name]))}
        with TemporaryDirectory() as folder:
            path = Path(folder, f"a{kind}")
            for part, content in spoilt.items():
                at = path / part if part else path
                at.parent.mkdir(parents=True, exist_ok=True)
                at.write_bytes(content)
            answered(lambda: read(path) and None, {"path"})

    check()


parts = st.sampled_from([0.0, 1.0, -0.5, 0.707, 32767.0, 1e-300, 1e300, np.nan, np.inf])
PLAIN = {name: np.array([0.5, -0.5]) for name in "wxyz"}


@fuzzed
@given(
    columns=st.one_of(
        st.fixed_dictionaries({name: st.lists(parts, max_size=3) for name in "wxyz"}), st.just(PLAIN), junk
    ),
    names=st.one_of(st.just(["w", "x", "y", "z"]), st.lists(st.sampled_from(["w", "x", 3, None]), max_size=5), junk),
)
def test_quaternions_of_logs(columns, names):
    found = {}
    said = judged(lambda: found.update(unit_quaternions(columns, names)), {"columns", "names", *"wxyz"})
    if not said:
        length = np.sqrt(sum(a**2 for a in found.values()))
        assert (np.isnan(length) | (np.abs(length - 1) < 1e-12)).all() and np.isfinite(length).any()


def test_what_is_no_path():
    for bad in [b for b in JUNK if not isinstance(b, str)]:
        assert judged(load, {"path"}, bad, {})
        assert judged(read, {"path"}, bad) and judged(write, {"path"}, bad, HERE) and judged(report, {"path"}, bad, {})
        for f in (dataset, lambda path: run(path, campaign(), 128), lambda path: rerun(path, campaign(), 0)):
            assert judged(f, {"path"}, bad)


# saved searches


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("search") / "tune.npz"
    search(path)
    return path.read_bytes()


def search(path, theta=0.5, steps=3):
    return tune(parabola, theta, optax.sgd(0.1), steps, jax.random.key(0), save=path, progress=False)


def parabola(theta, key):
    return (theta - 2) ** 2


def forged(saved, changes):
    """A saved search with some of its arrays others."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "a.npz")
        path.write_bytes(saved)
        held = dict(np.load(path))
        for name, value in changes.items():
            held[list(held)[name % len(held)]] = value
        np.savez(path, **held)
        return path.read_bytes()


values = st.sampled_from(
    [np.zeros(3), np.array("a"), np.array([Bomb()]), np.zeros((0,)), np.float32(1.0), np.array(1 + 1j), None]
)


def test_saved_searches(saved):
    @fuzzed
    @given(data=st.one_of(spoiled(saved), st.dictionaries(st.integers(0, 20), values, max_size=2)))
    def check(data):
        with TemporaryDirectory() as folder:
            path = Path(folder, "tune.npz")
            path.write_bytes(forged(saved, data) if isinstance(data, dict) else data)
            answered(lambda: search(path), {"save", "steps"})

    check()


# campaigns: what is asked


def good(found):
    return found.get("ok", found.scenario >= 0)  # which no score may have told


key = jax.random.key(3)
TINY = campaign()
functions = st.sampled_from([None, 3, "a", lambda *a: {}, lambda *a: np.zeros(2)])  # their own errors are the user's
rarely = st.sampled_from([0, -1, 2.5, "a", None, 2**31, True, np.nan, np.int64(9)])
FIELDS = dict(
    system=st.sampled_from([None, 3, TINY, TINY.system._replace(dt=0.2), TINY.system._replace(check=None)]),
    params=st.sampled_from([TINY.params._replace(gain=a) for a in ("a", -1.0, np.nan, np.zeros(2), np.float16(1), 1j, None)]),
    sample=st.sampled_from([None, 3, "a"]), key=plain(), ticks=rarely, score=functions,
    inputs=functions, record=functions, every=rarely, block=st.one_of(whole, st.just(256)), size=whole,
    units=st.sampled_from([{}, {"rms": 3}, {"colour": "m"}, None, "m", 3]),
)  # fmt: skip
ASKED = dict(
    n=st.one_of(st.sampled_from([128, 100, 129]), st.sampled_from([0, -1, 2**31, "a", None, 1.5])),
    shard=st.one_of(st.sampled_from([(0, 1), (0, 2), (1, 2), (2, 2), (0,), (0, 0), (-1, 1)]), junk),
    accept=st.sampled_from([(), ["jax"], "jax", 3, None, [3]]), executor=st.sampled_from([None, None, 3, "a"]),
    index=whole, looks=st.sampled_from([[100, 128], [], [128, 100], 3, ["a"], None]), half_width=plain(), level=plain(),
    success=st.sampled_from([good, None, 3]), start=whole, stop=st.one_of(st.just(128), whole),
    **{f"campaign.{name}": values for name, values in FIELDS.items()}, campaign=junk,
)  # fmt: skip
FITTING = dict(n=128, shard=(0, 1), accept=(), executor=None, index=0, looks=[100, 128], half_width=0.3, level=0.95, campaign=TINY,
               success=good, start=0, stop=128)  # fmt: skip
FITTING |= {f"campaign.{name}": getattr(TINY, name) for name in FIELDS}
WORDS = {"campaign", "path", "key", "params", "score", "input", "record", "scenario", "scenarios", *ASKED, *FIELDS}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """The files of a store of two blocks, with records, and the numbers in it."""
    path = tmp_path_factory.mktemp("store") / "x.zarr"
    run(path, campaign(record=record, every=10), 200, progress=False)
    return files(path), {name: a.values for name, a in dataset(path).load().variables.items()}


@fuzzed
@given(nearly(FITTING, ASKED))
def test_campaigns(asked):
    fields = {name.split(".")[1]: value for name, value in asked.items() if "." in name}
    given_ = TINY._replace(**fields) if asked["campaign"] is TINY else asked["campaign"]
    how = {name: asked[name] for name in ("shard", "accept", "executor")} | {"progress": False}
    with TemporaryDirectory() as folder:
        path = Path(folder, "x.zarr")
        judged(sampling_key, WORDS, asked["campaign.key"])
        said = judged(scenarios, WORDS, given_, asked["start"], asked["stop"])
        said = judged(run, WORDS, path, given_, asked["n"], **how)
        if said:
            assert not path.exists() or dataset(path).sizes["scenario"] == 0, "refused, but something was computed"
        else:
            judged(rerun, WORDS, path, given_, asked["index"])
            judged(extend, WORDS, path, given_, asked["stop"], **how)
            judged(
                until,
                WORDS,
                path,
                given_,
                asked["looks"],
                asked["success"],
                asked["half_width"],
                level=asked["level"],
                **how,
            )


# campaigns: what lies on the disk


@st.composite
def other_json(draw, text):
    """Metadata with one value another."""
    tree = json.loads(text)
    node = tree
    while True:
        place = draw(st.sampled_from(list(node) if isinstance(node, dict) else range(len(node))))
        if not (isinstance(node[place], (dict, list)) and node[place] and draw(st.integers(0, 3))):
            break
        node = node[place]
    node[place] = draw(
        st.sampled_from([None, -1, 0, 7, 10**12, "a", [], {}, [10**12], [1], True, 1e300, "float64", {"name": "a"}])
    )
    if draw(st.integers(0, 4)) == 0:
        del node[place]
    return json.dumps(tree).encode()


@st.composite
def spoiled_store(draw, files):
    """A store with up to two of its files other, gone, or beside a store of the old format whose chunks are pickles."""
    whole, files = files, dict(files)
    for _ in range(draw(st.integers(0, 2))):
        name = draw(st.sampled_from(sorted(files)))
        if name.endswith("zarr.json") and draw(st.booleans()):
            files[name] = draw(other_json(whole[name]))
        elif draw(st.integers(0, 3)):
            files[name] = draw(spoiled(files[name]))
        else:
            del files[name]
        if not files:
            break
    if draw(st.integers(0, 9)) == 0:
        array = dict(zarr_format=2, shape=[200], chunks=[200], dtype="|O", compressor=None, fill_value=None, order="C",
                     filters=[{"id": "pickle"}])  # fmt: skip
        files.pop("rms/zarr.json", None)
        files |= {"rms/.zarray": json.dumps(array).encode(), "rms/0": PICKLE, ".zgroup": b'{"zarr_format": 2}'}
    return files


def test_spoiled_stores(store):
    whole_one, (whole, numbers) = campaign(record=record, every=10), store

    @fuzzed
    @given(spoiled_store(whole))
    def check(spoiled):
        with TemporaryDirectory() as folder:
            path = Path(folder, "x.zarr")
            for name, data in spoiled.items():
                (path / name).parent.mkdir(parents=True, exist_ok=True)
                (path / name).write_bytes(data)
            said = answered(lambda: dataset(path).load() and None, {"path"})
            repaired = answered(lambda: run(path, whole_one, 200, progress=False) and None, {"path", "campaign", "n"})
            if not (said or repaired):
                found = dataset(path).load()
                for name, values in numbers.items():
                    np.testing.assert_array_equal(found[name], values, name)

    check()


def test_a_store_that_grows_where_there_is_none():
    with (
        TemporaryDirectory() as folder,
        pytest.raises(FileNotFoundError, match="`path` must be the store of a campaign"),
    ):
        extend(Path(folder, "x.zarr"), TINY, 128)
    shutil.rmtree(folder, ignore_errors=True)
