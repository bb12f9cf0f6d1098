"""Singularities of control-moment-gyro clusters: laws, plain oracles, the numbers of the paper and the reference."""

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

from jaxatt import singularity as sg  # noqa: E402
from jaxatt.mounting import GimbalAxes, check_gimbal_axes, cmg_axes, cmg_triads, modules  # noqa: E402
from jaxatt.vec import Mat3, Vec3  # noqa: E402

SKEWS = {"pyramid": 54.7, "box": 90.0}
FOUR = {name: cmg_axes(np.radians(skew), np.radians([0.0, 90.0, 180.0, 270.0])) for name, skew in SKEWS.items()}
THREE = {name: modules(axes, [0, 1, 2]) for name, axes in FOUR.items()}


def lanes(axes):
    return jax.tree.map(lambda a: np.asarray(a)[:, None], axes)


def torque(axes, gamma):
    return cmg_triads(lanes(axes), gamma).t


def matrices(t):
    """T of shape (lanes, 3, n)."""
    return np.moveaxis(np.stack([np.asarray(c) for c in t]), -1, 0)


def angles(n, m, seed=0):
    return np.random.default_rng(seed).uniform(0, 2 * np.pi, (n, m))


@pytest.mark.parametrize("beta", [54.7, 90.0, 17.2])
def test_triads_are_those_of_the_paper(beta):
    g = angles(4, 50)
    got = cmg_triads(lanes(cmg_axes(np.radians(beta), np.radians([0.0, 90, 180, 270]))), g)
    sb, cb = np.sin(np.radians(beta)), np.cos(np.radians(beta))
    s, c, o = np.sin(g), np.cos(g), np.zeros(50)
    S = [  # eqs. (9), (10)
        [-s[0] * cb, -c[1], s[2] * cb, c[3]],
        [c[0], -s[1] * cb, -c[2], s[3] * cb],
        [s[0] * sb, s[1] * sb, s[2] * sb, s[3] * sb],
    ]
    T = [
        [-c[0] * cb, s[1], c[2] * cb, -s[3]],
        [-s[0], -c[1] * cb, s[2], c[3] * cb],
        [c[0] * sb, c[1] * sb, c[2] * sb, c[3] * sb],
    ]
    R = [[sb + o, o, -sb + o, o], [o, sb + o, o, -sb + o], [cb + o] * 4]
    for v, paper in zip(got, (np.broadcast_to(got.r, (3, 4, 50)), S, T)):
        np.testing.assert_allclose(np.broadcast_to(np.stack(v), (3, 4, 50)), paper, atol=1e-14)
    np.testing.assert_allclose(np.broadcast_to(np.stack(got.r), (3, 4, 50)), R, atol=1e-14)
    np.testing.assert_allclose(got.s @ got.s, 1, atol=1e-14)
    np.testing.assert_allclose(got.s @ got.t, 0, atol=1e-14)


@pytest.mark.parametrize("name", SKEWS)
def test_determinant_in_closed_form(name):
    g, b = angles(3, 1000), np.radians(SKEWS[name])
    t = torque(THREE[name], g)
    (d,) = sg.minors(sg.columns(t)).values()
    closed = np.sin(b) * (
        np.sin(g[1]) * np.sin(g[0] + g[2])
        + np.cos(b) * np.cos(g[1]) * (2 * np.cos(b) * np.cos(g[0]) * np.cos(g[2]) + np.sin(g[2] - g[0]))
    )
    np.testing.assert_allclose(d, closed, atol=1e-13)
    np.testing.assert_allclose(d, np.linalg.det(matrices(t)), atol=1e-13)
    t = torque(FOUR[name], angles(4, 1000))
    T = matrices(t)
    np.testing.assert_allclose(sg.gram_determinant(t), np.linalg.det(T @ np.swapaxes(T, 1, 2)), atol=1e-13)


@pytest.mark.parametrize("axes", [*THREE.values(), *FOUR.values(), cmg_axes(1.0, np.arange(6.0))])
def test_singular_values_against_svd(axes):
    t = torque(axes, angles(len(axes.r.x), 20000))
    ours = np.stack(jax.jit(sg.singular_values)(t), -1)
    theirs = np.linalg.svd(matrices(t), compute_uv=False)
    np.testing.assert_allclose(ours, theirs, atol=3e-9)
    kappa = theirs[:, 0] / theirs[:, 2]
    ok = kappa < 1e4
    np.testing.assert_allclose(np.asarray(sg.condition(t))[ok], kappa[ok], rtol=1e-9)
    single = sg.condition(jax.tree.map(jnp.float32, t))
    ok = kappa < 100
    assert single.dtype == jnp.float32
    assert np.quantile(np.abs(np.asarray(single)[ok] / kappa[ok] - 1), 0.99) < 1e-4


