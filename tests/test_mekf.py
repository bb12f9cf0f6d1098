"""The multiplicative filter against plain NumPy, exact noise against Van Loan, late samples, resets, consistency."""

from functools import cache, partial
from math import pi
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaxatt import mekf
from jaxatt.attitude import (
    left_jacobian,
    quat_angle,
    quat_conjugate,
    quat_from_vector,
    quat_normalised,
    quat_to_body,
    vector_from_quat,
)
from jaxatt.engine import alone
from jaxatt.faults import Reading
from jaxatt.vec import Mat3, Quat, Vec3, array, scaled_identity, where, zeros

ARW, RRW, DT = 2e-3, 3e-4, 0.5  # coarse, so that every term counts
AXES = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
VARIANCE = np.array([1e-2, 2e-2, 5e-2]) ** 2


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def rotation(q):
    """A `Quat` as SciPy's rotation."""
    return Rotation.from_quat(np.array(q), scalar_first=True)


def noise_of(step):
    """Q of turn and bias."""
    return np.block([[array(step.aa), array(step.ab)], [array(step.ab).T, array(step.bb)]])


def random_covariance(n, seed=0):
    L = np.random.default_rng(seed).normal(size=(n, n)) * np.repeat([0.1, 0.01, 0.1], 3)[:n, None]
    return L @ L.T


BELIEF = mekf.Mekf(quat_normalised(Quat(0.9, 0.1, -0.3, 0.2)), Vec3(1e-3, -2e-3, 3e-3), random_covariance(6))


# the step


def van_loan(w, dt):
    """Phi and Q of turn and bias by one exponential of twice the size."""
    F, G = np.zeros((6, 6)), np.diag([ARW**2] * 3 + [RRW**2] * 3)
    F[:3, :3], F[:3, 3:] = -skew(w), -np.eye(3)
    M = expm(np.block([[-F, G], [np.zeros((6, 6)), F.T]]) * dt)
    Phi = M[6:, 6:].T
    return Phi, Phi @ M[:6, 6:]


@jax.jit
def traced_step(w, dt):
    """The step at the rate w (3,)."""
    return mekf.farrenkopf(Vec3(*w), dt, ARW, RRW)


def step_of(w, dt=DT):
    return jax.tree.map(np.asarray, traced_step(np.asarray(w, float), dt))


@pytest.fixture(scope="module")
def steps():
    """Steps at rates from none to seven radians a step, and the series' edge."""
    x = np.array([0, 1e-9, 1e-4, 1e-2, 0.02, 0.3, 0.49999, 0.50001, 0.7, 1, 2, 3, pi, 4, 5, 6, 2 * pi, 7])
    n = np.random.default_rng(3).normal(size=(len(x), 3))
    w = x[:, None] / DT * n / np.linalg.norm(n, axis=1, keepdims=True)
    return w, [step_of(one) for one in w]


def test_the_step_is_the_matrix_exponential_and_van_loan_s_integral(steps):
    scale = np.diag([1 / (ARW * DT**0.5)] * 3 + [1 / (RRW * DT**0.5)] * 3)
    for w, step in zip(*steps):
        Phi, Q = van_loan(w, DT)
        np.testing.assert_allclose(np.hstack([array(step.turn), array(step.drift)]), Phi[:3], atol=1e-12)
        got = noise_of(step)
        np.testing.assert_allclose(scale @ got @ scale, scale @ Q @ scale, atol=1e-12)


def test_a_step_at_rest_is_farrenkopf_s(steps):
    step = steps[1][0]
    eye = np.eye(3)
    np.testing.assert_allclose(array(step.aa), (ARW**2 * DT + RRW**2 * DT**3 / 3) * eye, rtol=1e-15)
    np.testing.assert_allclose(array(step.ab), -(RRW**2) * DT**2 / 2 * eye, rtol=1e-15)
    np.testing.assert_allclose(array(step.bb), RRW**2 * DT * eye, rtol=1e-15)


def test_two_half_steps_are_one_step():
    half, full = (step_of([0.3, -1.2, 0.8], dt) for dt in (DT / 2, DT))
    matrix = lambda s: np.block([[array(s.turn), array(s.drift)], [np.zeros((3, 3)), np.eye(3)]])
    np.testing.assert_allclose(matrix(half) @ matrix(half), matrix(full), atol=1e-14)
    np.testing.assert_allclose(
        matrix(half) @ noise_of(half) @ matrix(half).T + noise_of(half), noise_of(full), atol=1e-17
    )


