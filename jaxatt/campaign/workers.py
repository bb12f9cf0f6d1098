"""Who computes a campaign: this process, or the workers of an executor; this process alone writes.

May import: check, clock, noise, sweeping, draw, provenance, read, store, summary.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor, as_completed
from functools import lru_cache
from pathlib import Path

import jax
import numpy as np
import xarray as xr

from jaxatt import check
from jaxatt.campaign.draw import Campaign, checked, results, variables
from jaxatt.campaign.provenance import environment, manifest_of, names_of, refuse_other
from jaxatt.campaign.read import dataset
from jaxatt.campaign.store import (
    OWN,
    Store,
    blocks_of,
    create,
    lock_file,
    metadata_lock,
    open_store,
    read_block,
    repair_times,
    sized,
    state_of,
    sweep_up,
    take,
    write_block,
)
from jaxatt.campaign.summary import Rate, narrowed
from jaxatt.clock import time_of
from jaxatt.noise import BLOCK
from jaxatt.sweeping import progress_bar


def run(path, campaign: Campaign, n: int, *, shard: tuple[int, int] = (0, 1), executor: Executor | None = None,
        accept: Collection[str] = (), progress: bool | None = None) -> xr.Dataset:  # fmt: skip
    """Score the first n scenarios of a campaign into a store on disk; what is done there already, stays.

    Call it again to resume, after whatever end; damaged blocks are computed again, with a warning. Every number is the
    same, bit for bit, however the work is cut: score i equals that of `jaxatt.sweep` of `scenarios` with the campaign's
    key. Memory does not grow with n. On resuming, a few scenarios that are done are computed again: another code under
    the same name is found out.

    Args:
        path: folder of the store.
        campaign: what is computed.
        n: how many scenarios.
        shard: (k, m) for the k-th of m processes that share one store, such as the tasks of a Slurm array.
        executor: of concurrent.futures, such as a process pool or Dask's ``Client.get_executor()``: computes the
            blocks, each on one core; without one they run on all cores and devices. Its workers need the environment of this process,
            XLA_FLAGS too, and must not be forked from it. This process alone writes.
        accept: names in the manifest that may differ from the store's, such as ``jax``; then the bits of later blocks
            are those of another program, and nothing is compared by trial.
        progress: show a bar; None shows it on terminals and in notebooks.

    Returns:
        The `dataset`.

    Raises:
        ValueError: a store of other inputs, naming which, or of another n (`extend` it); an executor that forks.
        RuntimeError: another process writes the same blocks; a worker was lost.
        OSError: the disk is full.
        What is done is kept in all these cases.

    Example:
        >>> data = campaign.run("faults.zarr", study, n=100_000)
    """
    return _run(check.place("path", path), campaign, n, False, shard, executor, accept, progress)


def extend(path, campaign: Campaign, n: int, **how) -> xr.Dataset:
    """Grow a store to n scenarios and `run` what is new.

    Scenario i stays what it was, so a design must not depend on n: iid and Sobol points do not, a Latin hypercube does
    and has a `size` for that.

    Args:
        path, campaign: as of `run`.
        n: how many scenarios there shall be.
        how: the keywords of `run`.

    Returns:
        The `dataset`.

    Raises:
        FileNotFoundError: there is no store.
        ValueError: n is less than there is; and what `run` raises.

    Example:
        >>> data = campaign.extend("faults.zarr", study, n=200_000)
    """
    path = check.place("path", path)
    open_store(path)
    return _run(path, campaign, n, True, **{"shard": (0, 1), "executor": None, "accept": (), "progress": None, **how})


def _run(path: Path, campaign: Campaign, n: int, grow: bool, shard, executor, accept, progress) -> xr.Dataset:
    campaign, n = checked(campaign), check.whole("n", n)
    accept = names_of(accept)
    if executor is not None:
        check.function("executor.submit", getattr(executor, "submit", None))
        _refuse_fork(executor)
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


def _refuse_fork(executor) -> None:
    """Refuse a pool of forked processes: JAX has threads, whose locks a fork leaves held for ever."""
    context = getattr(executor, "_mp_context", None)
    if context is not None and context.get_start_method() == "fork":
        must = 'start its processes anew: ProcessPoolExecutor(..., mp_context=get_context("spawn"))'
        check.refuse("executor", must, "a pool that forks, which hangs")


def _prepared(path: Path, campaign: Campaign, n: int, grow: bool, accept) -> Store:
    """The store, created if there is none, for n scenarios."""
    times = None
    if campaign.record is not None:
        times = time_of(np.arange(0, campaign.ticks, campaign.every), campaign.system.dt, np.float64)
    if not path.exists():
        create(path, variables(campaign), manifest_of(campaign, n), times)
        return open_store(path, "r+")
    store = open_store(path, "r+")
    refuse_other(path, store.manifest, manifest_of(campaign, n), accept)
    stored = store.manifest["n"]
    if n < stored or (n > stored and not grow):
        check.refuse("n", f"be the {stored} scenarios of the store (or more, in `extend`)", n)
    if times is not None:
        repair_times(store, times)
    return sized(store, n)


def _complete(store: Store, campaign: Campaign, mine: range, executor: Executor | None, accept, progress) -> None:
    """Compute and write those of my blocks that are not done."""
    states = {block: state_of(store, block) for block in mine}
    damaged = [block for block, state in states.items() if state == "damaged"]
    if damaged:
        check.warn(f"{store.path.name}: blocks {damaged} are damaged and computed again.")
    missing = [block for block, state in states.items() if state != "done"]
    done = [block for block, state in states.items() if state == "done"]
    length = lambda blocks: sum(stop - start for start, stop in map(store.span, blocks))
    if not missing:
        return
    with progress_bar(progress, length(mine), " scenarios", length(done)) as bar:
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
        yield (start, stop), results(campaign, start, stop, advance)


def _elsewhere(campaign: Campaign, spans, executor: Executor, advance: Callable) -> Iterator:
    try:
        from cloudpickle import dumps  # comes with Dask; takes lambdas too
    except ImportError:
        dumps = pickle.dumps
    payload = dumps(campaign)  # once: the workers keep the functions, and with them what they compiled
    futures = {executor.submit(_task, payload, environment(), *span): span for span in spans}
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


def _task(payload: bytes, sender: dict, start: int, stop: int) -> dict[str, np.ndarray]:
    """`results` in a worker process, whose environment must be that of the sender."""
    with jax.enable_x64(sender["x64"]):
        here = environment()
        differ = [f"{k} is {here[k]!r}, but {sender[k]!r} there" for k in here if here[k] != sender[k]]
        if differ:
            raise ValueError(f"`executor` must have workers like this process, but these differ: {'; '.join(differ)}.")
        return results(_loaded(payload), start, stop, jobs=1)  # the executor's workers are as many as it wants


def until(path, campaign: Campaign, looks, success: Callable, half_width: float, *, level: float = 0.95, **how
          ) -> tuple[xr.Dataset, Rate]:  # fmt: skip
    """Run a campaign until the confidence interval of a rate is narrow enough, at the latest to the last look.

    However it stopped, the interval covers the rate with probability of at least ``level``
    (`jaxatt.campaign.summary.narrowed`), if the scenarios are iid.

    Args:
        path, campaign: as of `run`.
        looks: growing numbers of scenarios at which the interval is looked at, fixed beforehand; multiples of the block
            are cheapest.
        success: (dataset) -> bools, one for each scenario; their share is the rate.
        half_width: of the interval, at which to stop.
        level: probability with which the interval covers the rate.
        how: the keywords of `run`, but for shards, which cannot see each other's scenarios.

    Returns:
        The dataset up to the look at which it stopped, and the `Rate` there.

    Raises:
        ValueError: looks that do not grow, a half_width or level outside (0, 1); and what `run` raises.

    Example:
        >>> data, rate = campaign.until("x.zarr", study, [1024, 4096], lambda data: data.miss.values < 0.1, 0.01)
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
