"""The unscented filter against the paper's, written plainly; its noise, its missing readings and its race."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxatt import mekf
from jaxatt.attitude import quat_conjugate, quat_from_vector, quat_normalised, quat_to_body, vector_from_quat
from jaxatt.engine import alone
from jaxatt.faults import Reading
from jaxatt.usque import refuse_unfit, usque_step
from jaxatt.vec import Quat, Vec3, array, zeros

ARW, RRW, DT, STD = 2e-3, 3e-4, 0.5, 0.05
START = mekf.start(quat_normalised(Quat(0.9, 0.1, -0.3, 0.2)), Vec3(1e-3, -2e-3, 3e-3), 0.3, 0.01)


traced_step = jax.jit(usque_step)


def step(belief, rate, reading, reference, std=STD, arw=ARW, rrw=RRW):
    """A step of DT, by one program for all numbers."""
    numbers = belief, rate, DT, arw, rrw, reading.value, reference, std
    *before, value, reference, std = jax.tree.map(lambda a: np.asarray(a, float), numbers)
    return traced_step(*before, Reading(value, np.asarray(reading.valid)), reference, std)


# the paper's filter: attitude from reference to body, scalar last, the product that keeps the order of matrices


def product(p, q):
    """p (x) q with A(p (x) q) = A(p) A(q)."""
    (v, w), (u, s) = (p[:3], p[3]), (q[:3], q[3])
    return np.array([*(w * u + s * v - np.cross(v, u)), w * s - v @ u])


def matrix(q):
    """Reference to body."""
    v, w = q[:3], q[3]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) - 2 * w * cross


def inverted(q):
    return np.array([*-q[:3], q[3]])


def from_grp(p):
    """Quaternion of a Rodrigues parameter, a = 1, f = 4."""
    w = (-(p @ p) + 4 * np.sqrt(16 + 0 * (p @ p))) / (16 + p @ p)
    return np.array([*((1 + w) * p / 4), w])


def turned(q, w):
    h = np.linalg.norm(w) * DT / 2
    return product(np.array([*(np.sin(h) * w / np.linalg.norm(w)), np.cos(h)]), q)


def paper(q, b, P, rate, y, reference, told=True):
    """One cycle: six numbers of three Rodrigues parameters and three biases, lambda = 1."""
    Q = DT / 2 * np.diag([ARW**2 - RRW**2 * DT**2 / 6] * 3 + [RRW**2] * 3)
    L = np.linalg.cholesky(7 * (P + Q))
    mean = np.array([0.0, 0.0, 0.0, *b])
    points = np.array([mean, *(mean + L.T), *(mean - L.T)])
    weights = np.array([1 / 7] + [1 / 14] * 12)
    q = np.array([turned(product(from_grp(x[:3]), q), rate - x[3:]) for x in points])
    errors = np.array([product(one, inverted(q[0])) for one in q])
    points[:, :3] = 4 * errors[:, :3] / (1 + errors[:, 3:])
    x = weights @ points
    P = (points - x).T @ np.diag(weights) @ (points - x) + Q
    nis = 0.0
    if told:
        seen = np.array([matrix(one) @ reference for one in q])
        expected = weights @ seen
        S = (seen - expected).T @ np.diag(weights) @ (seen - expected) + STD**2 * np.eye(3)
        K = (points - x).T @ np.diag(weights) @ (seen - expected) @ np.linalg.inv(S)
        x, P = x + K @ (y - expected), P - K @ S @ K.T
        nis = (y - expected) @ np.linalg.solve(S, y - expected)
    q = product(from_grp(x[:3]), q[0])
    return q / np.linalg.norm(q), x[3:], P, nis


def test_thirty_ticks_are_those_of_the_paper_s_filter():
    rng = np.random.default_rng(2)
    belief = START
    q, b, P = np.array([*START.q[1:], START.q[0]]), np.array(START.b), np.diag([0.3**2] * 3 + [0.01**2] * 3)
    for k in range(30):
        rate, reference, y = 0.3 * rng.normal(size=3), rng.normal(size=3), 0.5 * rng.normal(size=3)
        y = y + matrix(q) @ reference
        told = k % 3 != 2
        belief, innovation = step(belief, Vec3(*rate), Reading(Vec3(*y), told), Vec3(*reference))
        q, b, P, nis = paper(q, b, P, rate, y, reference, told)
        ours = Rotation.from_quat([*belief.q[1:], belief.q[0]])
        assert (ours.inv() * Rotation.from_quat(q)).magnitude() < 1e-10
        np.testing.assert_allclose(np.array(belief.b), b, atol=1e-10)
        np.testing.assert_allclose(belief.P, P, atol=1e-10 * np.abs(P).max())
        assert float(innovation.nis) == pytest.approx(nis, abs=1e-9)
        assert float(innovation.rows) == (3 if told else 0)


def test_the_noise_of_both_halves_is_the_exact_noise_at_rest():
    """Phi Q Phi' + Q = Q of the whole step, and the filter's P is it where the spread is small."""
    Q = DT / 2 * np.diag([ARW**2 - RRW**2 * DT**2 / 6] * 3 + [RRW**2] * 3)
    exact = mekf.farrenkopf(zeros(), DT, ARW, RRW)
    Phi = np.block([[array(exact.turn), array(exact.drift)], [np.zeros((3, 3)), np.eye(3)]])
    want = np.block([[array(exact.aa), array(exact.ab)], [array(exact.ab).T, array(exact.bb)]])
    np.testing.assert_allclose(Phi @ Q @ Phi.T + Q, want, atol=1e-14 * np.abs(want).max())
    small = mekf.start(START.q, zeros(), 1e-8, 1e-8)
    missing = Reading(zeros(), False)
    got = step(small, zeros(), missing, Vec3(1.0, 0.0, 0.0), STD, ARW * 1e-3, RRW * 1e-3)[0]
    prior = mekf.predict(small, zeros(), DT, ARW * 1e-3, RRW * 1e-3)
    np.testing.assert_allclose(got.P, prior.P, atol=1e-9 * 1e-6 * ARW**2)


def test_where_all_is_nearly_linear_it_is_the_mekf():
    """But for the second half of the noise, which the paper's gain does not see: hence hardly any noise."""
    belief = mekf.start(START.q, START.b, 1e-5, 1e-6)
    rate, reference = Vec3(0.1, -0.2, 0.3), Vec3(0.3, 0.4, -0.5)
    prior = mekf.predict(belief, rate, DT, 1e-10, 1e-13)
    reading = Reading(quat_to_body(prior.q, reference) + Vec3(1e-6, 2e-6, -1e-6), True)
    want, told = mekf.update_vector(prior, reading, reference, 1e-5)
    got, same = step(belief, rate, reading, reference, 1e-5, 1e-10, 1e-13)
    np.testing.assert_allclose(got.P, want.P, atol=1e-8 * 1e-10)
    turn = vector_from_quat(quat_conjugate(want.q) * got.q)
    assert np.abs(np.array(turn)).max() < 1e-9
    assert float(same.nis) == pytest.approx(float(told.nis), rel=1e-3)
    assert float(same.nll) == pytest.approx(float(told.nll), rel=1e-3)
    np.testing.assert_allclose(same.gain, told.gain, atol=1e-4)


