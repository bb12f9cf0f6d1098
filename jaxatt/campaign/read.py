"""Reading a store: its numbers as a labelled table, and any of its runs again.

May import: check, engine, noise, sweeping, draw, provenance, store.
"""

from __future__ import annotations

from collections.abc import Collection

import jax
import numpy as np
import xarray as xr

from jaxatt import check
from jaxatt.campaign.draw import Campaign, checked, drawn
from jaxatt.campaign.provenance import manifest_of, names_of, refuse_other
from jaxatt.campaign.store import OWN, blocks_of, open_store, readable, state_of, stored_times
from jaxatt.engine import prepared
from jaxatt.noise import BLOCK
from jaxatt.sweeping import block_of, logged


def dataset(path) -> xr.Dataset:
    """The scenarios of a store that are done.

    Every block is read once and held against its checksum; values are then loaded as they are asked for.

    Args:
        path: folder of the store.

    Returns:
        A table with the axis ``scenario``, whose coordinate says which ones are done. The attribute ``role`` tells
        scores, inputs and records apart; ``status`` is 0 for a good scenario, 1 for a failed one (its score ``ok`` did
        not hold), 2 for one that its fields or the system's check refused.

    Raises:
        FileNotFoundError: there is nothing.
        ValueError: what is there is no campaign.
        RuntimeError: blocks are damaged, or the store was left while it grew: run the campaign again.

    Example:
        >>> data = campaign.dataset("faults.zarr")
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
    recorded = {a.shape[0] for a in store.arrays.values() if "time" in (a.metadata.dimension_names or ())}
    if recorded - {len(stored_times(store))}:
        raise RuntimeError(
            f"`path` must be whole, but the times of its records are damaged in {store.path}: run the campaign again to repair them."
        )
    with readable(store.path):
        opened = xr.open_zarr(store.path, consolidated=False, chunks=None, zarr_format=3)
        opened = opened[store.names]
        if opened.sizes["scenario"] != n:
            raise ValueError(f"its axis of scenarios has {opened.sizes['scenario']} of {n}")
    spans = [np.arange(*store.span(block)) for block, state in enumerate(states) if state == "done"]
    index = np.concatenate([np.arange(0), *spans])
    if len(index) < n:
        opened = opened.isel(scenario=index)
    return opened.assign_coords(scenario=index)


def rerun(path, campaign: Campaign, index: int, *, every: int = 1, accept: Collection[str] = ()):
    """The log of one scenario of a store: the run that was scored, bit for bit.

    Args:
        path: folder of the store.
        campaign: the one that made it.
        index: number of the scenario, from 0.
        every: keep the log of ticks 0, every, 2 every, ...
        accept: names in the manifest that may differ from the store's, such as ``jax``; the bits may then differ, too.

    Returns:
        The log, time first, as of `jaxatt.simulate`.

    Raises:
        ValueError: the campaign is not the one of the store, or the index is none of its scenarios.

    Example:
        >>> log = campaign.rerun("faults.zarr", study, int(data.rms_q.argmax("scenario")))
    """
    campaign, every, accept = checked(campaign), check.whole("every", every), names_of(accept)
    store = open_store(check.place("path", path))
    n = store.manifest["n"]
    refuse_other(store.path, store.manifest, manifest_of(campaign, n), accept)
    if check.whole("index", index, 0) >= n:
        check.refuse("index", f"be less than the {n} scenarios", index)
    start = index // BLOCK * BLOCK
    scenarios, _ = drawn(campaign, start, min(start + BLOCK, n))
    params, scenarios = prepared(campaign.system, campaign.params, scenarios)
    log = logged(campaign.system, params, block_of(scenarios, 0), campaign.key, index, campaign.ticks)
    return jax.tree.map(lambda a: a[::every], log)
