"""The store of a campaign: a Zarr group of labelled arrays in chunks of one block, and who may write to it.

Every chunk is written whole and carries a checksum; the chunk of a block in ``done``, written last, holds that of all
its numbers. A block whose numbers do not fit it is not done. The metadata of all arrays stand in the group's own file,
too (consolidated), so that plain xarray opens it. Attributes are strings and numbers; the manifest is JSON in one of
them. Knows no campaign but its manifest.

May import: nothing of ours.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import zlib
from collections.abc import Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec

STATUS = ("good", "failed", "refused")  # of a scenario: its score `ok` held; it did not; the system's check refused it
OWN = "done"  # the array of checksums
_CODECS: Any = [ZstdCodec(level=1), Crc32cCodec()]
_WHOLE = {"array.write_empty_chunks": True}  # a missing file shall mean a missing block; read as arrays are opened


class Variable(NamedTuple):
    """An array of the store."""

    role: str  # score, input, record or status
    dims: tuple  # names of the axes; the last is "scenario"
    shape: tuple  # all axes but the last
    dtype: Any  # `numpy.dtype`
    units: str = ""  # "" where none are given


class Store(NamedTuple):
    """An open store."""

    path: Path
    arrays: dict  # of Zarr arrays by name, `OWN` too
    manifest: dict  # the inputs of the campaign by name, ``n`` and ``block`` [scenarios] among them
    names: list  # of the variables, in order

    def span(self, block: int) -> tuple[int, int]:
        """First scenario of a block and the one after its last."""
        size = self.manifest["block"]
        return block * size, min((block + 1) * size, self.manifest["n"])


def blocks_of(n: int, block: int) -> int:
    """How many blocks n scenarios make."""
    return -(-n // block)


def create(path: Path, variables: Mapping[str, Variable], manifest: Mapping, times: np.ndarray | None) -> None:
    """Make an empty store, beside its place first, so that it is there as a whole or not at all.

    manifest: plain values for JSON, ``n`` and ``block`` [scenarios] among them; times [s]: of the records, if any.
    """
    n, block = manifest["n"], manifest["block"]
    new = path.with_name(path.name + ".new")
    shutil.rmtree(new, ignore_errors=True)  # of a run that was killed just here
    path.parent.mkdir(parents=True, exist_ok=True)
    with zarr.config.set(_WHOLE):
        group = zarr.create_group(
            new, zarr_format=3, attributes={"campaign": "", "arrays": json.dumps(list(variables))}
        )
        for name, v in variables.items():
            flags = {"flag_values": [0, 1, 2], "flag_meanings": " ".join(STATUS)} if v.role == "status" else {}
            unit = {"units": v.units} if v.units else {}
            nothing: Any = {"f": np.nan, "i": -1}.get(v.dtype.kind, 0)
            group.create_array(
                name, shape=(*v.shape, n), chunks=(*(max(a, 1) for a in v.shape), block), dtype=v.dtype,
                compressors=_CODECS, fill_value=nothing, dimension_names=v.dims, attributes={"role": v.role, **flags, **unit},
            )  # fmt: skip
        group.create_array(
            OWN, shape=(blocks_of(n, block),), chunks=(1,), dtype=np.uint64, fill_value=0, compressors=_CODECS,
            dimension_names=("block",), attributes={"role": "checksum", "long_name": "2^32 + crc32 of a block"},
        )  # fmt: skip
        if times is not None:
            _write_times(group, times)
    _describe(new, manifest)
    os.rename(new, path)


def _write_times(group, times: np.ndarray) -> None:
    array = group.create_array(
        "time", shape=times.shape, dtype=times.dtype, dimension_names=("time",), attributes={"role": "time", "units": "s"},
        compressors=_CODECS, fill_value=np.nan, overwrite=True,
    )  # fmt: skip
    array[:] = times


def repair_times(store: Store, times: np.ndarray) -> None:
    """Write the times [s] of the records anew, where the store holds others or none."""
    if not np.array_equal(stored_times(store), times):
        with zarr.config.set(_WHOLE):
            _write_times(zarr.open_group(store.path, mode="r+", zarr_format=3, use_consolidated=False), times)


def stored_times(store: Store) -> np.ndarray:
    """Times [s] of the records; none where they are gone or damaged."""
    try:
        group: Any = zarr.open_group(store.path, mode="r", zarr_format=3, use_consolidated=False)
        times = np.asarray(group["time"][:], float)
        return times[np.isfinite(times)]
    except Exception:  # whatever Zarr says of it
        return np.zeros(0)


_BESIDE = "zarr.json.partial"


def _describe(path: Path, manifest: Mapping) -> None:
    """Write the manifest and the metadata of all arrays into the group's own file, all at once."""
    group = json.loads((path / "zarr.json").read_text())
    group["attributes"]["campaign"] = json.dumps(dict(manifest))
    arrays = {file.parent.name: json.loads(file.read_text()) for file in sorted(path.glob("*/zarr.json"))}
    group["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": arrays}
    text = json.dumps(group, indent=2)
    if text != (path / "zarr.json").read_text():
        (path / _BESIDE).write_text(text)
        os.replace(path / _BESIDE, path / "zarr.json")


def open_store(path: Path, mode: Any = "r") -> Store:
    """The store at path; mode "r" reads, "r+" writes.

    Raises FileNotFoundError if there is none, ValueError if it is no campaign.
    """
    if not path.exists():
        raise FileNotFoundError(f"`path` must be the store of a campaign, but there is nothing at {path}.")
    with readable(path), zarr.config.set(_WHOLE):
        group = zarr.open_group(path, mode=mode, zarr_format=3, use_consolidated=False)
        arrays = {name: array for name, array in group.arrays() if name != "time"}
        manifest, names = (json.loads(str(group.attrs[word])) for word in ("campaign", "arrays"))
        _check_metadata(manifest, names, arrays)
    return Store(path, arrays, manifest, names)