def test_points_beyond_half_a_turn_keep_their_spread():
    """At rest and with nothing measured the spread of 100 deg and more only grows."""
    belief = mekf.start(START.q, zeros(), 2.0, 1e-6)
    got = step(belief, zeros(), Reading(zeros(), False), Vec3(1.0, 0.0, 0.0))[0]
    np.testing.assert_allclose(np.diag(got.P)[:3], 4.0, rtol=1e-4)


# what is missing, and what cannot be


RATE, REFERENCE = Vec3(0.1, -0.2, 0.3), Vec3(0.3, 0.4, -0.5)


@pytest.mark.parametrize("valid, value", [(False, 1.0), (False, np.nan), (True, np.nan), (True, np.inf)])
def test_a_missing_reading_predicts_and_no_more(valid, value):
    want, _ = step(START, RATE, Reading(zeros(), False), REFERENCE)
    got, told = step(START, RATE, Reading(Vec3(0.1, value, 0.2), valid), REFERENCE)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(np.all(a == b)), got, want))
    assert (float(told.nis), float(told.nll), float(told.rows)) == (0, 0, 0)
    assert not np.any(told.value) and not np.any(told.gain)


@pytest.mark.parametrize("at", ["turn", "bias"])
@pytest.mark.parametrize("bad", [-1.0, np.nan])
def test_an_impossible_covariance_never_looks_like_a_perfect_fit(at, bad):
    i = 1 if at == "turn" else 4
    belief = START._replace(P=START.P.at[i, i].set(bad))
    got, told = step(belief, RATE, Reading(Vec3(0.1, 0.2, 0.3), True), REFERENCE)
    assert np.isnan(told.nis) and np.isnan(told.nll) and told.rows == 0
    assert np.isfinite(np.array(got.q)).all() and got.b == belief.b


