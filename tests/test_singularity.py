"""Singular sets of CMG clusters: laws, plain oracles, the numbers of the paper and the reference."""

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
import pytest  # noqa: E402
from clusters import FOUR, SKEWS, THREE, matrices, over, torque  # noqa: E402

from jaxatt import singularity as sg  # noqa: E402
from jaxatt.cmg import GimbalAxes, cmg_axes, cmg_triads, modules  # noqa: E402
from jaxatt.torque_matrix import condition  # noqa: E402
from jaxatt.vec import Vec3  # noqa: E402

COUNTS = {72: (9168, 22720), 120: (40976, 77312), 180: (137152, 229744), 360: (1104912, 2161632)}
COUNTS[720] = (8808256, 16346560)


@pytest.mark.parametrize("points", [*list(COUNTS)[:-1], pytest.param(720, marks=pytest.mark.slow)])
def test_table_3(points):
    got = [sg.ill_conditioned(THREE[name], points) for name in SKEWS]
    assert got == [(count, points**3) for count in COUNTS[points]]


@pytest.mark.slow
def test_table_3_in_single_precision():
    printed = {72: (0.0246, 0.0609), 360: (0.0237, 0.0463), 720: (0.0236, 0.0438)}
    for points, fractions in printed.items():
        for name, fraction in zip(SKEWS, fractions):
            count, of = sg.ill_conditioned(jax.tree.map(np.float32, THREE[name]), points)
            assert round(count / of, 4) == fraction


@pytest.mark.parametrize(
    "axes, points, threshold",
    [(THREE["pyramid"], 72, 100.0), (THREE["box"], 72, 10.0), (THREE["box"], 45, 30.0), (FOUR["box"], 18, 5.0)],
)
def test_grid_counts_against_svd(axes, points, threshold):
    n = len(axes.r.x)
    grid = np.stack(np.meshgrid(*[2 * np.pi * np.arange(points) / points] * n, indexing="ij")).reshape(n, -1)
    kept = (grid < np.pi - 1e-9).all(0) if points % 2 == 0 else slice(None)
    theirs = np.linalg.svd(matrices(torque(axes, grid[:, kept])), compute_uv=False)
    count = int((theirs[:, 0] >= threshold * theirs[:, 2]).sum()) * (2**n if points % 2 == 0 else 1)
    assert sg.ill_conditioned(axes, points, threshold) == (count, points**n)


def test_several_thresholds_are_counted_at_once():
    several, of = sg.ill_conditioned(THREE["box"], 45, [10.0, 30.0])
    assert several.tolist() == [sg.ill_conditioned(THREE["box"], 45, k)[0] for k in (10.0, 30.0)] and of == 45**3


@pytest.mark.parametrize("axes", [*THREE.values(), *FOUR.values()])
def test_singular_momenta_are_singular(axes):
    u = sg.sphere(100)
    for signs in sg.sign_patterns(len(axes.r.x)):
        h, gamma = sg.singular_momentum(axes, u, signs)
        at = cmg_triads(over(axes), gamma)
        np.testing.assert_allclose(np.stack(h), np.stack([np.asarray(c).sum(0) for c in at.s]), atol=1e-12)
        np.testing.assert_allclose(at.t @ u, 0, atol=1e-12)
        assert (np.asarray(condition(at.t)) > 1e6).all()


def test_holes_of_the_box_are_discs():
    rims = sg.rims(THREE["box"])
    discs = [rim for rim in rims if rim.modules == 2]
    assert sorted(rim.centre[0] for rim in discs) == pytest.approx([-1, 1])
    assert all(rim.modules == 1 for rim in sg.rims(THREE["pyramid"]))
    # the circle x^2 + z^2 = 1 in the plane y = 0, on which -s_4 lies for every gamma_4
    assert any(np.allclose(rim.centre, 0) and np.allclose(np.abs(rim.normal), [0, 1, 0]) for rim in rims)
    s4 = cmg_triads(modules(FOUR["box"], [3]), np.array([0.3])).s
    assert sg.clearance(THREE["box"], -np.stack(s4)[:, 0]) < 1e-9
    assert np.isnan(sg.singular_momentum(THREE["box"], Vec3(*np.eye(3)[:, :1]), np.ones(3))[0].x).all()


def test_the_rims_of_the_pyramid_are_singular():
    """Close to a gimbal axis its own module spins in any direction across it, the others point along it as far as they can."""
    axes, rng = THREE["pyramid"], np.random.default_rng(3)
    r = np.stack(axes.r, axis=-1)
    for i, u in enumerate(r):
        for signs in ((1, 1), (1, -1), (-1, -1)):
            across = np.cross(u, rng.normal(size=3))
            h = across / np.linalg.norm(across)
            for sign, other in zip(signs, np.delete(r, i, axis=0)):
                s = u - (u @ other) * other
                h = h + sign * s / np.linalg.norm(s)
            assert sg.clearance(axes, h) < 1e-9


