"""Pictures of the spacecraft: the box stands as the attitude says, whatever holds the log; movies are files."""

from typing import Annotated, Any, NamedTuple

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.animation import FFMpegWriter
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from PIL import Image

from jaxatt import tables, view
from jaxatt.attitude import mrp_from_quat, quat_normalised, quat_rotate
from jaxatt.contract import Now
from jaxatt.loops import observer_pd
from jaxatt.observers import AttitudeRate
from jaxatt.vec import Quat, Vec3

T = 6
RNG = np.random.default_rng(2)
Q, P = (Quat(*map(np.asarray, quat_normalised(Quat(*RNG.normal(size=(4, T)))))) for _ in range(2))
TIMES = 0.5 * np.arange(T)


class Turned(NamedTuple):
    t: Annotated[Any, "s"]
    angle: Annotated[Vec3, "rad"]


LOG = {"t": TIMES, "q": Q, "estimate": P, "alarm": TIMES > 1}


class Faces(Poly3DCollection):
    """Faces that know their corners, which matplotlib hides, each release elsewhere."""

    def __init__(self, verts, *args, **kwargs):
        super().__init__(verts, *args, **kwargs)
        self.corners = np.reshape(verts, (-1, 3))


class Edges(Line3DCollection):
    """Edges, likewise."""

    def __init__(self, lines, *args, **kwargs):
        super().__init__(lines, *args, **kwargs)
        self.corners = np.reshape(lines, (-1, 3))


@pytest.fixture(autouse=True)
def closed(monkeypatch):
    monkeypatch.setattr(view, "Poly3DCollection", Faces)
    monkeypatch.setattr(view, "Line3DCollection", Edges)
    yield
    plt.close("all")


def corners(ax, kind):
    """The corners (n, 3) of the box that is drawn last, in reference axes."""
    *_, drawn = [a for a in ax.collections if isinstance(a, kind)]
    return np.unique(drawn.corners.round(9), axis=0)


def turned(q, i, size=(1, 1, 1)):
    box = 1.1 * np.array(size) / max(size) * view.SIDES
    at = np.stack(quat_rotate(Quat(*(a[i] for a in q)), Vec3(*box.T)), axis=1)
    return np.unique(at.round(9), axis=0)


def words(ax):
    return [t.get_text() for t in ax.texts]


def test_the_boxes_stand_as_true_and_estimated_attitude_say():
    ax = view.picture(LOG, 1.4, size=(1, 2, 3), directions={"Sun": Vec3(0.0, 2.0, 0.0)})
    np.testing.assert_allclose(corners(ax, Faces), turned(Q, 3, (1, 2, 3)), atol=1e-6)
    np.testing.assert_allclose(corners(ax, Edges), turned(P, 3, (1, 2, 3)), atol=1e-6)
    assert {"ALARM", "1.5 s", "Sun", "x", "Y"} <= set(words(ax))
    again = view.picture(LOG, 0.0, ax=ax)
    assert again is ax and "0.0 s" in words(ax)


def test_mrp_names_and_components_draw_the_same():
    mrp = mrp_from_quat(Q)
    wanted = turned(Q, T - 1)
    observed = {"t": TIMES, "q": mrp, "estimate": AttitudeRate(mrp, mrp)}
    ax = None
    for log, attitude in (
        ({"t": TIMES, "q": mrp}, "q"),
        ({"t": TIMES, "star": {"q": Q}}, "star"),
        ({"t": TIMES}, mrp),
        (observed, "q"),
    ):
        ax = view.picture(log, attitude=attitude)
        np.testing.assert_allclose(corners(ax, Faces), wanted, atol=1e-6)
        assert "ALARM" not in words(ax)
    np.testing.assert_allclose(corners(ax, Edges), wanted, atol=1e-6)


def test_a_table_draws_what_its_log_draws():
    shapes = jax.eval_shape(lambda: observer_pd.tick(observer_pd.params, observer_pd.scenario, *now(), np.zeros(6))[2])
    log = jax.tree.map(lambda a: 0.2 * RNG.random((T, *a.shape)), shapes)._replace(t=TIMES)
    data = tables.dataset(log)
    wanted = corners(view.picture(log, 1.0), Faces)
    for table in (data, tables.frame(data)):
        np.testing.assert_array_equal(corners(view.picture(table, 1.0), Faces), wanted)


def now():
    return Now(0, 0.0, 0.1), *observer_pd.init(observer_pd.params, observer_pd.scenario)


def test_an_attitude_that_is_no_number_is_not_drawn():
    ax = view.picture(LOG | {"q": Q._replace(w=np.full(T, np.nan))})
    assert "no attitude" in words(ax) and not any(isinstance(a, Faces) for a in ax.collections)


def test_a_movie_has_its_frames_and_its_size(tmp_path):
    path = view.movie(LOG, tmp_path / "a.gif", frames=3, pixels=60, rate=5)
    with Image.open(path) as movie:
        assert movie.n_frames == 3 and movie.size == (60, 60) and movie.info["duration"] == 200  # pyright: ignore[reportAttributeAccessIssue]
    assert not plt.get_fignums()


@pytest.mark.skipif(FFMpegWriter.isAvailable(), reason="ffmpeg is here")
def test_without_ffmpeg_mp4_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"`path` must end in .gif where no ffmpeg is installed.*'a.mp4'"):
        view.movie(LOG, tmp_path / "a.mp4")


@pytest.mark.skipif(not FFMpegWriter.isAvailable(), reason="no ffmpeg here")
def test_mp4_is_written(tmp_path):
    assert view.movie(LOG, tmp_path / "a.mp4", frames=2, pixels=60).stat().st_size > 100


@pytest.mark.parametrize(
    ("log", "how", "message"),
    [
        ({"q": Q}, {}, "`log` must have the times t"),
        (LOG, dict(attitude="x"), r"`attitude` must name a quaternion or an MRP of the log.*'x'"),
        (LOG, dict(size=(1, 0, 1)), r"`size\[1\]` must be a positive number"),
        (LOG, dict(directions={"Sun": Vec3(0.0, 0.0, 0.0)}), r"must be a positive number"),
        (LOG, dict(alarm="nothing"), "`alarm` must be one of"),
        (LOG | {"q": Q._replace(w=np.ones(2))}, dict(), "`attitude` must name a quaternion"),
    ],
)
def test_bad_input_is_refused_in_one_line(log, how, message):
    with pytest.raises(ValueError, match=message) as refusal:
        view.picture(log, **how)
    assert "\n" not in str(refusal.value) and not plt.get_fignums()


def test_an_angle_is_no_attitude():
    log = Turned(TIMES, Vec3(TIMES, TIMES, TIMES))
    with pytest.raises(ValueError, match=r"`attitude` must be a quaternion or an MRP, of unit 1.*angle.x in rad"):
        view.picture(log, attitude="angle")