def test_noise_that_is_no_number_gives_a_prediction_and_no_number():
    want, _ = step(START, RATE, Reading(Vec3(0.1, 0.2, 0.3), False), REFERENCE, STD)
    got, told = step(START, RATE, Reading(Vec3(0.1, 0.2, 0.3), True), REFERENCE, np.nan)
    assert np.isnan(told.nis)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(np.all(a == b)), got, want))


def test_a_bias_that_walks_too_fast_is_refused():
    refuse_unfit(ARW, 2.44 * ARW / DT, DT)
    with pytest.raises(ValueError, match=r"`rrw` must stay below sqrt\(6\) arw / dt.* but it is 0.0098."):
        refuse_unfit(ARW, 2.45 * ARW / DT, DT)
    with pytest.raises(ValueError, match=r"`rrw\[1\]` must stay below"):
        refuse_unfit(np.array([ARW, 0.0]), 1e-9, DT)


def test_a_clone_is_refused():
    with pytest.raises(ValueError, match=r"`belief` must be without a clone, but it is one with a clone\."):
        usque_step(mekf.cloned(START), RATE, DT, ARW, RRW, Reading(RATE, True), REFERENCE, STD)


# batches, types, gradients


def total(x):
    """Sum of NIS over five ticks, one of them missing."""
    rng, dtype = np.random.default_rng(6), x.dtype
    belief = jax.tree.map(lambda a: jnp.asarray(a, dtype), START)
    operands = [jnp.asarray(s * rng.normal(size=(5, 3)), dtype) for s in (0.3, 1.0, 1.0)]

    def one(belief, x, rate, y, reference, k):
        reading = Reading(Vec3(*(y + jnp.where(k == 2, jnp.nan, 0).astype(dtype))), k != 2)
        belief, told = usque_step(belief, Vec3(*rate), DT, x[0], x[1], reading, Vec3(*reference), x[2])
        return belief, told.nis

    tick = lambda belief, now: alone(one, belief, x, *now)
    return jnp.sum(jax.lax.scan(tick, belief, (*operands, jnp.arange(5)))[1])


slopes = jax.jit(jax.value_and_grad(total))


def test_gradients_of_nis_are_those_of_central_differences():
    at = np.array([ARW, RRW, STD])
    got = slopes(at)[1]
    for i in range(
        3
    ):  # a step of 1e-4: the rounding of Cholesky's factors is 3e-7 of the slope, with 1e-5 ten times that
        h = 1e-4 * at * (np.arange(3) == i)
        numeric = (slopes(at + h)[0] - slopes(at - h)[0]) / (2 * h[i])
        assert float(got[i]) == pytest.approx(float(numeric), rel=1e-6)


