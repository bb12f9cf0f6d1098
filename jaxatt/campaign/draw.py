"""What a campaign computes of some indices: scenarios, scores, inputs and records.

Scenarios lead, shape (n, ...), as in a sweep; what goes into the store has them in the last axis.

May import: check, fields, contract, compiling, noise, engine, sweeping, store.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxatt import check
from jaxatt.campaign.store import OWN, Variable
from jaxatt.compiling import compiled
from jaxatt.contract import System
from jaxatt.engine import prepared, tree_bytes, validated
from jaxatt.fields import named, units_within
from jaxatt.noise import BLOCK, one_key
from jaxatt.sweeping import block_of, block_records, recorded, score_shapes, scored


class Campaign(NamedTuple):
    """What is computed of every index; how many, where and by whom is said to `jaxatt.campaign.run`.

    The functions of key and index are pure JAX on one scenario, as `System.init` is; index is a traced integer.
    """

    system: System
    params: Any  # `Params` of the loop, what the engineer ships
    sample: Callable  # (key, index) -> scenario
    key: Any  # of the noise, as in `sweep`; `sample` gets one split off it, `sampling_key`
    ticks: int
    score: Callable  # as in `sweep`; a value called ok says whether a scenario went well
    inputs: Callable | None = None  # (key, index) -> tree of the numbers drawn, to be stored beside the scores
    record: Callable | None = None  # (log) -> tree to be recorded; runs every block a second time
    every: int = 1  # ticks between records
    block: int = 1024  # scenarios written together, a multiple of 128
    size: int | None = None  # scenarios that the design has; None: as many as wanted
    units: Mapping[str, str] = MappingProxyType({})  # by name, beside and over those that the fields of the trees state


def sampling_key(key):
    """The key that `sample` and `inputs` get: split off the campaign's, so that the noise is independent of it.

    Raises TypeError for what is no key and ValueError for several.
    """
    key = one_key(key)
    return jax.random.wrap_key_data(jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), 2**32 - 1)))


def scenarios(campaign: Campaign, start: int, stop: int):
    """The scenarios start .. stop - 1 of a campaign, as `jaxatt.sweep` takes them.

    Args:
        campaign: the campaign.
        start: number of the first one, from 0.
        stop: number after the last one.

    Returns:
        The tree of a scenario, every leaf a NumPy array of shape (stop - start, ...).

    Raises:
        ValueError: start < 0 or stop <= start.

    Example:
        >>> some = campaign.scenarios(study, 0, 256)
        >>> found = jaxatt.sweep(study.system, study.params, some, study.key, ticks=study.ticks, score=study.score)
    """
    campaign, start = checked(campaign), check.whole("start", start, 0)
    return drawn(campaign, start, check.whole("stop", stop, start + 1))[0]


def checked(campaign: Campaign) -> Campaign:
    """The campaign with plain NumPy leaves; ValueError or TypeError, by the field's name, for what does not fit."""
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


def drawn(campaign: Campaign, start: int, stop: int):
    """Scenarios start .. stop - 1 and their inputs, leaves (stop - start, ...).

    They are always drawn in whole blocks of 128, so that their bits do not depend on how the work is cut.
    """
    first, last = start // BLOCK, -(-stop // BLOCK)
    key, draw = sampling_key(campaign.key), compiled(_draw, 2)
    most = (campaign.size or 2**31) - 1
    numbers = [np.minimum(np.arange(b * BLOCK, (b + 1) * BLOCK), most).astype(np.int32) for b in range(first, last)]
    parts = [draw(campaign.sample, campaign.inputs, key, some) for some in numbers]
    here = slice(start - first * BLOCK, stop - first * BLOCK)
    return jax.tree.map(lambda *blocks: np.concatenate([np.asarray(a) for a in blocks])[here], *parts)


def _draw(sample, inputs, key, indices):
    def one(index):
        return sample(key, index), ({} if inputs is None else inputs(key, index))

    return jax.vmap(one)(indices)


