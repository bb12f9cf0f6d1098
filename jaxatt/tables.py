"""Runs as labelled tables: a log, a batch of logs or scores, with names and units, to files of other tools and back.

    data = tables.dataset(log)  # an xarray.Dataset: w.x in rad/s over time
    frame = tables.frame(data)  # a pandas.DataFrame
    tables.write("run.nc", data)  # or .csv, .parquet, .zarr, .mat
    readings = tables.tree_of(tables.read("run.nc"), like)  # as `jaxatt.replay.replay` takes them

One table, whatever the format: a column for every number of a tick, named by its place in the tree, the components of a
`Vec3`, `Quat` or `Mat3` as ``w.x`` and ``J.x.y``, those of an array as ``h.0`` and ``P.0.3``; its unit is the one that the
field states (`jaxatt.fields`), an attribute ``units`` in a dataset, part of the header in CSV and Parquet: "w.x [rad/s]".
Times are seconds from 0, the first tick. Numbers keep their type; in CSV they have as many digits as tell them apart from
their neighbours. Needs the extra ``tables``: pip install 'jaxatt[tables]'.

May import: check, clock, fields, headers.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import jax
import numpy as np

from jaxatt import check, fields
from jaxatt.clock import time_of
from jaxatt.headers import name_and_unit

if TYPE_CHECKING:
    import pandas
    import xarray

DIMS = (("time",), ("scenario", "time"), ("scenario",))  # of a log, a batch of logs, scores
FORMATS = (".csv", ".parquet", ".nc", ".zarr", ".mat")
SINCE = "time since the first tick"
# what MATLAB would not take as the name of a variable
MATLAB = {
    "names", "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global", "if", "otherwise",
    "parfor", "persistent", "return", "spmd", "switch", "try", "while",
}  # fmt: skip


def _needs(*modules: str) -> None:
    """Refuse, with the extra's name, where a library is missing."""
    for module in modules:
        try:
            __import__(module)
        except ImportError as error:
            raise ImportError(f"jaxatt.tables needs {module}: pip install 'jaxatt[tables]' ({error}).") from None


def dataset(
    tree, *, dt: float | None = None, t=None, dims: tuple[str, ...] = ("time",), units: Mapping[str, str] | None = None
) -> xarray.Dataset:
    """A log, a batch of logs, scores, or any tree of arrays with the same first axes as a table.

    Args:
        tree: NamedTuples, dicts, tuples and arrays, every leaf with the axes dims first; or a data frame of `frame`.
        dt: [s] between ticks, the first at t = 0, where the tree has no times of its own: a field ``t`` in seconds.
        t: (T,) [s] instead of it, such as the times of a recorded file.
        dims: ("time",) of a log, ("scenario", "time") of a batch of logs, ("scenario",) of scores.
        units: by name, of a leaf or a column, beside and over those that the fields state.

    Returns:
        An `xarray.Dataset` of one column, over dims, for every number of a tick or scenario; ``time`` in seconds.

    Raises:
        ValueError: leaves of other axes, no times or two sorts of them, names that a header cannot hold.
        TypeError: what is no number.
        ImportError: without xarray.

    Example:
        >>> data = dataset(simulate(loop.system, loop.params, loop.scenario, key, ticks=100))
    """
    _needs("xarray")
    import xarray

    if hasattr(tree, "columns") and hasattr(tree, "index"):
        return _of_frame(tree)
    if dims not in DIMS:
        check.refuse("dims", f"be one of {DIMS}", check.short(dims))
    check.mapping("units", {} if units is None else units)
    stated = fields.units_within(tree) | dict(units or {})
    leaves = fields.named(check.numbers("tree", tree), "value")
    if not leaves:
        check.refuse("tree", "hold at least one array", "empty")
    if len(leaves) < len(jax.tree.leaves(tree)):
        check.refuse("tree", "name every number once", f"with names such as {check.short(list(leaves))} twice")
    shape: tuple = next(np.shape(leaf)[: len(dims)] for leaf in leaves.values())
    own = leaves.pop("t") if "time" in dims and "t" in leaves and stated.get("t") == "s" else None
    columns: dict[str, tuple] = {}
    for name, leaf in leaves.items():
        a = np.asarray(leaf)
        if a.ndim < len(dims) or a.shape[: len(dims)] != shape or 0 in shape:
            check.refuse(f"tree.{name}", f"lead with the axes {dims}, as the others do", f"of shape {a.shape}")
        for place in np.ndindex(a.shape[len(dims) :]):
            column = ".".join([name, *map(str, place)])
            if column in columns:
                check.refuse("tree", "name every number once", f"with {column!r} twice")
            unit = "1" if a.dtype == bool else stated.get(column, stated.get(name))
            columns[column] = dims, a[(..., *place)], _attributes(column, unit)
    for name in units or {}:
        if name not in leaves and name not in columns:
            check.refuse("units", f"name leaves or columns ({check.short(list(columns))})", repr(name))
    coords: dict[str, Any] = {}
    if "scenario" in dims:
        coords["scenario"] = np.arange(shape[0])
    if "time" in dims:
        coords["time"] = (
            "time",
            _times(own, dt, t, shape),
            {"units": "s", "long_name": SINCE if t is None else "time"},
        )
    elif dt is not None or t is not None:
        check.refuse(
            "dt" if t is None else "t", "be None for scores, which have no times", check.short(dt if t is None else t)
        )
    return xarray.Dataset(columns, coords)


