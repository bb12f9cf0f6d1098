"""Sensors: where gyros point, gyros by their data sheets, star trackers, sun sensors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from slopes import slopes

from jaxatt import fields
from jaxatt.attitude import quat_from_vector, vector_from_quat
from jaxatt.faults import Fault, Reading, dead, on_axes
from jaxatt.loops.gyro_ekf import DEG
from jaxatt.sensors import (
    Gyro,
    GyroState,
    StarTracker,
    allan_deviation,
    apart,
    cell_currents,
    direction_read,
    gauss_markov,
    gyro_from_sheet,
    gyro_pyramid,
    gyro_read,
    interrupted,
    parity_vector,
    quantised,
    rate_from,
    rate_maps,
    read_triad,
    star_axes,
    star_covariance,
    star_error,
    star_read,
    sun_from_cells,
    sun_from_six,
    triad,
)
from jaxatt.vec import Mat3, Quat, Vec3, array, project, zeros

AXES = gyro_pyramid(54.7 * DEG, 60 * DEG)
G = np.asarray(project(AXES, Vec3.of(np.eye(3))))


def test_a_triad_reads_each_axis_with_its_own_fault_and_noise():
    truth, last, normals = Vec3(1.0, 2.0, 3.0), Vec3(7.0, 8.0, 9.0), np.array([1.0, -1.0, 2.0])
    faults = on_axes(Fault())._replace(y=Fault(bias=0.5), z=Fault(stuck=1.0))
    reads = lambda t: array(read_triad(triad(faults, t, 0.1, normals, last), truth))
    np.testing.assert_allclose(reads(0.0), [1.1, 2.4, 9.0], rtol=1e-6)
    healthy = on_axes(Fault())
    np.testing.assert_allclose(array(read_triad(triad(healthy, 0.0, 0.1, normals, last), truth)), [1.1, 1.9, 3.2])


def test_a_quantised_signal_takes_whole_steps_and_gradients_do_not_see_them():
    y = np.array([-3.3, -0.4, 0.6, 2.6])
    np.testing.assert_allclose(quantised(y, 0.5), [-3.5, -0.5, 0.5, 2.5])
    np.testing.assert_array_equal(quantised(y, 0.0), y)
    assert jax.grad(quantised)(0.6, 0.5) == 1 and jax.grad(quantised, argnums=1)(0.6, 0.0) == 0


def test_gyro_axes_are_unit_and_as_the_paper_says():
    np.testing.assert_allclose(np.linalg.norm(G, axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(np.diag(G.T @ G), [0.9991, 0.9991, 2.0018], atol=5e-5)
    square = np.asarray(project(gyro_pyramid(np.arccos(1 / np.sqrt(3)), 60 * DEG)[:3], Vec3.of(np.eye(3))))
    np.testing.assert_allclose(square @ square.T, np.eye(3), atol=1e-15)  # A, B, C are then an orthogonal triad


def test_the_parity_vector_sees_no_rate():
    v = np.asarray(parity_vector(AXES))
    np.testing.assert_allclose(v @ G, 0, atol=1e-15)
    np.testing.assert_allclose(v, [0.408, 0.408, 0.408, 0.707], atol=5e-4)


def test_the_parity_vector_follows_an_axis_that_is_turned_round_and_keeps_its_first_number_positive():
    a, b, c, d = AXES
    v = np.asarray(parity_vector(AXES))
    np.testing.assert_allclose(parity_vector((a, -b, c, d)), v * [1, -1, 1, 1], atol=1e-15)
    np.testing.assert_allclose(parity_vector((-a, b, c, d)), v * [1, -1, -1, -1], atol=1e-15)


def test_the_parity_vector_of_many_pyramids_is_that_of_each():
    alphas = np.array([0.5, 0.9, 1.2])
    one = lambda alpha: parity_vector(gyro_pyramid(alpha, 60 * DEG))
    np.testing.assert_allclose(jax.vmap(one)(alphas), [one(alpha) for alpha in alphas], atol=1e-15)


def test_the_rate_comes_from_the_gyros_in_use_alone():
    """Three of the four give the rate; two give its part along them, and none gives none. The rest may say anything."""
    w, maps = np.array([0.1, -0.2, 0.3]), rate_maps(AXES)
    for used in np.ndindex(2, 2, 2, 2):
        used = np.array(used, bool)
        found = array(rate_from(maps, Reading(np.where(used, G @ w, np.nan), used)))
        np.testing.assert_allclose(found, np.linalg.pinv(G[used]) @ (G[used] @ w), atol=1e-14)


def test_rate_maps_are_exact_for_axes_that_are_nearly_parallel():
    axes = gyro_pyramid(1e-3, 60 * DEG)
    G = np.asarray(project(axes, Vec3.of(np.eye(3))))
    np.testing.assert_allclose(rate_maps(axes)[7], np.linalg.pinv(G * [[1], [1], [1], [0]]), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(rate_maps(G.T), rate_maps(axes), rtol=1e-9, atol=1e-9)  # an array (3, n): columns


def test_the_parity_vector_watches_what_it_can_where_three_axes_lie_in_a_plane():
    a, b, c = (Vec3.of(row) for row in np.eye(3))
    v = np.asarray(parity_vector((a, b, c, (b + c) / np.sqrt(2))))  # the last three lie in a plane
    np.testing.assert_allclose(np.abs(v), [0, 0.5, 0.5, np.sqrt(0.5)], atol=1e-15)
    np.testing.assert_allclose(v @ np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0.5**0.5, 0.5**0.5]]), 0, atol=1e-15)


# gyros by their data sheets

STILL = GyroState(zeros(), zeros())


def test_data_sheets_are_converted_once():
    gyro = gyro_from_sheet(arw=0.15, rrw=0.3, instability=0.5, tau=600.0)
    assert gyro.arw == pytest.approx(4.36332e-5, rel=1e-5) and gyro.rrw == pytest.approx(2.42407e-8, rel=1e-5)
    assert gyro.wander == pytest.approx(np.deg2rad(0.5 / 3600) / 0.61736, rel=1e-12) and gyro.tau == 600
    for name in ("arw", "rrw", "instability"):
        with pytest.raises(ValueError, match=f"`{name}` must not be negative, but it is -1"):
            gyro_from_sheet(**{"arw": 0.1, name: -1.0})
    with pytest.raises(ValueError, match=r"`gyro\.tau` must be a positive number, but it is 0"):
        fields.validate("gyro", Gyro(tau=0.0))


def increments(key, n, ticks, dt, gyro):
    """Angle increments and biases of n gyros at rest over so many ticks, and the last bias of each."""

    def tick(state, k):
        noise = jax.random.normal(jax.random.fold_in(key, k), (6, n), float)
        state, y = gyro_read(gyro, state, zeros(), dt, noise[:3], noise[3:])
        return state, array(y) * dt

    start = GyroState(Vec3(*jnp.zeros((3, n))), Vec3(*jnp.zeros((3, n))))
    state, angles = jax.lax.scan(tick, start, jnp.arange(ticks))
    return np.asarray(angles.sum(0)).ravel(), np.asarray(array(state.bias)).ravel()


def test_angle_and_bias_have_the_covariance_of_the_continuous_gyro():
    """Over T: sv^2 T + su^2 T^3/3, su^2 T^2/2, su^2 T, at any step; 60 000 gyros, four standard errors."""
    sv, su, ticks, dt = 4e-5, 2e-5, 50, 0.1
    angle, bias = increments(jax.random.key(0), 20_000, ticks, dt, Gyro(arw=sv, rrw=su))
    T, n = ticks * dt, len(angle)
    exact = np.array([[sv**2 * T + su**2 * T**3 / 3, su**2 * T**2 / 2], [0, su**2 * T]])
    found = np.cov(angle, bias)
    for i, j in ((0, 0), (0, 1), (1, 1)):
        spread = np.sqrt((exact[i, i] * exact[j, j] + exact[i, j] ** 2) / n)
        assert abs(found[i, j] - exact[i, j]) < 4 * spread


def test_one_step_of_the_gyro_is_the_exact_one():
    """The reading is affine in its normal numbers: their coefficients give the moments of one step, to rounding."""
    sv, su, dt = 3e-5, 4e-6, 0.7
    gyro = Gyro(arw=sv, rrw=su)
    x = lambda white, walk: gyro_read(gyro, STILL, zeros(), dt, [white, 0.0, 0.0], [walk, 0.0, 0.0])
    state = [x(*unit) for unit in np.eye(2)]
    G = np.array([[y.x * dt, s.bias.x] for s, y in state])
    exact = [[sv**2 * dt + su**2 * dt**3 / 3, su**2 * dt**2 / 2], [su**2 * dt**2 / 2, su**2 * dt]]
    np.testing.assert_allclose(G.T @ G, exact, rtol=1e-13)


@pytest.mark.parametrize("ratio", [1e-6, 1e-3, 0.009, 0.499, 0.501, 3.0, 8.0])
def test_the_wander_has_the_moments_of_the_gauss_markov_process(ratio):
    """End and mean over a step, of covariance exp(-|t - s| / tau) - exp(-(t + s) / tau), by quadrature; x = dt / tau."""
    std, tau, x = 2.0, 30.0, ratio
    dt = ratio * tau
    u, weights = np.polynomial.legendre.leggauss(24)
    u, weights = (u + 1) / 2, weights / 2
    covariance = lambda u, v: -np.exp(-x * (u - v)) * np.expm1(-2 * x * v)  # v <= u, both in steps
    cross = weights @ covariance(1, u)
    square = 2 * weights @ (u * (covariance(u[:, None], u[:, None] * u) @ weights))
    end = -np.expm1(-2 * ratio)
    G = np.array([gauss_markov(0.0, std, tau, dt, *unit) for unit in np.eye(2)])
    np.testing.assert_allclose(G.T @ G / std**2, [[end, cross], [cross, square]], rtol=1e-14)
    ahead, mean = gauss_markov(5.0, std, tau, dt, 0.0, 0.0)
    assert ahead == pytest.approx(5 * np.exp(-ratio), rel=1e-14)
    assert mean == pytest.approx(5 * (weights @ np.exp(-x * u)), rel=1e-14)


def allan(gyro, dt, ticks, n, key, spans):
    @jax.jit
    def run(key):
        def tick(state, k):
            white, walk, w1, w2 = jax.random.normal(jax.random.fold_in(key, k), (4, 3, n))
            state, y = gyro_read(gyro, state, zeros(), dt, white, walk, [*w1, *w2])
            return state, array(y)

        start = jax.random.normal(jax.random.fold_in(key, ticks), (3, n)) * gyro.wander
        return jax.lax.scan(tick, GyroState(Vec3(*jnp.zeros((3, n))), Vec3(*start)), jnp.arange(ticks))[1]

    return np.sqrt(np.mean(allan_deviation(run(key), dt, spans) ** 2, axis=(1, 2)))


def test_the_allan_deviation_is_that_of_the_sheet():
    """sqrt(arw^2 / T + rrw^2 T / 3) within 2 % from 1 to 1000 s: 120 gyros, 20 000 s."""
    gyro, spans = gyro_from_sheet(arw=0.15, rrw=30.0), np.array([1.0, 10.0, 100.0, 1000.0])
    found = allan(gyro, 1.0, 20_000, 40, jax.random.key(3), spans)
    np.testing.assert_allclose(found, np.sqrt(gyro.arw**2 / spans + gyro.rrw**2 * spans / 3), rtol=0.02)


def test_the_flat_of_the_allan_plot_is_the_bias_instability():
    """.61736 of the wander's deviation, at 1.8926 time constants."""
    gyro = gyro_from_sheet(arw=0.0, instability=0.5, tau=20.0)
    spans = np.array([0.7, 1.8926, 5.0]) * 20.0
    found = allan(gyro, 2.0, 10_000, 40, jax.random.key(4), spans)
    assert found.argmax() == 1 and found[1] == pytest.approx(np.deg2rad(0.5 / 3600), rel=0.02)


