"""Filters of few states: their maps against plain matrices, missing readings, impossible covariances."""

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
import pytest  # noqa: E402
from made_up import left, right  # noqa: E402

from jaxatt import Quat, Reading, Vec3, star_filters  # noqa: E402
from jaxatt.star_filters import AttitudeBias, Belief, Moments, star_angle  # noqa: E402

DT = 0.1
S, W, W_R = Vec3(0.6, 0.0, 0.8), Vec3(0.01, 0.02, -0.03), Vec3(0.0, -1e-3, 0.0)


def covariance(n, seed=0):
    P = 1e-3 * np.random.default_rng(seed).normal(size=(n, n))
    return tuple(map(tuple, P @ P.T))


def test_the_step_is_that_of_two_quaternion_products():
    A = np.eye(4) + DT / 2 * (right(np.r_[0, W]) - left(np.r_[0, W_R]))
    x = np.random.default_rng(1).normal(size=4)
    np.testing.assert_allclose(star_filters.quaternion_step(W, W_R, DT)(x), A @ x, rtol=1e-13)


def test_a_star_is_seen_by_the_linear_map_of_7():
    x = np.random.default_rng(2).normal(size=4)
    C = np.column_stack([S, 2 * np.cross(S, np.eye(3)).T])
    np.testing.assert_allclose(star_filters.star_map(S)(x), C @ x, rtol=1e-13)


def test_multiplicative_noise_has_the_closed_form():
    Q = np.cov(np.random.default_rng(0).standard_normal((4, 9)))
    B = [-DT / 2 * right(np.r_[0, e]) for e in np.eye(3)]
    plain = sum(0.3**2 * b @ Q @ b.T for b in B)
    np.testing.assert_allclose(np.array(star_filters.rate_noise(Q, 0.3, DT)), plain, atol=1e-15)


def test_a_known_bias_is_taken_off_the_gyros_reading():
    x, b, P = Quat(0.9, 0.1, -0.3, 0.2), Vec3(1e-3, -2e-3, 3e-3), covariance(7, 1)
    predicted = lambda b, w: star_filters.bias_predict(Belief(AttitudeBias(*x, *b), P), w, W_R, 1e-3, 1e-5, DT)
    a, c = predicted(b, W), predicted(Vec3(0.0, 0.0, 0.0), W - b)
    np.testing.assert_allclose(a.mean[:4], c.mean[:4], rtol=1e-13)
    np.testing.assert_allclose(a.cov, c.cov, rtol=1e-12, atol=1e-18)


UPDATES = {
    "lmmse": (star_filters.lmmse_update, lambda P: Moments(Quat(1.0, 0.0, 0.0, 0.0), P, P), 4),
    "bias": (star_filters.bias_update, lambda P: Belief(AttitudeBias(1.0, *[0.0] * 6), P), 7),
    "mekf": (star_filters.mekf_update, lambda P: Belief(Quat(1.0, 0.0, 0.0, 0.0), P), 3),
}


@pytest.mark.parametrize("name", UPDATES)
def test_a_star_that_is_missing_changes_nothing_whatever_it_reads(name):
    update, believed, n = UPDATES[name]
    belief = believed(covariance(n))
    for y in (Reading(Vec3(0.6, np.nan, 0.8), True), Reading(Vec3(5.0, 5.0, 5.0), False)):
        after, told = update(belief, y, S, 1e-3)
        assert after == belief
        assert (told.nis, told.rows, told.nll, told.value) == (0, 0, 0, (0, 0, 0))
    there, told = update(belief, Reading(Vec3(0.6, 0.01, 0.8), True), S, 1e-3)
    assert there != belief and told.rows == 3 and told.nis > 0


@pytest.mark.parametrize("name", UPDATES)
@pytest.mark.parametrize("bad", [-1.0, np.nan])
def test_a_covariance_that_cannot_be_fits_nothing_and_moves_nothing(name, bad):
    update, believed, n = UPDATES[name]
    belief = believed(tuple(tuple(bad * (i == j) for j in range(n)) for i in range(n)))
    after, told = update(belief, Reading(Vec3(0.6, 0.01, 0.8), True), S, 1e-3)
    assert np.isnan(told.nis) and np.isnan(told.nll)
    np.testing.assert_array_equal(jax.tree.leaves(after), jax.tree.leaves(belief))


def test_a_covariance_with_a_row_too_short_is_refused():
    with pytest.raises(ValueError, match="`P` must be n rows of n, but it is 2 rows of 2, 1"):
        star_filters.congruence(lambda x: x, ((1.0, 0.0), (0.0,)))


