"""The loop `star_isolation`: its filters against plain matrices, the reference's numbers, gradients, bad input."""

import jax

jax.config.update("jax_enable_x64", True)

import warnings  # noqa: E402
from functools import partial  # noqa: E402

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from made_up import left, repeated, right, tallied  # noqa: E402

import jaxatt  # noqa: E402
from jaxatt import Fault, Quat, Vec3, detection, scores, star_filters  # noqa: E402
from jaxatt.attitude import quat_to_body  # noqa: E402
from jaxatt.faults import Reading  # noqa: E402
from jaxatt.loops import star_isolation as star  # noqa: E402
from jaxatt.loops.star_isolation import ARCSEC, DEG, HEALTHY, PITCH, ROLL, params, scenario  # noqa: E402
from jaxatt.replay import replay  # noqa: E402
from jaxatt.vec import Mat3, array  # noqa: E402

KEY = jax.random.key(1)
TICKS = 3000
DT = star.DT
SIZE = 100 * ARCSEC
FILTERS = star_filters.LMMSE, star_filters.WITH_BIAS, star_filters.MEKF
healthy = scenario._replace(star=HEALTHY)


def with_fault(sensor, fault):
    return scenario._replace(star=star.on_sensor(sensor, star.tangential(sensor, fault)))


@jax.jit
def _run(one):
    log = jaxatt.simulate(star.system, params, one, KEY, ticks=TICKS)
    return log.verdict, log.readings, log.q


@pytest.fixture(scope="module")
def run():
    """Runs of the default loop with one seed, kept: (verdict, readings, q) by scenario."""
    kept = {}

    def of(one=healthy):
        name = str(jax.tree.leaves(one))
        if name not in kept:
            kept[name] = jax.tree.map(np.asarray, _run(jax.tree.map(lambda a: jnp.asarray(a, float), one)))
        return kept[name]

    return of


def test_the_spacecraft_starts_off_its_pointing_by_what_the_reference_says():
    q, w = scenario.q, scenario.w
    np.testing.assert_allclose(np.array(q[1:]) * 2 / DEG, [0.10, -0.08, 0.12], rtol=1e-5)
    relative = np.array(w) - in_body(np.array(q), [0, -scenario.orbit_rate, 0])
    np.testing.assert_allclose(relative / DEG, [2e-3, -1e-3, 1.5e-3], rtol=1e-9)
    assert scenario.torque == (2e-4, -1e-4, 1.5e-4)


# the filter in plain matrices


def in_body(q, v):
    """A(q) v: a vector of the orbit frame in body axes."""
    return (left(q * [1, -1, -1, -1]) @ right(q) @ [0, *v])[1:]


def skew(v):
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def plain_filter(s, gyro, readings):
    """Eqs. (11) to (16) as matrices: residuals, their covariances, gains, A and C; reading 0 is not used."""
    sg, ss, wo = params.std_gyro, params.std_star, params.orbit_rate
    B = [-DT / 2 * right(np.r_[0, e]) for e in np.eye(3)]
    C = np.column_stack([s, 2 * skew(s)])
    x, P = np.array([1.0, 0, 0, 0]), np.diag([1e-12, 1e-6, 1e-6, 1e-6])
    Q = P + np.outer(x, x)
    r, M, K, A = [], [], [], []
    for w, y in zip(gyro[:-1], readings[1:]):
        a = np.eye(4) + DT / 2 * (right(np.r_[0, w]) - left([0, 0, -wo, 0]))
        noise = sum(sg**2 * b @ Q @ b.T for b in B)
        P, Q = a @ P @ a.T + noise, a @ Q @ a.T + noise
        m = C @ P @ C.T + ss**2 * np.eye(3)
        k = P @ C.T @ np.linalg.inv(m)
        r.append(y - C @ a @ x)
        x, P = a @ x + k @ r[-1], P - k @ m @ k.T
        M.append(m)
        K.append(k)
        A.append(a)
    return np.array(r), np.array(M), np.array(K), np.array(A), C


