"""What a store says of where its numbers come from: the inputs of the campaign by name, and the machine.

A campaign goes on only where all of it is the same; the message says what differs.

May import: check, store, draw.
"""

from __future__ import annotations

import os
import platform
import subprocess
import zlib
from collections.abc import Collection, Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np
import xarray as xr
import zarr

from jaxatt import check
from jaxatt.campaign.draw import Campaign, named


def manifest_of(campaign: Campaign, n: int) -> dict:
    """The inputs of a campaign of n scenarios as plain values, by name.

    All but ``n`` and ``history`` must be the same to resume.
    """
    functions = {field: _name(getattr(campaign, field)) for field in ("sample", "score", "inputs", "record")}
    loop = {f"system.{field}": _name(value) for field, value in campaign.system._asdict().items()}
    return {
        "format": 2,
        "n": n,
        "key": campaign.key.tolist(),
        **{field: getattr(campaign, field) for field in ("ticks", "every", "block", "size")},
        **loop,
        **functions,
        **{f"params.{name}": _plain(leaf) for name, leaf in named(campaign.params, "params").items()},
        **environment(),
        "history": _history(),
    }


def refuse_other(path: Path, stored: Mapping, now: Mapping, accept: Collection[str] = ()) -> None:
    """Refuse a campaign whose manifest ``now`` is not the stored one; accept: names that may differ.

    path: of the store. The ValueError says what differs.
    """
    names = [k for k in {**stored, **now} if k not in ("n", "history", *accept)]
    differ = [k for k in names if stored.get(k) != now.get(k)]
    if differ:
        each = "; ".join(f"{k} is {now.get(k)!r}, but {stored.get(k)!r} in the store" for k in differ)
        raise ValueError(f"`campaign` must be the one that began {path.name}, but these differ: {each}.")


def names_of(accept) -> tuple[str, ...]:
    """``accept`` as names in the manifest; TypeError for what holds no names."""
    if isinstance(accept, str) or not all(isinstance(name, str) for name in (accept if np.iterable(accept) else [0])):
        raise TypeError(f"`accept` must be names in the manifest, but it is {check.short(accept)}.")
    return tuple(accept)


def environment() -> dict:
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