def test_rank_one_is_seen():
    T = np.zeros((3, 3))
    T[2] = 1  # box-90 at gimbal angles zero: all torques along z
    kappa, rank_one = sg.condition_and_rank(Vec3(*T))
    assert np.isinf(kappa) and rank_one
    kappa, rank_one = sg.condition_and_rank(cmg_triads(THREE["box"], np.zeros(3)).t)
    assert kappa > 1e7 and rank_one
    kappa, rank_one = sg.condition_and_rank(Vec3(*np.eye(3)))
    assert kappa == 1 and not rank_one
    kappa, rank_one = sg.condition_and_rank(Vec3(*np.diag([1.0, 1.0, 0.0])))
    assert np.isinf(kappa) and not rank_one


def test_condition_has_finite_gradients():
    kappa = lambda g: sg.condition(cmg_triads(THREE["pyramid"], g).t)
    g = angles(3, 1)[:, 0]
    numeric = [(kappa(g + 1e-6 * e) - kappa(g - 1e-6 * e)) / 2e-6 for e in np.eye(3)]
    np.testing.assert_allclose(jax.grad(kappa)(g), numeric, rtol=1e-6)
    for T in (np.eye(3), np.ones((3, 3)), np.zeros((3, 3)), np.diag([1.0, 1.0, 0.5])):
        gradient = jax.grad(lambda T: sum(sg.singular_values(Vec3(*T))))(jnp.asarray(T))
        assert np.isfinite(gradient).all()
    flat = jax.grad(lambda T: jnp.sum(sg.condition(Vec3(*T))))(jnp.diag(jnp.array([1.0, 1.0, 0.0])))
    assert np.isfinite(flat).all()


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


def test_min_norm_solve_is_the_pseudo_inverse():
    rng = np.random.default_rng(3)
    for axes in (*THREE.values(), *FOUR.values()):
        n = len(axes.r.x)
        t = torque(axes, angles(n, 500))
        T, a = matrices(t), rng.normal(size=(500, 3))
        x = np.asarray(sg.min_norm_solve(t, Vec3(*a.T), 1e-15)).T
        np.testing.assert_allclose(x, np.einsum("mij,mj->mi", np.linalg.pinv(T), a), rtol=1e-6, atol=1e-10)
    # a column of zeros changes nothing, so a failed module is a mask
    t = torque(FOUR["pyramid"], angles(4, 500))
    masked = Vec3(*(c * np.array([1, 1, 0, 1])[:, None] for c in t))
    few = Vec3(*(np.asarray(c)[[0, 1, 3]] for c in t))
    x, y = (np.asarray(sg.min_norm_solve(v, Vec3(*a.T), 1e-15)) for v in (masked, few))
    np.testing.assert_allclose(x[[0, 1, 3]], y, rtol=1e-12)
    np.testing.assert_array_equal(x[2], 0)


def test_min_norm_solve_cuts_small_singular_values():
    rng = np.random.default_rng(4)
    for n, sigma, rcond in ((3, (1.5, 0.7, 0.01), 0.02), (4, (1.5, 0.7, 1e-13), 1e-8), (3, (1.5, 1.5, 0), 1e-15)):
        left, right = (np.linalg.qr(rng.normal(size=(k, k)))[0] for k in (3, n))
        T, a = left @ np.diag(sigma) @ right[:3], rng.normal(size=3)
        x = sg.min_norm_solve(Vec3(*jnp.asarray(T)), Vec3(*a), rcond)
        np.testing.assert_allclose(x, np.linalg.pinv(T, rcond) @ a, atol=1e-9)
    for lost in range(3):  # rank two, whatever axis gets no torque
        T = rng.normal(size=(3, 4)) * (np.arange(3) != lost)[:, None]
        x = sg.min_norm_solve(Vec3(*jnp.asarray(T)), Vec3(0.3, -0.2, 0.5), 1e-8)
        np.testing.assert_allclose(x, np.linalg.pinv(T) @ [0.3, -0.2, 0.5], atol=1e-12)
    T = np.outer([1.0, 2.0, 2.0], [1.0, 0.5, 1.0])
    x = sg.min_norm_solve(Vec3(*jnp.asarray(T)), Vec3(1.0, 0.0, 0.5), 1e-7)
    np.testing.assert_allclose(x, np.linalg.pinv(T) @ [1.0, 0.0, 0.5], atol=1e-12)
    assert (np.asarray(sg.min_norm_solve(Vec3(*np.zeros((3, 4))), Vec3(1.0, 0.0, 0.0), 1e-15)) == 0).all()