def test_the_allan_deviation_of_a_ramp_and_of_times_that_a_record_does_not_hold():
    """A rate that grows by c a second: c T / sqrt 2."""
    ramp = 0.3 * np.arange(200) * 0.5
    np.testing.assert_allclose(allan_deviation(ramp, 0.5, [0.5, 7.0, 50.0]), 0.3 * np.array([0.5, 7, 50]) / 2**0.5)
    for span in (0.1, 51.0):
        with pytest.raises(ValueError, match=r"`spans` must lie between dt = 0\.5 s and half the record, 50 s"):
            allan_deviation(ramp, 0.5, span)


def test_scale_misalignment_counts_and_limit_come_in_the_order_of_the_box():
    k, M = np.array([1e-3, -2e-3, 5e-4]), np.array([[0, 0.02, -0.01], [0.03, 0, 0.01], [0.005, -0.02, 0]])
    gyro = Gyro(scale=Vec3.of(k), misalignment=Mat3.of(M), lsb=1e-4, limit=0.5)
    bias, w, dt = np.array([0.01, -0.02, 0.005]), np.array([0.3, -0.9, 0.2]), 0.1
    _, y = gyro_read(gyro, GyroState(Vec3.of(bias), zeros()), Vec3.of(w * dt), dt, np.zeros(3), np.zeros(3))
    plain = (np.eye(3) + np.diag(k) + M) @ w + bias
    expected = np.clip(np.round(plain * dt / 1e-4) * 1e-4 / dt, -0.5, 0.5)
    np.testing.assert_allclose(array(y), expected, rtol=1e-12)
    assert expected[1] == -0.5 and abs(expected - plain)[0] > 1e-5
    drawn, y = gyro_read(
        Gyro(arw=0.1, rrw=0.2), STILL, Vec3.of(w * dt), dt, np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    )
    assert drawn.bias.y == pytest.approx(0.2 * dt**0.5)  # the mean of both biases, half of the new one, is read
    sigma = np.sqrt(0.01 / dt + 0.04 * dt / 12)
    np.testing.assert_allclose(array(y), w + np.array([sigma, 0.1 * dt**0.5, 0]), rtol=1e-12)


