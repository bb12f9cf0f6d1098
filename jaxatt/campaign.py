"""Campaigns: a sweep on disk, in blocks that can be killed, resumed, shared out, extended and replayed.

A campaign is a pure function of the index of a scenario, so it matters neither who computes a block nor when.
The store is a Zarr group: one array for every score, the scenarios in its last axis, in chunks of one block. A
block counts as done when the last chunk written of it, its checksum in ``done``, fits what is there; everything
else is computed again. A store holds numbers and names, no code: opening one runs nothing.

May import: check, engine, study, store, summary.
"""

from __future__ import annotations

import os
import pickle
import platform
import subprocess
import warnings
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import Executor, as_completed
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.engine import BLOCK, System, block_records, compiled, one_key, tree_bytes
from jaxatt.store import (
    OWN,
    Store,
    Variable,
    blocks_of,
    create,
    lock_file,
    metadata_lock,
    open_store,
    read_block,
    readable,
    sized,
    state_of,
    sweep_up,
    take,
    write_block,
)
from jaxatt.study import _bar, _lanes_of, _unpacked, logged, score_shapes, scored
from jaxatt.summary import Rate, narrowed

try:
    import xarray as xr
    import zarr
except ImportError as error:
    raise ImportError(
        f"jaxatt.campaign needs the extra `campaign`: pip install 'jaxatt[campaign]' ({error})."
    ) from None


class Campaign(NamedTuple):
    """What is computed of every index; how many, where and by whom is said to `run`.

    The functions of key and index are pure JAX on one scenario, as `System.init` is; index is a traced integer.
    """

    system: System
    params: Any  # `Params` of the loop, what the engineer ships
    sample: Callable  # (key, index) -> scenario
    key: Any  # of the noise, as in `sweep`; `sample` gets one split off it, `sampling_key`
    ticks: int
    score: Callable  # as in `sweep`; a value called ok says whether a scenario went well
    inputs: Callable | None = None  # (key, index) -> dict of the numbers drawn, to be stored beside the scores
    record: Callable | None = None  # (log) -> tree to be recorded; runs every block a second time
    every: int = 1  # ticks between records
    block: int = 1024  # scenarios written together, a multiple of 128
    size: int | None = None  # scenarios that the design has; None: as many as wanted
    units: Mapping[str, str] = MappingProxyType({})  # of scores, inputs and records, by name


def sampling_key(key):
    """The key that `sample` and `inputs` get: split off the campaign's, so that the noise is independent of it.

    Raises TypeError for what is no key and ValueError for several.
    """
    key = one_key(key)
    return jax.random.wrap_key_data(jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), 2**32 - 1)))


# the numbers of some scenarios


def _lanes(sample, inputs, key, indices):
    def one(index):
        return sample(key, index), ({} if inputs is None else inputs(key, index))

    return jax.vmap(one, out_axes=-1)(indices)


@lru_cache
def _layout(sample, inputs, real):
    """The types of what is drawn, and how `_unpacked` gets it back; real: the default float type, which decides."""
    del real
    indices = jax.ShapeDtypeStruct((BLOCK,), np.int32)
    leaves, structure = jax.tree.flatten(jax.eval_shape(partial(_lanes, sample, inputs), jax.random.key(0), indices))
    kinds = sorted({str(a.dtype) for a in leaves})
    return tuple(kinds), (structure, tuple((kinds.index(str(a.dtype)), a.shape[:-1]) for a in leaves))


def _draw(sample, inputs, kinds, key, indices):
    """One array (rows, 128) for each type: a hundred small ones would cost more than they hold."""
    leaves = jax.tree.leaves(_lanes(sample, inputs, key, indices))
    return [jnp.concatenate([a.reshape(-1, BLOCK) for a in leaves if str(a.dtype) == kind]) for kind in kinds]


def _drawn(campaign: Campaign, start: int, stop: int):
    """Scenarios start .. stop - 1 and their inputs, lanes last; always drawn in whole blocks of 128, for the bits."""
    first, last = start // BLOCK, -(-stop // BLOCK)
    kinds, layout = _layout(campaign.sample, campaign.inputs, jnp.result_type(float))
    key, draw = sampling_key(jnp.asarray(campaign.key)), compiled(_draw, 3)
    most = (campaign.size or 2**31) - 1
    lanes = [np.minimum(np.arange(b * BLOCK, (b + 1) * BLOCK), most).astype(np.int32) for b in range(first, last)]
    parts = [[np.asarray(a) for a in draw(campaign.sample, campaign.inputs, kinds, key, lane)] for lane in lanes]
    here = slice(start - first * BLOCK, stop - first * BLOCK)
    return _unpacked([np.concatenate(rows, axis=-1)[:, here] for rows in zip(*parts)], layout)