def rows(v):
    """A Vec3 of (T, ...) as (T, ..., 3)."""
    return np.stack([np.asarray(a) for a in v], axis=-1)


@pytest.mark.parametrize("own", [ROLL, PITCH])
def test_the_filter_is_that_of_plain_matrices(run, own):
    verdict, readings, _ = run()
    r, M, *_ = plain_filter(np.eye(3)[own], rows(readings.gyro.value), rows(readings.stars.value)[:, own])
    np.testing.assert_allclose(rows(verdict.innovation.value)[1:, own], r, atol=1e-14)
    nis = np.einsum("ti,tij,tj->t", r, np.linalg.inv(M), r)
    np.testing.assert_allclose(verdict.innovation.nis[1:, own], nis, atol=1e-9)
    np.testing.assert_allclose(verdict.innovation.covariance.y.z[1:, own], M[:, 1, 2], atol=1e-14)
    nll = 0.5 * (nis + np.linalg.slogdet(M)[1] + 3 * np.log(2 * np.pi))
    np.testing.assert_allclose(verdict.innovation.nll[1:, own], nll, atol=1e-9)


@pytest.mark.parametrize("own", [ROLL, PITCH])
def test_a_fault_answers_as_the_linear_error_equations_say(run, own):
    fault = Fault(onset=100.0, bias=SIZE)
    (faulty, _, _), (well, readings, _) = run(with_fault(own, fault)), run()
    difference = rows(faulty.innovation.value)[1:, own] - rows(well.innovation.value)[1:, own]
    _, _, K, A, C = plain_filter(np.eye(3)[own], rows(readings.gyro.value), rows(readings.stars.value)[:, own])
    f = SIZE * (1 - np.eye(3)[own])
    x, response = np.zeros(4), []
    for k in range(TICKS - 1):
        response.append(C @ A[k] @ x + f * (k >= 999))  # eq. (14) with A(k-1)
        x = A[k] @ x - K[k] @ response[-1]  # eq. (16)
    np.testing.assert_allclose(difference, response, atol=1e-12 * SIZE / ARCSEC / 100)


def test_the_steady_state_satisfies_17(run):
    _, readings, _ = run()
    *_, K, _, C = plain_filter(np.eye(3)[ROLL], rows(readings.gyro.value), rows(readings.stars.value)[:, ROLL])
    K, f = K[-1], SIZE * np.array([0.0, 1, 1])
    w = [0, 0, -params.orbit_rate, 0]
    A = np.eye(4) + DT / 2 * (right(w) - left(w))
    F = (np.eye(4) - K @ C) @ A
    assert np.abs(np.linalg.eigvals(F)).max() < 1 and np.abs(np.linalg.eigvals(A)).max() > 1 - 1e-12  # erratum 2
    x = -np.linalg.solve(np.eye(4) - F, K @ f)
    assert np.abs((np.eye(4) - A) @ x + K @ (C @ A @ x + f)).max() < 1e-12  # eq. (17)
    settled = np.zeros(4)
    for _ in range(200_000):
        settled = F @ settled - K @ f
    np.testing.assert_allclose(settled, x, atol=1e-12)


# the reference's numbers


def test_time_constants(run):
    expected = {(ROLL, 1): 12.28, (ROLL, 2): 16.15, (PITCH, 0): 16.03, (PITCH, 2): 16.25}
    t = DT * np.arange(101)
    for (own, axis), seconds in expected.items():
        faulty = rows(run(with_fault(own, Fault(onset=100.0, bias=SIZE)))[0].innovation.value)
        r = (faulty - rows(run()[0].innovation.value))[1000:1101, own, axis] / SIZE
        assert r[0] == pytest.approx(1, abs=1e-12)
        assert -1 / np.polyfit(t, np.log(r), 1)[0] == pytest.approx(seconds, rel=0.02)


