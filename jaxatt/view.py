"""The spacecraft in three dimensions: a picture of one instant of a log, and a movie of all of it.

    view.picture(log, 12.0)  # matplotlib axes: body box and axes, reference axes, time, alarm
    view.movie(log, "slew.gif", directions={"Sun": Vec3(1.0, 0.0, 0.0)})

A log is what `simulate` returns, a dict of arrays with the times ``t``, or a table of `jaxatt.tables`. The true attitude is
drawn solid, the estimated one dashed. Attitudes are quaternions, scalar first, or MRP, body to reference, as all of
`jaxatt.attitude`; convert others there. The view is fixed to the reference frame.

May import: check, fields, vec, attitude, plot.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FFMpegWriter, PillowWriter
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D

from jaxatt import check, fields
from jaxatt.attitude import mrp_matrix, quat_matrix
from jaxatt.plot import COLOURS, GREY
from jaxatt.vec import Quat, Vec3, array

SIDES = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2  # corners of a box
FACES = [(4, 5, 7, 6), (2, 6, 7, 3), (1, 3, 7, 5), (0, 1, 3, 2), (0, 4, 5, 1), (0, 2, 6, 4)]  # +x +y +z -x -y -z
EDGES = [(i, j) for i in range(8) for j in range(i) if (i ^ j) in (1, 2, 4)]


class _Run(NamedTuple):
    """What is drawn, over the T records of a log."""

    t: np.ndarray  # (T,) [s]
    true: np.ndarray  # (T, 3, 3), body to reference
    estimated: np.ndarray | None  # the same
    alarm: np.ndarray  # (T,) bool
    directions: dict[str, np.ndarray]  # (T, 3) unit vectors in reference axes
    corners: np.ndarray  # (8, 3) of the body in its axes, the longest side 1.1


def picture(
    log,
    at: float | None = None,
    *,
    attitude: Any = "q",
    estimate: Any = None,
    alarm: Any = None,
    directions: Mapping[str, Vec3] | None = None,
    size: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ax: Any = None,
) -> Axes3D:
    """The spacecraft at one instant: its box and axes x, y, z in the reference axes X, Y, Z.

    Args:
        log: of one run: a NamedTuple or dict with the times ``t``, or a dataset or data frame of `jaxatt.tables`.
        at: [s] the record nearest to it is drawn; None: the last.
        attitude: name of the true attitude in the log, or a `Quat` or `Vec3` (MRP) of components (T,).
        estimate: the same of the estimated one; None: "estimate", if the log has one attitude of that name.
        alarm: name of a flag in the log, or (T,) bool; None: "alarm", if the log has it.
        directions: by name, such as "Sun" or "target", vectors in reference axes, `Vec3` of numbers or of (T,).
        size: of the body along its axes, in any unit.
        ax: three-dimensional axes to draw on.

    Returns:
        The axes.

    Raises:
        ValueError: no times, no such attitude or one of another unit than 1, columns of another length, a size or a
            direction that is not positive, an instant that is no number.
        TypeError: what is no log, no number or no axes.

    Example:
        >>> view.picture(log, 30.0, directions={"Sun": Vec3(1.0, 0.0, 0.0)}, size=(0.1, 0.1, 0.3))
    """
    run = _run(log, attitude, estimate, alarm, directions, size)
    if ax is not None and not isinstance(ax, Axes3D):
        raise TypeError(f"`ax` must be three-dimensional axes of matplotlib, but it is {check.short(ax)}.")
    i = len(run.t) - 1
    if at is not None:
        check.finite("at", at := check.number("at", at))
        i = int(np.argmin(np.abs(run.t - at)))
    if ax is None:
        ax = plt.figure(figsize=(4.2, 4.2)).add_axes((0, 0, 1, 1), projection="3d")
    _draw(ax, run, i)
    return ax


def movie(
    log,
    path,
    *,
    attitude: Any = "q",
    estimate: Any = None,
    alarm: Any = None,
    directions: Mapping[str, Vec3] | None = None,
    size: tuple[float, float, float] = (1.0, 1.0, 1.0),
    frames: int = 80,
    rate: float = 10.0,
    pixels: int = 360,
) -> Path:
    """The spacecraft over the time of a log, as a file: ``.gif``, or ``.mp4`` where ffmpeg is installed.

    Args:
        log: as of `picture`, like all before frames.
        path: of the file.
        attitude: see `picture`.
        estimate: see `picture`.
        alarm: see `picture`.
        directions: see `picture`.
        size: see `picture`.
        frames: how many pictures, evenly spread over the records.
        rate: [1/s] of the pictures.
        pixels: width and height.

    Returns:
        The path.

    Raises:
        ValueError: what `picture` raises; another ending, a folder that is not there, ``.mp4`` without ffmpeg.
        TypeError: what `picture` raises.

    Example:
        >>> view.movie(log, "slew.gif", frames=60)
    """
    run = _run(log, attitude, estimate, alarm, directions, size)
    frames, pixels = check.whole("frames", frames), check.whole("pixels", pixels, 40)
    check.positive("rate", rate := check.number("rate", rate))
    check.fits_memory(f"`pixels` = {pixels}", 16 * pixels**2, "take fewer")
    path = check.new_file("path", path)
    writers = {".gif": PillowWriter, ".mp4": FFMpegWriter}
    if path.suffix not in writers:
        check.refuse("path", "end in .gif or .mp4", repr(path.name))
    if not writers[path.suffix].isAvailable():
        check.refuse("path", "end in .gif where no ffmpeg is installed, which .mp4 needs", repr(path.name))
    figure = plt.figure(figsize=(pixels / 100, pixels / 100), dpi=100)
    try:
        ax = figure.add_axes((0, 0, 1, 1), projection="3d")
        writer = writers[path.suffix](fps=rate)
        with writer.saving(figure, path, dpi=100):
            for i in np.unique(np.linspace(0, len(run.t) - 1, frames).round().astype(int)):
                ax.clear()
                _draw(ax, run, i)
                writer.grab_frame()
    finally:
        plt.close(figure)
    return path


# from a log to what is drawn


def _run(log, attitude, estimate, alarm, directions, size) -> _Run:
    columns, units = _columns(log)
    t = _series("log.t", columns.get("t"), None)
    true = _matrices("attitude", attitude, columns, units, len(t))
    if estimate is None and _parts("estimate", columns, len(t)):
        estimate = "estimate"
    estimated = None if estimate is None else _matrices("estimate", estimate, columns, units, len(t))
    if alarm is None or isinstance(alarm, str):
        if alarm is not None and alarm not in columns:
            check.refuse("alarm", f"be one of {', '.join(columns)}", repr(alarm))
        alarm = columns.get(alarm or "alarm", np.zeros(len(t)))
    on = _series("alarm", alarm, len(t)) > 0
    if directions is not None:
        check.mapping("directions", directions)
    toward = {str(name): _direction(f"directions[{name!r}]", v, len(t)) for name, v in (directions or {}).items()}
    sides = check.real("size", size).astype(float)
    if sides.shape != (3,):
        check.refuse("size", "be three lengths", check.short(size))
    check.positive("size", sides)
    return _Run(t, true, estimated, on, toward, 1.1 * SIDES * (sides / sides.max()))


def _columns(log) -> tuple[dict[str, Any], dict[str, str]]:
    """The columns of a log by name, ``q.x``, its times as ``t``, and their units."""
    if hasattr(log, "data_vars") or (hasattr(log, "columns") and hasattr(log, "index")):
        if hasattr(log, "data_vars"):
            units = {str(name): a.attrs.get("units") for name, a in log.data_vars.items()}
            axes, t = tuple(log.dims), log.get("time")
        else:
            units, axes, t = dict(log.attrs.get("units") or {}), tuple(log.index.names), log.index
        if axes != ("time",):
            check.refuse("log", "be of one run over time (of a batch take data.isel(scenario=0))", f"over {axes}")
        names = log.data_vars if hasattr(log, "data_vars") else log.columns
        return {str(name): np.asarray(log[name]) for name in names} | {"t": np.asarray(t)}, units
    if not hasattr(log, "_fields") and not isinstance(log, Mapping):
        raise TypeError(f"`log` must be a log, a dict of arrays or a table, but it is {check.short(log)}.")
    columns = fields.named(log, "log")
    if "t" not in columns:
        check.refuse("log", "have the times t", f"of {check.short(list(columns))}")
    return columns, fields.units_within(log)


def _series(name: str, values, n: int | None) -> np.ndarray:
    """(n,) floats."""
    a = check.real(name, values).astype(float)
    if a.ndim != 1 or not len(a) or n not in (None, len(a)):
        check.refuse(name, f"have shape ({n or 'T'},)", f"of shape {a.shape}")
    return a


def _parts(name: str, columns, n: int) -> dict[str, Any]:
    """The columns of a quaternion or an MRP of a name, or of its field q, such as that of `AttitudeRate`."""
    for stem in (name, f"{name}.q"):
        found = {f"{stem}.{part}": columns[f"{stem}.{part}"] for part in "wxyz" if f"{stem}.{part}" in columns}
        if [part[-1] for part in found] in (list("wxyz"), list("xyz")):
            return found if all(np.shape(a) == (n,) for a in found.values()) else {}
    return {}


def _matrices(what: str, given, columns, units, n: int) -> np.ndarray:
    """Rotation matrices (n, 3, 3), body to reference, of an attitude by name or by components."""
    if isinstance(given, str):
        found = _parts(given, columns, n)
        if not found:
            must = "name a quaternion or an MRP of the log, components (T,)"
            check.refuse(what, f"{must}, of {check.short(list(columns))}", repr(given))
        for name in found:
            if units.get(name) not in (None, "1"):
                must = "be a quaternion or an MRP, of unit 1 (`jaxatt.attitude` converts)"
                check.refuse(what, must, f"{name} in {units[name]}")
        given = Quat(*found.values()) if len(found) == 4 else Vec3(*found.values())
    if not isinstance(given, (Quat, Vec3)):
        raise TypeError(f"`{what}` must be a name, a Quat or a Vec3 of MRP, but it is {check.short(given)}.")
    given = given._make(_series(f"{what}.{part}", a, n) for part, a in zip(given._fields, given))
    return np.moveaxis(np.asarray(_rotation(given)), -1, 0)


@jax.jit
def _rotation(q):
    return array(quat_matrix(q) if isinstance(q, Quat) else mrp_matrix(q))


def _direction(name: str, v, n: int) -> np.ndarray:
    if not isinstance(v, Vec3):
        raise TypeError(f"`{name}` must be a Vec3 in reference axes, but it is {check.short(v)}.")
    parts = [_series(f"{name}.{p}", np.full(n, a) if np.ndim(a) == 0 else a, n) for p, a in zip("xyz", v)]
    along = np.stack(parts, axis=1)
    length = np.linalg.norm(along, axis=1)
    check.positive(f"|{name}|", length)
    return along / length[:, None]


# drawing


def _draw(ax: Any, run: _Run, i: int) -> None:
    words = plt.rcParams["text.color"]
    ax.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-0.85, 1.15))
    ax.set_axis_off()
    ax.set_box_aspect((1, 1, 1), zoom=1.25)
    ax.view_init(elev=22, azim=35)
    for name, axis in zip("XYZ", np.eye(3)):
        ax.plot(*np.outer(axis, [0, 1.25]), color=GREY, linewidth=1)
        ax.text(*(1.35 * axis), name, color=GREY, ha="center", va="center")
    for name, along in run.directions.items():
        ax.quiver(0, 0, 0, *(1.2 * along[i]), color=COLOURS[3], linewidth=1.5, arrow_length_ratio=0.1)
        ax.text(*(1.4 * along[i]), name, color=COLOURS[3], ha="center", va="center")
    body = run.true[i]
    if np.isfinite(body).all():
        at = run.corners @ body.T
        tints = [*COLOURS[:3], GREY, GREY, GREY]
        faces = Poly3DCollection([at[list(face)] for face in FACES], facecolors=tints, edgecolors=words, linewidths=0.8)
        faces.set_alpha(0.35)
        ax.add_collection3d(faces)
        for name, axis, colour in zip("xyz", body.T, COLOURS):
            ax.quiver(0, 0, 0, *axis, color=colour, linewidth=2, arrow_length_ratio=0.12)
            ax.text(*(1.1 * axis), name, color=colour, ha="center", va="center", weight="bold")
    else:
        ax.text2D(0.5, 0.5, "no attitude", transform=ax.transAxes, ha="center")
    if run.estimated is not None and np.isfinite(run.estimated[i]).all():
        at = run.corners @ run.estimated[i].T
        ax.add_collection3d(
            Line3DCollection([at[list(edge)] for edge in EDGES], colors=words, linestyles="--", linewidths=1)
        )
        for axis, colour in zip(run.estimated[i].T, COLOURS):
            ax.plot(*np.outer(axis, [0, 1]), "--", color=colour, linewidth=1.5)
    ax.text2D(0.04, 0.95, f"{run.t[i]:.1f} s", transform=ax.transAxes, va="top", size="large")
    if run.estimated is not None:
        ax.text2D(0.04, 0.04, "solid: true, dashed: estimated", transform=ax.transAxes, size="small")
    if run.alarm[i]:
        box = dict(facecolor=COLOURS[1], edgecolor="none", boxstyle="round")
        ax.text2D(0.96, 0.95, "ALARM", transform=ax.transAxes, ha="right", va="top", color="w", weight="bold", bbox=box)