def _attributes(name: str, unit) -> dict[str, str]:
    """Attributes of a column; refuses names and units that do not come back from a header."""
    if not isinstance(unit, (str, type(None))):
        check.refuse(f"units[{name!r}]", "be a string", check.short(unit))
    header = f"{name} [{unit}]" if unit else name
    if name in ("time", "scenario") or name_and_unit(header) != (name, unit or None) or name.startswith("#"):
        check.refuse("tree", "have names and units that a header can hold (no brackets, not 'time')", repr(header))
    if any(sign in name for sign in '\n\r"/\\') or name != name.strip():
        check.refuse("tree", "have names without slashes, quotes and ends of lines", repr(name))
    return {"units": unit} if unit else {}


def _times(own, dt, t, shape: tuple) -> np.ndarray:
    """Times (T,) [s]: those of the log, of a period, or as given; shape: that of the table."""
    given = [name for name, value in (("t", own), ("dt", dt), ("t", t)) if value is not None]
    if len(given) != 1:
        must = "be given, for the tree has no field t in seconds" if not given else "be None, for the tree has times t"
        check.refuse("dt", must, check.short(dt))
    if dt is not None:
        check.positive("dt", check.number("dt", dt))
        return time_of(np.arange(shape[-1]), float(dt), np.float64)
    a = check.real("t", own if own is not None else t)
    if a.shape != (shape if own is not None else shape[-1:]):
        check.refuse("t", f"have shape {shape if own is not None else shape[-1:]}", f"of shape {a.shape}")
    if a.ndim == 2:
        if not (a == a[:1]).all():
            check.refuse("t", "be the same in all scenarios", f"of shape {a.shape} with different rows")
        a = a[0]
    check.finite("t", a)
    return a