@pytest.mark.parametrize("tau, z, y", [(10.0, 0.4602, 0.4126), (50.0, 0.1890, 0.1549), (200.0, 0.0650, 0.0492)])
def test_peaks_of_incipient_faults(run, tau, z, y):
    faulty = rows(run(with_fault(ROLL, Fault(onset=100.0, drift=SIZE, tau=tau)))[0].innovation.value)
    r = (faulty - rows(run()[0].innovation.value))[:, ROLL].max(axis=0) / SIZE
    assert r[2] == pytest.approx(z, rel=0.02) and r[1] == pytest.approx(y, rel=0.02)


@pytest.mark.parametrize("own", [ROLL, PITCH])
@pytest.mark.parametrize("fault", [Fault(onset=100.0, bias=SIZE), Fault(onset=100.0, drift=6 * SIZE, tau=50.0)])
def test_figures_2_to_5(run, own, fault):
    verdict, _, _ = run(with_fault(own, fault))
    assert verdict.alarm[1000:, own].any() and not verdict.alarm[:, 1 - own].any()
    assert verdict.latched_cause[-1] == own + 1
    if fault.bias:
        assert verdict.alarm[1000, own] and not verdict.alarm[999, own]
    if own == ROLL and fault.bias:
        assert not verdict.alarm[-1, own] and verdict.latched[-1, own]  # the alarm ends by itself: latch


def test_an_actuator_fault_raises_no_alarm(run):
    bad = Vec3(Fault(onset=100.0, bias=0.01), Fault(), Fault(onset=100.0, scale=0.5))
    verdict, _, q = run(healthy._replace(actuator=bad))
    assert not verdict.alarm.any()
    assert 2 * np.abs(np.asarray(q.x[-1])) > 2e-3  # while it does move the satellite


def test_a_gyro_fault_raises_both_alarms_and_no_angle_alarm(run):
    verdict, _, _ = run(healthy._replace(gyro=Vec3(*[Fault(onset=100.0, bias=3e-5)] * 3)))
    assert verdict.latched_cause[-1] == 3 and not verdict.angle_alarm.any()


def test_a_star_fault_towards_the_other_star_opens_the_angle(run):
    axis = Vec3(Fault(), Fault(onset=100.0, bias=SIZE), Fault())
    verdict, _, _ = run(scenario._replace(star=star.on_sensor(ROLL, axis)))
    assert verdict.angle_alarm[1000:].mean() > 0.9 and not verdict.angle_alarm[:1000].any()


def swept(one, n, p=params):
    """Scores of n runs whose initial estimates err as the prior says."""
    errors = params.std_qv * np.random.default_rng(0).standard_normal((3, 2, n)).T  # (n, 2, 3)
    guess = Quat(one.q.w + np.zeros((n, 2)), *(a + errors[..., i] for i, a in enumerate(one.q.v)))
    many = repeated(one, n)._replace(q_hat=guess)
    return jaxatt.sweep(star.system, p, many, jax.random.key(5), ticks=TICKS, score=both, progress=False)


def both(p, s, now, log):
    return star.score(p, s, now, log), scores.mean(log.verdict.innovation.nis, now.t >= 100)


@pytest.mark.slow
def test_monte_carlo_is_consistent():
    n = 600
    out, _ = swept(healthy, n, params._replace(threshold=10.35))
    np.testing.assert_allclose(out.nis.mean(axis=0), 3, atol=0.01)
    np.testing.assert_allclose(out.nees.mean(axis=0), 3, atol=1.96 * np.sqrt(6 / n))
    assert out.false_alarms.mean() == pytest.approx(1.58e-2, rel=0.05)
    assert out.ok.all()


@pytest.mark.slow
def test_unit_vectors_leave_two_degrees_of_freedom():
    out, _ = swept(healthy, 600, params._replace(unit=1.0))
    np.testing.assert_allclose(out.nis.mean(axis=0), 2, atol=0.01)


