import errno
import json
import os
import re
import runpy
import subprocess
import sys
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import xarray as xr
import zarr

from benchmarks import tiny_campaign as tiny
from jaxatt import noise, scores, simulate, sweep
from jaxatt.campaign import dataset, draw, extend, rerun, run, scenarios, until, workers
from jaxatt.campaign.draw import checked, results
from jaxatt.campaign.provenance import environment, manifest_of
from jaxatt.campaign.store import lock_file
from jaxatt.campaign.summary import failing

ROOT = Path(__file__).parents[1]
BLOCKS, N = 8, 8 * 128
KEY = jax.random.key(3)


def same(a, b):
    return a.tobytes() == b.tobytes() and a.dtype == b.dtype and a.shape == b.shape


def same_data(a, b):
    return list(a.data_vars) == list(b.data_vars) and all(same(a[k].values, b[k].values) for k in a.data_vars)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted campaign."""
    path = tmp_path_factory.mktemp("campaign") / "whole.zarr"
    run(path, tiny.campaign(), N)
    return path


@pytest.fixture(scope="module")
def swept():
    """The sweep of the same scenarios; the one that the check refuses is replaced."""
    many = scenarios(tiny.campaign(), 0, N)
    many = many._replace(start=np.where(np.arange(N) == 300, 0.0, many.start))
    return sweep(tiny.system, tiny.Params(), many, KEY, ticks=30, score=tiny.score)


def test_scores_are_those_of_the_sweep_and_inputs_those_of_the_scenarios(whole, swept):
    ds, many = dataset(whole), scenarios(tiny.campaign(), 0, N)
    others = np.arange(N) != 300
    for name, values in swept._asdict().items():
        assert same(ds[name].values[..., others], np.moveaxis(values, 0, -1)[..., others]), name
    plain = ~np.isin(np.arange(N), [5, 300])
    for name in ("start", "push"):
        assert same(ds[name].values[plain], getattr(many, name)[plain])
    assert len(np.unique(ds.start.values)) == N  # nobody twice
    assert ds["last"].dims == ("last_0", "scenario")


def test_units_come_from_the_fields_and_the_campaign_adds_to_them(whole, tmp_path):
    ds = dataset(whole)
    units = {name: variable.attrs.get("units") for name, variable in ds.data_vars.items()}
    assert units == dict(status=None, rms="m", far="s", last="m, m/s", ok=None, start="m", push=None)
    nested = lambda *words: dict(main=tiny.score(*words), other=tiny.score(*words).rms)
    c = tiny.campaign(score=nested, record=lambda log: log, every=10, units={"main.far": "0.1 s"})
    ds = run(tmp_path / "x.zarr", c, 128)
    assert [ds[name].attrs.get("units") for name in ("main.rms", "main.far", "other", "x", "v")] == [
        "m", "0.1 s", None, "m", "m/s",
    ]  # fmt: skip


@pytest.mark.filterwarnings("error")
def test_plain_xarray_opens_a_store_and_writes_it_as_netcdf(whole, tmp_path):
    run(tmp_path / "grown.zarr", tiny.campaign(), 200)
    extend(tmp_path / "grown.zarr", tiny.campaign(), N)
    for path in (whole, tmp_path / "grown.zarr"):
        plain, ours = xr.open_zarr(path), dataset(path)
        assert same_data(plain[list(ours.data_vars)], ours)
        assert plain.attrs == ours.attrs and json.loads(ours.attrs["campaign"])["n"] == N
    ours.to_netcdf(tmp_path / "x.nc")
    back = xr.open_dataset(tmp_path / "x.nc")
    assert back.attrs == ours.attrs
    for name in ours.data_vars:
        np.testing.assert_array_equal(back[name].values, ours[name].values)


def test_failing_scenarios_are_kept_listed_and_rerun(whole):
    ds = dataset(whole)
    assert failing(ds).tolist() == [5, 300]
    assert ds.status.values[[5, 300]].tolist() == [1, 2] and ds.status.values.sum() == 3
    log = rerun(whole, tiny.campaign(), 5)
    assert not np.isfinite(log.x).all() and not ds.ok.values[5]


def test_a_rerun_is_the_run_that_was_scored(whole, tmp_path):
    ds = dataset(whole)
    for index in (0, 127, 128, N - 1):
        log = rerun(whole, tiny.campaign(), index)
        assert log.x.shape == (30,)
        assert [log.x[-1], log.v[-1]] == ds["last"].values[:, index].tolist()
        outside = np.flatnonzero(np.abs(log.x) > 1)
        assert ds.far.values[index] == (outside[0] * 0.1 if len(outside) else np.inf)
    recorded = tiny.campaign(record=tiny.record, every=7)
    ds = run(tmp_path / "r.zarr", recorded, 200)
    assert ds.position.dims == ("time", "scenario") and ds.time.attrs["units"] == "s"
    np.testing.assert_allclose(ds.time.values, 0.7 * np.arange(5))
    for index in (3, 130):
        assert same(ds.position.values[:, index], np.asarray(rerun(tmp_path / "r.zarr", recorded, index, every=7).x))


def test_however_it_is_cut_the_numbers_are_the_same(whole, tmp_path):
    ds, c = dataset(whole), tiny.campaign()
    for shard in ((2, 3), (0, 3), (1, 3)):
        part = run(tmp_path / "shards.zarr", c, N, shard=shard)
    assert tiny.files(tmp_path / "shards.zarr") == tiny.files(whole)
    assert same_data(part, ds)
    larger = run(tmp_path / "large.zarr", tiny.campaign(block=384), N)
    assert same_data(larger, ds)
    run(tmp_path / "grown.zarr", c, 200)  # ends within a block
    assert same_data(extend(tmp_path / "grown.zarr", c, N), ds)
    assert tiny.files(tmp_path / "grown.zarr") == tiny.files(whole)
    for block in (0, 5):  # any block, by itself
        again = results(checked(c), block * 128, (block + 1) * 128)
        assert all(same(again[str(k)], ds[k].values[..., block * 128 : (block + 1) * 128]) for k in ds.data_vars)


DEVICES = """
import sys
import jax
from benchmarks import tiny_campaign as tiny
if __name__ == "__main__":
    assert jax.local_device_count() == 2
    tiny.work(sys.argv[1], int(sys.argv[2]), block=256)