def test_the_transition_is_the_derivative_of_the_error_it_moves():
    """Signs: errors of truth and filter through the true kinematics, by central differences."""
    q, b, rate, h = (
        Rotation.from_rotvec([1.0, -0.7, 0.4]),
        np.array([0.1, -0.2, 0.05]),
        np.array([0.4, 0.3, -0.6]),
        1e-5,
    )
    believed = q * Rotation.from_rotvec((rate - b) * DT)

    def error(e):
        true = q * Rotation.from_rotvec(e[:3]) * Rotation.from_rotvec((rate - b - e[3:]) * DT)
        return (believed.inv() * true).as_rotvec()

    numeric = np.stack([(error(h * e) - error(-h * e)) / (2 * h) for e in np.eye(6)], axis=1)
    step = step_of(rate - b)
    np.testing.assert_allclose(np.hstack([array(step.turn), array(step.drift)]), numeric, atol=1e-9)


def test_the_steady_state_is_farrenkopf_s():
    """A gyro of .15 deg/sqrt(h) and .3 deg/h/sqrt(h) with an attitude every T: his closed form, and the Riccati equation.

    8, 60 and 360 arc seconds about the three axes, every .25 s and every second.
    """
    arw, rrw, arcsec = 0.15 * pi / 180 / 60, 0.3 * pi / 180 / 3600 / 60, pi / 180 / 3600
    stds = np.array([8.0, 60.0, 360.0]) * arcsec

    @jax.jit
    def run(T, belief):
        def tick(beliefs, _):
            prior = mekf.predict(beliefs[1], zeros(), T, arw, rrw)
            reading = Reading(prior.q, True)
            return (prior, mekf.update_attitude(prior, reading, scaled_identity(), Vec3(*stds**2))[0]), None

        before, after = jax.lax.scan(tick, (belief, belief), None, length=60_000)[0]
        return before.P, after.P

    printed = {(0, 0.25): (6.895, 5.223, 0.2122), (1, 0.25): (16.759, 16.141, 0.2123), (2, 1.0): (57.91, 57.18, 0.2144)}
    for T in (0.25, 1.0):
        before, after = (np.asarray(P) for P in run(T, mekf.start(Quat(1.0, 0.0, 0.0, 0.0), zeros(), 1e-4, 1e-6)))
        for i, s in enumerate(stds):
            u, v = rrw * T**1.5 / s, arw * T**0.5 / s
            g = np.sqrt(4 + v * v + u * u / 12)
            z = g / 2 + u / 4 + 0.5 * np.sqrt(g * u + v * v + u * u / 3)
            assert np.sqrt(before[i, i]) == pytest.approx(s * np.sqrt(z * z - 1), rel=1e-6)
            assert np.sqrt(after[i, i]) == pytest.approx(s * np.sqrt(1 - 1 / z**2), rel=1e-6)
            Phi = np.array([[1, -T], [0, 1]])
            Q = np.array([[arw**2 * T + rrw**2 * T**3 / 3, -(rrw**2) * T**2 / 2], [-(rrw**2) * T**2 / 2, rrw**2 * T]])
            unit = np.diag([s, 1e-6])  # in units of order one
            inv = np.linalg.inv(unit)
            P = unit @ solve_discrete_are((inv @ Phi @ unit).T, np.array([[1.0], [0.0]]), inv @ Q @ inv, 1.0) @ unit
            np.testing.assert_allclose(before[np.ix_([i, i + 3], [i, i + 3])], P, rtol=1e-6)
            if (i, T) in printed:
                found = np.sqrt([before[i, i], after[i, i], before[i + 3, i + 3]])
                np.testing.assert_allclose(found / [arcsec, arcsec, pi / 180 / 3600], printed[i, T], rtol=1e-3)


# a plain filter, a tick at a time


def plain_predict(q, b, P, rate):
    Phi, Q = np.eye(len(P)), np.zeros_like(P)
    Phi[:6, :6], Q[:6, :6] = van_loan(rate - b, DT)
    return q * Rotation.from_rotvec((rate - b) * DT), b, Phi @ P @ Phi.T + Q


