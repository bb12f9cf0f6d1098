"""Figures: what they show is what the data says, in light and dark, with units."""

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.text import Text
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from jaxatt import Fault, evaluation, on_axes, plot
from jaxatt import singularity as sg
from jaxatt.loops import cmg_loss, observer_pd
from jaxatt.vec import Vec3

RNG = np.random.default_rng(5)
N = 400
DATA = {
    "size [rad/s]": np.exp(RNG.uniform(-5, 0, N)),
    "onset [s]": RNG.uniform(20, 40, N),
    "seen [1]": RNG.random(N) < 0.7,
    "delay [s]": np.where(RNG.random(N) < 0.3, np.inf, RNG.random(N)),
}
OUT = np.array([[i >> j & 1 for j in range(4)] for i in range(16)], bool)


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def overview():
    t = 0.1 * np.arange(300)
    panels = {
        "residual [1]": np.abs(np.sin(t)),
        "error [MRP]": Vec3(*RNG.normal(size=(3, 300))),
        "u [N m]": np.ones((300, 2)),
    }
    return plot.overview(
        t, panels, faults={"gyro fault": 10.0, "star fault": 11.0}, thresholds={"residual [1]": 0.5}, alarm=t > 12
    )


FIGURES = {
    "overview": overview,
    "heat_map": lambda: plot.heat_map(DATA, "size [rad/s]", "onset [s]", "seen [1]", log=("size [rad/s]",), chance=0.1),
    "sweep_summary": lambda: plot.sweep_summary(DATA, ["delay [s]", "onset [s]"]),
    "roc": lambda: plot.roc({"a": evaluation.roc(RNG.normal(size=99), 1 + RNG.normal(size=99))}, samples=10),
    "pareto": lambda: plot.pareto(DATA, "size [rad/s]", "onset [s]", marked={"paper": 0, "tuned": 1}),
    "subsets": lambda: plot.subsets(OUT, {"settling [s]": {"a": np.arange(16.0), "b": np.full(16, np.inf)}}),
    "singular_surface": lambda: plot.singular_surface(cmg_loss.scenario.axes, 1, fine=12),
}  # fmt: skip


def luminance(colour) -> float:
    c = np.asarray(to_rgb(colour))
    return float(np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) @ (0.2126, 0.7152, 0.0722))