@pytest.mark.parametrize(
    "fault, gain, offset",
    [(dead(), 0, 0.0), (Fault(stuck=1.0), 0, 0.7), (Fault(bias=0.2), 1, 0.2), (Fault(scale=0.5), 0.5, 0)],
)
def test_a_gyro_fails_like_any_channel(fault, gain, offset):
    """Dead, stuck, biased or weak on one axis, from the onset on; the two others and the time before are healthy."""
    faults = on_axes(Fault())._replace(y=fault._replace(onset=5.0))
    _, y = gyro_read(Gyro(arw=0.01), STILL, Vec3(0.01, 0.02, 0.03), 0.1, np.ones(3), np.ones(3))
    for t in (4.9, 5.0):
        seen = read_triad(triad(faults, t, 0.0, np.zeros(3), Vec3(0.6, 0.7, 0.8)), y)
        expected = y._replace(y=gain * y.y + offset) if t == 5.0 else y
        np.testing.assert_allclose(array(seen), array(expected), rtol=1e-12)


def test_gradients_of_a_gyro_are_those_of_central_differences():
    rng = np.random.default_rng(1)
    white, walk, wander = rng.normal(size=(3,)), rng.normal(size=(3,)), rng.normal(size=(6,))

    def cost(p):
        gyro = Gyro(arw=p[0], rrw=p[1], wander=p[2], tau=p[3], scale=Vec3(p[4], 0.0, 0.0))
        state = GyroState(Vec3(p[5], 0.1, 0.2), Vec3(0.3, p[5], 0.1))
        y = zeros()
        for _ in range(2):
            state, y = gyro_read(gyro, state, Vec3(p[6], 0.2, 0.1), p[7], white, walk, wander)
        return y @ y + state.bias @ state.wander

    at = [[0.1, 0.2, 0.3, tau, 0.01, 0.4, 0.5, 0.5] for tau in (0.3, 20.0)]
    found, central = slopes(cost, at, [1e-6, 1e-6, 1e-6, 1e-5, 1e-6, 1e-6, 1e-6, 1e-6])
    np.testing.assert_allclose(found, central, rtol=1e-6, atol=1e-8)
    nothing = jax.jit(jax.grad(lambda p: array(gyro_read(Gyro(*p), STILL, zeros(), 0.1, white, walk, wander)[1]).sum()))
    ideal = tuple(jnp.float32(a) for a in (0, 0, 0, 1000))
    assert all(np.isfinite(g) for g in nothing(ideal))