def plain_update(q, b, P, held, residual, H, R):
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    a = K @ residual
    q, held = q * Rotation.from_rotvec(a[:3]), held * Rotation.from_rotvec(a[6:])
    nll = 0.5 * (residual @ np.linalg.solve(S, residual) + np.log(np.linalg.det(2 * pi * S)))
    return q, b + a[3:6], P - K @ S @ K.T, held, nll


def story(seed):
    """Thirty ticks of random readings: attitudes, late ones of the clone, vectors, and gaps."""
    r = np.random.default_rng(seed)
    rates, y = 0.3 * r.normal(size=(30, 3)), 0.1 * r.normal(size=(30, 3))
    kinds = r.permutation([0] * 8 + [1] * 8 + [2] * 8 + [3] * 6)  # attitude, vector, late attitude, nothing
    return rates, y, kinds, r.normal(size=(30, 3))


@jax.jit
def ours(start, rates, y, kinds, references):
    """The filter over the story; a sample is the attitude believed, turned by y, or the vector believed, moved by y."""

    def tick(belief, now):
        rate, y, kind, reference = now
        belief = mekf.predict(belief, Vec3(*rate), DT, ARW, RRW)
        sample = lambda q: q * quat_from_vector(Mat3.of(AXES.tolist()) @ Vec3(*y))
        star = partial(mekf.update_attitude, axes=Mat3.of(AXES.tolist()), variance=Vec3(*VARIANCE))
        belief, late = star(belief, Reading(sample(belief.clone), kind == 2), late=True)
        belief, now_told = star(belief, Reading(sample(belief.q), kind == 0))
        seen = quat_to_body(belief.q, Vec3(*reference)) + Vec3(*y)
        belief, vector = mekf.update_vector(belief, Reading(seen, kind == 1), Vec3(*reference), 0.1)
        belief = where(kind == 3, mekf.cloned(belief), belief)
        return belief, (belief, [(t.nis, t.nll, t.rows) for t in (late, now_told, vector)])

    return jax.lax.scan(tick, start, (rates, y, kinds, references))[1]


def test_thirty_ticks_are_those_of_a_plain_filter():
    start = mekf.cloned(mekf.start(BELIEF.q, BELIEF.b, 0.05, 0.01))
    for seed in (0, 1, 2):
        told = story(seed)
        got, informed = ours(start, *told)
        q, b, P = rotation(BELIEF.q), np.array(BELIEF.b), np.diag([0.05**2] * 3 + [0.01**2] * 3)
        P = np.vstack([np.hstack([P, P[:, :3]]), np.hstack([P[:3], P[:3, :3]])])
        held = q
        n = len(P)
        for k, (rate, y, kind, reference) in enumerate(zip(*told)):
            q, b, P = plain_predict(q, b, P, rate)
            nll = 0.0
            if kind == 0 or kind == 2:
                H = np.zeros((3, n))
                H[:, 6 if kind == 2 else 0 :][:, :3] = AXES.T
                q, b, P, held, nll = plain_update(q, b, P, held, y, H, np.diag(VARIANCE))
            if kind == 1:
                H = np.zeros((3, n))
                H[:, :3] = skew(q.as_matrix().T @ reference)
                q, b, P, held, nll = plain_update(q, b, P, held, y, H, 0.01 * np.eye(3))
            if kind == 3:
                held, P = q, np.block([[P[:6, :6], P[:6, :3]], [P[:3, :6], P[:3, :3]]])
            belief = jax.tree.map(lambda a, k=k: np.asarray(a)[k], got)
            assert (rotation(belief.q).inv() * q).magnitude() < 1e-10
            np.testing.assert_allclose(np.array(belief.b), b, atol=1e-10)
            np.testing.assert_allclose(belief.P, P, atol=1e-10 * np.abs(P).max())
            assert (rotation(belief.clone).inv() * held).magnitude() < 1e-10
            assert sum(float(i[1][k]) for i in informed) == pytest.approx(nll, abs=1e-9)
            assert sum(int(i[2][k]) for i in informed) == (0 if kind == 3 else 3)


compiled_star = jax.jit(mekf.update_attitude)