@pytest.mark.parametrize("degrees, nis", [(1.0, 3.73), (2.0, 14.7)])
@pytest.mark.filterwarnings("ignore:.*deg from the orbit frame")
def test_pointing_off_raises_the_residual(degrees, nis):
    q = Quat(np.cos(degrees * DEG / 2), *[np.sin(degrees * DEG / 2) / np.sqrt(3)] * 3)
    w = quat_to_body(q, star_filters.orbit_rate(scenario.orbit_rate))
    out, _ = swept(healthy._replace(q=q, w=Vec3(*(float(a) for a in w))), 128, params._replace(q_d=q))
    assert out.nis[:, ROLL].mean() == pytest.approx(nis, rel=0.05)


def test_a_gyro_bias_raises_both_residuals():
    bias = DEG / 3600 / np.sqrt(3)
    _, settled = swept(healthy._replace(bias=Vec3(bias, bias, bias)), 128)
    np.testing.assert_allclose(settled.mean(axis=0), [3.9, 4.8], rtol=0.05)


# the other filters


@partial(jax.jit, static_argnums=0)
def replayed(number, readings, p):
    """What the computer knows and concludes with one of `FILTERS` on recorded readings, time first."""
    computer = star.init(FILTERS[number], 1, p, healthy)[1].computer
    return replay(partial(star.decide, star_filter=FILTERS[number]), p, computer, readings, dt=DT)


def innovations(number, readings, p=params):
    """Of both filters; the first tick uses no reading."""
    return jax.tree.map(lambda a: a[1:], replayed(number, readings, p)[1].innovation)


@pytest.mark.slow
def test_replay_is_the_run(run):
    verdict, readings, _ = run()
    again = innovations(0, readings)
    np.testing.assert_allclose(again.nis, verdict.innovation.nis[1:], atol=1e-11)


@pytest.mark.parametrize("number", [1, 2])
def test_the_other_filters_are_consistent(run, number):
    _, readings, _ = run()
    nis = np.asarray(innovations(number, readings).nis)
    np.testing.assert_allclose(nis.mean(axis=0), 3, atol=4 * np.sqrt(6 / TICKS))


@pytest.mark.slow
def test_seven_states_without_a_bias_are_the_four(run):
    _, readings, _ = run()
    tiny = params._replace(std_bias=1e-14)
    seven, four = innovations(1, readings, tiny), innovations(0, readings)
    # not equal: seven states weigh the gyro's noise at P + x x', four at the second moment's own recursion
    np.testing.assert_allclose(rows(seven.value), rows(four.value), atol=1e-3 * params.std_star)


def test_the_plant_is_eulers_equation_with_gravity_gradient():
    rng = np.random.default_rng(5)
    q, w = rng.normal(size=4), 1e-2 * rng.normal(size=3)
    q /= np.linalg.norm(q)
    J, rate = np.diag([900.0, 1100.0, 700.0]), 0.02  # [rad/s], so fast that the gradient counts
    J[0, 1] = J[1, 0] = 50.0
    wheels, outside = rng.normal(size=(2, 3))
    day = scenario._replace(q=Quat(*q), w=Vec3(*w), J=Mat3.of(J), orbit_rate=rate, torque=Vec3(*outside))
    x, z = star.system.init(params, day)
    moved = star.system.flow(params, day, 0.0, x, z._replace(torque=Vec3(*wheels)))
    down = in_body(q, [0, 0, 1])
    torque = wheels + outside + 3 * rate**2 * np.cross(down, J @ down) - np.cross(w, J @ w)
    np.testing.assert_allclose(moved.w, np.linalg.solve(J, torque), rtol=1e-9)
    np.testing.assert_allclose(moved.q, 0.5 * (right(np.r_[0, w]) - left([0, 0, -rate, 0])) @ q, rtol=1e-12)  # eq. (2)


