"""The Kalman filter against textbooks in NumPy, in a batch, differentiated, and with covariances that cannot be."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from jaxatt import Reading, Vec3, simulate
from jaxatt.attitude import full_turn
from jaxatt.contract import System
from jaxatt.engine import every
from jaxatt.filters import Belief, innovation, nees, predict, update

rng = np.random.default_rng(0)
B, C = rng.normal(size=(3, 5)), rng.normal(size=(4, 5))
STEADY, Q, DT = np.array([0.3, -0.1]), np.array([0.1, 0.2, 0.0, 0.3, 0.5]), 0.1
R = np.array([0.1, 0.2, 0.3, 0.4])
L = rng.normal(size=(5, 5))
START = Belief(rng.normal(size=5), L @ L.T)


def f(x, B=B):
    """Rates of the first three of five states, as a tree."""
    return Vec3(*(jnp.asarray(B) @ jnp.sin(x)))


def h(x, C=C):
    """Four measurements, as a tree."""
    both = jnp.asarray(C) @ x
    return both[:1], {"rest": both[1:]}


def jacobian(x):
    return np.vstack([B * np.cos(x), np.zeros((2, 5))])


def seen(value):
    return Reading(value, jnp.isfinite(value))


def exactly_symmetric(P):
    return (np.asarray(P) == np.swapaxes(P, -1, -2)).all()


# textbooks


def test_prediction_is_the_joint_rk4_step_of_mean_and_covariance():
    def rate(x, P):
        mean = np.concatenate([np.array(f(x)), STEADY])
        return mean, jacobian(x) @ P + P @ jacobian(x).T + np.diag(Q)

    k1 = rate(*START)
    k2, k3, k4 = (0, 0), (0, 0), (0, 0)
    ahead = lambda by, k: (a + by * b for a, b in zip(START, k))
    k2 = rate(*ahead(DT / 2, k1))
    k3 = rate(*ahead(DT / 2, k2))
    k4 = rate(*ahead(DT, k3))
    got = jax.jit(lambda b: predict(b, f, STEADY, Q, DT))(START)
    for a, start, *k in zip(got, START, k1, k2, k3, k4):
        np.testing.assert_allclose(a, start + DT / 6 * (k[0] + 2 * (k[1] + k[2]) + k[3]), atol=1e-13)
    assert exactly_symmetric(got.cov)


def test_prediction_of_a_linear_model_is_the_matrix_exponential():
    A = np.array([[0.0, 1.0, 0.0], [-2.0, -0.3, 1.0], [0.0, 0.0, 0.0]])
    noise, dt = np.array([0.1, 0.2, 0.3]), 1e-2
    P = L[:3, :3] @ L[:3, :3].T
    van_loan = expm(np.block([[A, np.diag(noise)], [np.zeros((3, 3)), -A.T]]) * dt)
    Phi = van_loan[:3, :3]
    got = jax.jit(lambda b: predict(b, lambda x: A[:2] @ x, 0.0, noise, dt))(Belief(START.mean[:3], P))
    np.testing.assert_allclose(got.mean, Phi @ START.mean[:3], rtol=1e-9)
    np.testing.assert_allclose(got.cov, Phi @ P @ Phi.T + van_loan[:3, 3:] @ Phi.T, rtol=1e-9)


@pytest.fixture(scope="module")
def updated():
    return jax.jit(lambda b, y, R=R: update(b, y, h, R))


@pytest.mark.parametrize("missing", [(), (1,), (0, 3), (0, 1, 2, 3)])
def test_update_is_the_textbook_one_and_missing_is_missing(updated, missing):
    value = np.random.default_rng(1).normal(size=4)
    used = np.array([i not in missing for i in range(4)])
    poisoned, valid, variances = value.copy(), used.copy(), R.copy()
    for i, poison in zip(missing, (np.nan, np.inf)):  # these count as missing even where they are called valid
        poisoned[i], valid[i] = poison, True
    for i in missing[2:3]:
        variances[i], valid[i] = np.inf, True
    got, told = updated(START, Reading(poisoned, valid), variances)
    (x, P), H = START, C[used]
    S = H @ P @ H.T + np.diag(R[used])
    K = P @ H.T @ np.linalg.inv(S)
    e = (value - C @ x)[used]
    np.testing.assert_allclose(got.mean, x + K @ e, atol=1e-12)
    np.testing.assert_allclose(got.cov, P - K @ S @ K.T, atol=1e-12)
    assert exactly_symmetric(got.cov)
    nis = e @ np.linalg.solve(S, e)
    nll = 0.5 * (nis + np.linalg.slogdet(2 * np.pi * S)[1])
    np.testing.assert_allclose([told.nis, told.rows, told.nll], [nis, used.sum(), nll], atol=1e-11)
    value, gain = np.zeros(4), np.zeros((5, 4))
    value[used], gain[:, used] = e, K
    np.testing.assert_allclose(told.value, value, atol=1e-13)
    np.testing.assert_allclose(told.gain, gain, atol=1e-12)
    np.testing.assert_allclose(told.covariance, C @ P @ C.T + np.diag(variances), rtol=1e-12)
    if missing == ():
        np.testing.assert_allclose(np.stack(innovation(START, poisoned, h, R)), [e, np.diag(S)], rtol=1e-12)


def test_a_measurement_that_is_not_linear_is_linearised_at_the_mean():
    x, P = jnp.array([3.0, 4.0]), jnp.array([[0.2, 0.05], [0.05, 0.1]])
    got, told = update(Belief(x, P), seen(jnp.array([5.5])), lambda x: jnp.hypot(*x), 0.01)
    H = np.array([0.6, 0.8])
    S = H @ P @ H + 0.01
    np.testing.assert_allclose(got.mean, x + P @ H * 0.5 / S, rtol=1e-12)
    np.testing.assert_allclose(told.nis, 0.25 / S, rtol=1e-12)


def test_nees_needs_no_solver():
    truth = np.random.default_rng(2).normal(size=5)
    e = truth - START.mean
    np.testing.assert_allclose(nees(START, truth), e @ np.linalg.solve(START.cov, e), rtol=1e-9)


def test_float32_stays_positive_with_precise_sensors():
    """P0 = 1, R = 1e-8: where (I - K H) P goes indefinite."""

    def step(b, y):  # three integrators in a row, the last one constant
        b = predict(b, lambda x: x[1:], 0.0, jnp.full(3, 1e-10), 0.125)
        return update(b, seen(y), lambda x: x[:2], 1e-8)[0], None

    start = Belief(jnp.zeros(3, jnp.float32), jnp.eye(3, dtype=jnp.float32))
    b, _ = jax.jit(lambda b, ys: jax.lax.scan(step, b, ys))(start, jnp.zeros((4000, 2), jnp.float32))
    assert b.cov.dtype == jnp.float32
    assert np.linalg.eigvalsh(np.asarray(b.cov, float)).min() > 0


# angles


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_residuals_of_angles_are_taken_modulo_a_turn_of_their_unit(unit):
    """A star sensor wraps at +-180 deg, the filter that follows a spinning body does not; a gain beside it has no turn."""
    turn = full_turn(unit)
    period = np.array([turn, np.inf])
    b = Belief(jnp.array([0.49 * turn, 10 * turn]), jnp.diag(jnp.array([1.0, 2.0]) * turn**2 * 1e-4))
    run = jax.jit(lambda y, period: update(b, seen(y), lambda x: x, R=jnp.array([1e-6, 1e-6]) * turn**2, period=period))
    for turns in (0, -1, 3):
        got, told = run(np.array([(0.5 + turns) * turn, 10.5 * turn]), period)
        np.testing.assert_allclose(told.value, [0.01 * turn, 0.5 * turn], rtol=1e-9)
        np.testing.assert_allclose(got.mean[0], (0.49 + 0.01 / 1.01) * turn, rtol=1e-9)  # not from turn to turn
        np.testing.assert_allclose(told.nis, 0.01**2 / 1.01e-4 + 0.5**2 / 2.01e-4, rtol=1e-9)
        residual, _ = innovation(b, [(0.5 + turns) * turn, 10.5 * turn], lambda x: x, np.ones(2), period)
        np.testing.assert_allclose(residual, [0.01 * turn, 0.5 * turn], rtol=1e-9)
        truth = b.mean + jnp.array([(0.01 + turns) * turn, 0.0])
        np.testing.assert_allclose(nees(b, truth, period), 0.01**2 / 1e-4, rtol=1e-9)
    _, told = run(np.array([-0.5 * turn, 10.5 * turn]), None)
    assert told.value[0] == pytest.approx(-0.99 * turn)  # where nobody says that it is an angle


def test_a_filter_of_a_spinning_body_follows_sensors_that_wrap():
    """Alone, in a batch, and differentiated: the wrap changes nothing but the numbers that are read."""
    rate, dt = 40.0, 0.1
    truth = 150 + rate * dt * np.arange(300)
    read = (truth + 180) % 360 - 180

    def run(log_r, read):
        def step(b, y):
            b = predict(b, lambda x: x[1:], 0.0, np.array([1e-3, 1e-2]), dt)
            b, told = update(b, seen(y[None]), lambda x: x[:1], jnp.exp(log_r), 360.0)
            return b, (b.mean, told.nis, told.nll)

        start = Belief(jnp.array([150.0 - rate * dt, 0.0]), jnp.diag(jnp.array([1.0, 1e4])))
        return jax.lax.scan(step, start, read)[1]

    many = jax.jit(jax.vmap(run, (None, 0)))
    mean, nis, _ = many(np.log(1e-2), np.stack([read, truth]))
    np.testing.assert_allclose(mean[0, :, 0], mean[1, :, 0], rtol=1e-9)
    np.testing.assert_allclose(mean[0, 200:, 0], truth[200:], atol=1e-3)
    np.testing.assert_allclose(nis[0], nis[1], atol=1e-6)
    slope = jax.jit(jax.grad(lambda log_r: jnp.sum(jax.vmap(run, (None, 0))(log_r, read[None])[2])))(np.log(1e-2))
    ahead, back = (np.sum(many(np.log(1e-2) + d, np.stack([read, truth]))[2][0]) for d in (1e-5, -1e-5))
    np.testing.assert_allclose(slope, (ahead - back) / 2e-5, rtol=1e-6)


# singular and impossible covariances


def test_exact_measurements_leave_the_schur_complement_and_told_twice_add_nothing(updated):
    y = np.random.default_rng(3).normal(size=4)
    b, told = updated(START, seen(y), np.zeros(4))
    x, P = START
    K = P @ C.T @ np.linalg.inv(C @ P @ C.T)
    np.testing.assert_allclose(b.mean, x + K @ (y - C @ x), atol=1e-11)
    np.testing.assert_allclose(b.cov, P - K @ C @ P, atol=1e-12)
    assert told.rows == 4 and (np.diag(b.cov) >= 0).all()
    same = lambda x: (x[0], x[0])
    once, first = jax.jit(lambda b, y: update(b, seen(y), same, np.zeros(2)))(Belief(*START), np.array([y[0], y[0]]))
    assert first.rows == 1 and first.nis == pytest.approx((y[0] - x[0]) ** 2 / P[0, 0])
    np.testing.assert_allclose(once.cov, P - np.outer(P[0], P[0]) / P[0, 0], atol=1e-14)
    again, second = update(once, seen(jnp.array([y[0], y[0]])), same, np.zeros(2))
    np.testing.assert_allclose(again.mean, once.mean, atol=1e-14)
    np.testing.assert_allclose(again.cov, once.cov, atol=1e-14)
    assert second.nis < 1e-9
    _, contradiction = update(once, seen(jnp.array([y[0] + 1, y[0]])), same, np.zeros(2))
    assert contradiction.nis > 1e6


NAN = float("nan")


@pytest.fixture(scope="module")
def scalar():
    """One state measured twice, in a batch of covariances."""

    @jax.jit
    @jax.vmap
    def told(P, R):
        b = Belief(jnp.array([1.0, 0.0]), P * jnp.eye(2))
        return *update(b, seen(jnp.array([1.0, 1.0])), lambda x: (x[0], x[0]), R), nees(b, b.mean)

    return told


@pytest.mark.parametrize(
    "P, R",
    [
        (-1.0, (0.5, 0.5)),
        (-1.0, (2.0, 2.0)),
        (1.0, (-2.0, 1.0)),
        (1.0, (1.0, -1e-9)),
        (1.0, (NAN, 1.0)),
        (NAN, (1.0, 1.0)),
    ],
)
def test_an_impossible_covariance_never_looks_like_a_perfect_fit(scalar, P, R):
    b, told, squared = jax.tree.map(lambda a: a[1], scalar(jnp.array([1.0, P]), jnp.array([(1.0, 1.0), R])))
    assert np.isnan(told.nis) and np.isnan(told.nll)  # although the measurements are as expected
    if not P > 0:
        assert np.isnan(squared)
    if P == P:
        np.testing.assert_array_equal(b.mean, [1.0, 0.0])
        np.testing.assert_array_equal(b.cov, P * np.eye(2))


def test_a_likelihood_over_the_variance_has_its_least_value_at_the_truth_and_none_below_zero():
    """Residuals of x = 0 known for certain, of variance 0.5: the best R is their mean square, and R < 0 is never better."""
    y = np.sqrt(0.5) * np.random.default_rng(0).normal(size=400)
    grid = np.linspace(-2, 2, 401)
    one = lambda R, y: update(Belief(jnp.zeros(1), jnp.zeros((1, 1))), seen(y[None]), lambda x: x, R[None])[1].nll
    total = np.asarray(jax.jit(jax.vmap(lambda R: jnp.sum(jax.vmap(partial(one, R))(y))))(grid))
    assert np.isnan(total[grid < -1e-9]).all()
    assert grid[np.nanargmin(total)] == pytest.approx(np.mean(y**2), abs=0.01)


def test_what_is_missing_may_have_any_variance(updated):
    y = Reading(np.ones(4), np.array([True, False, True, False]))
    _, told = updated(START, y, np.array([0.1, -1.0, 0.3, NAN]))
    _, want = updated(START, y, R)
    np.testing.assert_allclose([told.nis, told.nll], [want.nis, want.nll])


def test_a_certain_filter_that_is_wrong_is_no_perfect_fit():
    b = Belief(jnp.zeros(2), jnp.zeros((2, 2)))
    _, told = update(b, seen(jnp.array([0.0, 1e-3])), lambda x: x, np.zeros(2))
    assert told.nis > 1e100 and nees(b, jnp.array([1e-3, 0.0])) > 1e100
    assert nees(b, jnp.zeros(2)) == 0


def test_beliefs_that_do_not_fit_are_refused():
    for mean, cov in ((np.zeros(3), np.eye(2)), (np.zeros((3, 2)), np.zeros((3, 3, 2))), (0.0, 1.0)):
        for call in (lambda b: predict(b, f, 0.0, Q, DT), lambda b: update(b, seen(np.zeros(4)), h, R)):
            with pytest.raises(ValueError, match=r"`belief` must hold a mean \(n,\) and a cov \(n, n\)"):
                call(Belief(mean, cov))
    with pytest.raises(ValueError, match=r"[Ii]ncompatible|broadcast"):
        update(START, seen(np.zeros(3)), h, R)
    with pytest.raises(ValueError, match=r"[Ii]ncompatible|broadcast"):
        predict(START, f, np.zeros(3), Q, DT)


# in a batch

N = 3
draws = np.random.default_rng(4)
READINGS = draws.normal(size=(N, 4))
READINGS[1, 2] = np.nan
MODELS = C + 0.1 * draws.normal(size=(N, 4, 5))
SIGNS = np.array([1, -1, 2])  # integers are captured too
MASKS = draws.random((N, 4)) > 0.2  # and flags


def step(b, y, C, sign, mask):
    """One tick of a filter whose model closes over floats, integers and flags of its scenario."""
    b = predict(b, lambda x: f(x, sign * C[:3]), STEADY, Q, DT)
    return update(b, Reading(y, mask), lambda x: (h(x, C), jnp.where(mask[0], x[0], x[1]))[0], R)


def close(got, want):
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12), got, want)


@pytest.fixture(scope="module")
def singly():
    one = jax.jit(step)
    return jax.tree.map(lambda *a: np.stack(a), *(one(START, *a) for a in zip(READINGS, MODELS, SIGNS, MASKS)))


def test_a_batch_is_one_after_the_other_along_any_axis(singly):
    batch = jax.jit(jax.vmap(step, (None, 0, 0, 0, 0)))
    got = batch(START, READINGS, MODELS, SIGNS, MASKS)
    close(got, singly)
    assert exactly_symmetric(got[0].cov)
    last = [np.moveaxis(a, 0, -1) for a in (READINGS, MODELS, SIGNS, MASKS)]
    close(
        jax.jit(jax.vmap(step, (None, -1, -1, -1, -1), -1))(START, *last),
        jax.tree.map(lambda a: np.moveaxis(a, 0, -1), singly),
    )


def test_batches_of_batches_and_batched_models_alone(singly):
    inner = jax.vmap(step, (None, None, 0, 0, 0))  # one reading, many models
    got = jax.jit(jax.vmap(inner, (None, 0, None, None, None)))(START, READINGS, MODELS, SIGNS, MASKS)
    close(jax.tree.map(lambda a: a[np.arange(N), np.arange(N)], got), singly)
    jitted = jax.vmap(jax.jit(step), (None, 0, 0, 0, 0))
    close(jitted(START, READINGS, MODELS, SIGNS, MASKS), singly)


def test_without_the_compiler_it_is_the_same():
    def one(b, y):
        return update(predict(b, lambda x: x[1:], 0.1, np.ones(2), 0.1), seen(y), lambda x: x[0], 0.1)

    start, ys = Belief(jnp.zeros(2), jnp.eye(2)), np.array([[0.3], [np.nan]])
    batch = jax.vmap(one, (None, 0))
    want = jax.jit(batch)(start, ys)
    with jax.disable_jit():
        close(batch(start, ys), want)


def test_what_nobody_asks_for_is_not_computed():
    def loops(pick):
        one = lambda b, y: pick(*update(b, seen(y), h, R))
        program = jax.jit(jax.vmap(one)).lower(Belief(*(np.stack([a] * N) for a in START)), READINGS)
        return str(program.compile().as_text()).count(" while(")

    plain = loops(lambda b, told: (b, told.nis))
    assert plain < loops(lambda b, told: (b, told.nis, told.gain))
    assert plain < loops(lambda b, told: (b, told.nis, told.covariance))
    assert loops(lambda b, told: told.nis) < plain  # nor is the covariance


# gradients


def cost(log_r):
    """Likelihood and estimates of N filters over three ticks, as a function of four variances."""

    def one(b, y, C):
        b = predict(b, lambda x: f(x, C[:3]), STEADY, Q, DT)
        b, told = update(b, seen(y), lambda x: h(x, C), jnp.exp(log_r))
        return b, told.nll + jnp.sum(told.gain**2)

    def tick(b, _):
        b, nll = jax.vmap(one)(b, READINGS, MODELS)
        return b, jnp.sum(nll) + jnp.sum(b.mean**2) + jnp.sum(b.cov)

    start = jax.tree.map(lambda a: jnp.broadcast_to(a, (N, *a.shape)), START)
    return jnp.sum(jax.lax.scan(jax.checkpoint(tick), start, None, length=3)[1])


def test_gradients_are_central_differences_forward_and_reverse():
    at, way = jnp.log(jnp.asarray(R)), jnp.array([1.0, -2.0, 0.5, 0.3])
    run = jax.jit(cost)
    slope = (run(at + 1e-5 * way) - run(at - 1e-5 * way)) / 2e-5
    reverse = jax.jit(jax.grad(cost))(at)
    np.testing.assert_allclose(reverse @ way, slope, rtol=1e-7)
    forward = jax.jit(lambda at: jax.jvp(cost, (at,), (way,))[1])(at)
    np.testing.assert_allclose(reverse @ way, forward, rtol=1e-10)


def test_forward_mode_needs_no_batch():
    nll = lambda log_r: update(START, seen(READINGS[0]), h, jnp.exp(log_r))[1].nll
    at, way = jnp.zeros(4), jnp.array([1.0, -2.0, 0.5, 0.3])
    run = jax.jit(nll)
    central = (run(at + 1e-5 * way) - run(at - 1e-5 * way)) / 2e-5
    np.testing.assert_allclose(jax.jvp(nll, (at,), (way,))[1], central, rtol=1e-7)


def test_gradients_at_missing_and_redundant_measurements_are_finite():
    def cost(r, P):
        b = Belief(jnp.ones(2), P * jnp.eye(2))
        y = Reading(jnp.array([1.0, jnp.nan, 1.0]), jnp.array([True, True, False]))
        b, told = update(b, y, lambda x: (x[0], x[1], x[0]), r * jnp.ones(3))
        again, redundant = update(b, seen(jnp.array([1.0, 1.0])), lambda x: (x[0], x[0]), jnp.zeros(2))
        return told.nll + redundant.nll + jnp.sum(again.mean) + jnp.sum(again.cov)

    slopes = jax.jit(jax.vmap(jax.grad(lambda a, b: jnp.sum(jax.vmap(cost)(a, b)), (0, 1))))
    for slope in slopes(jnp.array([[0.5], [0.0], [0.0]]), jnp.array([[1.0], [1.0], [0.0]])):
        assert np.isfinite(slope).all()


# in a loop of the engine


class Tuning(NamedTuple):
    log_r: Any = -2.0
    rate: Any = 0.7


class Memory(NamedTuple):
    belief: Belief
    nll: Any


def tracking(params, scenario, now, x, z, noise):
    """An oscillator that is tracked by a filter, updated at every other tick."""
    belief = predict(
        z.belief, lambda s: jnp.stack([s[1], -params.rate * s[0]]), 0.0 * x[:0], 0.01 * jnp.ones(2), now.dt
    )
    measured = Reading(x[:1] + scenario + 0.1 * noise, jnp.ones(1, bool))

    def corrected():
        b, told = update(belief, measured, lambda s: s[0], jnp.exp(params.log_r))
        return Memory(b, told.nll)

    z = every(2, now, corrected, Memory(belief, jnp.zeros_like(z.nll)))
    return x, z, z


LOOP = System(
    init=lambda params, scenario: (jnp.array([1.0, 0.0]), Memory(Belief(jnp.zeros(2), jnp.eye(2)), 0.0)),
    tick=tracking, flow=lambda params, scenario, t, x, z: jnp.stack([x[1], -x[0]]), dt=0.1, normals=1,
)  # fmt: skip


def test_a_loop_of_the_engine_runs_alone_in_a_batch_and_under_grad():
    noise, offsets = np.random.default_rng(5).normal(size=(8, 1)), np.array([0.0, 0.3])
    one = lambda params, scenario: simulate(LOOP, params, scenario, noise, ticks=8)
    many = jax.jit(jax.vmap(one, (None, 0)))(Tuning(), offsets)
    alone = jax.jit(one)(Tuning(), offsets[1])
    close(jax.tree.map(lambda a: a[1], many), alone)
    assert (np.asarray(alone.nll)[1::2] == 0).all() and (np.asarray(alone.nll)[::2] != 0).all()
    cost = jax.jit(lambda params: jnp.sum(one(params, 0.3).nll))
    slope = jax.jit(jax.grad(cost))(Tuning())
    for name in Tuning._fields:
        up, down = (Tuning()._replace(**{name: getattr(Tuning(), name) + d}) for d in (1e-5, -1e-5))
        np.testing.assert_allclose(getattr(slope, name), (cost(up) - cost(down)) / 2e-5, rtol=1e-6)