def tree_of(data, like):
    """The numbers of a table in the tree that they came from, such as readings for `jaxatt.replay.replay`.

    Args:
        data: an `xarray.Dataset` or `pandas.DataFrame` of this module, also one that was written and read; it may hold more.
        like: a tree of the same structure for one tick or scenario: ``loop.computer_of(*loop.init(params, scenario))``.

    Returns:
        The tree, every leaf with the axes of the table first, of the type that the leaf in like has.

    Raises:
        ValueError: a number that the table does not hold, in another unit, or that its type cannot hold.

    Example:
        >>> computers = tree_of(read("run.nc"), loop.computer_of(*loop.init(loop.params, loop.scenario)))
    """
    data = _flat(data)
    check.numbers("like", like)
    dims = tuple(name for name in ("scenario", "time") if name in data.dims)
    shape = tuple(data.sizes[name] for name in dims)
    stated = fields.units_within(like)

    def column(name: str, place: tuple):
        full = ".".join([name, *map(str, place)])
        if full == "t" and "t" not in data and "time" in dims:
            return np.broadcast_to(data["time"].values, shape)
        if full not in data:
            check.refuse("data", f"hold {full!r}", f"a table of {check.short(list(data.data_vars))}")
        unit, wanted = data[full].attrs.get("units"), stated.get(full, stated.get(name))
        if unit and wanted and unit != wanted and data[full].dtype != bool and unit != "1":
            check.refuse(f"data.{full}", f"be given in [{wanted}]", f"in [{unit}]")
        return data[full].transpose(*dims).values

    out = []
    for (name, leaf), typed in zip(fields.named(like, "value").items(), jax.tree.leaves(like)):
        inner = np.shape(leaf)
        kind = np.dtype(typed.dtype) if hasattr(typed, "dtype") else None
        parts = [column(name, place) for place in np.ndindex(inner)]
        a = np.stack(parts, -1).reshape(*shape, *inner) if parts else np.zeros((*shape, *inner), kind or float)
        out.append(_typed(name, a, kind))
    return jax.tree.unflatten(jax.tree.structure(like), out)


def _typed(name: str, a: np.ndarray, kind) -> np.ndarray:
    """a in another type; refuses what a type of whole numbers does not hold."""
    if kind is None or a.dtype == kind:
        return a
    if kind.kind in "biu":
        with np.errstate(invalid="ignore"):
            there = a.astype(kind)
        if not (there == a).all():
            check.refuse(f"data.{name}", f"hold numbers of type {kind}", f"{float(a[there != a][0]):g}")
        return there
    return a.astype(kind)


def _flat(data) -> xarray.Dataset:
    """A table of columns over scenario and time alone; axes of others, as stores of campaigns have, become ``.0``."""
    _needs("xarray")
    import xarray

    if not isinstance(data, xarray.Dataset):
        if not (hasattr(data, "columns") and hasattr(data, "index")):
            raise TypeError(f"`data` must be an xarray.Dataset or a pandas.DataFrame, but it is {check.short(data)}.")
        return _of_frame(data)
    there = [name for name in ("scenario", "time") if name in data.dims]
    if not there:
        check.refuse("data", "have the axes scenario or time", f"of {check.short(dict(data.sizes))}")
    for name in there:
        if name not in data.coords:
            check.refuse("data", f"have a coordinate {name}", f"of {check.short(list(data.coords))}")
    if set(data.dims) == set(there):
        return data
    columns = {}
    for name, a in data.data_vars.items():
        if missing := [dim for dim in there if dim not in a.dims]:
            check.refuse(f"data.{name}", f"have the axis {missing[0]}, as others do", f"over {a.dims}")
        a = a.transpose(*there, ...)
        for place in np.ndindex(a.shape[len(there) :]):
            columns[".".join([str(name), *map(str, place)])] = there, a.values[(..., *place)], a.attrs
    return xarray.Dataset(columns, {name: data[name] for name in there})


def frame(data) -> pandas.DataFrame:
    """A dataset as a data frame: a row a tick or scenario, columns named ``w.x``, units in ``attrs["units"]`` by column.

    data: a dataset of `dataset`, of `read` or of a campaign. The index is ``time`` [s] of a log, ``scenario`` of scores,
    both of a batch of logs. Raises ImportError without pandas.
    """
    _needs("pandas")
    import pandas

    data = _flat(data)
    there = [name for name in ("scenario", "time") if name in data.dims]
    index = pandas.Index(data[there[0]].values, name=there[0])
    if len(there) == 2:
        index = pandas.MultiIndex.from_product([data[name].values for name in there], names=there)
    columns = {name: a.transpose(*there).values.ravel() for name, a in data.data_vars.items()}
    table = pandas.DataFrame(columns, index=index)
    table.attrs["units"] = {name: a.attrs["units"] for name, a in data.variables.items() if "units" in a.attrs}
    return table


