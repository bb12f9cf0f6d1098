"""Figures that a paper takes: each function draws on the axes it is given, or on new ones, and returns the axes.

Data is what the other modules give: logs and scores (NamedTuples), dicts of arrays, an ``xarray.Dataset`` or a
``pandas.DataFrame`` whose columns lead to arrays of shape (n,). Every axis carries a unit: names end in one,
"delay [s]", "[1]" for a pure number; the units that fields state do as well, a dataset's ``units``, and ``labels``.
Colours are Okabe and Ito's, with a contrast of 3 or more on white and on black; text follows matplotlib's style.
In the package `jaxatt.view` alone imports this module.

May import: check, fields, vec, faults, cmg, evaluation, singularity.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any, TypeVar

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from jaxatt import check, evaluation, fields
from jaxatt import singularity as sg
from jaxatt.cmg import GimbalAxes
from jaxatt.faults import Fault
from jaxatt.vec import Vec3, array

F = TypeVar("F", bound=Callable)
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")  # blue, vermilion, green, purple
LINES = ("-", "--", "-.", ":")  # one style for each colour: no line is told by its colour alone
MARKS = ("o", "s", "^", "D")
GREY = "0.5"  # for what is no data: seen on white and on black
MAP = "cividis"  # reads the same with and without colour vision

# names, units and columns


def column(data, name: str) -> np.ndarray:
    """One quantity of a dict, a NamedTuple, a dataset or a data frame, as an array.

    Raises ValueError where there is none of that name.
    """
    there = _names(data)
    if not isinstance(name, str) or name not in there:
        check.refuse("name", "be one of " + ", ".join(map(str, there)), check.short(name))
    values = getattr(data, name) if hasattr(data, "_fields") else data[name]
    return np.asarray(values) if not check.is_key(values) else check.real(f"data[{name!r}]", values)


def _names(data) -> list:
    if not hasattr(data, "_fields") and not hasattr(data, "keys"):
        raise TypeError(f"`data` must be columns by name, such as a dict, but it is {check.short(data)}.")
    return list(data._fields) if hasattr(data, "_fields") else list(data)


def _numbers(data, name: str, n: int | None = None) -> np.ndarray:
    """A column of shape (n,) as floats."""
    return _series(f"data[{name!r}]", column(data, name), n)


def _series(name: str, values, n: int | None = None) -> np.ndarray:
    """Values as floats, if they are real numbers of shape (n,)."""
    a = np.asarray(check.real(name, values), float)
    if a.ndim != 1 or not len(a) or n not in (None, len(a)):
        check.refuse(name, f"have shape ({n or 'n'},)", f"of shape {a.shape}")
    return a


def _mapping(name: str, value) -> Mapping:
    """A mapping, empty for None."""
    if value is not None:
        check.mapping(name, value)
    return value or {}


def label_of(data, name: str, labels: Mapping[str, str] | None = None) -> str:
    """The axis label of a quantity: of ``labels``, or its name with the unit that the data knows.

    Fields of a NamedTuple know it by their annotation (`jaxatt.fields`), variables of a dataset by their attribute
    ``units``. Raises ValueError where no unit is known.
    """
    if name not in (there := _names(data)):
        check.refuse("name", "be one of " + ", ".join(map(str, there)), repr(name))
    text = _mapping("labels", labels).get(name, name)
    if "[" not in str(text):
        if hasattr(data, "_fields"):
            unit = fields.units(data).get(name)
        else:
            unit = getattr(data[name], "attrs", {}).get("units")
        text = f"{text} [{unit}]" if unit else text
    return _with_unit(text)


def _with_unit(label: str) -> str:
    if not isinstance(label, str) or not (label.endswith("]") and "[" in label):
        check.refuse("label", "end in a unit, such as 'delay [s]' or '[1]' for a pure number", repr(label))
    return label


def _legend(ax) -> None:
    """A legend beside the axes, where it hides no data."""
    if ax.get_legend_handles_labels()[1]:
        ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1), borderaxespad=0, fontsize="small")


def _new(ax, **how) -> Any:
    """The axes given, or new ones; TypeError or ValueError for what is no axes, or too few."""
    name, n = ("axes", how["nrows"] * how.get("ncols", 1)) if "nrows" in how else ("ax", 1)
    if ax is None:
        return plt.subplots(layout="constrained", **how)[1]
    given = np.ravel(np.asarray(ax, object))
    if not all(isinstance(a, Axes) for a in given):
        raise TypeError(f"`{name}` must be axes of matplotlib, but it is {check.short(ax)}.")
    if len(given) < n:
        check.refuse(name, f"be {n} axes", f"{len(given)}")
    return ax


def _figure(f: F) -> F:
    """f, but a refusal closes the figure that it had begun, which a notebook would show empty."""

    @wraps(f)
    def draw(*args, **kwargs):
        before = set(plt.get_fignums())
        try:
            return f(*args, **kwargs)
        except Exception:
            for number in set(plt.get_fignums()) - before:
                plt.close(number)
            raise

    return draw  # pyright: ignore[reportReturnType]


# one run


def fault_times(scenario) -> dict[str, float]:
    """The onsets [s] of the faults in a scenario, by the sensors or actuators at fault; of one scenario.

    Faults that begin together are one entry: ``{"gyro fault": 150.0, "star fault": 250.0}``.
    """
    found: dict[float, list[str]] = {}
    leaves = jax.tree_util.tree_flatten_with_path(scenario, is_leaf=lambda node: isinstance(node, Fault))[0]
    for path, fault in leaves:
        if isinstance(fault, Fault):
            name = jax.tree_util.keystr(path[:1]).lstrip(".").replace("_", " ") or "a"
            for onset in np.unique(check.real(f"scenario.{name}", fault.onset).astype(float)):
                if np.isfinite(onset) and name not in found.setdefault(float(onset), []):
                    found[float(onset)].append(name)
    return {" and ".join(names) + " fault": onset for onset, names in sorted(found.items())}


@_figure
def overview(
    t,
    panels: Mapping[str, Any] | Sequence[str] | None = None,
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

    Or t is a table of one run, a dataset or data frame of `jaxatt.tables`: every quantity that it holds is a panel, or those
    that panels names, ``["w", "filter.nis"]``; the labels are names with their units, "w [rad/s]".
    """
    if hasattr(t, "data_vars") or (hasattr(t, "columns") and hasattr(t, "index")):
        t, panels = _run_of(t, panels)
    t, faults, thresholds = _series("t", t), _mapping("faults", faults), _mapping("thresholds", thresholds)
    panels = _mapping("panels", panels)
    if not panels:
        check.refuse("panels", "hold at least one quantity", "empty")
    for name, values in (("t", t), ("faults", [*faults.values()]), ("thresholds", [*thresholds.values()])):
        check.finite(name, values)
    onsets = {name: check.number(f"faults[{name!r}]", onset) for name, onset in faults.items()}
    levels = {label: check.number(f"thresholds[{label!r}]", level) for label, level in thresholds.items()}
    on = None if alarm is None else _series("alarm", alarm, len(t)) > 0
    axes = _new(axes, nrows=len(panels), sharex=True, squeeze=False, figsize=(8, 1 + 1.9 * len(panels)))
    axes = np.ravel(axes)
    for ax, (label, values) in zip(axes, panels.items()):
        lines: Mapping[str, Any] = {"": values}
        if isinstance(values, Mapping):
            lines = values
        elif isinstance(values, tuple):
            lines = dict(zip(getattr(values, "_fields", map(str, range(1, 1 + len(values)))), values))
        elif np.ndim(check.real(f"panels[{label!r}]", values)) == 2:
            lines = {str(i + 1): column for i, column in enumerate(np.asarray(values).T)}
        for i, (name, line) in enumerate(lines.items()):
            line = _series(f"panels[{label!r}]", line, len(t))
            ax.plot(t, line, LINES[i % 4], color=COLOURS[i % 4], linewidth=1.1, label=name or None)
        if label in levels:
            ax.axhline(levels[label], color=plt.rcParams["text.color"], linestyle="--", label="threshold")
        if on is not None:
            ax.fill_between(t, 0, 1, where=on, transform=ax.get_xaxis_transform(), color=GREY, alpha=0.25,
                            linewidth=0, step="post", label="alarm" if ax is axes[0] else None)  # fmt: skip
        for onset in onsets.values():
            ax.axvline(onset, color=GREY, linestyle=":", linewidth=1.5)
        ax.set(ylabel=_with_unit(label), xlim=(t[0], t[-1]))
        ax.grid(alpha=0.3)
        _legend(ax)
    for row, (name, onset) in enumerate(onsets.items()):
        near = row % 2 and onset - list(onsets.values())[row - 1] < 0.2 * (t[-1] - t[0])
        axes[0].annotate(
            name, (onset, 1), xycoords=("data", "axes fraction"), xytext=(0, 14 if near else 3),
            textcoords="offset points", ha="center", va="bottom", fontsize="small", annotation_clip=True,
        )  # fmt: skip
    axes[-1].set_xlabel("time [s]")
    return axes