def results(
    campaign: Campaign, start: int, stop: int, advance: Callable = lambda n: None, jobs=None
) -> dict[str, np.ndarray]:
    """All that is stored of the scenarios start .. stop - 1, by name, each of shape (..., stop - start).

    start: a multiple of 128. The scores are those of `sweep`, bit for bit. advance(n): n more are done; jobs:
    blocks at once, as of `sweeping.by_block`.
    """
    scenarios, inputs = drawn(campaign, start, stop)
    params, scenarios = prepared(campaign.system, campaign.params, scenarios)
    bad = refused(campaign.system, params, scenarios, campaign.ticks)
    values = scored(
        campaign.system, params, scenarios, campaign.key, campaign.ticks, campaign.score, start // BLOCK, advance, jobs
    )
    out = {name: np.moveaxis(a, 0, -1) for name, a in named(values, "score").items()}
    good = out.get("ok", np.ones(stop - start, bool)).astype(bool)
    out["status"] = np.where(bad, 2, np.where(good, 0, 1)).astype(np.int8)
    out |= {name: np.moveaxis(a, 0, -1) for name, a in named(inputs, "input").items()}
    if campaign.record is not None:
        how = campaign.ticks, campaign.every, params, scenarios, campaign.key, start // BLOCK, jobs
        records = recorded(campaign.system, campaign.record, *how)
        out |= named(records, "record")
    return out


def refused(system: System, params, scenarios, ticks: int) -> np.ndarray:
    """Which of the scenarios their fields or the system's check refuse, (n,) bool."""
    bad = np.zeros(check.batch_size("scenarios", scenarios), bool)

    def look(start: int, stop: int):
        try:
            validated(system, params, jax.tree.map(lambda a: a[start:stop], scenarios), stop - start, ticks)
        except ValueError:
            if stop - start == 1:
                bad[start] = True
            else:
                look(start, (start + stop) // 2)
                look((start + stop) // 2, stop)

    look(0, len(bad))
    return bad


def variables(campaign: Campaign) -> dict[str, Variable]:
    """The arrays of the store by name; draws the first scenarios and traces the loop.

    Raises ValueError where all of the first scenarios are refused, or two arrays share a name.
    """
    scenarios, inputs = drawn(campaign, 0, BLOCK)
    params, scenarios = prepared(campaign.system, campaign.params, scenarios)
    if refused(campaign.system, params, scenarios, campaign.ticks).all():
        validated(campaign.system, params, scenarios, BLOCK, campaign.ticks)
    scores = score_shapes(campaign.system, params, scenarios, campaign.key, campaign.ticks, campaign.score)
    ok = named(scores, "score").get("ok")
    if ok is not None and (ok.dtype != bool or ok.shape != (BLOCK,)):
        found = f"{ok.dtype} of shape {ok.shape[:-1]}"
        check.refuse("campaign.score", "give one bool of each scenario for ok, such as scores.always(...)", found)
    inputs = jax.tree.map(lambda a: np.moveaxis(a, 0, -1), inputs)
    trees: dict[str, Any] = {"status": {"status": np.zeros(BLOCK, np.int8)}, "score": scores, "input": inputs}
    if campaign.record is not None:
        static = campaign.system, campaign.record, campaign.ticks, campaign.every
        here = block_of(scenarios, 0)
        records = compiled(block_records, 4).eval_shape(*static, params, here, campaign.key, np.int32(0))
        takes = tree_bytes(records) // BLOCK * campaign.block
        check.fits_memory("`campaign.record` of a block", takes, "keep fewer records, by `every`")
        trees["record"] = records
    arrays = {}
    for role, tree in trees.items():
        units = {**units_within(tree), **campaign.units}
        for name, a in named(tree, role).items():
            if name in (*arrays, OWN, "time", "scenario"):
                check.refuse(f"{role}.{name}", "have a name of its own among scores, inputs and records", repr(name))
            inner = a.shape[1:-1] if role == "record" else a.shape[:-1]
            dims = ("time",) * (role == "record") + tuple(f"{name}_{axis}" for axis in range(len(inner)))
            arrays[name] = Variable(role, (*dims, "scenario"), a.shape[:-1], np.dtype(a.dtype), units.get(name, ""))
    for name in campaign.units:
        if name not in arrays:
            check.refuse("campaign.units", f"name scores, inputs or records ({', '.join(arrays)})", repr(name))
    return arrays