@pytest.mark.parametrize("star_filter", FILTERS)
def test_feedback_from_a_filter_is_ideal_feedback_at_what_it_believes(star_filter):
    rng = np.random.default_rng(6)
    computer, y = believing(star_filter)
    x = rng.normal(size=(7, 2))
    if star_filter is star_filters.WITH_BIAS:
        filters = computer.filters._replace(mean=star_filters.AttitudeBias(*x))
    else:  # unit quaternions, no bias
        x = np.concatenate([x[:4] / np.linalg.norm(x[:4], axis=0), np.zeros((3, 2))])
        filters = computer.filters._replace(mean=Quat(*x[:4]))
    computer = computer._replace(filters=filters, gyro=Vec3(*rng.normal(size=3)))
    for i in (ROLL, PITCH):
        q = x[:4, i] / np.linalg.norm(x[:4, i])
        believed = y._replace(q=Quat(*q), w=computer.gyro - Vec3(*x[4:, i]))
        got, expected = (
            star.command(star_filter, params._replace(feedback=feedback, u_max=np.inf), computer, readings)
            for feedback, readings in ((i + 1, y), (0, believed))
        )
        np.testing.assert_allclose(got, expected, rtol=1e-12)


@pytest.mark.parametrize("star_filter", FILTERS)
def test_near_the_truth_every_filter_means_the_same_by_an_error(star_filter):
    near = np.r_[1, 1e-6 * np.random.default_rng(6).normal(size=3)]
    prior = jax.tree.map(lambda a: a[0], believing(star_filter)[0].filters)
    mean = star_filters.AttitudeBias(*near, *np.zeros(3)) if star_filter is star_filters.WITH_BIAS else Quat(*near)
    error, std, nees, _ = star_filter.error(prior._replace(mean=mean), Quat(1.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(error, 2 * near[1:], rtol=1e-9)
    np.testing.assert_allclose(std, 2 * params.std_qv)
    np.testing.assert_allclose(nees, np.sum(near[1:] ** 2) / params.std_qv**2, rtol=1e-9)


def believing(star_filter):
    """The computer at the start, and readings."""
    _, z = star.init(star_filter, 1, params, scenario)
    return z.computer, z.sensors.readings


def test_the_torque_is_pd_about_the_target_in_the_orbit_frame():
    rng = np.random.default_rng(7)
    q, target, w = rng.normal(size=4), rng.normal(size=4), rng.normal(size=3)
    q, target = q / np.linalg.norm(q), target / np.linalg.norm(target)
    p = params._replace(q_d=Quat(*target), orbit_rate=0.2, bandwidth=0.3, damping=0.7, u_max=np.inf)
    computer, y = believing(star_filters.LMMSE)
    readings = y._replace(q=Quat(*q), w=Vec3(*w))
    J = array(p.J)
    e = left(target * [1, -1, -1, -1]) @ q
    orbit = in_body(q, [0, -0.2, 0])
    u = np.cross(w, J @ w) - J @ (2 * 0.3**2 * np.sign(e[0]) * e[1:] + 2 * 0.7 * 0.3 * (w - orbit))
    np.testing.assert_allclose(star.command(star_filters.LMMSE, p, computer, readings), u, rtol=1e-12)
    limited = star.command(star_filters.LMMSE, p._replace(u_max=1.0), computer, readings)
    np.testing.assert_allclose(limited, np.clip(u, -1, 1), rtol=1e-12)


# structure


def test_every_reading_has_noise_of_its_own():
    bias = np.array([0.1, -0.2, 0.3])
    s = healthy._replace(std_gyro=1e-3, std_star=1e-3, walk=1e-3, bias=Vec3(*bias))
    x, z = star.init(star_filters.LMMSE, 1, params, s)
    read = lambda noise: star.sense(params, s, jaxatt.Now(0, 0.0, DT), x, z, jnp.asarray(noise))
    loud, quiet = read(np.arange(1.0, 13.0)), read(np.zeros(12))
    q = np.array(s.q)
    for star_, shown in zip(np.eye(3), rows(quiet.readings.stars.value)):  # eq. (6)
        np.testing.assert_allclose(shown, in_body(q, star_), atol=1e-12)
    np.testing.assert_allclose(rows(quiet.readings.gyro.value), np.array(s.w) + bias, rtol=1e-12)  # eq. (4)
    np.testing.assert_allclose(rows(quiet.bias), bias, rtol=1e-12)
    off = jax.tree.map(lambda a, b: np.asarray(a, float) - np.asarray(b, float), loud, quiet)
    np.testing.assert_allclose(rows(off.readings.gyro.value), [1e-3, 2e-3, 3e-3], rtol=1e-9)
    np.testing.assert_allclose(rows(off.bias), 1e-3 * DT**0.5 * np.array([4.0, 5.0, 6.0]), rtol=1e-9)
    np.testing.assert_allclose(
        rows(off.readings.stars.value), 1e-3 * np.array([[7.0, 9.0, 11.0], [8.0, 10.0, 12.0]]), rtol=1e-9
    )


@pytest.mark.slow
def test_a_window_on_board_is_that_of_detection():
    log = jaxatt.simulate(
        star.system_of(window=10), params, with_fault(PITCH, Fault(onset=2.0, bias=SIZE)), KEY, ticks=40
    )
    np.testing.assert_allclose(log.verdict.J, detection.windowed(log.verdict.innovation.nis, 10), rtol=1e-12)


# missing readings


@pytest.mark.parametrize("number", range(3))
def test_missing_readings_leave_predictions_and_latch_no_alarm(run, number):
    """A star missing for 5 s and a gyro for 1 s: the filter predicts, stays finite and silent, and recovers."""
    readings = jax.tree.map(np.array, run()[1])
    for axis in readings.stars.value:
        axis[100:150, PITCH] = np.nan
    readings.gyro.value.y[200:210] = np.nan
    computers, verdicts = replayed(number, readings, params)
    used = np.ones((TICKS, 2), bool)
    used[0], used[100:150, PITCH] = False, False
    assert np.all(np.asarray(verdicts.innovation.rows) == 3 * used)
    assert np.all(np.asarray(verdicts.innovation.nis)[~used] == 0)
    assert not np.asarray(verdicts.latched).any() and not np.asarray(verdicts.angle_alarm).any()
    told = readings._replace(
        gyro=Reading(readings.gyro.value, np.isfinite(readings.gyro.value.y)),
        stars=Reading(readings.stars.value, np.isfinite(readings.stars.value.x)),
    )
    for axis in (*told.gyro.value, *told.stars.value):
        axis[~np.isfinite(axis)] = 7.0
    for a, b in zip(jax.tree.leaves((computers, verdicts)), jax.tree.leaves(replayed(number, told, params))):
        np.testing.assert_array_equal(a, b)  # said to be missing, or NaN: the same
    spread = np.asarray(computers.filters.cov[1][1])[:, PITCH]
    assert np.all(np.diff(spread[99:150]) > 0) and spread[150] < spread[149]
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(computers))


def test_what_is_missing_feeds_no_window_and_brings_no_verdict():
    """Tick by tick: the window of two holds the last two stars; one filter alone blames nobody."""
    star_filter, p = star_filters.LMMSE, params._replace(threshold=20.0)
    _, z = star.init(star_filter, 2, p, healthy)
    law = jax.jit(partial(star.decide, star_filter=star_filter))
    here, off = rows(Vec3(*(np.asarray(a, float) for a in healthy.stars))).T, np.array([0.0, 1.0, 1.0]) * 1e-2
    computer, kept = z.computer, [np.zeros(2), np.zeros(2)]
    # (stars there, star readings off): a gyro fault while the pitch star is out; both back; none; the first again
    days = [((1, 1), 0), ((1, 1), 0), ((1, 0), 1), ((0, 0), 1), ((1, 1), 0), ((1, 1), 1)]
    for k, (there, wrong) in enumerate(days):
        value = here + wrong * off[:, None] * [1, 0]
        told = z.sensors.readings._replace(stars=Reading(Vec3(*value), np.array(there, bool)))
        computer, verdict = law(p, jaxatt.Now(k, k * DT, DT), computer, told)
        used = np.array(there, bool) & (k > 0)
        for own in np.flatnonzero(used):
            for age in (0, 1):
                kept[age][own] = kept[age + 1][own] if age == 0 else verdict.innovation.nis[own]
        np.testing.assert_allclose(computer.recent, kept, rtol=1e-12)
        np.testing.assert_allclose(verdict.J, np.sum(kept, axis=0), rtol=1e-12)
        assert not np.asarray(verdict.alarm)[~used].any()
        assert used.all() or (verdict.cause == 0 and verdict.latched_cause == 0)
        if k == 2:
            assert verdict.alarm.tolist() == [True, False] and verdict.latched.tolist() == [True, False]
    assert verdict.latched_cause == 1 and verdict.angle_alarm == (verdict.angle > p.angle_threshold)


def test_gradients_pass_what_is_missing():
    _, z = star.init(star_filters.LMMSE, 1, params, healthy)

    def cost(p, hole):
        gone = lambda reading, there: Reading(jax.tree.map(lambda a: a * hole, reading.value), there)
        y = z.sensors.readings
        y = y._replace(gyro=gone(y.gyro, False), stars=gone(y.stars, jnp.zeros(2, bool)))
        computer, verdict = star.decide(p, jaxatt.Now(jnp.asarray(1), 0.1, DT), z.computer, y)
        return sum(jnp.sum(a) for a in jax.tree.leaves((computer.filters, computer.gyro, verdict.J, verdict.angle)))

    slopes = jax.jit(jax.grad(cost))(jax.tree.map(lambda a: jnp.asarray(a, float), params), np.nan)
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(slopes))