@pytest.mark.parametrize(
    ("momentum", "distance"), [((0.9, 0.5, 0), 0.1), ((1.1, -1, 1), 0.1), ((1, 1, 0.5), 0), ((1, 2.3, 0), 0.3)]
)
def test_clearance_from_a_disc(momentum, distance):
    """Over it, in it, and beside it: the discs x = +-1 of three modules of the box reach 2 from the axis."""
    assert sg.clearance(THREE["box"], momentum) == pytest.approx(distance, abs=1e-9)


def test_clearance_of_zero_momentum():
    assert sg.clearance(THREE["box"], np.zeros(3)) == pytest.approx(1, abs=1e-6)
    assert sg.clearance(THREE["pyramid"], np.zeros(3)) == pytest.approx(0.15419, abs=1e-4)
    assert sg.clearance(FOUR["box"], np.zeros(3)) == pytest.approx(0, abs=1e-6)


def test_far_outside_the_nearest_singular_momentum_is_the_envelopes():
    """The flat discs of the rims end where the envelope ends, and circles too."""
    for axes in (FOUR["box"], THREE["box"], THREE["pyramid"]):
        for far in np.eye(3):
            reached = float(sg.support(axes, Vec3(*far[:, None]))[0])
            near = sg.clearance(axes, 100 * far)
            assert 100 - reached - 1e-6 <= near <= np.hypot(100 - reached, 4)


REACH = {
    "pyramid": ((2.15572, 2.30991, 2.37880), (3.1557, 3.1557, 3.2646)),
    "box": ((1, 3**0.5, 3), (2, 2, 4)),
}


@pytest.mark.parametrize("name", SKEWS)
def test_reach_along_the_axes(name):
    d = Vec3(
        *(np.append(a, b) for a, b in zip(np.eye(3), sg.sphere(96)))
    )  # 99 directions, as many as `envelope` refines
    for axes, along, atol in zip((THREE[name], FOUR[name]), REACH[name], (1e-5, 1e-4)):
        reached = np.asarray(sg.reach(axes, d))
        np.testing.assert_allclose(reached[:3], along, atol=atol)
        assert (reached <= np.asarray(sg.support(axes, d)) + 1e-9).all()


@pytest.mark.slow
def test_envelopes_of_the_pyramid():
    pyramid = [sg.envelope(axes["pyramid"], 400) for axes in (FOUR, THREE)]
    assert pyramid[0].inscribed / pyramid[1].inscribed == pytest.approx(1.607, abs=0.01)
    assert pyramid[0].largest == pytest.approx(3.2667, abs=1e-4)
    assert pyramid[1].largest == pytest.approx(2.8284, abs=1e-4)


def test_envelope_of_the_box():
    box = sg.envelope(FOUR["box"], 400)
    assert box.inscribed == pytest.approx(2, abs=1e-6)
    assert box.volume == pytest.approx(24 ** (1 / 3), rel=2e-3)  # two crossed discs added: 32 pi
    assert box.largest == pytest.approx(4, abs=1e-6)


def test_area_of_the_singular_set():
    assert sg.singular_area(THREE["box"], 200) == pytest.approx(2 + 2 * 2**0.5, abs=1e-6)
    assert sg.singular_area(THREE["pyramid"], 500) == pytest.approx(3.89, abs=0.01)


def test_the_area_knows_no_order_of_the_modules():
    r, s0 = np.random.default_rng(0).normal(size=(2, 3, 3))
    r /= np.linalg.norm(r, axis=0)
    s0 = np.cross(r, s0, axis=0)
    axes = GimbalAxes(Vec3(*r), Vec3(*(s0 / np.linalg.norm(s0, axis=0))))
    areas = [sg.singular_area(modules(axes, order), 400) for order in ([0, 1, 2], [1, 2, 0], [2, 1, 0])]
    np.testing.assert_allclose(areas, areas[0], rtol=1e-3)


def test_passability_of_the_lock():
    np.testing.assert_allclose(
        np.abs(sg.passability(FOUR["pyramid"], np.radians([90, 0, -90, 0]))), [0.144655, 0.577858], atol=1e-6
    )
    u = sg.sphere(200)
    for name in SKEWS:
        _, gamma = sg.singular_momentum(FOUR[name], u, np.ones(4))
        q = sg.passability(FOUR[name], gamma)
        assert (q[0] * q[1] > 0).all()  # every external singularity is impassable
    _, gamma = sg.singular_momentum(FOUR["pyramid"], u, np.array([1, 1, -1, -1]))
    q = sg.passability(FOUR["pyramid"], gamma)
    assert 0.05 < np.mean(q[0] * q[1] > 0) < 0.25