def star(belief, reading, variance: Any = VARIANCE, late=False, spread=False, kind: Any = float):
    """An update by an attitude: the belief and what was told; what is asked often by one program for all numbers."""
    numbers = jax.tree.map(lambda a: np.asarray(a, kind), (belief, reading.value, Vec3(*variance)))
    belief, value, variance = numbers
    often = belief.clone is None and kind is float
    update = compiled_star if often and not late else partial(mekf.update_attitude, late=late, spread=spread)
    return update(belief, Reading(value, np.asarray(reading.valid)), Mat3.of(AXES.astype(kind)), variance)


def test_three_rows_one_after_the_other_are_one_batch():
    y, P = np.array([0.02, -0.05, 0.03]), random_covariance(6)
    q = BELIEF.q * quat_from_vector(Mat3.of(AXES.tolist()) @ Vec3(*y))
    got, told = star(BELIEF, Reading(q, True))
    H = np.hstack([AXES.T, np.zeros((3, 3))])
    S = H @ P @ H.T + np.diag(VARIANCE)
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(got.P, P - K @ S @ K.T, atol=1e-14)
    np.testing.assert_allclose(np.array(got.b), np.array(BELIEF.b) + (K @ y)[3:], atol=1e-14)
    turn = (rotation(BELIEF.q).inv() * rotation(got.q)).as_rotvec()
    np.testing.assert_allclose(turn, (K @ y)[:3], atol=1e-12)
    np.testing.assert_allclose(told.covariance, S, atol=1e-15)
    np.testing.assert_allclose(np.asarray(told.gain), K, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(told.value, y, atol=1e-14)
    assert float(told.nis) == pytest.approx(y @ np.linalg.solve(S, y), rel=1e-12)


def test_a_sample_s_sign_is_free_and_half_a_turn_is_no_nan():
    q = BELIEF.q * quat_from_vector(Vec3(0.01, 0.02, -0.03))
    a, b = (star(BELIEF, Reading(p, True))[0] for p in (q, -q))
    np.testing.assert_allclose(np.array(a.q), np.array(b.q), atol=1e-15)
    far, told = star(BELIEF, Reading(BELIEF.q * Quat(0.0, 1.0, 0.0, 0.0), True))
    assert all(np.isfinite(a).all() for a in jax.tree.leaves((far, told)))


# what is missing, and what cannot be


def same(a, b):
    """Whether two trees hold the same numbers, NaN where the other has NaN."""
    return jax.tree.all(jax.tree.map(lambda a, b: np.array_equal(a, b, equal_nan=True), a, b))


MISSING = {
    "invalid": Reading(Quat(0.5, 0.5, 0.5, 0.5), False),
    "invalid and NaN": Reading(Quat(np.nan, np.nan, np.nan, np.nan), False),
    "valid and NaN": Reading(Quat(0.5, np.nan, 0.5, 0.5), True),
    "valid and infinite": Reading(Quat(0.5, np.inf, 0.5, 0.5), True),
    "zeros of a dead tracker": Reading(Quat(0.0, 0.0, 0.0, 0.0), True),
}


@pytest.mark.parametrize("reading", MISSING.values(), ids=MISSING)
def test_a_missing_sample_moves_nothing(reading):
    got, told = star(BELIEF, reading)
    np.testing.assert_allclose(np.array(got.q), np.array(BELIEF.q), atol=1e-15)
    assert same((got.b, got.P), (BELIEF.b, BELIEF.P))
    assert (float(told.nis), float(told.nll), float(told.rows)) == (0, 0, 0)
    assert not np.any(told.value) and not np.any(told.gain)


traced_vector = jax.jit(mekf.update_vector)


def vector(belief, reading, std):
    """An update by a vector, by one program for all numbers."""
    operands = belief, reading.value, Vec3(0.2, -0.9, 0.4), std
    belief, value, reference, std = jax.tree.map(lambda a: np.asarray(a, float), operands)
    return traced_vector(belief, Reading(value, np.asarray(reading.valid)), reference, std)


@pytest.mark.parametrize("valid, value", [(False, 1.0), (True, np.nan), (True, -np.inf)])
def test_a_missing_vector_moves_nothing(valid, value):
    got, told = vector(BELIEF, Reading(Vec3(0.1, value, 0.2), valid), 0.1)
    assert same((got.b, got.P), (BELIEF.b, BELIEF.P))
    assert (float(told.nis), float(told.rows)) == (0, 0)


@pytest.mark.parametrize("std", [np.nan, -0.1])
def test_a_vector_s_noise_that_cannot_be_never_looks_like_a_perfect_fit(std):
    got, told = vector(BELIEF, Reading(Vec3(0.1, 0.2, 0.3), True), std)
    assert np.isnan(told.nis) and told.rows == 0
    assert same(got, BELIEF)


def test_an_infinite_variance_is_a_missing_row():
    q = BELIEF.q * quat_from_vector(Mat3.of(AXES.tolist()) @ Vec3(0.02, -0.05, 0.03))
    got, told = star(BELIEF, Reading(q, True), [VARIANCE[0], np.inf, VARIANCE[2]])
    H = np.hstack([AXES.T, np.zeros((3, 3))])[[0, 2]]
    P = random_covariance(6)
    S = H @ P @ H.T + np.diag(VARIANCE[[0, 2]])
    K, y = P @ H.T @ np.linalg.inv(S), np.array([0.02, 0.03])
    np.testing.assert_allclose(got.P, P - K @ S @ K.T, atol=1e-14)
    assert float(told.nis) == pytest.approx(y @ np.linalg.solve(S, y), rel=1e-11)
    assert float(told.rows) == 2
    np.testing.assert_allclose(np.asarray(told.gain)[:, [0, 2]], K, rtol=1e-11, atol=1e-13)
    assert not np.any(np.asarray(told.gain)[:, 1])


@pytest.mark.parametrize("bad", [-1e-4, np.nan])
@pytest.mark.parametrize("at", ["R", "turn", "bias"])
def test_an_impossible_covariance_never_looks_like_a_perfect_fit(bad, at):
    R, P = VARIANCE.copy(), random_covariance(6)
    if at == "R":
        R[1] = bad
    else:
        i = 1 if at == "turn" else 4
        P[i, i] = bad
    belief = BELIEF._replace(P=P)
    got, told = star(belief, Reading(BELIEF.q * Quat(1.0, 0.0, 0.0, 0.0), True), R)
    assert np.isnan(told.nis) and np.isnan(told.nll) and told.rows == 0
    assert same(got, belief)


def test_a_sample_without_noise_is_taken_once_and_never_gives_nan():
    q = BELIEF.q * quat_from_vector(Vec3(0.01, 0.02, -0.03))
    nothing = np.zeros(3)
    once, told = star(BELIEF, Reading(q, True), nothing)
    twice, again = star(once, Reading(q, True), nothing)
    assert float(quat_angle(quat_conjugate(q) * once.q)) < 1e-12
    assert np.abs(twice.P[:3]).max() < 1e-15 and (np.diag(twice.P) >= 0).all()
    assert all(np.isfinite(a).all() for a in jax.tree.leaves((told, again)))
    contradiction = star(twice, Reading(q * quat_from_vector(Vec3(0.1, 0.0, 0.0)), True), nothing)[1]
    assert float(contradiction.nis) > 1e6


def test_no_variance_is_rounded_below_zero_in_float32():
    """A first sample a hundred thousand times as good as the prior."""
    belief, q = mekf.start(BELIEF.q, BELIEF.b, 1.5, 1e-2), BELIEF.q * quat_from_vector(Vec3(0.5, -0.3, 0.2))
    for _ in range(5):
        belief, told = star(belief, Reading(q, True), [1e-10, 3e-10, 1e-9], kind=np.float32)
        assert (np.diag(belief.P) >= 0).all() and np.isfinite(told.nis)
    assert belief.q.w.dtype == jnp.float32


def test_a_late_sample_needs_a_clone():
    with pytest.raises(ValueError, match=r"`late` must be False for a belief without a clone, but it is True\."):
        star(BELIEF, Reading(BELIEF.q, True), late=True)


def test_a_new_filter_fits_a_scan():
    belief = mekf.cloned(mekf.start(Quat(1.0, 0.0, 0.0, 0.0), zeros(), 0.1, np.float32(0.1)))
    step = lambda b, _: (mekf.predict(b, zeros(), 0.1, ARW, RRW), None)
    shapes = jax.eval_shape(lambda b: jax.lax.scan(step, b, None, length=2)[0], belief)
    assert shapes.q.w.dtype == belief.q.w.dtype


# late samples


@cache
def late():
    """Many filters whose star tracker is two ticks late, which they know or not, at constant rate and in a slew.

    Knowledge and innovations: normalised squares over lanes and exposures of the last half.
    """
    dt, arw, rrw, std = 0.1, 4.36332e-5, 2.42407e-8, Vec3(3.9e-5**2, 3.9e-5**2, 2.9e-4**2)
    eye = scaled_identity()

    def run(key, slew, known):
        first, second = jax.random.split(key)
        normal = jax.random.normal(first, (600, 9))
        offset = jax.random.normal(second, (6,)) * jnp.repeat(jnp.array([1.7e-3, 1e-4]), 3)
        q, b = Quat(1.0, 0.0, 0.0, 0.0), zeros()
        belief = mekf.start(q * quat_from_vector(Vec3(*offset[:3])), b + Vec3(*offset[3:]), 1.7e-3, 1e-4)
        q, b = jax.tree.map(jnp.asarray, (q, b))
        belief = mekf.cloned(belief)

        def tick(carry, now):
            q, b, belief, sample = carry
            k, n = now
            w = Vec3(1.107e-3 * (1 + slew * jnp.sin(0.5 * dt * k)), slew * 5e-4 * jnp.cos(0.3 * dt * k), 0.0)
            ahead = b + rrw * dt**0.5 * Vec3(*n[:3])
            spread = jnp.sqrt(arw**2 / dt + rrw**2 * dt / 12)
            rate = w + 0.5 * (b + ahead) + spread * Vec3(*n[3:6])
            q, b = q * quat_from_vector(dt * w), ahead
            belief = mekf.predict(belief, rate, dt, arw, rrw)
            due = (k % 2 == 0) & (k > 0)
            belief = where(known, belief, mekf.cloned(belief))  # a clone of now: the sample is taken for one of now
            belief, told = mekf.update_attitude(belief, Reading(sample, due), eye, std, late=True)
            noise = Vec3(*(jnp.sqrt(s) * a for s, a in zip(std, n[6:])))
            sample = where(k % 2 == 0, q * quat_from_vector(noise), sample)
            belief = where(k % 2 == 0, mekf.cloned(belief), belief)
            return (q, b, belief, sample), (mekf.mekf_nees(belief, q, b), told.nis)

        nees, nis = jax.lax.scan(tick, (q, b, belief, q), (jnp.arange(600), normal))[1]
        return nees[300::2], nis[300::2]

    lanes = jax.random.split(jax.random.key(5), 100)
    program = jax.jit(jax.vmap(run, in_axes=(0, None, None)))
    return {(slew, known): program(lanes, slew, known) for slew in (0.0, 1.0) for known in (True, False)}


@pytest.mark.parametrize("slew", [0.0, 1.0])
def test_a_clone_makes_late_samples_consistent(slew):
    nees, nis = late()[slew, True]
    # samples of NIS are independent; of NEES those of one lane are not, hence the last instant alone
    assert abs(np.mean(nis) / 3 - 1) < 4 * np.sqrt(2 / 3 / nis.size)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 6 * len(nees)) / len(nees)
    assert low < np.mean(nees[:, -1]) < high