def test_robust_solve():
    T, a, E = matrices(torque(FOUR["box"], angles(4, 1)))[0], np.array([1.0, -2.0, 0.3]), np.diag([0.1, 0.2, 0.3])
    x = sg.robust_solve(Vec3(*jnp.asarray(T)), Vec3(*a), Mat3(*(Vec3(*row) for row in E)))
    np.testing.assert_allclose(x, T.T @ np.linalg.solve(T @ T.T + E, a), rtol=1e-12)


@pytest.mark.parametrize("axes", [*THREE.values(), *FOUR.values()])
def test_singular_momenta_are_singular(axes):
    u = sg.sphere(100)
    for signs in sg.sign_patterns(len(axes.r.x)):
        h, gamma = sg.singular_momentum(axes, u, signs)
        at = cmg_triads(lanes(axes), gamma)
        np.testing.assert_allclose(np.stack(h), np.stack([np.asarray(c).sum(0) for c in at.s]), atol=1e-12)
        np.testing.assert_allclose(at.t @ u, 0, atol=1e-12)
        assert (np.asarray(sg.condition(at.t)) > 1e6).all()


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
    np.testing.assert_allclose(sg.reach(THREE[name], Vec3(*np.eye(3))), REACH[name][0], atol=1e-5)
    np.testing.assert_allclose(sg.reach(FOUR[name], Vec3(*np.eye(3))), REACH[name][1], atol=1e-4)
    d = sg.sphere(50)
    assert (np.asarray(sg.reach(THREE[name], d)) <= np.asarray(sg.support(THREE[name], d)) + 1e-9).all()


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


def test_bad_input_is_refused_in_one_line():
    two, flat = modules(THREE["box"], [0, 1]), cmg_axes(0.0, np.arange(4.0))
    long = GimbalAxes(Vec3(*(2 * c for c in THREE["box"].r)), THREE["box"].s0)
    slanted = GimbalAxes(THREE["box"].r, THREE["box"].r)
    for axes, words in ((two, "at least 3"), (flat, "parallel"), (long, "unit"), (slanted, "right angles")):
        with pytest.raises(ValueError, match=words) as error:
            sg.ill_conditioned(axes, 10)
        assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="whole number"):
        sg.ill_conditioned(THREE["box"], 0)
    with pytest.raises(ValueError, match="greater than 1"):
        sg.ill_conditioned(THREE["box"], 10, 0.5)
    with pytest.raises(ValueError, match="three modules"):
        sg.singular_area(FOUR["box"])
    with pytest.raises(ValueError, match="three modules"):
        sg.rearrange_by_gradient(FOUR["box"], np.zeros(4))


def test_axes_and_what_is_used_must_fit_each_other():
    box = THREE["box"]
    uneven = GimbalAxes(Vec3(box.r.x[:2], *box.r[1:]), box.s0)
    for axes, used in ((box, np.ones(4, bool)), (uneven, True), (uneven, np.ones(3, bool))):
        with pytest.raises(ValueError, match="`axes` must have components of one shape, that of `used` too"):
            check_gimbal_axes("axes", axes, used)
    with pytest.raises(ValueError, match=r"`used` must have the shape of the axes, \(3,\), but it is \(2, 3\)"):
        check_gimbal_axes("axes", box, np.ones((2, 3), bool))
    check_gimbal_axes("axes", FOUR["box"], [True, True, False, True])
    with pytest.raises(ValueError, match="at least 3"):
        check_gimbal_axes("axes", FOUR["box"], [True, False, False, True])


@pytest.mark.parametrize("m", [100, 1000])
def test_points_on_the_sphere_are_even(m):
    points = np.stack(sg.sphere(m), axis=-1)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, rtol=1e-12)
    apart = np.linalg.norm(points[:, None] - points, axis=-1) + 9 * np.eye(m)
    nearest = apart.min(1) * np.sqrt(m / (4 * np.pi))  # 1.07 in a hexagonal lattice
    assert nearest.min() > 0.8 and nearest.max() < 1.08