TIES = [
    ("pyramid", [-90, 90, 90], 14.04089566, {(-95, 90, 85), (-85, 90, 95)}),
    ("box", [90, 0, -90], 132.13018304, {(95, 5, -85), (95, -5, -85), (85, 5, -95), (85, -5, -95)}),
    ("box", [-90, 90, 90], 11.43005230, {(-95, 90, 85), (-85, 90, 95)}),
]


@pytest.mark.parametrize("name, start, kappa, ties", TIES)
def test_rearrangement_returns_all_ties(name, start, kappa, ties):
    got = sg.rearrange(THREE[name], np.radians(start))
    assert {tuple(int(v) for v in np.round(np.degrees(g))) for g in got.gamma} == ties
    np.testing.assert_allclose(got.condition, kappa, rtol=1e-8)
    first = sg.rearrange(THREE[name], np.radians(start), rank=lambda g: -g[:, 0])
    assert (np.diff(first.gamma[:, 0]) <= 1e-12).all() and first.gamma.shape == got.gamma.shape
    by_gradient = sg.rearrange_by_gradient(THREE[name], np.radians(start))
    assert (by_gradient.condition <= kappa * (1 + 1e-6)).all()  # the box of +-5 deg holds the grid
    assert (np.abs(by_gradient.gamma - np.radians(start)) <= np.pi / 36 + 1e-12).all()


BOX = THREE["box"]
LONG = GimbalAxes(Vec3(*(2 * c for c in BOX.r)), BOX.s0)
UNEVEN = GimbalAxes(Vec3(BOX.r.x[:2], *BOX.r[1:]), BOX.s0)
ONES = Vec3(*np.ones((3, 1)))
REFUSED = [  # what is called, words of the refusal
    (lambda: sg.ill_conditioned(modules(BOX, [0, 1]), 10), "at least 3"),
    (lambda: sg.ill_conditioned(cmg_axes(0.0, np.arange(4.0)), 10), "parallel"),
    (lambda: sg.ill_conditioned(LONG, 10), r"\|axes.r\|\[0\]` must be 1"),
    (lambda: sg.ill_conditioned(GimbalAxes(BOX.r, BOX.r), 10), "right angles"),
    (lambda: sg.ill_conditioned(UNEVEN, 10), r"`axes.r.y` must have shape \(2,\)"),
    (lambda: sg.ill_conditioned(BOX, 0), "whole number"),
    (lambda: sg.ill_conditioned(BOX, 10, 0.5), "greater than 1"),
    (lambda: sg.singular_area(FOUR["box"]), "three modules"),
    (lambda: sg.rearrange_by_gradient(FOUR["box"], np.zeros(4)), "three modules"),
    (lambda: sg.rearrange(BOX, np.zeros(4)), r"`gamma` must have shape \(3,\), but it is of shape \(4,\)"),
    (lambda: sg.rearrange(BOX, [0.0, np.nan, 0.0]), r"`gamma\[1\]` must be finite"),
    (lambda: sg.passability(FOUR["box"], np.zeros(3)), r"`gamma` must have shape \(4,\)"),
    (lambda: sg.clearance(BOX, 0.0), r"`h` must have shape \(3,\)"),
    (lambda: sg.singular_momentum(BOX, sg.sphere(3), [1, 1, 0]), r"`signs\[2\]` must be one of"),
    (lambda: sg.singular_momentum(BOX, sg.sphere(3), [1, 1]), r"`signs` must have shape \(3,\)"),
    (lambda: sg.support(BOX, ONES), r"`\|u\|\[0\]` must be 1"),
    (lambda: sg.reach(LONG, sg.sphere(3)), "must be 1"),
    (lambda: sg.reach(BOX, Vec3(0.0, 0.0, 1.0)), r"`d` must have components of one shape \(m,\)"),
    (lambda: sg.rims(LONG), "must be 1"),
    (lambda: sg.sign_patterns(21), "not exceed 20"),
]


@pytest.mark.parametrize("call, words", REFUSED)
def test_bad_input_is_refused_in_one_line(call, words):
    with pytest.raises(ValueError, match=words) as error:
        call()
    assert "\n" not in str(error.value)


def test_what_are_no_axes_is_refused():
    with pytest.raises(TypeError, match="`axes` must be a GimbalAxes"):
        sg.clearance(np.eye(3), np.zeros(3))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("m", [100, 1000])
def test_points_on_the_sphere_are_even(m):
    points = np.stack(sg.sphere(m), axis=-1)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, rtol=1e-12)
    apart = np.linalg.norm(points[:, None] - points, axis=-1) + 9 * np.eye(m)
    nearest = apart.min(1) * np.sqrt(m / (4 * np.pi))  # 1.07 in a hexagonal lattice
    assert nearest.min() > 0.8 and nearest.max() < 1.08