def test_the_nees_is_that_of_plain_matrices():
    rng = np.random.default_rng(2)
    P, x, q = rng.normal(size=(4, 4)) * 1e-3, rng.normal(size=4), rng.normal(size=4)
    P, e = P @ P.T, x - q
    turn, std, nees, nees_q = star_filters.quaternion_error(Quat(*x), tuple(map(tuple, P)), Quat(*q))
    np.testing.assert_allclose(turn, 2 * e[1:])
    np.testing.assert_allclose(std, 2 * np.sqrt(np.diag(P)[1:]))
    np.testing.assert_allclose(nees, e[1:] @ np.linalg.solve(P[1:, 1:], e[1:]), rtol=1e-9)
    np.testing.assert_allclose(nees_q, e @ np.linalg.solve(P, e), rtol=1e-9)


@pytest.mark.parametrize("sign", [1, -1])  # of a quaternion, which no attitude knows
def test_the_error_of_the_multiplicative_filter_is_the_turn_to_the_estimate(sign):
    rng = np.random.default_rng(3)
    P, q, a = rng.normal(size=(3, 3)) * 1e-3, rng.normal(size=4), rng.normal(size=3) * 1e-6
    P, q = P @ P.T, q / np.linalg.norm(q)
    x = sign * left(q) @ [1, *(a / 2)]
    turn, std, nees, nees_q = star_filters.mekf_error(Quat(*x), tuple(map(tuple, P)), Quat(*q))
    np.testing.assert_allclose(turn, a, rtol=1e-6)
    np.testing.assert_allclose(std, np.sqrt(np.diag(P)))
    np.testing.assert_allclose(nees, a @ np.linalg.solve(P, a), rtol=1e-6)
    assert nees_q == nees


def test_the_angle_between_two_stars_is_judged_by_its_own_variance():
    s, p, a, b = np.random.default_rng(4).normal(size=(4, 3)) / 3
    got = star_angle(*(Vec3(*v) for v in (a, b, s, p)), std=0.01)
    np.testing.assert_allclose(got, (a @ b - s @ p) ** 2 / (2e-4 * (1 - (s @ p) ** 2)), rtol=1e-9)
    assert star_angle(Vec3(*s), Vec3(*p), Vec3(*s), Vec3(*p), 0.01) == 0
    assert star_angle(Vec3(np.nan, 0.0, 0.0), Vec3(*p), Vec3(*s), Vec3(*p), 0.01) == 0


# no covariance


@pytest.mark.parametrize("P0, R", [(-1.0, 0.5), (1.0, -2.0), (1.0, -0.5), (-0.1, 1.0), (1.0, np.nan), (np.nan, 1.0)])
def test_an_impossible_variance_is_no_perfect_fit_and_moves_nothing(P0, R):
    P = star_filters.diagonal(1.0, P0, 1.0)
    belief, y = star_filters.Belief(Vec3(0.0, 0.0, 0.0), P), Reading(Vec3(3.0, 3.0, 3.0), True)
    mean, cov, told = star_filters.update_three(belief, y, lambda a: Vec3(*a), Vec3(0.0, 0.0, 0.0), R)
    assert np.isnan(told.nis) and np.isnan(told.nll)
    np.testing.assert_array_equal(mean, 0)
    np.testing.assert_array_equal([cov[i][i] for i in range(3)], [1.0, P0, 1.0])


def test_the_error_of_an_impossible_covariance_is_no_number():
    one, q = Quat(1.0, 0.0, 0.0, 0.0), Quat(1.0, 1e-3, 0.0, 0.0)
    good = star_filters.diagonal(1e-6, 1e-6, 1e-6, 1e-6)
    assert all(np.isfinite(a) for a in star_filters.quaternion_error(one, good, q)[2:])
    for i in range(4):
        P = star_filters.diagonal(*(-1e-6 if j == i else 1e-6 for j in range(4)))
        nees, nees_q = star_filters.quaternion_error(one, P, q)[2:]
        assert np.isnan(nees_q) and (i == 0 or np.isnan(nees))
        if i < 3:
            assert np.isnan(star_filters.mekf_error(one, [row[:3] for row in P[:3]], q)[2:]).all()


def test_rounding_makes_no_variance_negative():
    """A measurement far better than the prior, in float32: 1 - 1 / (1 + 1e-12) rounds to or below zero."""
    single = lambda *a: np.array(a, np.float32)
    P = star_filters.diagonal(*single(1, 3, 7))
    belief, y = star_filters.Belief(Vec3(*single(0, 0, 0)), P), Reading(Vec3(*single(1, 1, 1)), True)
    h = lambda a: Vec3(a[0] + a[1], a[1] + a[2], a[2] + a[0])
    for _ in range(3):
        mean, P, told = star_filters.update_three(belief, y, h, h(belief.mean), np.float32(1e-6))
        belief = star_filters.Belief(mean, P)
        assert all(P[i][i] >= 0 for i in range(3)) and not np.isnan(told.nis)