def _of_frame(table) -> xarray.Dataset:
    """The dataset of a data frame of `frame`."""
    import xarray

    there = tuple(name for name in table.index.names)
    if there not in DIMS:
        check.refuse("frame", "have the index time, scenario, or both", f"of {there}")
    units = table.attrs.get("units") or {}
    axes = [np.asarray(table.index.get_level_values(name).unique()) for name in there]
    shape = tuple(map(len, axes))
    if len(table) != np.prod(shape) or (
        len(there) == 2 and not (np.asarray(table.index.get_level_values(1)).reshape(shape) == axes[1]).all()
    ):
        check.refuse("frame", "have all times of every scenario, in order", f"of {len(table)} rows for {shape}")
    known = lambda name: {"units": units[name]} if name in units else {}
    coords = {name: (name, axis, known(name)) for name, axis in zip(there, axes)}
    columns = {
        str(name): (there, check.real(f"frame.{name}", table[name].to_numpy()).reshape(shape), known(name))
        for name in table.columns
    }
    return xarray.Dataset(columns, coords)


# files


def write(path, data) -> None:
    """Write a table; the ending of the path says how.

    ``.csv``, ``.parquet``: a row a tick or scenario, columns named "w.x [rad/s]"; `jaxatt.replay.load` reads them, too.
    ``.nc``: NetCDF 3, whose whole numbers have 32 bits; longer ones become floats. ``.zarr``: a Zarr group, format 3.
    ``.mat``: MATLAB, a variable w_x for each column, and the cell array ``names`` of its name there, here, and its unit.

    Args:
        path: of the file, which is written over, or of a ``.zarr`` folder that is not there yet.
        data: a dataset or data frame of this module, or of a campaign.

    Raises:
        ValueError: another ending, a folder that is there already.
        ImportError: without the library of the format.

    Example:
        >>> write("run.csv", dataset(log))
    """
    path = _place(path)
    data, kind = _flat(data), path.suffix
    if kind in (".csv", ".parquet"):
        table = frame(data).reset_index()
        units = {name: a.attrs["units"] for name, a in data.variables.items() if "units" in a.attrs}
        table.columns = [f"{name} [{units[name]}]" if name in units else name for name in table.columns]
        table.attrs = {}
        if kind == ".csv":
            table.to_csv(path, index=False, na_rep="nan")
        else:
            table.to_parquet(path, index=False)
    elif kind == ".nc":
        data.map(_short).to_netcdf(path, engine="scipy", format="NETCDF3_64BIT")
    elif kind == ".zarr":
        if path.exists():
            check.refuse("path", "be a folder that is not there yet", str(path))
        data.to_zarr(path, mode="w-", zarr_format=3, consolidated=False)
    else:
        _write_matlab(path, data)


def read(path) -> xarray.Dataset:
    """A table that `write` wrote, as a dataset with names, units, times and types. Nothing in a file is executed.

    Args:
        path: of the file; its ending says what it is.

    Returns:
        The dataset. Floats of a CSV file are float64, `tree_of` makes them what they were; the other formats keep float32.

    Raises:
        FileNotFoundError: there is none.
        ValueError: another ending, what is no such file.
        ImportError: without the library of the format.

    Example:
        >>> data = read("run.nc")
    """
    path = _place(path)
    if not path.exists():
        raise FileNotFoundError(f"`path` must be a file, but there is nothing at {path}.")
    readers = {
        ".csv": _read_rows,
        ".parquet": _read_rows,
        ".nc": _read_netcdf,
        ".zarr": _read_zarr,
        ".mat": _read_matlab,
    }
    try:
        return _flat(readers[path.suffix](path))
    except Exception as error:
        _no_table(path, error)


def _no_table(path: Path, error: Exception) -> NoReturn:
    reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
    raise ValueError(f"`path` must be a table of jaxatt.tables, but {path.name} is none: {reason}") from None


def _place(path) -> Path:
    path = check.place("path", path)
    if path.suffix not in FORMATS:
        check.refuse("path", f"end in one of {', '.join(FORMATS)}", repr(path.name))
    needed = {".csv": ["pandas"], ".parquet": ["pandas", "pyarrow"], ".nc": ["scipy"], ".mat": ["scipy"]}
    _needs("xarray", *needed.get(path.suffix, ["zarr"]))
    return path