"""


def test_two_devices_give_the_same_bits(whole, tmp_path):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    env = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", DEVICES, tmp_path / "two.zarr", str(BLOCKS // 2)], env=env, check=True)
    assert same_data(dataset(tmp_path / "two.zarr"), dataset(whole))


def test_two_dask_workers_give_the_same_bits_and_one_may_be_killed(whole, tmp_path):
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
        client.get_executor() as executor,
    ):
        first, write = [], workers.write_block

        def kill_one(*args):
            write(*args)
            if not first:
                first.append(next(iter(cluster.workers.values())).pid)
                os.kill(first[0], 9)

        workers.write_block = kill_one
        try:
            ds = run(tmp_path / "dask.zarr", tiny.campaign(), N, executor=executor)
        finally:
            workers.write_block = write
    assert first and same_data(ds, dataset(whole))
    assert tiny.files(tmp_path / "dask.zarr") == tiny.files(whole)


class Dying(Executor):
    """A pool whose worker dies in the middle, as that of `concurrent.futures` reports it."""

    def __init__(self, after: int):
        self.left = after

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        self.left -= 1
        if self.left < 0:
            future.set_exception(BrokenProcessPool("a process was terminated abruptly"))
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def test_a_lost_worker_is_reported_and_the_work_resumed(whole, tmp_path):
    path = tmp_path / "pool.zarr"
    with pytest.raises(RuntimeError, match=r"a worker must return scenarios \d+ to \d+, but it failed \(BrokenProcess"):
        run(path, tiny.campaign(), N, executor=Dying(after=4))
    assert dataset(path).sizes["scenario"] < N
    assert same_data(run(path, tiny.campaign(), N), dataset(whole))


def test_a_worker_unlike_its_master_is_refused(tmp_path):
    _, payload = environment(), b""
    other = environment() | {"XLA_FLAGS": "--xla_other"}
    with pytest.raises(ValueError, match="`executor` must have workers like this process, but these differ: XLA_FLAGS"):
        workers._task(payload, other, 0, 128)


def test_a_pool_that_forks_is_refused(tmp_path):
    with (
        ProcessPoolExecutor(1, mp_context=get_context("fork")) as pool,
        pytest.raises(ValueError, match=r"`executor` must start its processes anew: .*mp_context=get_context\(\"spawn"),
    ):
        run(tmp_path / "x.zarr", tiny.campaign(), 128, executor=pool)
    assert not (tmp_path / "x.zarr").exists()


def test_killed_at_random_moments_and_resumed(tmp_path):
    context, rng = tiny.processes(), np.random.default_rng(int(time.time_ns()) % 2**32)
    run(tmp_path / "whole.zarr", tiny.campaign(), 40 * 128)
    expected = tiny.files(tmp_path / "whole.zarr")
    for k in range(3):
        path = tmp_path / f"{k}.zarr"
        death = tiny.killed(context, path, 40, int(rng.integers(1, 36)), rng.uniform(0, 0.03))
        assert 1 <= death.blocks < 40
        run(path, tiny.campaign(), 40 * 128)
        assert tiny.files(path) == expected, death


def test_stopped_while_writing_each_file(tmp_path, monkeypatch):
    """Stopped with a piece of any one file written: it resumes to the same."""
    from zarr.storage import _local

    put, n, count, stop_at = _local._put, 2 * 128, 0, None

    def dying(path, value, *args, **kwargs):
        nonlocal count
        count += 1
        if count - 1 == stop_at:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.with_suffix(".0123.partial").write_bytes(bytes(value.as_buffer_like())[:9])
            raise OSError("stopped")
        return put(path, value, *args, **kwargs)

    monkeypatch.setattr(_local, "_put", dying)
    run(tmp_path / "whole.zarr", tiny.campaign(), n)
    expected, writes = tiny.files(tmp_path / "whole.zarr"), count
    assert writes >= len(expected) >= 9 + 2 * 8
    for k in range(writes):
        count, stop_at, path = 0, k, tmp_path / f"{k}.zarr"
        with pytest.raises(OSError, match="stopped"):
            run(path, tiny.campaign(), n)
        stop_at = None
        run(path, tiny.campaign(), n)
        assert tiny.files(path) == expected, k


def copied(whole, path):
    for name, content in tiny.files(whole).items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)


def halved(file):
    file.write_bytes(file.read_bytes()[: len(file.read_bytes()) // 2])


def flipped(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(content)


def of_another_block(file):
    file.write_bytes((file.parent / "1").read_bytes())


def emptied(file):
    file.write_bytes(b"")


@pytest.mark.parametrize("damage", [halved, flipped, emptied, of_another_block, Path.unlink])
@pytest.mark.parametrize("chunk", ["rms/c/3", "last/c/0/3", "status/c/3", "done/c/3"])
def test_damage_is_never_read_and_is_repaired(whole, tmp_path, damage, chunk):
    if damage is of_another_block and chunk == "status/c/3":
        damage = flipped  # the two blocks agree in their status
    path = tmp_path / "x.zarr"
    copied(whole, path)
    damage(path / chunk)
    if damage is Path.unlink and chunk.startswith("done"):
        assert 3 * 128 not in dataset(path).scenario.values  # not done, as far as anyone can tell
        run(path, tiny.campaign(), N)
    else:
        with pytest.raises(RuntimeError, match=r"blocks \[3\] are damaged"):
            dataset(path)
        with pytest.warns(UserWarning, match=r"blocks \[3\] are damaged and computed again"):
            run(path, tiny.campaign(), N)
    assert tiny.files(path) == tiny.files(whole)


def test_damaged_times_are_never_read_and_are_repaired(tmp_path):
    recorded, path = tiny.campaign(record=tiny.record, every=10), tmp_path / "x.zarr"
    run(path, recorded, 200)
    before = tiny.files(path)
    for damage in (halved, flipped, emptied, Path.unlink):
        damage(path / "time/c/0")
        with pytest.raises(RuntimeError, match="the times of its records are damaged"):
            dataset(path)
        run(path, recorded, 200)
        assert tiny.files(path) == before


def test_a_full_disk_is_reported_and_what_is_done_is_kept(whole, tmp_path):
    place = tmp_path / "small"
    place.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=260k", "tmpfs", place], capture_output=True)
    if mounted.returncode:
        pytest.skip(f"no small disk can be mounted here: {mounted.stderr.decode().strip()}")
    try:
        with pytest.raises(OSError) as error:
            run(place / "x.zarr", tiny.campaign(), N)
        assert error.value.errno == errno.ENOSPC
        kept = dataset(place / "x.zarr")
        assert 0 < kept.sizes["scenario"] < N
        for name in kept.data_vars:
            assert same(kept[name].values, dataset(whole)[name].values[..., : kept.sizes["scenario"]])
        subprocess.run(["mount", "-o", "remount,size=8m", place], check=True)
        run(place / "x.zarr", tiny.campaign(), N)
        assert tiny.files(place / "x.zarr") == tiny.files(whole)
    finally:
        subprocess.run(["umount", place], check=True)


def test_two_writers_of_one_block_are_refused_and_disjoint_shards_are_not(whole, tmp_path):
    path = tmp_path / "x.zarr"
    run(path, tiny.campaign(), N, shard=(0, 2))
    hold = (
        "import fcntl, os, sys; f = os.open(sys.argv[1], os.O_RDWR);"
        "fcntl.lockf(f, fcntl.LOCK_EX, 4, 5); print('held', flush=True); sys.stdin.read()"
    )
    lock = path.with_name("x.zarr.lock")
    with subprocess.Popen([sys.executable, "-c", hold, lock], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()  # it holds blocks 4 to 7
        with pytest.raises(RuntimeError, match="must have one writer for a block, but another process is writing"):
            run(path, tiny.campaign(), N)
        run(path, tiny.campaign(), N, shard=(0, 2))
        other.kill()
    assert same_data(run(path, tiny.campaign(), N), dataset(whole))  # the lock died with its holder
    with lock_file(path), pytest.raises(RuntimeError, match="this process is writing to"):
        run(path, tiny.campaign(), N)


def test_another_campaign_is_refused_by_name(whole, tmp_path, monkeypatch):
    path = tmp_path / "x.zarr"
    run(path, tiny.campaign(), N, shard=(0, 2))
    before = tiny.files(path)
    other = tiny.campaign(ticks=31, params=tiny.Params(gain=3.0), key=jax.random.key(4))
    with pytest.raises(ValueError, match="these differ: ") as error:
        run(path, other, N)
    for words in ("ticks is 31, but 30 in", "params.gain is 3.0, but 2.0 in", "key is [0, 4], but [0, 3] in"):
        assert words in str(error.value)
    monkeypatch.setattr(jax, "__version__", "0.0.1")
    with pytest.raises(ValueError, match=r"these differ: jax is '0.0.1', but '"):
        run(path, tiny.campaign(), N)
    monkeypatch.undo()
    monkeypatch.setattr(noise, "VERSION", noise.VERSION + 1)
    with pytest.raises(ValueError, match=r"these differ: noise is \d, but \d in the store"):
        run(path, tiny.campaign(), N)
    monkeypatch.undo()
    with pytest.raises(ValueError, match=r"`n` must be the 1024 scenarios of the store \(or more, in `extend`\)"):
        run(path, tiny.campaign(), N + 1)
    with pytest.raises(ValueError, match=r"these differ: system\.dt"):
        rerun(path, tiny.campaign(system=tiny.system._replace(dt=0.2)), 3)
    assert tiny.files(path) == before

    def sample(key, index):  # another code under the same name
        return tiny.Scenario(**tiny.draw(key, index + 1))

    sample.__qualname__ = "sample"
    with pytest.raises(
        ValueError, match=r"these differ: sample is 'sample \(code of Python 3\.\d+, crc32 \w{8}\)', but"
    ):
        run(path, tiny.campaign(sample=sample), N)

    class Sample:  # says that it is the other one
        __wrapped__ = staticmethod(tiny.sample)
        __call__ = staticmethod(sample)

    sample = Sample()
    with pytest.raises(ValueError, match=r"must give the numbers of x\.zarr, but for the scenarios 0 to 127 these"):
        run(path, tiny.campaign(sample=sample), N)
    assert tiny.files(path) == before


def test_a_difference_may_be_accepted(whole, tmp_path):
    path = tmp_path / "x.zarr"
    run(path, tiny.campaign(), N, shard=(0, 2))
    file = path / "zarr.json"
    content = json.loads(file.read_text())
    manifest = json.loads(content["attributes"]["campaign"])
    content["attributes"]["campaign"] = json.dumps(manifest | {"jaxlib": "0.0.1"})
    file.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="jaxlib is"):
        run(path, tiny.campaign(), N)
    with pytest.raises(ValueError, match="jaxlib is"):
        rerun(path, tiny.campaign(), 3)
    assert same(rerun(path, tiny.campaign(), 3, accept=["jaxlib"]).x, rerun(whole, tiny.campaign(), 3).x)
    assert same_data(run(path, tiny.campaign(), N, accept=["jaxlib"]), dataset(whole))


def test_what_is_no_campaign_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="`path` must be the store of a campaign, but there is nothing at"):
        dataset(tmp_path / "none.zarr")
    with pytest.raises(FileNotFoundError):
        extend(tmp_path / "none.zarr", tiny.campaign(), 10)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="`path` must be the store of a campaign, but"):
        run(tmp_path / "empty", tiny.campaign(), 10)
    refused: list[tuple[dict[str, Any], str]] = [
        (dict(block=100), "`campaign.block` must be a multiple of 128, but it is 100"),
        (dict(ticks=0), "`campaign.ticks` must be a whole number of at least 1, but it is 0"),
        (dict(size=9), "`n` must not exceed the 9 points of the design, but it is 10"),
        (dict(units={"rsm": "m"}), "`campaign.units` must name scores, inputs or records"),
        (dict(params=tiny.Params(gain=-1.0)), "`params.gain` must be a positive number, but it is -1"),
        (dict(inputs=lambda key, index: dict(rms=1.0)), "`input.rms` must have a name of its own"),
    ]
    for change, message in refused:
        with pytest.raises(ValueError, match=message):
            run(tmp_path / "x.zarr", tiny.campaign(**change), 10)
    with pytest.raises(ValueError, match=r"`shard` must be \(k, m\) with k < m, but it is \(3, 3\)"):
        run(tmp_path / "x.zarr", tiny.campaign(), 10, shard=(3, 3))
    assert not (tmp_path / "x.zarr").exists()


@pytest.mark.parametrize(
    ("ok", "found"),
    [(scores.mean(1.0), "float64 of shape ()"), (scores.always(np.ones(3, bool)), "bool of shape (3,)")],
)
def test_an_ok_that_is_no_bool_per_scenario_is_refused_before_a_block_is_run(ok, found, tmp_path, monkeypatch):
    def never(*_, **__):
        raise AssertionError("a block was run")

    for name in ("scored", "block_records"):
        monkeypatch.setattr(draw, name, never)
    monkeypatch.setattr(workers, "results", never)
    message = (
        f"`campaign.score` must give one bool of each scenario for ok, such as scores.always(...), but it is {found}."
    )
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        run(tmp_path / "x.zarr", tiny.campaign(score=lambda params, scenario, now, log: dict(ok=ok)), 10)
    assert not (tmp_path / "x.zarr").exists()


def test_left_while_it_grew(whole, tmp_path, monkeypatch):
    path = tmp_path / "x.zarr"
    run(path, tiny.campaign(), 200)
    group = zarr.open_group(path, mode="r+")
    rms = group["rms"]
    assert isinstance(rms, zarr.Array)
    rms.resize((N,))  # as far as a killed `extend` came
    with pytest.raises(RuntimeError, match="was left while it grew"):
        dataset(path)
    assert run(path, tiny.campaign(), 200).sizes["scenario"] == 200
    assert same_data(extend(path, tiny.campaign(), N), dataset(whole))
    assert tiny.files(path) == tiny.files(whole)


def test_until_the_interval_is_narrow(tmp_path):
    c = tiny.campaign()
    success = lambda ds: ds.rms.values < 0.3
    some, rate = until(tmp_path / "x.zarr", c, [256, 512, N], success, 0.06)
    assert some.sizes["scenario"] == rate.trials == 512
    assert rate.successes == int((some.rms.values < 0.3).sum()) and (rate.high - rate.low) / 2 <= 0.06
    again, same_rate = until(tmp_path / "x.zarr", c, [256, 512, N], success, 0.06)
    assert same_rate == rate and same_data(again, some)
    _, last = until(tmp_path / "x.zarr", c, [256, 512, N], success, 0.001)
    assert last.trials == N  # as narrow as it gets
    with pytest.raises(ValueError, match="`looks` must be growing numbers of scenarios"):
        until(tmp_path / "x.zarr", c, [512, 256], success, 0.1)


def test_float32_stays_float32(tmp_path):
    small = jax.tree.map(lambda a: np.asarray(a, np.float32), tiny.Params())
    single = lambda key, index: jax.tree.map(lambda a: a.astype(np.float32), tiny.sample(key, index))
    c = tiny.campaign(params=small, sample=single, inputs=None, units={})
    ds = run(tmp_path / "x.zarr", c, 130)
    assert ds.rms.dtype == np.float32
    one = jax.tree.map(lambda a: a[129], scenarios(c, 0, 130))
    log = simulate(tiny.system, small, one, KEY, ticks=1)
    assert log.x.dtype == np.float32


SCRIPT = """
import jax
from benchmarks import tiny_campaign as tiny