def test_a_forgotten_delay_is_seen_by_the_truth_and_not_by_innovations_at_constant_rate():
    nees, nis = late()[0.0, False]
    assert abs(np.mean(nis) / 3 - 1) < 0.02
    assert np.mean(nees) / 6 > 1.8


def test_a_forgotten_delay_shows_in_the_innovations_of_a_slew():
    assert np.mean(late()[1.0, False][1]) / 3 > 1.1


def test_a_fresh_clone_is_the_attitude_and_no_news():
    belief = mekf.cloned(BELIEF)
    full = np.asarray(belief.P)
    np.testing.assert_array_equal(full[6:], full[:3])
    np.testing.assert_array_equal(full[:, 6:], full[:, :3])
    q = BELIEF.q * quat_from_vector(Vec3(0.02, -0.01, 0.03))
    now, then = (star(belief, Reading(q, True), late=late)[0] for late in (False, True))
    for a, b in zip(jax.tree.leaves((now.q, now.b, now.P)), jax.tree.leaves((then.q, then.b, then.P))):
        np.testing.assert_allclose(a, b, atol=1e-15)


def test_a_clone_is_replaced_where_there_is_an_exposure_and_a_belief_begun_anew_where_asked():
    old = mekf.predict(mekf.cloned(BELIEF), Vec3(0.1, -0.2, 0.3), DT, ARW, RRW)
    assert same(mekf.cloned(old, when=False), old) and not same(mekf.cloned(old, when=True), old)
    assert same(mekf.cloned(old, when=True), mekf.cloned(old._replace(P=old.P[:6, :6], clone=None)))
    assert same(mekf.restarted(old, False, zeros(), 0.1, 0.01), old)
    for belief, want in ((BELIEF, mekf.start(BELIEF.q, zeros(), 0.1, 0.01)), (old, None)):
        want = mekf.cloned(mekf.start(old.q, zeros(), 0.1, 0.01)) if want is None else want
        assert same(mekf.restarted(belief, True, zeros(), 0.1, 0.01), want)