def scenarios(campaign: Campaign, start: int, stop: int):
    """The scenarios start .. stop - 1 in the last axis of every leaf, as `sweep` takes them."""
    campaign, start = _admitted(campaign), check.whole("start", start, 0)
    return _drawn(campaign, start, check.whole("stop", stop, start + 1))[0]


def _results(campaign: Campaign, start: int, stop: int, advance: Callable = lambda n: None) -> dict[str, np.ndarray]:
    """All that is stored of the scenarios start .. stop - 1, by name, each of shape (..., stop - start).

    start: a multiple of 128. The scores are those of `sweep`, bit for bit. advance(n): n more are done.
    """
    scenarios, inputs = _drawn(campaign, start, stop)
    params, scenarios = check.converted(campaign.params, scenarios)
    refused = _refused(campaign.system, params, scenarios)
    values = scored(
        campaign.system, params, scenarios, campaign.key, campaign.ticks, campaign.score, start // BLOCK, advance
    )
    out = _named(values, "score")
    good = out.get("ok", np.ones(stop - start, bool)).astype(bool)
    out["status"] = np.where(refused, 2, np.where(good, 0, 1)).astype(np.int8)
    out |= _named(jax.tree.map(np.asarray, inputs), "input")
    if campaign.record is not None:
        run, parts = compiled(block_records, 4), []
        for block in range(-(-(stop - start) // BLOCK)):
            number = np.int32(start // BLOCK + block)
            here = _lanes_of(scenarios, block)
            static = campaign.system, campaign.record, campaign.ticks, campaign.every
            parts.append(jax.tree.map(np.asarray, run(*static, params, here, campaign.key, number)))
        records = jax.tree.map(lambda *a: np.concatenate(a, axis=-1)[..., : stop - start], *parts)
        out |= _named(records, "record")
    return out


def _refused(system: System, params, scenarios) -> np.ndarray:
    """Which scenarios the system's check refuses."""
    n = check.lanes(scenarios)

    def bad(i):
        try:
            system.check(params, jax.tree.map(lambda a: a[..., i], scenarios))
        except ValueError:
            return True
        return False

    try:
        system.check(params, scenarios)
    except ValueError:
        return np.array([bad(i) for i in range(n)])
    return np.zeros(n, bool)


def _named(tree, alone: str) -> dict:
    """The leaves of a tree by name: ``delay``, ``main.delay``, ``spans.0``; alone: the name of a single leaf."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator=".") or alone: leaf for path, leaf in leaves}


def _variables(campaign: Campaign) -> dict[str, Variable]:
    """The arrays of the store by name; draws the first scenarios and traces the loop.

    Raises ValueError if the system's check refuses all of the first scenarios, or two arrays share a name.
    """
    scenarios, inputs = _drawn(campaign, 0, BLOCK)
    params, scenarios = check.converted(campaign.params, scenarios)
    if _refused(campaign.system, params, scenarios).all():
        campaign.system.check(params, scenarios)
    scores = score_shapes(campaign.system, params, scenarios, campaign.key, campaign.ticks, campaign.score)
    found = [("status", "status", np.zeros(BLOCK, np.int8))]
    found += [("score", *item) for item in _named(scores, "score").items()]
    found += [("input", *item) for item in _named(inputs, "input").items()]
    if campaign.record is not None:
        static = campaign.system, campaign.record, campaign.ticks, campaign.every
        records = compiled(block_records, 4).eval_shape(*static, params, scenarios, campaign.key, np.int32(0))
        takes = tree_bytes(records) // BLOCK * campaign.block
        check.fits_memory("`campaign.record` of a block", takes, "keep fewer records, by `every`")
        found += [("record", *item) for item in _named(records, "record").items()]
    variables = {}
    for role, name, a in found:
        if name in (*variables, OWN, "time", "scenario"):
            check.refuse(f"{role}.{name}", "have a name of its own among scores, inputs and records", repr(name))
        inner = a.shape[1:-1] if role == "record" else a.shape[:-1]
        dims = ("time",) * (role == "record") + tuple(f"{name}_{axis}" for axis in range(len(inner)))
        unit = campaign.units.get(name, "")
        variables[name] = Variable(role, (*dims, "scenario"), a.shape[:-1], np.dtype(a.dtype), unit)
    for name in campaign.units:
        if name not in variables:
            check.refuse("campaign.units", f"name scores, inputs or records ({', '.join(variables)})", repr(name))
    return variables


# what the store says of itself


def _admitted(campaign: Campaign) -> Campaign:
    """The campaign with plain NumPy leaves, checked."""
    check.kind("campaign", campaign, Campaign)
    check.kind("campaign.system", campaign.system, System)
    for name in ("init", "tick", "flow", "check"):
        check.function(f"campaign.system.{name}", getattr(campaign.system, name))
    for name in ("sample", "score", "inputs", "record"):
        if getattr(campaign, name) is not None or name in ("sample", "score"):
            check.function(f"campaign.{name}", getattr(campaign, name))
    check.mapping("campaign.units", campaign.units)
    counts: dict[str, Any] = {
        name: check.whole(f"campaign.{name}", getattr(campaign, name)) for name in ("ticks", "every", "block")
    }
    if counts["block"] % BLOCK:
        check.refuse("campaign.block", f"be a multiple of {BLOCK}", campaign.block)
    counts["size"] = None if campaign.size is None else check.whole("campaign.size", campaign.size)
    params, _ = check.converted(campaign.params, ())
    params = jax.tree.map(np.asarray, params)
    return campaign._replace(params=params, key=np.asarray(one_key(campaign.key)), **counts)


def _name(thing) -> str:
    """A function by its module and name, a partial one with its arguments, a value by what it prints."""
    if isinstance(thing, partial):
        words = [_name(a) for a in thing.args] + [f"{k}={_name(v)}" for k, v in sorted(thing.keywords.items())]
        return f"{_name(thing.func)}({', '.join(words)})"
    if callable(thing):
        return f"{thing.__module__}.{thing.__qualname__}"
    if isinstance(thing, tuple):
        return f"({', '.join(_name(a) for a in thing)})"
    if isinstance(thing, (np.ndarray, jax.Array)):
        return str(_plain(thing))
    return repr(thing)


def _plain(leaf):
    """A leaf for JSON: its numbers, or the checksum of many."""
    a = np.asarray(leaf)
    if a.size > 32:
        return f"{a.dtype} of shape {a.shape}, crc32 {zlib.crc32(a.tobytes()):08x}"
    numbers = a.tolist() if a.dtype.kind != "f" else np.vectorize(_number, otypes=[object])(a).tolist()
    return numbers if a.dtype != np.float32 else {"float32": numbers}


def _number(x: float):
    return float(x) if np.isfinite(x) else str(float(x))  # JSON has no infinity


def _environment() -> dict:
    """What the bits of a result depend on, beside the campaign."""
    flags = [f for f in os.environ.get("XLA_FLAGS", "").split() if "host_platform_device_count" not in f]
    return {
        "jax": jax.__version__,
        "jaxlib": version("jaxlib"),
        "backend": jax.default_backend(),
        "device": jax.devices()[0].device_kind,
        "machine": platform.machine(),
        "x64": bool(jax.config.read("jax_enable_x64")),
        "XLA_FLAGS": " ".join(sorted(flags)),
    }


def _history() -> dict:
    """What is worth knowing later and decides nothing."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        git = subprocess.run(command, capture_output=True, text=True, timeout=10).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        git = ""
    versions = {"numpy": np.__version__, "zarr": zarr.__version__, "xarray": xr.__version__}
    return {"python": platform.python_version(), **versions, "git": git or "none"}


def _manifest(campaign: Campaign, n: int) -> dict:
    """The inputs of a campaign as plain values, by name. All but ``n`` and ``history`` must be the same to resume."""
    functions = {field: _name(getattr(campaign, field)) for field in ("sample", "score", "inputs", "record")}
    loop = {f"system.{field}": _name(value) for field, value in campaign.system._asdict().items()}
    shipped = _named(campaign.params, "params")
    return {
        "format": 1,
        "n": n,
        "key": campaign.key.tolist(),
        **{field: getattr(campaign, field) for field in ("ticks", "every", "block", "size")},
        **loop,
        **functions,
        **{f"params.{name}": _plain(leaf) for name, leaf in shipped.items()},
        **_environment(),
        "history": _history(),
    }


def _refuse_other(path: Path, stored: Mapping, now: Mapping, accept: Collection[str] = ()) -> None:
    """Refuse a campaign that is not the stored one."""
    names = [k for k in {**stored, **now} if k not in ("n", "history", *accept)]
    differ = [k for k in names if stored.get(k) != now.get(k)]
    if differ:
        each = "; ".join(f"{k} is {now.get(k)!r}, but {stored.get(k)!r} in the store" for k in differ)
        raise ValueError(f"`campaign` must be the one that began {path.name}, but these differ: {each}.")


# running


def run(path, campaign: Campaign, n: int, *, shard: tuple[int, int] = (0, 1), executor: Executor | None = None,
        accept: Collection[str] = (), progress: bool | None = None) -> xr.Dataset:  # fmt: skip
    """Score scenarios 0 .. n - 1 of a campaign into the store at path; whatever is done there already, stays.

    Call it again to resume, after whatever end; damaged blocks are computed anew, with a warning. Every number is
    the same, bit for bit, however the work is cut: score i equals that of ``sweep`` of `scenarios` with the
    campaign's key. Memory does not grow with n.

    shard: (k, m) for the k-th of m processes that share one store, such as the tasks of a Slurm array. executor:
    any of concurrent.futures, such as a process pool or Dask's ``Client.get_executor()``, computes the blocks;
    without one they run on the local devices. Its workers need the environment of this process, XLA_FLAGS too.
    This process alone writes. accept: names in the manifest that may differ from the store's, such as ``jax``;
    then the bits of later blocks are those of another program, and nothing is compared by trial.
    progress: show a bar; None shows it on terminals and in notebooks.

    On resuming, a few scenarios that are done are computed again: another code under the same name is found out.

    Returns the `dataset`. Raises ValueError for a store of other inputs, naming which, or of another n (`extend`
    it); RuntimeError while another process writes the same blocks, and where a worker was lost; OSError where
    the disk is full. What is done is kept in all these cases.
    """
    return _run(check.place("path", path), campaign, n, False, shard, executor, accept, progress)


def extend(path, campaign: Campaign, n: int, **how) -> xr.Dataset:
    """Grow a store to n scenarios and `run` what is new; how: the keywords of `run`.

    Scenario i stays what it was, so a design must not depend on n: iid and Sobol points do not, a Latin hypercube
    does and has a `size` for that. Raises what `run` raises, FileNotFoundError where there is no store, and
    ValueError if n is less than there is.
    """
    path = check.place("path", path)
    open_store(path)
    return _run(path, campaign, n, True, **{"shard": (0, 1), "executor": None, "accept": (), "progress": None, **how})


def _run(path: Path, campaign: Campaign, n: int, grow: bool, shard, executor, accept, progress) -> xr.Dataset:
    campaign, n = _admitted(campaign), check.whole("n", n)
    if isinstance(accept, str) or not all(isinstance(name, str) for name in (accept if np.iterable(accept) else [0])):
        raise TypeError(f"`accept` must be names in the manifest, but it is {check.short(accept)}.")
    if executor is not None:
        check.function("executor.submit", getattr(executor, "submit", None))
    k, *m = check.wholes("shard", shard, 0)
    m = m[0] if len(m) == 1 else 0
    if k >= m:
        check.refuse("shard", "be (k, m) with k < m", check.short(shard))
    if campaign.size is not None and n > campaign.size:
        check.refuse("n", f"not exceed the {campaign.size} points of the design", n)
    with lock_file(path) as handle:
        with metadata_lock(handle):
            store = _prepared(path, campaign, n, grow, accept)
        count = blocks_of(n, campaign.block)
        mine = range(k * count // m, (k + 1) * count // m)
        if len(mine):
            take(handle, path, mine)
            sweep_up(store, mine)
            _complete(store, campaign, mine, executor, accept, progress)
    return dataset(path)


def _prepared(path: Path, campaign: Campaign, n: int, grow: bool, accept) -> Store:
    """The store, created if there is none, for n scenarios."""
    if not path.exists():
        records = np.arange(0, campaign.ticks, campaign.every) * campaign.system.dt
        variables = _variables(campaign)
        create(path, variables, _manifest(campaign, n), None if campaign.record is None else records)
        return open_store(path, "r+")
    store = open_store(path, "r+")
    _refuse_other(path, store.manifest, _manifest(campaign, n), accept)
    stored = store.manifest["n"]
    if n < stored or (n > stored and not grow):
        check.refuse("n", f"be the {stored} scenarios of the store (or more, in `extend`)", n)
    return sized(store, n)


def _complete(store: Store, campaign: Campaign, mine: range, executor: Executor | None, accept, progress) -> None:
    """Compute and write those of my blocks that are not done."""
    states = {block: state_of(store, block) for block in mine}
    damaged = [block for block, state in states.items() if state == "damaged"]
    if damaged:
        warnings.warn(f"{store.path.name}: blocks {damaged} are damaged and computed again.", stacklevel=4)
    missing = [block for block, state in states.items() if state != "done"]
    done = [block for block, state in states.items() if state == "done"]
    length = lambda blocks: sum(stop - start for start, stop in map(store.span, blocks))
    if not missing:
        return
    with _bar(progress, length(mine), " scenarios", length(done)) as bar:
        if executor is None:
            compute = lambda spans: _here(campaign, spans, bar.update)
        else:
            compute = lambda spans: _elsewhere(campaign, spans, executor, bar.update)
        known = next((b for b in (*done, *range(store.arrays[OWN].shape[0])) if state_of(store, b) == "done"), None)
        if known is not None and not accept:
            _try(store, known, compute)
        spans = {store.span(block): block for block in missing}
        for span, values in compute(list(spans)):
            if {*values, OWN} != {*store.arrays}:
                check.refuse("campaign", f"give what the store holds, {sorted(store.arrays)}", sorted({*values, OWN}))
            for name, a in values.items():
                held = store.arrays[name]
                if (held.dtype, held.shape[:-1]) != (a.dtype, a.shape[:-1]):
                    check.refuse(
                        "path", f"hold {name} as {a.dtype} of shape {a.shape[:-1]}", f"{held.dtype}, {held.shape[:-1]}"
                    )
            write_block(store, spans[span], values)


def _try(store: Store, block: int, compute: Callable) -> None:
    """Compute the first scenarios of a block that is done again, and compare."""
    start, stop = store.span(block)
    span = start, min(start + BLOCK, stop)
    [(_, again)] = compute([span])
    there = {name: a[..., : span[1] - start] for name, a in read_block(store, block).items()}
    other = [name for name in there if name not in again or again[name].tobytes() != there[name].tobytes()]
    if other:
        raise ValueError(
            f"`campaign` must give the numbers of {store.path.name}, but for the scenarios {start} to {span[1] - 1} "
            f"these differ: {', '.join(other)}. The code behind a name, or the processor, is another."
        )


def _here(campaign: Campaign, spans, advance: Callable) -> Iterator:
    for start, stop in spans:
        yield (start, stop), _results(campaign, start, stop, advance)


def _elsewhere(campaign: Campaign, spans, executor: Executor, advance: Callable) -> Iterator:
    try:
        from cloudpickle import dumps  # comes with Dask; takes lambdas too
    except ImportError:
        dumps = pickle.dumps
    payload = dumps(campaign)  # once: the workers keep the functions, and with them what they compiled
    futures = {executor.submit(_task, payload, _environment(), *span): span for span in spans}
    try:
        for future in as_completed(list(futures)):
            span = futures.pop(future)
            try:
                values = future.result()
            except (ValueError, TypeError):  # the campaign's own
                raise
            except Exception as error:  # a broken pool, Dask's KilledWorker, ...
                raise RuntimeError(
                    f"a worker must return scenarios {span[0]} to {span[1] - 1}, but it failed "
                    f"({type(error).__name__}: {error}); what is done is kept, run again to resume."
                ) from error
            yield span, values
            advance(span[1] - span[0])
    finally:
        for future in futures:
            future.cancel()


_loaded = lru_cache(maxsize=2)(pickle.loads)


def _task(payload: bytes, environment: dict, start: int, stop: int) -> dict[str, np.ndarray]:
    """`_results` in a worker process, which must be like the one that sent the work."""
    with jax.enable_x64(environment["x64"]):
        here = _environment()
        differ = [f"{k} is {here[k]!r}, but {environment[k]!r} there" for k in here if here[k] != environment[k]]
        if differ:
            raise ValueError(f"`executor` must have workers like this process, but these differ: {'; '.join(differ)}.")
        return _results(_loaded(payload), start, stop)


# reading


def dataset(path) -> xr.Dataset:
    """The scenarios that are done, as an xarray.Dataset; its coordinate ``scenario`` says which they are.

    Every block is read once and held against its checksum; values are then loaded as they are asked for. Scores,
    inputs and records are told apart by their attribute ``role``; ``status`` is 0 for a good scenario, 1 for a
    failed one (its score ``ok`` did not hold), 2 for one that the system's check refused.

    Raises RuntimeError if blocks are damaged or the store was left while it grew: run the campaign again.
    """
    store = open_store(check.place("path", path))
    n = store.manifest["n"]
    if any(a.shape[-1] != n for name, a in store.arrays.items() if name != OWN):
        raise RuntimeError(
            f"`path` must be whole, but {store.path} was left while it grew: run or extend the campaign again."
        )
    states = [state_of(store, block) for block in range(blocks_of(n, store.manifest["block"]))]
    damaged = [block for block, state in enumerate(states) if state == "damaged"]
    if damaged:
        raise RuntimeError(
            f"`path` must be whole, but blocks {damaged} are damaged in {store.path}: run the campaign again to repair them."
        )
    with readable(store.path):
        opened = xr.open_zarr(store.path, consolidated=False, chunks=None, zarr_format=3)
        opened = opened[store.group.attrs["variables"]]
        if opened.sizes["scenario"] != n:
            raise ValueError(f"its axis of scenarios has {opened.sizes['scenario']} of {n}")
    spans = [np.arange(*store.span(block)) for block, state in enumerate(states) if state == "done"]
    index = np.concatenate([np.arange(0), *spans])
    if len(index) < n:
        opened = opened.isel(scenario=index)
    return opened.assign_coords(scenario=index)


def replay(path, campaign: Campaign, index: int):
    """The log, time first, of scenario ``index`` of a store: the run that was scored, bit for bit.

    Raises ValueError if the campaign is not the one of the store, or the index is none of its scenarios.
    """
    campaign, store = _admitted(campaign), open_store(check.place("path", path))
    n = store.manifest["n"]
    _refuse_other(store.path, store.manifest, _manifest(campaign, n))
    if check.whole("index", index, 0) >= n:
        check.refuse("index", f"be less than the {n} scenarios", index)
    start = index // BLOCK * BLOCK
    drawn, _ = _drawn(campaign, start, min(start + BLOCK, n))
    params, here = check.converted(campaign.params, drawn)
    return logged(campaign.system, params, _lanes_of(here, 0), campaign.key, index, campaign.ticks)


def until(path, campaign: Campaign, looks, success: Callable, half_width: float, *, level: float = 0.95, **how
          ) -> tuple[xr.Dataset, Rate]:  # fmt: skip
    """Run a campaign until the confidence interval of a rate is narrow enough, at the latest to the last look.

    looks: growing numbers of scenarios at which the interval is looked at, fixed beforehand; multiples of the
    block are cheapest. success(dataset) -> bools, one for each scenario; their share is the rate. half_width: of its
    interval, at which to stop. However it stopped, the interval covers the rate with probability of at least
    ``level`` (`jaxatt.summary.narrowed`), if the scenarios are iid. how: the keywords of `run`, but for shards,
    which cannot see each other's scenarios.

    Returns the dataset up to the look at which it stopped, and the `Rate` there.
    """
    looks = check.wholes("looks", looks)
    check.function("success", success)
    if sorted(set(looks)) != looks:
        check.refuse("looks", "be growing numbers of scenarios", looks)
    check.between("half_width", check.number("half_width", half_width), 0, 1, "a share")
    check.between("level", check.number("level", level), 0, 1, "a probability")
    path = check.place("path", path)

    def counts():
        for n in looks:
            stored = open_store(path).manifest["n"] if path.exists() else n
            done = (extend if n > stored else run)(path, campaign, max(n, stored), **how)
            yield int(np.sum(success(done.isel(scenario=slice(n)))))

    rate = narrowed(counts(), looks, half_width, level)
    return dataset(path).isel(scenario=slice(rate.trials)), rate