def _read_rows(path: Path):
    import pandas

    if path.suffix == ".csv":
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file, strict=True)
        columns = [_of_words(cells) for cells in zip(*rows, strict=True)]
        table = pandas.concat([pandas.Series(a, name=name) for name, a in zip(header, columns, strict=True)], axis=1)
    else:
        import pyarrow.parquet

        with path.open("rb") as file:
            table = pyarrow.parquet.read_table(file).to_pandas()
    known = dict(name_and_unit(str(header)) for header in table.columns)
    if len(known) < len(table.columns):
        raise ValueError("a column stands in it twice")
    table.columns = list(known)
    units = {name: unit for name, unit in known.items() if unit}
    table = table.set_index([name for name in ("scenario", "time") if name in known])
    table.attrs["units"] = units
    return _of_frame(table)


def _of_words(cells: tuple[str, ...]) -> np.ndarray:
    """A column of text as what was written: flags, whole numbers, or floats to the last bit."""
    if set(cells) <= {"True", "False"}:
        return np.array([cell == "True" for cell in cells])
    try:
        return np.array([int(cell) for cell in cells])
    except ValueError:
        return np.array([float(cell) for cell in cells])


def _read_netcdf(path: Path):
    import xarray

    found = xarray.load_dataset(path, engine="scipy", decode_times=False, decode_timedelta=False)
    native = lambda a: (a.dims, a.values.astype(a.dtype.newbyteorder("=")), a.attrs)
    columns, axes = ({name: native(a) for name, a in part.items()} for part in (found.data_vars, found.coords))
    return xarray.Dataset(columns, axes)


def _short(a):
    """A column as NetCDF 3 can hold it, which knows whole numbers of 8 to 32 bits with a sign alone."""
    if a.dtype.kind not in "iu" or (a == a.astype(np.int32)).all():
        return a if a.dtype.kind not in "iu" else a.astype(np.int32, keep_attrs=True)
    if not (a.astype(float).astype(a.dtype) == a).all():
        check.refuse(str(a.name), "hold whole numbers that a float can hold, in .nc", f"up to {int(abs(a).max())}")
    return a.astype(float, keep_attrs=True)


def _read_zarr(path: Path):
    import xarray

    plain: dict[str, Any] = dict(consolidated=False, zarr_format=3, chunks=None)
    return xarray.open_zarr(path, decode_times=False, decode_timedelta=False, **plain).load()


def _write_matlab(path: Path, data) -> None:
    from scipy.io import savemat

    out, names = {}, []
    for name, a in data.variables.items():
        there = "".join(sign if sign.isascii() and sign.isalnum() else "_" for sign in str(name))
        there = there if there[:1].isalpha() else f"x{there}"
        there = (f"{there}_" if there in MATLAB else there)[:63]
        for count in range(2, len(data.variables) + 2):
            if there not in out:
                break
            there = f"{there[:56]}_{count}"
        out[there] = a.transpose(*(dim for dim in ("scenario", "time") if dim in a.dims)).values
        names.append([there, str(name), a.attrs.get("units", "")])
    savemat(path, out | {"names": np.array(names, object)}, oned_as="column", long_field_names=True)


def _read_matlab(path: Path):
    import xarray
    from scipy.io import loadmat

    found = loadmat(path, mat_dtype=True, chars_as_strings=True)
    known = {}
    for row in found["names"]:
        there, name, unit = ("".join(np.ravel(cell).tolist()) for cell in row)
        known[name] = found[there], ({"units": unit} if unit else {})
    dims = tuple(name for name in ("scenario", "time") if name in known)
    coords = {name: (name, known[name][0].ravel(), known[name][1]) for name in dims}
    shape = tuple(len(axis) for _, axis, _ in coords.values())
    columns = {name: (dims, a.reshape(shape), attrs) for name, (a, attrs) in known.items() if name not in dims}
    return xarray.Dataset(columns, coords)