def _run_of(data, names) -> tuple[Any, dict[str, dict]]:
    """Times and panels of a table of one run: the components of one quantity, ``w.x`` or ``h.0``, share a panel."""
    if hasattr(data, "data_vars"):
        units = {str(name): a.attrs.get("units") for name, a in data.data_vars.items()}
        axes, t = tuple(data.dims), data.get("time")
    else:
        stated, axes, t = data.attrs.get("units") or {}, tuple(data.index.names), data.index
        units = {str(name): stated.get(name) for name in data.columns}
    if axes != ("time",):
        check.refuse("t", "be a table of one run over time (of a batch take data.isel(scenario=0))", f"over {axes}")
    found: dict[str, dict] = {}
    for name, unit in units.items():
        stem, _, part = name.rpartition(".")
        stem, part = (stem, part) if stem and (part in "xyzw" or part.isdigit()) else (name, "")
        found.setdefault(stem, {}).setdefault(unit, {})[part] = np.asarray(data[name])
    if names is not None:
        names = list(names) if np.iterable(names) and not isinstance(names, (str, Mapping)) else [names]
        for name in names:
            if name not in list(found):
                check.refuse("panels", f"name quantities of the table ({', '.join(found)})", check.short(name))
        found = {str(name): found[str(name)] for name in names}
    panels = {}
    for stem, parts in found.items():
        for unit, lines in parts.items():
            if not unit:
                check.refuse(
                    stem, "have a unit (see `units` of `jaxatt.tables.dataset`, or name other panels)", "without"
                )
            panels[f"{stem} [{unit}]"] = lines
    return np.asarray(t), panels


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
    if chance is not None:
        chance = check.number("chance", chance)
    log = tuple(log) if np.iterable(log) else check.refuse("log", "be names of axes", check.short(log))
    check.fits_memory(f"`bins` = {bins}", 100 * bins**2, "take fewer")
    ax = _new(ax, figsize=(5.6, 4.2))
    edges, places = [], []
    z = _numbers(data, value)
    for name in (x, y):
        a = _numbers(data, name, len(z))
        if name in log:
            check.positive(f"data[{name!r}]", a)
        check.finite(f"data[{name!r}]", a)
        if name in log:
            a = np.log(a)
        low, high = a.min(), a.max()
        edge = np.linspace(low, high if high > low else low + 1, bins + 1)
        places.append(np.clip(np.searchsorted(edge, a, side="right") - 1, 0, bins - 1))
        edges.append(np.exp(edge) if name in log else edge)
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
        bar.ax.axhline(chance, color=COLOURS[1], linewidth=2)
        bar.ax.annotate("chance", (0, chance), xycoords=("axes fraction", "data"), xytext=(-3, 0),
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
    if names is None:
        names = [n for n in _names(data) if np.ndim(column(data, n)) == 1]
    names = list(names) if np.iterable(names) else []
    if not names:
        check.refuse("names", "be at least one column of shape (n,)", "none")
    rows = -(-len(names) // 3)
    columns = -(-len(names) // rows)
    axes = _new(axes, nrows=rows, ncols=columns, squeeze=False, sharey=True, figsize=(3.4 * columns, 2.9 * rows))
    axes = np.ravel(axes)
    for ax in axes[len(names) :]:
        ax.set_axis_off()
    for i, (ax, name) in enumerate(zip(axes, names)):
        values = _numbers(data, name)
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
def roc(curves: Mapping[str, evaluation.Roc], *, samples: int = 1, least: float = 1e-6, ax: Any = None) -> Axes:
    """Detection over false alarms for each `evaluation.Roc`, beside what luck gives.

    samples: how many independent samples one detection may use; the chance curve is `evaluation.chance` of that
    many. least: where the logarithmic axis begins.
    """
    samples = check.whole("samples", samples)
    check.between("least", check.number("least", least), 0, 1, "a share of samples")
    check.mapping("curves", curves)
    ax = _new(ax, figsize=(6.6, 4.0))
    for i, (name, curve) in enumerate(curves.items()):
        said = f"curves[{name!r}]"
        check.kind(said, curve, evaluation.Roc)
        _series(said, curve.detection, len(_series(said, curve.false_alarm)))
        ax.semilogx(
            np.maximum(curve.false_alarm, least), curve.detection, LINES[i % 4], color=COLOURS[i % 4], label=name
        )
    luck = np.geomspace(least, 1, 200)
    words = "chance" if samples == 1 else f"chance, {samples} independent samples"
    ax.plot(luck, evaluation.chance(luck, samples), color=GREY, linestyle=":", label=words)
    ax.set(xlabel="false alarms per sample [1]", ylabel="share of faults detected [1]", xlim=(least, 1), ylim=(0, 1.02))
    _legend(ax)
    ax.grid(alpha=0.3)
    return ax


def front(costs) -> np.ndarray:
    """Which of the designs no other one beats: (n,) bool from costs (n, m), all of them to be small."""
    a = np.asarray(check.real("costs", costs), float)
    if a.ndim != 2 or not a.size:
        check.refuse("costs", "have shape (n, m)", f"of shape {a.shape}")
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
    first = _numbers(data, x)
    costs = np.stack([first, _numbers(data, y, len(first))], axis=1)
    for name, number in _mapping("marked", marked).items():
        if check.whole(f"marked[{name!r}]", number, 0) >= len(costs):
            check.refuse(f"marked[{name!r}]", f"be less than the {len(costs)} designs", number)
    ax = _new(ax, figsize=(6.6, 4.0))
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
    out = check.real("out", out) > 0
    if out.ndim != 2 or not out.size:
        check.refuse("out", "have shape (subsets, units)", f"of shape {out.shape}")
    check.mapping("values", values)
    if not isinstance(names, str) or len(names) < out.shape[1]:
        check.refuse("names", f"be a letter for each of the {out.shape[1]} units", check.short(names))
    if not isinstance(what, str):
        raise TypeError(f"`what` must be a text, but it is {check.short(what)}.")
    place = np.arange(len(out))
    ratios = [3] * len(values) + [out.shape[1] / 3]
    axes = _new(axes, nrows=len(values) + 1, sharex=True, figsize=(8, 1.2 + 2.1 * len(values)), height_ratios=ratios)
    axes = np.ravel(axes)
    for ax, (label, series) in zip(axes, values.items()):
        several = series if isinstance(series, Mapping) else {"": series}
        if not several:
            check.refuse(f"values[{label!r}]", "hold one series at least", "empty")
        width = 0.8 / len(several)
        for i, (name, heights) in enumerate(several.items()):
            heights = _series(f"values[{label!r}]", heights, len(out))
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
    table.set_yticks(range(out.shape[1]), list(names[: out.shape[1]]))
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

    gimbals: axes of n modules. ax: three-dimensional. fine: patches from pole to pole. Momenta are in units of one
    module's, h_w. Circles and discs: a module's gimbal axis lies along the singular direction.
    """
    check.kind("gimbals", gimbals, GimbalAxes)
    fields.validate("gimbals", gimbals)
    n, reversed = gimbals.r.x.shape[0], check.whole("reversed", reversed, 0)
    check.fits_memory(f"`fine` = {fine}", 4000 * check.whole("fine", fine) ** 2, "take fewer")
    ax = _new(ax, figsize=(5.5, 5), subplot_kw={"projection": "3d"})
    if ax.name != "3d":
        check.refuse("ax", "be three-dimensional", check.short(ax))
    polar, around = np.meshgrid(np.linspace(0, np.pi, fine + 1), np.linspace(0, 2 * np.pi, 2 * fine + 1), indexing="ij")
    u = Vec3(np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar))
    patterns = [e for e in sg.sign_patterns(n) if min((e < 0).sum(), n - (e < 0).sum()) == reversed]
    size = 0.0
    for signs in patterns:
        h, _ = sg.singular_momentum(gimbals, Vec3(*(a.ravel() for a in u)), signs)
        p = np.asarray(array(h)).T.reshape(*polar.shape, 3)
        quads = np.stack([p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]], axis=2).reshape(-1, 4, 3)
        whole = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=-1).max(1) < 1.1  # no bridge over a hole
        quads = quads[whole & np.isfinite(quads).all((1, 2))]
        size = max(size, float(np.abs(quads).max(initial=0)))
        colours = plt.get_cmap(MAP)(0.5 + quads[:, :, 2].mean(1) / 7)
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