def contrast(a, b) -> float:
    low, high = sorted((luminance(a), luminance(b)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("style", ["default", "dark_background"])
@pytest.mark.parametrize("name", FIGURES)
def test_lines_and_words_are_seen_on_light_and_dark(name, style):
    with plt.style.context(style):
        axes = np.ravel(FIGURES[name]())
        figure = axes[0].figure
        figure.draw_without_rendering()
        behind = figure.get_facecolor()
        drawn = [a for ax in figure.axes for a in (*ax.lines, *ax.texts, ax.title, ax.xaxis.label, ax.yaxis.label)]
        drawn += [t for ax in figure.axes if ax.get_legend() for t in ax.get_legend().get_texts()]
        assert len(drawn) > 3
        for artist in drawn:
            assert isinstance(artist, (Line2D, Text))
            assert contrast(artist.get_color(), behind) >= 3, artist


@pytest.mark.parametrize("name", FIGURES)
def test_every_axis_has_its_unit(name):
    axes = np.ravel(FIGURES[name]())
    table = axes[-1] if name == "subsets" else None
    for ax in axes[0].figure.axes:
        if ax.axison and ax is not table:
            shown = [ax.yaxis] if ax.get_ylabel() or not ax.get_shared_y_axes().get_siblings(ax)[1:] else []
            bottom = ax.get_subplotspec() is None or ax.get_subplotspec().is_last_row()
            shown += [ax.xaxis] if bottom and ax.get_label() != "<colorbar>" and table is None else []
            for axis in shown:
                assert axis.get_label().get_text().endswith("]"), (name, axis)


def test_dicts_tuples_datasets_and_frames_are_read_alike():
    units = {"size": "rad/s", "onset": "s", "seen": "1"}
    plain = {name: DATA[f"{name} [{unit}]"] for name, unit in units.items()}
    dataset = xarray.Dataset({name: ("scenario", a, {"units": units[name]}) for name, a in plain.items()})
    labels = {name: f"{name} [{unit}]" for name, unit in units.items()}
    scores = observer_pd.Scores(*[np.ones(3)] * 15)
    assert plot.column(scores, "miss").shape == (3,)
    drawn = [
        plot.heat_map(DATA, *labels.values()),
        plot.heat_map(dataset, "size", "onset", "seen"),
        plot.heat_map(dataset.to_dataframe(), "size", "onset", "seen", labels=labels),
        plot.heat_map(plain, "size", "onset", "seen", labels=labels),
    ]
    for ax in drawn:
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("size [rad/s]", "onset [s]")
        np.testing.assert_array_equal(ax.collections[0].get_array(), drawn[0].collections[0].get_array())


def test_the_heat_map_is_the_mean_of_each_cell():
    x, y = np.exp(RNG.uniform(0, 3, 50)), RNG.normal(size=50)
    z = np.where(np.arange(50) == 7, np.nan, RNG.normal(size=50))
    ax = plot.heat_map({"x [s]": x, "y [m]": y, "z [1]": z}, "x [s]", "y [m]", "z [1]", bins=9, log=("x [s]",))
    shown = ax.collections[0].get_array()
    assert shown is not None
    edges = np.linspace(np.log(x).min(), np.log(x).max(), 10), np.linspace(y.min(), y.max(), 10)
    good = np.isfinite(z)
    count = np.histogram2d(np.log(x[good]), y[good], edges)[0].T
    total = np.histogram2d(np.log(x[good]), y[good], edges, weights=z[good])[0].T
    np.testing.assert_array_equal(np.ma.getmaskarray(shown), count == 0)
    np.testing.assert_allclose(shown[count > 0], (total / np.where(count == 0, 1, count))[count > 0])
    assert ax.get_xscale() == "log" and (count == 0).any()


def test_the_summary_counts_runs_without_a_value():
    delay = np.array([1.0, 2.0, 3.0, np.inf, np.nan])
    (ax,) = plot.sweep_summary({"delay [s]": delay})
    x, y = ax.lines[0].get_data()
    assert x.tolist() == [1, 2, 3] and y.tolist() == [0.2, 0.4, 0.6]
    assert ax.get_title() == "none in 2 of 5, median 3"


def test_the_front_is_what_no_other_design_beats():
    costs = RNG.integers(0, 6, (60, 2)).astype(float)
    costs[3] = np.nan
    best = plot.front(costs)
    for i, a in enumerate(costs):
        beaten = any((b <= a).all() and (b < a).any() for b in costs)
        assert best[i] == (not beaten and i != 3)


def test_onsets_are_found_in_any_scenario():
    assert plot.fault_times(observer_pd.scenario) == {"gyro fault": 150.0, "star fault": 250.0}
    healthy = on_axes(Fault())
    both = observer_pd.scenario._replace(star=healthy._replace(y=Fault(onset=30.0)), gyro=on_axes(Fault(onset=30.0)))
    assert plot.fault_times(both) == {"star and gyro fault": 30.0}
    assert plot.fault_times(both._replace(star=healthy, gyro=healthy)) == {}


@pytest.mark.parametrize("reversed", [0, 1])
def test_the_surface_reaches_as_far_as_the_cluster(reversed, monkeypatch):
    gimbals, drawn = cmg_loss.scenario.axes, []
    patches = lambda quads, **look: drawn.append(np.reshape(quads, (-1, 3))) or Poly3DCollection(quads, **look)
    monkeypatch.setattr(plot, "Poly3DCollection", patches)
    ax = plot.singular_surface(gimbals, reversed, fine=60)
    points = np.concatenate(drawn)
    least = float(np.asarray(sg.reach(gimbals, Vec3(*(points[::499].T / np.linalg.norm(points[::499], axis=1))))).min())
    far = np.linalg.norm(points, axis=1)
    limit = np.asarray(jax.jit(lambda d: sg.support(gimbals, d))(Vec3(*np.eye(3))))
    assert (np.abs(points).max(0) <= limit + 1e-9).all() and far.max() > 0.5 * least
    assert ax.get_xlim()[1] >= np.abs(points[:, 0]).max()
    if not reversed:
        np.testing.assert_allclose(np.abs(points).max(0), limit, rtol=2e-3)


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda: plot.overview([0.0, 1.0], {"residual": [0.0, 1.0]}), r"`label` must end in a unit.*'residual'"),
        (lambda: plot.heat_map(DATA, "nothing", "onset [s]", "seen [1]"), r"`name` must be one of size.*'nothing'"),
        (lambda: plot.heat_map(DATA, "size [rad/s]", "onset [s]", "seen [1]", bins=0), "`bins` must be a whole number"),
        (lambda: plot.heat_map({"a [s]": np.zeros(3)}, *["a [s]"] * 3, log=("a [s]",)), r"`data\['a \[s\]'\]\[0\]` must be a positive"),
        (lambda: plot.sweep_summary({"delay": np.ones(3)}), "`label` must end in a unit"),
        (lambda: plot.roc({}, samples=0), "`samples` must be a whole number"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_in_one_line(draw, message):
    before = plt.get_fignums()
    with pytest.raises(ValueError, match=message) as refusal:
        draw()
    assert "\n" not in str(refusal.value)
    assert plt.get_fignums() == before, "an empty figure is left open"