# gradients


@pytest.mark.slow
def test_the_likelihood_has_the_gradient_of_central_differences(run):
    readings = jax.tree.map(lambda a: a[:400], run()[1])

    @jax.jit
    def cost(theta):
        p = params._replace(std_gyro=3e-6 * jnp.exp(theta[0]), std_star=params.std_star * jnp.exp(theta[1]))
        return jnp.mean(innovations(0, readings, p).nll)

    at = jnp.array([0.3, -0.2])
    reverse, forward = jax.jit(jax.grad(cost))(at), jax.jit(jax.jacfwd(cost))(at)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    for i, h in enumerate(1e-3 * jnp.eye(2)):
        near, far = cost(at + h) - cost(at - h), cost(at + 2 * h) - cost(at - 2 * h)
        assert reverse[i] == pytest.approx(float(8 * near - far) / (12 * 1e-3), rel=1e-6)


# bad input


def simulate(p=params, s=scenario):
    return jaxatt.simulate(star.system, p, s, KEY, ticks=2)


@pytest.mark.parametrize(
    "p, s, words",
    [
        ({}, {"q": Quat(1.0, 0.1, 0.0, 0.0)}, "`|scenario.q|` must be 1, but it is 1.00499"),
        ({"q_d": Quat(2.0, 0.0, 0.0, 0.0)}, {}, "`|params.q_d|` must be 1, but it is 2"),
        ({"stars": Vec3(np.ones(2), np.zeros(2), np.zeros(2))}, {}, "`params.stars` must lie in directions at least"),
        ({"stars": Vec3(np.ones(2), np.ones(2), np.zeros(2))}, {}, "`|params.stars|[0]` must be 1, but it is 1.41421"),
        ({"std_gyro": -1e-6}, {}, "`params.std_gyro` must be a positive number, but it is -1e-06"),
        ({"std_star": 0.0}, {}, "`params.std_star` must be a positive number, but it is 0"),
        ({}, {"std_star": -1.0}, "`scenario.std_star` must not be negative, but it is -1"),
        ({"law": 4.0}, {}, "`params.law` must be one of"),
        ({"feedback": 5.0}, {}, "`params.feedback` must be one of"),
        ({}, {"gyro": jaxatt.on_axes(Fault(tau=0.0))}, "`scenario.gyro.x.tau` must be a positive number"),
    ],
)
def test_bad_input_is_refused_by_name(p, s, words):
    with pytest.raises(ValueError) as refused:
        simulate(params._replace(**p), scenario._replace(**s))
    assert words in str(refused.value)


