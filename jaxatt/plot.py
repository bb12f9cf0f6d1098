"""Figures that a paper takes: each function draws on the axes it is given, or on new ones, and returns the axes.

Data is what the other modules give: logs and scores (NamedTuples), dicts of arrays, an ``xarray.Dataset`` or a
``pandas.DataFrame`` whose columns lead to arrays of shape (n,). Every axis carries a unit: names end in one,
"delay [s]", "[1]" for a pure number; a dataset's ``units`` attribute does as well, and so does ``labels``.
Colours are Okabe and Ito's, with a contrast of 3 or more on white and on black; text follows matplotlib's style.
Nothing in the package imports this module.

May import: check, vec, attitude, faults, mounting, scores, bodies, sensors, estimators, kalman, lmmse, controllers,
detection, singularity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import wraps
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from jaxatt import check, detection
from jaxatt import singularity as sg
from jaxatt.check import F, door
from jaxatt.faults import Fault
from jaxatt.mounting import GimbalAxes
from jaxatt.vec import Vec3, array

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")  # blue, vermilion, green, purple
LINES = ("-", "--", "-.", ":")  # one style for each colour: no line is told by its colour alone
MARKS = ("o", "s", "^", "D")
GREY = "0.5"  # for what is no data: seen on white and on black
MAP = "cividis"  # reads the same with and without colour vision

# names, units and columns


@door
def column(data, name: str) -> np.ndarray:
    """One quantity of a dict, a NamedTuple, a dataset or a data frame, as an array.

    Raises ValueError where there is none of that name.
    """
    there = list(data._fields) if hasattr(data, "_fields") else list(data)
    if name not in there:
        check.refuse("name", "be one of " + ", ".join(map(str, there)), repr(name))
    return np.asarray(getattr(data, name) if hasattr(data, "_fields") else data[name])


@door
def label_of(data, name: str, labels: Mapping[str, str] | None = None) -> str:
    """The axis label of a quantity: of ``labels``, or its name with the unit that the data knows.

    Raises ValueError where no unit is known.
    """
    text = (labels or {}).get(name, name)
    if "[" not in text and not hasattr(data, "_fields"):
        unit = getattr(data[name], "attrs", {}).get("units") if name in data else None
        text = f"{text} [{unit}]" if unit else text
    return _with_unit(text)


def _with_unit(label: str) -> str:
    if not (label.endswith("]") and "[" in label):
        check.refuse("label", "end in a unit, such as 'delay [s]' or '[1]' for a pure number", repr(label))
    return label


def _legend(ax) -> None:
    """A legend beside the axes, where it hides no data."""
    if ax.get_legend_handles_labels()[1]:
        ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1), borderaxespad=0, fontsize="small")


def _new(ax, **how) -> Any:
    return plt.subplots(layout="constrained", **how)[1] if ax is None else ax


def _figure(f: F) -> F:
    """The door of what draws: a refusal closes the figure it had begun, which a notebook would show empty."""

    @wraps(f)
    def draw(*args, **kwargs):
        before = set(plt.get_fignums())
        try:
            return f(*args, **kwargs)
        except Exception:
            for number in set(plt.get_fignums()) - before:
                plt.close(number)
            raise

    return door(draw)  # pyright: ignore[reportReturnType]


# one run


@door
def fault_times(scenario) -> dict[str, float]:
    """The onsets [s] of the faults in a scenario, by the sensors or actuators at fault; of one scenario.

    Faults that begin together are one entry: ``{"gyro fault": 150.0, "star fault": 250.0}``.
    """
    found: dict[float, list[str]] = {}
    leaves = jax.tree_util.tree_flatten_with_path(scenario, is_leaf=lambda node: isinstance(node, Fault))[0]
    for path, fault in leaves:
        if isinstance(fault, Fault):
            name = jax.tree_util.keystr(path[:1]).lstrip(".").replace("_", " ") or "a"
            for onset in np.unique(np.asarray(fault.onset, float)):
                if np.isfinite(onset) and name not in found.setdefault(float(onset), []):
                    found[float(onset)].append(name)
    return {" and ".join(names) + " fault": onset for onset, names in sorted(found.items())}


@_figure
def overview(
    t,
    panels: Mapping[str, Any],
    *,
    faults: Mapping[str, float] | None = None,
    thresholds: Mapping[str, float] | None = None,
    alarm=None,
    axes: Any = None,
) -> np.ndarray:
    """One run over time: a panel for every quantity, fault onsets marked, thresholds dashed, alarms shaded.

    t: (T,) [s]. panels: by axis label with unit, values of shape (T,) or (T, k), a `Vec3` of (T,) or several (T,) by
    name. faults: onsets [s] by name, as `fault_times` gives them. thresholds: by the label of their panel. alarm: (T,) bool.
    Returns the axes, one for each panel.
    """
    axes = _new(axes, nrows=len(panels), sharex=True, squeeze=False, figsize=(8, 1 + 1.9 * len(panels)))
    axes, t = np.ravel(axes), np.asarray(t)
    for ax, (label, values) in zip(axes, panels.items()):
        lines: Mapping[str, Any] = {"": values}
        if isinstance(values, Mapping):
            lines = values
        elif isinstance(values, tuple):
            lines = dict(zip(getattr(values, "_fields", map(str, range(1, 1 + len(values)))), values))
        elif np.ndim(values) == 2:
            lines = {str(i + 1): column for i, column in enumerate(np.asarray(values).T)}
        for i, (name, line) in enumerate(lines.items()):
            ax.plot(t, line, LINES[i % 4], color=COLOURS[i % 4], linewidth=1.1, label=name or None)
        level = (thresholds or {}).get(label)
        if level is not None:
            ax.axhline(float(level), color=plt.rcParams["text.color"], linestyle="--", label="threshold")
        if alarm is not None:
            on = np.asarray(alarm, bool)
            ax.fill_between(t, 0, 1, where=on, transform=ax.get_xaxis_transform(), color=GREY, alpha=0.25,
                            linewidth=0, step="post", label="alarm" if ax is axes[0] else None)  # fmt: skip
        for onset in (faults or {}).values():
            ax.axvline(onset, color=GREY, linestyle=":", linewidth=1.5)
        ax.set(ylabel=_with_unit(label), xlim=(t[0], t[-1]))
        ax.grid(alpha=0.3)
        _legend(ax)
    for row, (name, onset) in enumerate((faults or {}).items()):
        near = row % 2 and onset - list((faults or {}).values())[row - 1] < 0.2 * (t[-1] - t[0])
        axes[0].annotate(
            name, (onset, 1), xycoords=("data", "axes fraction"), xytext=(0, 14 if near else 3),
            textcoords="offset points", ha="center", va="bottom", fontsize="small", annotation_clip=True,
        )  # fmt: skip
    axes[-1].set_xlabel("time [s]")
    return axes


# many runs


@_figure
def heat_map(
    data,
    x: str,
    y: str,
    value: str,
    *,
    bins: int = 16,
    log: tuple[str, ...] = (),
    labels: Mapping[str, str] | None = None,
    chance=None,
    ax: Any = None,
) -> Axes:
    """Mean of a score over two quantities of the scenarios, such as the share of faults detected; empty cells blank.

    data: columns of shape (n,), of which x, y and value are named. bins: cells along each axis. log: which of
    x and y run over decades. chance: the level that a detector reaches by luck, marked on the colour bar.

    Raises ValueError for an unknown name, a label without unit and values <= 0 on a logarithmic axis.
    """
    bins = check.whole("bins", bins)
    ax = _new(ax, figsize=(5.6, 4.2))
    edges, places = [], []
    for name in (x, y):
        a = np.asarray(column(data, name), float)
        if name in log:
            check.positive(name, a)
            a = np.log(a)
        low, high = a.min(), a.max()
        edge = np.linspace(low, high if high > low else low + 1, bins + 1)
        places.append(np.clip(np.searchsorted(edge, a, side="right") - 1, 0, bins - 1))
        edges.append(np.exp(edge) if name in log else edge)
    z = np.asarray(column(data, value), float)
    known = np.isfinite(z)
    where = places[1][known] * bins + places[0][known]
    total = np.bincount(where, z[known], bins * bins)
    count = np.bincount(where, minlength=bins * bins)
    mean = np.ma.masked_invalid(np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(bins, bins))
    share = bool(np.all((z[known] >= 0) & (z[known] <= 1)))
    limits = dict(vmin=0, vmax=1) if share else {}
    mesh = ax.pcolormesh(*edges, mean, cmap=MAP, rasterized=True, **limits)
    bar = ax.figure.colorbar(mesh, ax=ax, label=label_of(data, value, labels))
    if chance is not None:
        bar.ax.axhline(float(chance), color=COLOURS[1], linewidth=2)
        bar.ax.annotate("chance", (0, float(chance)), xycoords=("axes fraction", "data"), xytext=(-3, 0),
                        textcoords="offset points", ha="right", va="center", fontsize="small")  # fmt: skip
    ax.set(xlabel=label_of(data, x, labels), ylabel=label_of(data, y, labels))
    ax.set(xscale="log" if x in log else "linear", yscale="log" if y in log else "linear")
    return ax


@_figure
def sweep_summary(
    data, names: Sequence[str] | None = None, *, labels: Mapping[str, str] | None = None, axes: Any = None
) -> np.ndarray:
    """The distribution of each score of a sweep: share of runs up to a value, its median, and how many have none.

    data: columns of shape (n,); names: which of them, all of shape (n,) by default. A score that is not finite
    ("never", "no tick") counts among the runs, so that its curve ends below 1. Returns the axes.
    """
    every = data._fields if hasattr(data, "_fields") else list(data)
    names = [n for n in every if np.ndim(column(data, n)) == 1] if names is None else list(names)
    rows = -(-len(names) // 3)
    columns = -(-len(names) // rows)
    axes = _new(axes, nrows=rows, ncols=columns, squeeze=False, sharey=True, figsize=(3.4 * columns, 2.9 * rows))
    axes = np.ravel(axes)
    for ax in axes[len(names) :]:
        ax.set_axis_off()
    for i, (ax, name) in enumerate(zip(axes, names)):
        values = np.asarray(column(data, name), float)
        here = np.sort(values[np.isfinite(values)])
        n = len(values)
        ax.step(here, np.arange(1, len(here) + 1) / n, where="post", color=COLOURS[0])
        title = f"none in {n - len(here)} of {n}" if len(here) < n else f"{n} runs"
        if 2 * len(here) > n:
            median = float(np.sort(np.where(np.isfinite(values), values, np.inf))[(n - 1) // 2])
            ax.axvline(median, color=COLOURS[1], linestyle="--")
            title += f", median {median:.4g}"
        ax.set_title(title, fontsize="small")
        ax.set(
            xlabel=label_of(data, name, labels), ylim=(0, 1.02), ylabel="share of runs [1]" if i % columns == 0 else ""
        )
        ax.xaxis.set_major_locator(MaxNLocator(5))
        ax.grid(alpha=0.3)
    return axes[: len(names)]


# detectors and designs


@_figure
def roc(curves: Mapping[str, detection.Roc], *, samples: int = 1, least: float = 1e-6, ax: Any = None) -> Axes:
    """Detection over false alarms for each `detection.Roc`, beside what luck gives.

    samples: how many independent samples one detection may use; the chance curve is `detection.chance` of that
    many. least: where the logarithmic axis begins.
    """
    samples = check.whole("samples", samples)
    ax = _new(ax, figsize=(6.6, 4.0))
    for i, (name, curve) in enumerate(curves.items()):
        ax.semilogx(
            np.maximum(curve.false_alarm, least), curve.detection, LINES[i % 4], color=COLOURS[i % 4], label=name
        )
    luck = np.geomspace(least, 1, 200)
    words = "chance" if samples == 1 else f"chance, {samples} independent samples"
    ax.plot(luck, detection.chance(luck, samples), color=GREY, linestyle=":", label=words)
    ax.set(xlabel="false alarms per sample [1]", ylabel="share of faults detected [1]", xlim=(least, 1), ylim=(0, 1.02))
    _legend(ax)
    ax.grid(alpha=0.3)
    return ax


@door
def front(costs) -> np.ndarray:
    """Which of the designs no other one beats: (n,) bool from costs (n, m), all of them to be small."""
    a = np.asarray(costs, float)
    beaten = [np.any(np.all(a <= row, axis=1) & np.any(a < row, axis=1)) for row in a]
    return ~np.array(beaten, bool) & np.isfinite(a).all(axis=1)


@_figure
def pareto(
    data,
    x: str,
    y: str,
    *,
    marked: Mapping[str, int] | None = None,
    labels: Mapping[str, str] | None = None,
    ax: Any = None,
) -> Axes:
    """Designs by two costs, x and y, both to be small, with the front of those that no other one beats.

    data: columns of shape (n,); x and y name two of them. marked: names of designs, by their number, such as ``{"paper": 0}``.
    """
    ax = _new(ax, figsize=(6.6, 4.0))
    costs = np.stack([np.asarray(column(data, name), float) for name in (x, y)], axis=1)
    best = front(costs)
    edge = costs[best][np.argsort(costs[best][:, 0])]
    ax.scatter(*costs[~best].T, s=14, color=GREY, linewidths=0, label="designs")
    ax.step(*edge.T, where="post", color=COLOURS[0], linewidth=1)
    ax.scatter(*edge.T, s=22, color=COLOURS[0], label="Pareto front")
    for i, (name, number) in enumerate((marked or {}).items()):
        ax.scatter(*costs[number], s=70, marker=MARKS[1 + i % 3], facecolors="none", edgecolors=COLOURS[1 + i % 3],
                   linewidths=2, label=name)  # fmt: skip
    ax.set(xlabel=label_of(data, x, labels), ylabel=label_of(data, y, labels))
    _legend(ax)
    ax.grid(alpha=0.3)
    return ax


@_figure
def subsets(
    out, values: Mapping[str, Any], *, names: str = "ABCD", what: str = "dead gyros", axes: Any = None
) -> np.ndarray:
    """A table of subsets, such as the sixteen of four gyros: what each gives, above the units that are out.

    out: (subsets, units) bool; names: a letter for each unit; what: the label of the table. values: by axis label with unit, (subsets,) or several of them by name; inf is
    written as "never". Returns the axes, that of the table last.
    """
    out = np.asarray(out, bool)
    place = np.arange(len(out))
    ratios = [3] * len(values) + [out.shape[1] / 3]
    axes = _new(axes, nrows=len(values) + 1, sharex=True, figsize=(8, 1.2 + 2.1 * len(values)), height_ratios=ratios)
    axes = np.ravel(axes)
    for ax, (label, series) in zip(axes, values.items()):
        several = series if isinstance(series, Mapping) else {"": series}
        width = 0.8 / len(several)
        for i, (name, heights) in enumerate(several.items()):
            heights = np.asarray(heights, float)
            at = place + (i - (len(several) - 1) / 2) * width
            finite = np.isfinite(heights)
            ax.bar(
                at[finite], heights[finite], width, color=COLOURS[i % 4], hatch=("", "///")[i % 2], label=name or None
            )
            for never in at[~finite]:
                ax.annotate("never", (never, 0.05), xycoords=("data", "axes fraction"), rotation=90, ha="center",
                            va="bottom", fontsize="small")  # fmt: skip
        ax.axhline(0, color=GREY, linewidth=0.8)
        ax.set_ylabel(_with_unit(label))
        ax.grid(alpha=0.3, axis="y")
        _legend(ax)
    table = axes[-1]
    for unit in range(out.shape[1]):
        row = np.full(len(out), unit)
        table.scatter(place[~out[:, unit]], row[~out[:, unit]], s=45, color=GREY, alpha=0.35, linewidths=0)
        table.scatter(place[out[:, unit]], row[out[:, unit]], s=45, marker="X", color=COLOURS[1], linewidths=0)
    table.set_yticks(range(out.shape[1]), list(names))
    table.set_xticks(
        place, ["".join(n for n, gone in zip(names, row) if gone) or "none" for row in out], fontsize="small"
    )
    table.set(xlabel=what, ylim=(out.shape[1] - 0.4, -0.6))
    table.spines[:].set_visible(False)
    return axes


# momentum


@_figure
def singular_surface(gimbals: GimbalAxes, reversed: int = 0, ax: Any = None, *, fine: int = 80) -> Axes:
    """The singular momenta of a cluster with so many modules reversed, 0 for the envelope, and the rims of its holes.

    gimbals: (n,) without lanes. ax: three-dimensional. fine: patches from pole to pole. Momenta are in units of one
    module's, h_w. Circles and discs: a module's gimbal axis lies along the singular direction.
    """
    ax = plt.figure(figsize=(5.5, 5), layout="constrained").add_subplot(projection="3d") if ax is None else ax
    check.fits_memory(f"`fine` = {fine}", 4000 * check.whole("fine", fine) ** 2, "take fewer")
    polar, around = np.meshgrid(np.linspace(0, np.pi, fine + 1), np.linspace(0, 2 * np.pi, 2 * fine + 1), indexing="ij")
    u = Vec3(np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar))
    n = gimbals.r.x.shape[0]
    patterns = [e for e in sg.sign_patterns(n) if min((e < 0).sum(), n - (e < 0).sum()) == reversed]
    size = 0.0
    for signs in patterns:
        h, _ = sg.singular_momentum(gimbals, Vec3(*(a.ravel() for a in u)), signs)
        p = np.asarray(array(h)).T.reshape(*polar.shape, 3)
        quads = np.stack([p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]], axis=2).reshape(-1, 4, 3)
        whole = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=-1).max(1) < 1.1  # no bridge over a hole
        quads = quads[whole & np.isfinite(quads).all((1, 2))]
        size = max(size, float(np.abs(quads).max(initial=0)))
        colours = plt.get_cmap("viridis")(0.5 + quads[:, :, 2].mean(1) / 7)
        ax.add_collection3d(Poly3DCollection(quads, facecolors=colours, alpha=0.35 if reversed else 0.8, linewidths=0))
    turn = np.linspace(0, 2 * np.pi, 80)
    for rim in sg.rims(gimbals):
        if rim.modules == 1 or reversed:
            e = np.cross(rim.normal, [0.3, 0.5, 0.8])
            e /= np.linalg.norm(e)
            around = np.cos(turn)[:, None] * e + np.sin(turn)[:, None] * np.cross(rim.normal, e)
            circle = rim.centre + rim.modules * around
            for sign in (1, -1):
                if rim.modules > 1:
                    ax.add_collection3d(Poly3DCollection([sign * circle], facecolor=COLOURS[1], alpha=0.12))
                ax.plot(*(sign * circle).T, color=COLOURS[1], linewidth=0.6)
    limits = (-np.ceil(size), np.ceil(size))
    ax.set(xlim=limits, ylim=limits, zlim=limits)
    ax.set(xlabel="$h_x$ [$h_w$]", ylabel="$h_y$ [$h_w$]", zlabel="$h_z$ [$h_w$]")
    ax.set_box_aspect((1, 1, 1), zoom=0.85)  # room for the labels
    panes: Any = (ax.xaxis, ax.yaxis, ax.zaxis)
    for axis in panes:
        axis.set_pane_color((0.5, 0.5, 0.5, 0.1))
    return ax