def test_a_batch_is_its_scenarios_and_float32_stays_near():
    """To four digits of the largest number of each kind."""
    rng = np.random.default_rng(7)
    rates, y, references = rng.normal(size=(3, 3, 4))
    one = lambda rate, y, reference: step(START, Vec3(*rate), Reading(Vec3(*y), True), Vec3(*reference))
    belief, *numbers = jax.tree.map(np.float32, (START, DT, ARW, RRW, STD))

    def step_of(rate, y, reference):
        dt, arw, rrw, std = numbers
        return usque_step(belief, rate, dt, arw, rrw, Reading(y, True), reference, std)

    vectors = jax.tree.map(np.float32, (Vec3(*rates), Vec3(*y), Vec3(*references)))
    many = jax.jit(jax.vmap(step_of))(*vectors)
    many = jax.tree.map(lambda a: jnp.moveaxis(a, 0, -1), many)
    parts = lambda tree: (tree[0].q, tree[0].b, tree[0].P[:3, :3], tree[0].P[:3, 3:], tree[0].P[3:, 3:], *tree[1][:2])
    leaves = lambda tree: [np.asarray(jax.tree.leaves(part), float) for part in parts(tree)]
    alone_ = [leaves(one(rates[:, i], y[:, i], references[:, i])) for i in range(4)]
    assert all(a.dtype == np.float32 for a in jax.tree.leaves(many) if a.dtype.kind == "f")
    for together, *each in zip(leaves(many), *alone_):
        each = np.stack(each, axis=-1)
        np.testing.assert_allclose(together, each, atol=1e-4 * np.abs(each).max())


# the race


def field(t):
    """A dipole's field seen along a polar orbit of 5500 s [T]: 2.5 to 5e-5, turning through all directions."""
    u = 2 * np.pi * t / 5500
    return 2.5e-5 * Vec3(3 * jnp.sin(u) * jnp.cos(u), 0.3 * jnp.sin(u / 16), 1 - 3 * jnp.sin(u) ** 2)


@pytest.mark.slow
def test_from_sixty_degrees_it_is_five_times_nearer_than_the_mekf_after_a_thousand_seconds():
    """A magnetometer and a gyro, every 10 s, 16 runs; median error."""
    dt, arw, rrw, std = 10.0, 3.16e-7 * 10, 3.16e-10, 5e-8

    def run(key):
        start, rest = jax.random.split(key)
        normal, first = jax.random.normal(rest, (100, 9)), jax.random.normal(start, (3,))
        axis = first / jnp.linalg.norm(first)
        q, b = Quat(1.0, 0.0, 0.0, 0.0), Vec3(*(jnp.ones(3) * 1e-4))
        off = quat_from_vector(Vec3(*(jnp.pi / 3 * axis)))
        begin = mekf.start(q * off, zeros(), jnp.pi / 3, 1e-4)

        def tick(carry, now):
            q, b, one, other = carry
            k, n = now
            w = Vec3(0.0, -1.1e-3, 0.0) + 2e-4 * Vec3(jnp.sin(0.01 * k * dt), 0.0, jnp.cos(0.007 * k * dt))
            ahead = b + rrw * dt**0.5 * Vec3(*n[:3])
            rate = w + 0.5 * (b + ahead) + jnp.sqrt(arw**2 / dt + rrw**2 * dt / 12) * Vec3(*n[3:6])
            q, b = quat_normalised(q * quat_from_vector(dt * w)), ahead
            reference = field((k + 1) * dt)
            reading = Reading(quat_to_body(q, reference) + std * Vec3(*n[6:]), True)
            one = mekf.update_vector(mekf.predict(one, rate, dt, arw, rrw), reading, reference, std)[0]
            other = usque_step(other, rate, dt, arw, rrw, reading, reference, std)[0]
            off = lambda belief: vector_from_quat(quat_conjugate(belief.q) * q)
            return (q, b, one, other), [jnp.sqrt(off(x) @ off(x)) for x in (one, other)]

        return jax.lax.scan(tick, (q, jax.tree.map(jnp.asarray, b), begin, begin), (jnp.arange(100), normal))[1]

    linear, unscented = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(0), 16))
    assert np.median(unscented[:, -1]) < np.median(linear[:, -1]) / 5