def test_a_batch_of_gyros_is_that_of_each():
    rng = np.random.default_rng(2)
    arw, turn, noise = rng.uniform(size=4), rng.normal(size=(3, 4)), rng.normal(size=(12, 4))

    def one(arw, turn, noise):
        gyro = Gyro(arw=arw, rrw=0.1, wander=0.2, lsb=1e-3, limit=2.0)
        return gyro_read(gyro, STILL, Vec3.of(turn), 0.1, noise[:3], noise[3:6], noise[6:])

    together = jax.vmap(one, in_axes=-1, out_axes=-1)(arw, turn, noise)
    for i in range(4):
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(one(arw[i], turn[:, i], noise[:, i]))):
            np.testing.assert_allclose(a[i], b, rtol=1e-13)


# star trackers

TRACKER = StarTracker(Vec3(0.0, 1.0, 0.0), Vec3(0.0, 0.0, 1.0), 4e-5, 3e-4, np.deg2rad(1.5))  # boresight y, across z


def test_a_star_tracker_errs_about_its_own_axes():
    """Columns z, x, y; the sample against the truth is the small turn C e in body axes (SciPy's Rotation)."""
    C = np.array(jax.tree.leaves(star_axes(TRACKER))).reshape(3, 3)
    np.testing.assert_allclose(C, [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-15)
    q, e = np.array([0.5, -0.1, 0.7, 0.5]) / 1.0, np.array([1e-3, -2e-3, 5e-3])
    seen = star_read(TRACKER, Quat.of(q), zeros(), Vec3.of(e)).value
    ours = Rotation.from_quat(np.array(seen), scalar_first=True)
    expected = Rotation.from_quat(q, scalar_first=True) * Rotation.from_rotvec(C @ e)
    assert (expected.inv() * ours).magnitude() < 1e-14


def test_the_covariance_of_a_star_tracker_is_that_of_its_samples():
    skew = TRACKER._replace(boresight=Vec3(0.6, 0.0, 0.8), across=Vec3(0.0, 1.0, 0.0))
    C = np.array(jax.tree.leaves(star_axes(skew))).reshape(3, 3)
    np.testing.assert_allclose(C.T @ C, np.eye(3), atol=1e-15)
    R = np.array(jax.tree.leaves(star_covariance(skew))).reshape(3, 3)
    np.testing.assert_allclose(R, C @ np.diag([4e-5, 4e-5, 3e-4]) ** 2 @ C.T, rtol=1e-12, atol=1e-22)
    noise = jax.random.normal(jax.random.key(0), (3, 100_000), float)
    error = star_error(skew, on_axes(Fault()), 0.0, noise, zeros())
    turns = np.asarray(array(vector_from_quat(star_read(skew, Quat(1.0, 0.0, 0.0, 0.0), zeros(), error).value)))
    L = np.linalg.cholesky(np.linalg.inv(R)).T @ turns
    np.testing.assert_allclose(np.cov(L), np.eye(3), atol=4 * np.sqrt(2 / 100_000))


def test_a_star_tracker_gives_nothing_above_its_rate_limit():
    read = lambda rate: star_read(TRACKER, Quat(1.0, 0.0, 0.0, 0.0), Vec3(0.0, rate, 0.0), zeros()).valid
    assert read(np.deg2rad(1.49)) and not read(np.deg2rad(1.51)) and not read(-np.deg2rad(1.51))
    assert star_read(TRACKER._replace(rate_limit=np.inf), Quat(1.0, 0.0, 0.0, 0.0), Vec3(9.0, 0.0, 0.0), zeros()).valid


def test_faults_of_a_star_tracker_are_small_turns():
    """Bias, drift and stuck on one of its three axes; noise grown by the factor."""
    faults = Vec3(Fault(10.0, bias=0.02), Fault(10.0, drift=0.5, tau=50.0), Fault(10.0, stuck=1.0))
    last, normals = Vec3(0.1, 0.2, 0.3), np.array([1.0, -1.0, 2.0])
    before = star_error(TRACKER, faults, 9.9, normals, last)
    np.testing.assert_allclose(array(before), [4e-5, -4e-5, 6e-4], rtol=1e-12)
    after = star_error(TRACKER, faults, 15.0, normals, last)
    np.testing.assert_allclose(array(after), [0.02 + 4e-5, 0.5 * -np.expm1(-0.1) - 4e-5, 0.3], rtol=1e-12)
    grown = star_error(TRACKER, on_axes(Fault(growth=10.0)), 0.0, normals, last)
    np.testing.assert_allclose(array(grown), [4e-4, -4e-4, 6e-3], rtol=1e-12)


def test_a_frozen_box_repeats_itself_and_one_that_is_out_says_nothing():
    new, last = (
        Reading(Quat(1.0, 0.0, 0.0, 0.0), jnp.asarray(True)),
        Reading(Quat(0.0, 1.0, 0.0, 0.0), jnp.asarray(True)),
    )
    stuck, missing = Fault(2.0, 4.0, stuck=1.0), Fault(2.0, 4.0, missing=1.0)
    for box, values, valid in ((stuck, [1, 0, 0, 1], [1, 1, 1, 1]), (missing, [1, 1, 1, 1], [1, 0, 0, 1])):
        found = [interrupted(new, t, last, box) for t in (1.9, 2.0, 3.9, 4.0)]
        assert [float(r.value.w) for r in found] == values
        assert [bool(r.valid) for r in found] == valid
    untold = last._replace(valid=jnp.asarray(False))
    assert not interrupted(new, 2.0, untold, stuck).valid  # the last one again, as valid as it was


def test_stars_are_seen_away_from_the_sun():
    axis, at = Vec3(0.0, 1.0, 0.0), lambda a: Vec3(np.sin(a), np.cos(a), 0.0)
    assert not apart(at(0.5), axis, 0.6) and apart(at(0.7), axis, 0.6) and apart(at(-3.0), axis, 0.6)


@pytest.mark.parametrize(
    "tracker, message",
    [
        (TRACKER._replace(boresight=Vec3(0.0, 2.0, 0.0)), r"`\|tracker.boresight\|` must be 1, but it is 2"),
        (TRACKER._replace(across=Vec3(0.0, 0.6, 0.8)), "`tracker.across` must lie across the boresight"),
        (TRACKER._replace(roll=-1.0), "`tracker.roll` must not be negative"),
        (TRACKER._replace(rate_limit=0.0), "`tracker.rate_limit` must be greater than 0"),
    ],
)
def test_a_star_tracker_that_is_none_is_refused(tracker, message):
    fields.validate("tracker", TRACKER)
    with pytest.raises(ValueError, match=message):
        fields.validate("tracker", tracker)


def test_gradients_of_a_star_tracker_are_those_of_central_differences():
    def cost(p):
        tracker = TRACKER._replace(cross=p[0], roll=p[1])
        faults = Vec3(Fault(bias=p[2]), Fault(drift=p[3]), Fault(growth=p[4]))
        error = star_error(tracker, faults, 0.5, np.array([1.0, -2.0, 0.5]), zeros())
        q = star_read(tracker, quat_from_vector(Vec3(p[5], 0.2, 0.1)), zeros(), error).value
        return q @ Quat(1.0, 2.0, -1.0, 0.5)

    found, central = slopes(cost, [0.1, 0.2, 0.05, 0.3, 2.0, 0.4])
    np.testing.assert_allclose(found, central, rtol=1e-6, atol=1e-9)
    assert np.isfinite(jax.jit(jax.grad(cost))(jnp.zeros(6, jnp.float32))).all()


# directions


def test_a_direction_has_the_same_noise_on_all_three_components():
    noise = np.random.default_rng(0).normal(size=(3, 100_000))
    d = array(direction_read(Vec3(0.6, 0.0, 0.8), 1e-3, noise)) - np.array([[0.6], [0.0], [0.8]])
    np.testing.assert_allclose(np.cov(d) / 1e-6, np.eye(3), atol=4 * np.sqrt(2 / 100_000))


CELLS = np.array([[1, 1, 1], [1, 1, -1], [1, -1, 1], [1, -1, -1], [-1, 0, 1], [-1, 0, -1], [0, 1, 0]], float)
CELLS = (CELLS / np.linalg.norm(CELLS, axis=1, keepdims=True)).T
SIX = np.repeat(np.eye(3), 2, axis=0).T * np.tile([1, -1], 3)


def test_coarse_cells_see_the_sun_or_say_that_they_do_not():
    """Least squares of the cells above a tenth, against NumPy's; noise free it is the Sun itself."""
    rng = np.random.default_rng(3)
    valid = 0
    for noise in (0.0, 0.02):
        for _ in range(60):
            s = rng.normal(size=3)
            s /= np.linalg.norm(s)
            currents = cell_currents(Vec3.of(CELLS), Vec3.of(s), 1.0, noise * rng.normal(size=7))
            found = sun_from_cells(Vec3.of(CELLS), currents)
            seen = np.asarray(currents) > 0.1
            A = CELLS.T[seen]
            assert bool(found.valid) == (seen.sum() >= 3 and np.linalg.det(A.T @ A) > 1e-3)
            if found.valid:
                fit = np.linalg.lstsq(A, np.asarray(currents)[seen], rcond=None)[0]
                np.testing.assert_allclose(array(found.value), fit / np.linalg.norm(fit), atol=1e-12)
                assert noise > 0 or np.abs(fit - s).max() < 1e-12
                valid += 1
    assert 60 < valid < 120


def test_dark_cells_and_broken_ones_tell_nothing():
    dark = sun_from_cells(Vec3.of(CELLS), cell_currents(Vec3.of(CELLS), Vec3(1.0, 0.0, 0.0), 0.0, np.zeros(7)))
    assert not dark.valid and np.isfinite(array(dark.value)).all()
    currents = cell_currents(Vec3.of(CELLS), Vec3(1.0, 0.0, 0.0), 1.0, np.zeros(7)).at[6].set(jnp.nan)
    found = sun_from_cells(Vec3.of(CELLS), currents)
    assert found.valid
    np.testing.assert_allclose(array(found.value), [1, 0, 0], atol=1e-12)
    assert not sun_from_six(jnp.zeros(6)).valid and not sun_from_six(jnp.full(6, 0.9)).valid


def test_six_cells_see_the_sun_in_every_direction_along_an_axis_too():
    for s in (*np.eye(3), *-np.eye(3), np.array([2, -3, 6]) / 7):
        found = sun_from_six(cell_currents(Vec3.of(SIX), Vec3.of(s), 1.0, np.zeros(6)))
        assert found.valid
        np.testing.assert_allclose(array(found.value), s, atol=1e-15)
    half = sun_from_six(cell_currents(Vec3.of(SIX), Vec3(0.0, 0.0, 1.0), 0.5, np.zeros(6)))
    assert half.valid and half.value.z == 1


def test_gradients_of_sun_cells_are_those_of_central_differences_and_finite_in_the_dark():
    aim = Vec3(1.0, 2.0, -1.0)
    costs = [
        lambda p: (
            sun_from_cells(Vec3.of(CELLS), cell_currents(Vec3.of(CELLS), Vec3.of(p), 0.9, np.zeros(7))).value @ aim
        ),
        lambda p: sun_from_six(cell_currents(Vec3.of(SIX), Vec3.of(p), 0.9, np.zeros(6))).value @ aim,
    ]
    for cost in costs:
        found, central = slopes(cost, [0.8, 0.36, 0.48])
        np.testing.assert_allclose(found, central, rtol=1e-6, atol=1e-9)
        assert np.isfinite(jax.jit(jax.grad(cost))(jnp.zeros(3, jnp.float32))).all()


def test_a_batch_of_star_trackers_and_sun_cells_is_that_of_each():
    rng = np.random.default_rng(4)
    w, e, s = rng.normal(size=(3, 3, 5))
    s = s / np.linalg.norm(s, axis=0)

    def one(w, e, s):
        star = star_read(TRACKER, quat_from_vector(Vec3.of(s)), 0.02 * Vec3.of(w), Vec3.of(e))
        return star, sun_from_cells(Vec3.of(CELLS), cell_currents(Vec3.of(CELLS), Vec3.of(s), 1.0, np.zeros(7)))

    together = jax.vmap(one, in_axes=-1, out_axes=-1)(w, e, s)
    for i in range(5):
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(one(w[:, i], e[:, i], s[:, i]))):
            np.testing.assert_allclose(a[i], b, rtol=1e-12, atol=1e-14)