def test_a_batch_without_a_reading_is_as_each_of_its_scenarios():
    """Nothing is computed where nobody in the batch has a reading."""
    q = jax.tree.map(lambda a: jnp.stack([jnp.asarray(a)] * 2), BELIEF.q * quat_from_vector(Vec3(0.02, -0.01, 0.03)))
    update = lambda q, valid: mekf.update_attitude(BELIEF, Reading(q, valid), scaled_identity(), Vec3(*VARIANCE))
    many = jax.jit(jax.vmap(update))
    one = jax.tree.map(lambda a: a[0], q)
    used, missing = many(q, np.array([True, False])), many(q, np.zeros(2, bool))
    want = update(one, True), update(one, False)
    for i in (0, 1):
        for a, b in zip(jax.tree.leaves(used), jax.tree.leaves(want[i])):
            np.testing.assert_allclose(a[i], b, atol=1e-12)
        for a, b in zip(jax.tree.leaves(missing), jax.tree.leaves(want[1])):
            np.testing.assert_allclose(a[i], b, atol=1e-12)


def test_a_sample_beyond_the_gate_moves_nothing_and_tells_its_nis():
    q = BELIEF.q * quat_from_vector(Vec3(0.5, -0.3, 0.2))
    belief = jax.tree.map(lambda a: np.asarray(a, float), BELIEF)
    gated = jax.jit(
        lambda gate: mekf.update_attitude(belief, Reading(q, True), scaled_identity(), Vec3(*VARIANCE), gate=gate)
    )
    nis = float(gated(np.inf)[1].nis)
    got, told = gated(0.99 * nis)
    assert same(got, belief)
    assert float(told.nis) == nis and float(told.rows) == float(told.nll) == 0 and not np.any(told.gain)
    assert same(gated(1.01 * nis), gated(np.inf))