@pytest.mark.parametrize("dt", [0.0, -0.1, np.nan])
def test_a_step_must_be_positive(dt):
    with pytest.raises(ValueError, match="`dt` must be a positive number"):
        star.system_of(dt=dt)
    with pytest.raises(ValueError, match="`window` must be a whole number"):
        star.system_of(window=0)


@pytest.mark.parametrize("axis", np.eye(3))
def test_pointing_beyond_the_linear_range_warns_with_the_number(axis):
    off = Quat(np.cos(0.6 * DEG), *(np.sin(0.6 * DEG) * axis))
    with pytest.warns(UserWarning, match=r"`scenario.q` lies 1.2 deg from the orbit frame, beyond the 0.5 deg"):
        star.system.check(params, scenario._replace(q=off))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        star.system.check(params, scenario)
        star.system_of(star_filters.MEKF).check(params, scenario._replace(q=off))


def test_scores_are_those_of_a_made_up_log():
    rng, dt, onset = np.random.default_rng(7), 0.5, 1.9
    vectors = lambda *shape: Vec3(*rng.normal(size=(3, *shape)))
    alarm = np.array([[1, 0, 1, 0, 0, 1, 0, 1, 0], [0, 1, 0, 0, 0, 0, 1, 0, 1]], bool).T
    angle_alarm = np.array([1, 1, 0, 0, 0, 0, 0, 1, 1], bool)
    J, nis, nees = rng.random((3, 9, 2))
    innovation = star_filters.Innovation(**{name: nis for name in star_filters.Innovation._fields})
    innovation = innovation._replace(rows=3.0 * (np.arange(9) > 0)[:, None] * np.ones(2))
    verdict = star.Verdict(innovation, J, alarm, alarm, np.zeros(9), np.arange(9) // 3, J[:, 0], angle_alarm)
    q = Quat(*rng.normal(size=(4, 9)))
    log = star.Log(
        dt * np.arange(9),
        q,
        vectors(9),
        vectors(9),
        verdict,
        vectors(9, 2),
        vectors(9, 2),
        nees,
        nees,
        vectors(9, 2),
        None,  # pyright: ignore[reportArgumentType]
        None,  # pyright: ignore[reportArgumentType]
    )
    day = scenario._replace(star=star.on_sensor(PITCH, star.tangential(PITCH, Fault(onset=onset, end=3.3, bias=1.0))))
    got = tallied(star.score, params, day, log, dt)
    t = dt * np.arange(9)
    after, faulty = t >= onset, (t >= onset) & (t < 3.3)
    rms = lambda a: np.sqrt(np.mean(np.square(a), axis=0))
    found = {
        "delay": [2.5 - onset, 3.0 - onset], "alarm_end": [3.5 - onset, np.inf], "angle_delay": 3.5 - onset,
        "false_alarms": alarm[~after & (t > 0)].mean(axis=0), "miss": (~alarm[faulty]).mean(axis=0), "peak": J[after].max(axis=0),
        "nis": nis[1:].mean(axis=0), "nees": nees[-1], "error": np.sqrt(np.sum(rms(np.stack(log.error).transpose(1, 0, 2)) ** 2, axis=0)),
        "pointing": 2 * np.sqrt(np.mean(np.sum(np.square(q[1:]), axis=0))), "peak_u": np.linalg.norm(np.stack(log.u), axis=0).max(),
        "verdict": 2, "ok": True,
    }  # fmt: skip
    for name in star.Scores._fields:
        np.testing.assert_allclose(getattr(got, name), found[name], rtol=1e-12, err_msg=name)


def test_equal_arguments_give_one_system():
    assert star.system_of() is star.system_of(star_filters.LMMSE, window=1, dt=star.DT) is star.system
    assert star.system_of(star_filters.MEKF) is not star.system