LEVEL = 1.0

def level(index):
    return LEVEL * tiny.draw(KEY, index)["start"]

KEY = jax.random.key(9)

def make(factor):
    @jax.jit
    def sample(key, index):
        return tiny.Scenario(**{**tiny.draw(key, index), "start": factor * level(index)})
    return sample

study = tiny.campaign(sample=make(1.0), inputs=lambda key, index: {"start": level(index)})
"""


def test_functions_of_a_script_are_what_they_are_whatever_it_is_called(tmp_path, monkeypatch):
    """Run as a script, renamed and run, imported: one campaign; with another number, captured or global: another."""
    monkeypatch.syspath_prepend(tmp_path)
    changed = SCRIPT.replace("LEVEL = 1.0", "LEVEL = 1.5"), SCRIPT.replace("make(1.0)", "make(2.0)")
    edited = SCRIPT.replace("* level", "* 1.0 * level")
    texts = dict(
        first_study=SCRIPT, second_study=f"# moved down\n\n{SCRIPT}", third=changed[0], fourth=changed[1], fifth=edited
    )
    for name, text in texts.items():
        (tmp_path / f"{name}.py").write_text(text)
    script = lambda name: runpy.run_path(str(tmp_path / f"{name}.py"), run_name="__main__")["study"]
    told = lambda campaign: {k: v for k, v in manifest_of(checked(campaign), N).items() if k != "history"}
    first = told(script("first_study"))
    assert first == told(script("second_study")) == told(import_module("second_study").study)
    for name, differ in (("third", {"sample", "inputs"}), ("fourth", {"sample"}), ("fifth", {"sample"})):
        other = told(import_module(name).study)
        assert {k for k in first if first[k] != other[k]} == differ
    assert first["system.check"] == told(tiny.campaign())["system.check"]


def test_a_script_is_resumed_and_rerun_by_its_import(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "resumed_study.py").write_text(SCRIPT)
    study = runpy.run_path(str(tmp_path / "resumed_study.py"), run_name="__main__")["study"]
    run(tmp_path / "x.zarr", study, 128)
    again = import_module("resumed_study").study
    data = extend(tmp_path / "x.zarr", again, 256)
    assert data.sizes["scenario"] == 256 and len(rerun(tmp_path / "x.zarr", again, 130).x) == study.ticks