# resets


def spread_after_reset(how, a, P, count=400_000):
    """Largest whitened error of the covariance of what is left of turns N(a, P) after a correction by a."""
    true = np.random.default_rng(8).multivariate_normal(a, P, count, method="cholesky")
    left = (Rotation.from_rotvec(a).inv() * Rotation.from_rotvec(true)).as_rotvec()
    L = np.linalg.cholesky(how @ P @ how.T)
    return np.abs(np.cov(np.linalg.solve(L, left.T)) - np.eye(3)).max()


def test_the_full_jacobian_turns_the_spread_and_its_first_order_is_worse_than_none_of_a_round_one():
    a = 0.39 * np.array([0.6, -0.48, 0.64])
    J = np.asarray(array(left_jacobian(Vec3(*-a))))
    ways = np.eye(3), np.eye(3) - skew(a) / 2, J
    none, half, full = (spread_after_reset(G, a, 0.02**2 * np.eye(3)) for G in ways)
    assert full < 0.008 < none < half
    none, half, full = (spread_after_reset(G, a, np.diag([0.05, 0.02, 0.01]) ** 2) for G in ways)
    assert full < 0.01 < half < none


def test_spread_is_the_jacobian_on_turns_and_clone_only():
    belief = mekf.cloned(BELIEF)
    q = BELIEF.q * quat_from_vector(Vec3(0.3, -0.2, 0.1))
    plain, turned = (star(belief, Reading(q, True), late=True, spread=spread)[0] for spread in (False, True))
    G = np.eye(9)
    pairs: Any = (0, belief.q, plain.q), (6, belief.clone, plain.clone)
    for at, old, new in pairs:
        a = vector_from_quat(quat_conjugate(old) * new)
        G[at : at + 3, at : at + 3] = array(left_jacobian(-a))
    np.testing.assert_allclose(turned.P, G @ plain.P @ G.T, atol=1e-15)
    assert same(plain[:2], turned[:2])