@contextmanager
def readable(path: Path):
    """Whatever Zarr and xarray say of broken metadata, as one ValueError."""
    try:
        yield
    except Exception as error:
        if isinstance(error, OSError) and not isinstance(error, FileNotFoundError):
            raise
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise ValueError(f"`path` must be the store of a campaign, but {path} is not: {reason}.") from None


def _check_metadata(manifest, variables, arrays) -> None:
    """Refuse what would send a reader astray."""
    for name in ("n", "block"):
        if type(manifest[name]) is not int or not 0 < manifest[name] < 2**31:
            raise ValueError(f"its {name} is {manifest[name]!r}")
    if {OWN, *variables} != set(arrays):
        raise ValueError(f"it holds {', '.join(sorted(arrays))}")
    lengths = {a.shape[-1] for name, a in arrays.items() if name != OWN and a.ndim} | {manifest["n"]}
    blocks = {blocks_of(length, manifest["block"]) for length in lengths}  # two, where it was left while it grew
    if max(lengths) >= 2**31 or arrays[OWN].shape not in {(count,) for count in blocks}:
        raise ValueError(f"its arrays are of {sorted(lengths)} scenarios and {arrays[OWN].shape} blocks")
    for name, array in arrays.items():
        chunks = (1,) if name == OWN else (*(max(a, 1) for a in array.shape[:-1]), manifest["block"])
        if array.ndim == 0 or array.chunks != chunks:
            raise ValueError(f"{name} is not in chunks of one block")


def sized(store: Store, n: int) -> Store:
    """The store for n scenarios. The manifest speaks last: a run killed in between is made good by the next."""
    last, block = store.manifest["n"], store.manifest["block"]
    (store.path / _BESIDE).unlink(missing_ok=True)  # of a run that was killed just there
    wanted = {name: n for name in store.arrays} | {OWN: blocks_of(n, block)}
    if n != last and last % block:
        store.arrays[OWN][last // block] = 0  # the last block was not full and has to grow
    for name, array in store.arrays.items():
        if array.shape[-1] != wanted[name]:
            array.resize((*array.shape[:-1], wanted[name]))
    _describe(store.path, {**store.manifest, "n": n})
    return open_store(store.path, "r+")


def read_block(store: Store, block: int) -> dict[str, np.ndarray]:
    """The numbers of a block, by name; whatever the codecs raise where a chunk is broken."""
    start, stop = store.span(block)
    return {name: np.asarray(a[..., start:stop]) for name, a in store.arrays.items() if name != OWN}


def write_block(store: Store, block: int, values: dict[str, np.ndarray]) -> None:
    """Write a block; its checksum comes last and makes it one."""
    start, stop = store.span(block)
    for name, a in values.items():
        store.arrays[name][..., start:stop] = a
    store.arrays[OWN][block] = checksum_of(values)


def checksum_of(values: dict[str, np.ndarray]) -> np.uint64:
    """2^32 + crc32 of the names, types, shapes and numbers of a block: never 0, which is "not done"."""
    crc = 0
    for name in sorted(values):
        a = np.ascontiguousarray(values[name])
        crc = zlib.crc32(a.tobytes(), zlib.crc32(f"{name} {a.dtype} {a.shape}".encode(), crc))
    return np.uint64(2**32 + crc)


def state_of(store: Store, block: int) -> str:
    """done, missing or damaged: what is there does not fit its checksum, or cannot be read."""
    try:
        mark = store.arrays[OWN][block]
        if mark == 0:
            return "missing"
        return "done" if mark == checksum_of(read_block(store, block)) else "damaged"
    except OSError:
        raise
    except Exception:  # whatever a codec says of a broken chunk
        return "damaged"


# one writer for a block


_held: set[Path] = set()  # POSIX locks do not keep a process from itself


@contextmanager
def lock_file(path: Path):
    """The open lock file beside a store: its byte 0 stands for the metadata, byte 1 + b for block b.

    The system drops the locks of a process that dies, however it dies, so none is ever stale.
    """
    file = path.with_name(path.name + ".lock").resolve()
    if file in _held:
        raise RuntimeError(f"`path` must have one writer, but this process is writing to {path} already.")
    file.parent.mkdir(parents=True, exist_ok=True)
    _held.add(file)
    handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        yield handle
    finally:
        os.close(handle)
        _held.discard(file)


@contextmanager
def metadata_lock(handle: int):
    """Alone with the metadata of the store."""
    fcntl.lockf(handle, fcntl.LOCK_EX, 1, 0)  # waits: creating and growing a store take a moment
    yield
    fcntl.lockf(handle, fcntl.LOCK_UN, 1, 0)


def take(handle: int, path: Path, mine: range) -> None:
    """Lock the blocks mine until handle, the open lock file, is closed.

    Raises RuntimeError if another process has some of them.
    """
    try:
        fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB, len(mine), 1 + mine.start)
    except OSError:
        raise RuntimeError(
            f"`path` must have one writer for a block, but another process is writing to {path}, "
            f"blocks {mine.start} to {mine.stop - 1} or some of them."
        ) from None


def sweep_up(store: Store, mine: range) -> None:
    """Remove what a killed write left of my blocks; the last number in a chunk's name is its block."""
    for file in store.path.rglob("*.partial"):
        head = file.name.split(".")[0]
        if head.isdigit() and int(head) in mine:
            file.unlink(missing_ok=True)