# consistency and gradients


def test_nees_is_the_squared_error_of_attitude_and_bias():
    a, db = np.array([0.1, -0.2, 0.05]), np.array([0.01, 0.02, -0.01])
    q = BELIEF.q * quat_from_vector(Vec3(*a))
    e = np.concatenate([a, db])
    want = e @ np.linalg.solve(random_covariance(6), e)
    for belief in (BELIEF, mekf.cloned(BELIEF)):
        assert float(mekf.mekf_nees(belief, q, BELIEF.b + Vec3(*db))) == pytest.approx(want, rel=1e-10)


def total(x, missing, gate):
    """Sum of NIS over ten ticks of attitudes and vectors, as arw, rrw, std and the two sigmas of a restart see it."""
    rates, y, _, references = story(4)
    (arw, rrw, std, *sigmas), dtype = x, x.dtype
    kind = lambda a: jnp.asarray(a[:10], dtype)
    belief = jax.tree.map(lambda a: jnp.asarray(a, dtype), mekf.cloned(mekf.start(BELIEF.q, BELIEF.b, 0.05, 0.01)))
    axes, R = jax.tree.map(lambda a: jnp.asarray(a, dtype), (Mat3.of(AXES.tolist()), Vec3(1.0, 1.0, 1.0)))

    def one(belief, arw, rrw, std, sigmas, rate, y, reference, k):
        belief = mekf.predict(belief, Vec3(*rate), DT, arw, rrw)
        belief = mekf.restarted(belief, k == 4, zeros(), *sigmas)
        gone = missing & (k % 3 == 1)
        hole = jnp.where(gone, jnp.nan, 0).astype(dtype)
        sample = BELIEF.q * quat_from_vector(Vec3(*y))
        sample = Quat(*(jnp.asarray(a, dtype) + hole for a in sample))
        star = Reading(sample, True)
        belief, first = mekf.update_attitude(belief, star, axes, (std * std) * R, late=True, gate=gate)
        seen = Reading(Vec3(*(y + hole)), ~gone)
        belief, second = mekf.update_vector(belief, seen, Vec3(*reference), std, gate=gate)
        return mekf.cloned(belief, when=k % 2 == 0), jnp.stack([first.nis, second.nis])

    tick = lambda belief, now: alone(one, belief, arw, rrw, std, sigmas, *now)
    operands = kind(rates), kind(y), kind(references), jnp.arange(10)
    nis = jax.lax.scan(tick, belief, operands)[1]
    return jnp.sum(nis), nis


slopes = jax.jit(jax.value_and_grad(total, has_aux=True))


@pytest.mark.parametrize("missing, gate", [(False, np.inf), (True, np.inf), (False, 150.0)])
def test_gradients_of_nis_are_those_of_central_differences(missing, gate):
    """Through a restart, clones at every other tick, readings that are missing, and a gate that keeps some out."""
    at = np.array([ARW, RRW, 0.05, 0.1, 0.02])
    (_, nis), got = slopes(at, missing, gate)
    assert gate == np.inf or 0.2 < np.mean(nis > gate) < 0.8
    for i in range(len(at)):
        h = 1e-3 * at * (np.arange(len(at)) == i)  # the sum is of thousands, of which rrw moves a hundredth
        move = lambda by, h=h: float(slopes(at + by * h, missing, gate)[0][0])
        numeric = (8 * (move(1) - move(-1)) - (move(2) - move(-2))) / (12 * h[i])
        assert float(got[i]) == pytest.approx(numeric, rel=1e-6) != 0


def test_gradients_of_a_step_are_finite_at_rest_and_at_the_series_edge():
    leaves = lambda w: np.array(jax.tree.leaves(step_of(w)))
    jacobian = jax.jit(jax.jacfwd(lambda w: jnp.stack(jax.tree.leaves(mekf.farrenkopf(Vec3(*w), DT, ARW, RRW)))))
    for x in (0.0, 1e-12, 0.5, 3.0):
        w = np.array([0.0, 0.6, 0.8]) * x / DT
        numeric = np.stack([(leaves(w + h) - leaves(w - h)) / 2e-6 for h in 1e-6 * np.eye(3)], axis=1)
        np.testing.assert_allclose(jacobian(w), numeric, atol=1e-8)
