"""The gyro loop: its parts on board, growth rates, and what the reference says the closed loop does."""

import inspect
import sys
import warnings
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from made_up import repeated, tallied

import jaxatt
from experiments.gyro_ekf import TABLE_4
from jaxatt.attitude import euler_rate, quat_from_euler, quat_rotate
from jaxatt.contract import Now
from jaxatt.engine import validated
from jaxatt.faults import Channel, Fault, Reading, dead_where
from jaxatt.filters import Belief
from jaxatt.linear import growth_rates, observability_rank, sampled
from jaxatt.loops import gyro_ekf
from jaxatt.loops.gyro_ekf import ANGLE, BIAS, DEG, DT, Scenario, direct, params, system
from jaxatt.sensors import gyro_pyramid, parity_vector
from jaxatt.sweeping import varied
from jaxatt.vec import Mat3, Vec3, array, project, resultant
from jaxatt.wheels import park_pyramid

SUBSETS = ["", "A", "B", "C", "D", "AB", "AC", "AD", "BC", "BD", "CD", "ABC", "ABD", "ACD", "BCD", "ABCD"]
ZERO = [-10595, -3800, -4294, -4384, -10595, 3941, 3938, -6325, 4001, -4085, -4063, 4001, 3951, 3951, 4001, 6285]
PINV = [-10595, -10595, -10595, -10595, -10595, 3958, 3957, 651, 4001, 870, 823, 4001, 3952, 3952, 4001, 6285]
DEAD = np.array([[name in s for name in "ABCD"] for s in SUBSETS])  # gyros of each subset
QUIET: dict[str, Any] = dict(std_angle=0.0, std_gyro=0.0, std_tacho=0.0)


def flown(loop, ticks, *days, every=1):
    """Logs of (params, scenario) in each of ``days``: a batch, then time."""
    params, scenarios = jax.tree.map(lambda *a: np.stack(np.broadcast_arrays(*a)), *days)
    fly = lambda p, s, key: jaxatt.simulate(loop, p, s, key, ticks=ticks, every=every)
    return jax.vmap(fly)(params, scenarios, jax.random.split(jax.random.key(0), len(days)))


def matrix(axes):
    return np.asarray(project(axes, Vec3(*jnp.eye(3))))


def at(k, t=0.0):
    return Now(jnp.asarray(k), jnp.asarray(t), DT)


# the filter's model


@jax.jit
def model(x):
    """A (9, 17), of the states that move, and H (11, 17) at x, without command."""
    flat = lambda f: lambda x: ravel_pytree(f(x))[0]
    rates, readings = partial(gyro_ekf.drift, params, np.zeros(4)), partial(gyro_ekf.measured, params)
    return jax.jacfwd(flat(rates))(x), jax.jacfwd(flat(readings))(x)


def test_model_jacobian_is_the_specs():
    rng = np.random.default_rng(1)
    x = rng.normal(size=17) * np.repeat([1.0, 0.3, 1e-2, 10.0, 1e-4], [3, 3, 3, 4, 4])
    A, _ = model(x)
    (psi, phi, _), (wx, wy, wz), h = x[3:6], x[6:9], x[9:13]
    p, q = wy * np.cos(psi) - wz * np.sin(psi), wy * np.sin(psi) + wz * np.cos(psi)
    angles = [
        [np.tan(phi) * p, q / np.cos(phi) ** 2, 0],
        [-q, 0, 0],
        [p / np.cos(phi), q * np.sin(phi) / np.cos(phi) ** 2, 0],
    ]
    np.testing.assert_allclose(A[3:6, 3:6], angles, atol=1e-15)
    hat = lambda v: np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    J, W = np.array(params.J), matrix(park_pyramid(params.gamma)).T
    w = np.array([wx, wy, wz])
    np.testing.assert_allclose(A[6:9, 6:9], np.linalg.inv(J) @ (hat(J @ w + W @ h) - hat(w) @ J), atol=1e-15)
    np.testing.assert_allclose(A[6:9, 9:13], -np.linalg.inv(J) @ hat(w) @ W, atol=1e-15)
    np.testing.assert_allclose(A[:3, 3:6], np.eye(3), atol=0)
    assert not A[:, 13:].any() and not A[:, :3].any()


# linear analysis


@pytest.mark.parametrize("told, expected", [(0.0, ZERO), (1.0, PINV)])
@pytest.mark.slow
def test_growth_rates_of_the_sixteen_subsets(told, expected):
    rates = growth_rates(subset_matrices(told), 0.5)[:, 0]
    np.testing.assert_allclose(rates, np.array(expected) * 1e-6, atol=1e-6)


@jax.jit
def subset_matrices(told):
    still = Scenario(w=Vec3(0.0, 0.0, 0.0), h=np.zeros(4), bias=np.zeros(4), announced=told)
    states = ("x.integral", "x.angle", "x.w")
    period = lambda scenario: sampled(direct, params, scenario, ticks=gyro_ekf.CONTROL, states=states)
    return jax.vmap(lambda dead: period(still._replace(gyro=dead_where(dead))))(DEAD)


def test_each_dead_gyro_hides_its_own_bias():
    A, H = map(np.asarray, model(np.zeros(17)))
    A = np.concatenate([A, np.zeros((8, 17))])
    scale = np.repeat([1.0, 1e-2, 1e-4, 1.0, 1e-4], [3, 3, 3, 4, 4])
    for subset, dead in zip(SUBSETS, DEAD):
        rows = np.r_[0:3, 3 + np.flatnonzero(~dead), 7:11]
        assert observability_rank(A, H[rows], scale, duration=100.0) == 14 - len(subset)


# the loop with the filter


@pytest.fixture(scope="module")
def filtered():
    """600 s without noise: Table 6 whole, with A and C dead, with all dead; Table 4; noise with a wheel dead."""
    quiet = Scenario(**QUIET)
    return flown(
        system,
        4801,
        (params, quiet),
        (params, quiet._replace(gyro=dead_where(DEAD[6]))),
        (params, quiet._replace(gyro=dead_where(DEAD[15]))),
        (params, TABLE_4._replace(**QUIET)),
        (params, Scenario(wheel=dead_where(DEAD[1], 100.0), gyro=dead_where(DEAD[15], 50.0))),
        (params._replace(fill=1.0), quiet._replace(gyro=dead_where(DEAD[15]))),
    )


def plain_loop(ticks):
    """The loop with filter, Table 6, without noise, in NumPy by the paper's equations: truth (13) and filter (17), P (17)."""
    J, s = np.array(params.J), np.sqrt(0.5)
    W = np.array([[s * s, -s * s, -s * s, s * s], [s * s, s * s, -s * s, -s * s], [s, s, s, s]])  # eq. (2) at 45 deg
    sa, ca, sb, cb = (f(a * DEG) for a in (54.7, 60.0) for f in (np.sin, np.cos))
    G = np.array([[0, -sa, -ca], [sb * sa, cb * sa, -ca], [-sb * sa, cb * sa, -ca], [0, 0, 1]])  # eq. (1)
    hat = lambda v: np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    H = np.zeros((11, 17))
    H[:3, 3:6], H[3:7, 6:9], H[3:7, 13:], H[7:, 9:13] = np.eye(3), G, np.eye(4), np.eye(4)
    K_F, K_P, K_I = np.array([0.5, 0.5, 2]), np.array([364.5, 364.5, 52]), np.array([2.78125, 2.78125, 0.58984])
    K_D, bias = np.array([11504, 11504, 1152.0]), np.array([0.02, -0.01, 0.01, -0.02]) * DEG
    Q, R = np.diag(np.repeat([1e-10, 1e-8, 0], [9, 4, 4])), np.diag(np.repeat([1, 1e-2, 1], [3, 4, 4]))

    def rates(x, T):
        psi, phi, (wx, wy, wz), w, h = x[3], x[4], x[6:9], x[6:9], x[9:13]
        p, q = wy * np.cos(psi) - wz * np.sin(psi), wy * np.sin(psi) + wz * np.cos(psi)
        angle = [wx + np.tan(phi) * q, p, q / np.cos(phi)]
        turning = np.linalg.solve(J, -T - np.cross(w, J @ w + W @ h))  # eq. (3)
        A = np.zeros((17, 17))
        A[:3, 3:6] = np.eye(3)
        A[3:6, 3:6] = [
            [np.tan(phi) * p, q / np.cos(phi) ** 2, 0],
            [-q, 0, 0],
            [p / np.cos(phi), q * np.sin(phi) / np.cos(phi) ** 2, 0],
        ]
        A[3:6, 6:9] = [
            [1, np.tan(phi) * np.sin(psi), np.tan(phi) * np.cos(psi)],
            [0, np.cos(psi), -np.sin(psi)],
            [0, np.sin(psi) / np.cos(phi), np.cos(psi) / np.cos(phi)],
        ]
        A[6:9, 6:9] = np.linalg.solve(J, hat(J @ w + W @ h) - hat(w) @ J)
        A[6:9, 9:13] = -np.linalg.solve(J, hat(w) @ W)
        return np.concatenate([x[3:6], angle, turning, np.linalg.pinv(W) @ T, np.zeros(4)]), A

    def stepped(f, x):
        k1 = f(x)
        k2 = f([a + DT / 2 * b for a, b in zip(x, k1)])
        k3 = f([a + DT / 2 * b for a, b in zip(x, k2)])
        k4 = f([a + DT * b for a, b in zip(x, k3)])
        return [a + DT / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip(x, k1, k2, k3, k4)]

    x = np.concatenate([np.zeros(6), [0.01 * DEG, -0.02 * DEG, 0.02 * DEG], [-10.0, 5, 10, -15], bias])
    mean, P, out = np.zeros(17), np.eye(17), []
    for k in range(ticks):
        if k:
            (x,) = stepped(lambda x: [rates(x[0], T)[0]], [x])  # noqa: B023, T is that of this tick

            def both(state):
                rate, A = rates(state[0], T)  # noqa: B023
                return [rate, A @ state[1] + state[1] @ A.T + Q]

            mean, P = stepped(both, [mean, P])
            due = np.array([True, k % 2 == 0, k % 2 == 0] + [True] * 8)
            h, r, z = H[due], R[np.ix_(due, due)], (H @ x)[due]
            K = P @ h.T @ np.linalg.inv(h @ P @ h.T + r)
            mean, P = mean + K @ (z - h @ mean), (np.eye(17) - K @ h) @ P @ (np.eye(17) - K @ h).T + K @ r @ K.T
        out.append([x, mean, np.diag(P)])
        if k % 4 == 0:
            T = K_F * (K_P * mean[3:6] + K_I * mean[:3] + K_D * mean[6:9])  # eq. (5)
    return [np.array(column) for column in zip(*out)]


def test_the_loop_is_the_equations_in_numpy(filtered):
    """50 s of the 17-state loop to 1e-9 of each number's size: nothing in it is damped, cut or approximated."""
    x, mean, variance = plain_loop(401)
    first = jax.tree.map(lambda a: np.asarray(a)[0, :401], filtered)
    truth = np.concatenate([array(first.integral), array(first.angle), array(first.w), first.h.T]).T
    close = lambda a, b: np.testing.assert_allclose(a / np.abs(b).max(0), b / np.abs(b).max(0), atol=1e-9)
    close(truth, x[:, :13])
    close(first.filter.mean, mean)
    close(first.filter.variance, variance)


def test_filter_points_without_gyros(filtered):
    angle = np.asarray(array(filtered.angle)) / DEG  # (3, 6, ticks)
    assert (np.linalg.norm(angle[:, [0, 1, 2, 5], -1], axis=0) < 5e-4).all()
    outside = np.abs(angle).max(0) > 0.01
    settling = [filtered.t[i][outside[i]].max() for i in (0, 1, 2)]
    np.testing.assert_allclose(settling, [285, 290, 292], atol=3)
    assert np.abs(angle[:, 4, -1]).max() < 0.01  # a wheel and all gyros dead, with noise


def test_filter_starts_as_a_recursive_mean(filtered):
    error = np.asarray(filtered.filter.error[3])
    np.testing.assert_allclose(error[80, 9], -0.1234566, atol=1e-6)
    np.testing.assert_allclose(error[8, ANGLE] / DEG, [-6.12e-4, 4.861e-3, 6.840e-3], atol=1e-6)


def test_biases_are_found(filtered):
    wrong = np.abs(np.asarray(filtered.filter.error)[0, :, BIAS]) > 0.01 * np.abs(Scenario().bias)
    within = [(np.flatnonzero(w).max() + 1) * DT for w in wrong.T]
    np.testing.assert_allclose(within, [7.25, 8.5, 10.5, 9.0], atol=0.25)
    assert not np.asarray(filtered.filter.mean)[2, :, BIAS].any()  # a dead gyro's bias is not invented


def test_momentum_is_conserved_and_ends_in_the_wheels(filtered):
    body = params.J @ filtered.w + resultant(park_pyramid(params.gamma), np.moveaxis(filtered.h, -1, 0))
    H = np.asarray(array(quat_rotate(quat_from_euler(filtered.angle), body)))
    assert np.abs(H - H[..., :1]).max() < 1e-9
    np.testing.assert_allclose(filtered.h[0, -1], [-16.1907, -15.3863, 20.4364, 9.6320], atol=5e-3)


def test_printed_covariances_make_the_chi_square_mute(filtered):
    nis = np.asarray(filtered.filter.nis / filtered.filter.rows)[4, 2400:]
    assert nis.mean() < 1e-4


# the loop without the filter


def test_direct_control_takes_the_pseudo_inverse_of_the_gyros_in_use():
    G = matrix(gyro_pyramid(params.alpha, params.beta))
    rng = np.random.default_rng(4)
    gyro, angle, integral = (size * rng.normal(size=n) for size, n in ((1e-4, 4), (1e-3, 3), (0.1, 3)))
    known, held = np.ones(3, bool), np.zeros(4)
    computer, law = gyro_ekf.init_direct(params, Scenario())[1].computer, jax.jit(gyro_ekf.decide_direct)
    commands = []
    for used in ~DEAD:
        y = gyro_ekf.Readings(Reading(angle, known), Reading(gyro, used), Reading(held, used), held + 1, integral)
        w = np.linalg.pinv(G[used]) @ gyro[used]
        commands.append(gyro_ekf.command(params, at(0), y.up, Vec3.of(integral), Vec3.of(angle), Vec3.of(w)))
        np.testing.assert_allclose(law(params, at(0), computer, y)[0].u, commands[-1], rtol=1e-9, atol=1e-12)
    assert (np.ptp(commands, axis=0) > 0).all()


@pytest.mark.slow
def test_bias_is_borne_by_the_integral_without_a_filter():
    """And a run at 90 deg of roll is flagged, the other goes on."""
    quiet = Scenario(**QUIET)
    log = jaxatt.simulate(direct, params, quiet, jax.random.key(0), ticks=8001, every=8)
    np.testing.assert_allclose(array(log.integral)[:, -1] / DEG, [58.521, 67.575, 30.790], atol=1e-2)
    scenarios = repeated(quiet, 2)
    scenarios = scenarios._replace(angle=scenarios.angle._replace(y=np.array([0.0, 89.9 * DEG])))
    values = jaxatt.sweep(direct, params, scenarios, jax.random.key(0), ticks=40, score=gyro_ekf.score)
    assert values.ok.tolist() == [True, False]


# protocol


def test_computers_never_see_truth_or_scenario():
    for law in (gyro_ekf.decide, gyro_ekf.decide_direct):
        assert list(inspect.signature(law).parameters) == ["params", "now", "computer", "y"]


def test_orbital_rate_is_the_same_in_truth_and_filter():
    rate = gyro_ekf.SIDEREAL
    scenario = Scenario(angle=Vec3(0.1, -0.2, 0.3), orbit_rate=rate)
    x, z = gyro_ekf.init(params, scenario)
    z = z._replace(computer=z.computer._replace(u=jnp.array([0.1, 0.2, -0.3, 0.4])))
    true = gyro_ekf.flow(params, scenario, 0.0, x, z)
    state = jnp.concatenate([array(x.integral), array(x.angle), array(x.w), x.h, scenario.bias])
    believed = gyro_ekf.drift(params._replace(orbit_rate=rate), z.computer.u, state)
    for rate_on_board, rate_in_truth in zip(believed, (true.integral, true.angle, true.w)):
        np.testing.assert_allclose(array(rate_on_board), array(rate_in_truth), atol=1e-17)
    np.testing.assert_allclose(true.h, z.computer.u)


def test_the_truth_obeys_eulers_equation():
    """J w' + W h' + w x (J w + W h) = disturbance, whatever the wheels give of what is asked; eq. (3)."""
    rng = np.random.default_rng(4)
    J = np.diag([900.0, 1100.0, 1300.0]) + 20 * (lambda a: a + a.T)(rng.normal(size=(3, 3)))
    scenario = Scenario(
        h=rng.normal(size=4),
        torque_max=1.0,
        w=Vec3(*rng.normal(size=3)),
        disturbance=Vec3(0.1, -0.2, 0.3),
        J=Mat3.of(J),
        gamma=0.7,
    )
    x, z = gyro_ekf.init(params, scenario)
    asked, effect, offset = (rng.normal(size=4) for _ in range(3))
    z = z._replace(computer=z.computer._replace(u=jnp.asarray(asked)), motors=Channel(effect, offset))
    rate = gyro_ekf.flow(params, scenario, 0.0, x, z)
    W, w, h = matrix(park_pyramid(0.7)).T, array(x.w), np.asarray(x.h)
    np.testing.assert_allclose(rate.h, effect * np.clip(asked, -scenario.torque_max, scenario.torque_max) + offset)
    torque = J @ array(rate.w) + W @ rate.h + np.cross(w, J @ w + W @ h)
    np.testing.assert_allclose(torque, [0.1, -0.2, 0.3], atol=1e-12)


def test_the_sensors_read_the_truth_the_bias_and_noise_of_their_own():
    """What is not sampled, and a gyro stuck from the start, shows the last reading; before the first, the truth's."""
    rng = np.random.default_rng(5)
    truth, noise = rng.normal(size=(4, 4)), rng.normal(size=11)
    (angle, w), (h, bias) = truth[:2, :3], truth[2:]
    size: dict[str, Any] = dict(std_angle=0.1, std_gyro=0.2, std_tacho=0.3)
    second = dead_where([0, 1, 0, 0])._replace(stuck=np.ones(4))
    stuck = Scenario(angle=Vec3(*angle), w=Vec3(*w), h=h, bias=bias, gyro=second, **size)
    x, z = gyro_ekf.init(params, stuck)
    rates = matrix(gyro_pyramid(stuck.alpha, stuck.beta)) @ w + bias
    noisy = rates + 0.2 * noise[3:7]
    for k, fresh in ((2, [1, 1, 1]), (3, [1, 0, 0])):
        y = gyro_ekf.sense(params, stuck, at(k, k * DT), x, z, jnp.asarray(noise))
        np.testing.assert_allclose(y.angle.value, angle + 0.1 * noise[:3] * fresh, rtol=1e-12)
        np.testing.assert_array_equal(y.angle.valid, np.array(fresh, bool))
        np.testing.assert_allclose(y.gyro.value, np.where([0, 1, 0, 0], rates, noisy), rtol=1e-12)
        np.testing.assert_array_equal(y.gyro.valid, [True, False, True, True])
        np.testing.assert_allclose(y.tacho.value, h + 0.3 * noise[7:], rtol=1e-12)
        np.testing.assert_array_equal(y.integral, np.zeros(3))


def test_slew_is_one_motion():
    p = params._replace(slew=Vec3(1e-3, -2e-3, 5e-4), slew_start=10.0, slew_end=60.0, orbit_rate=1e-4)
    for t in (5.0, 30.0, 80.0):
        aim = gyro_ekf.target(p, t)
        slope = lambda get, t=t: np.asarray(array(jax.jacfwd(lambda t: get(gyro_ekf.target(p, t)))(t)))
        np.testing.assert_allclose(slope(lambda a: a.integral), array(aim.angle), atol=1e-15)
        rate = array(euler_rate(aim.angle, aim.w)) - np.array([0, 0, p.orbit_rate])
        np.testing.assert_allclose(slope(lambda a: a.angle), rate, atol=1e-16)
    slew = array(p.slew)
    for t, seconds, integral in ((5.0, 0, 0), (30.0, 20, 20**2 / 2), (80.0, 50, 50**2 / 2 + 20 * 50)):
        aim = gyro_ekf.target(p, t)
        np.testing.assert_allclose(array(aim.angle), seconds * slew, atol=1e-16)
        np.testing.assert_allclose(array(aim.integral), integral * slew, atol=1e-15)


def test_the_command_closes_on_what_is_off_the_slew():
    rng = np.random.default_rng(6)
    p = params._replace(slew=Vec3(1e-3, -2e-3, 5e-4), slew_start=10.0, slew_end=60.0, gamma=0.6, torque_max=10.0)
    validated(system, p, gyro_ekf.scenario)
    aim, up = gyro_ekf.target(p, 30.0), jnp.array([1.0, 1.0, 0.0, 1.0])
    off = 1e-3 * rng.normal(size=(3, 3))
    flown_off = [Vec3(*(array(a) + d)) for a, d in zip((aim.integral, aim.angle, aim.w), off)]
    gains = [np.diag(array(k)) for k in (p.k_f, p.k_i, p.k_p, p.k_d)]
    T = gains[0] @ sum(k @ d for k, d in zip(gains[1:], off))  # eq. (5)
    u = np.linalg.pinv(matrix(park_pyramid(0.6)).T * np.array(up)) @ T
    assert (np.abs(u) > 10).sum() == 1  # one wheel is at its limit
    np.testing.assert_allclose(gyro_ekf.command(p, at(240, 30.0), up, *flown_off), np.clip(u, -10, 10), rtol=1e-9)


def test_the_suspicion_is_that_of_plain_matrices():
    rng = np.random.default_rng(7)
    L, R, mean = rng.normal(size=(17, 17)), rng.uniform(0.5, 2, 11), rng.normal(size=5)
    x, P, y = rng.normal(size=17), L @ L.T, rng.normal(size=11)
    p = params._replace(R=R, memory=0.3)
    _, z = gyro_ekf.init(p, gyro_ekf.scenario)
    computer = z.computer._replace(mean=mean, dropped=jnp.array([False, True, False, False]))
    valid = lambda *v: jnp.array(v, bool)
    G = matrix(gyro_pyramid(p.alpha, p.beta))
    H = np.zeros((11, 17))
    H[:3, 3:6], H[3:7, 6:9], H[3:7, 13:], H[7:, 9:13] = np.eye(3), G, np.eye(4), np.eye(4)
    e, S = y - H @ x, H @ P @ H.T + np.diag(R)
    v = np.asarray(parity_vector(gyro_pyramid(p.alpha, p.beta)))
    parity = v @ e[3:7] / np.sqrt(v @ S[3:7, 3:7] @ v)
    normal = e[3:7] / np.sqrt(np.diag(S)[3:7])
    for third, k in ((True, 7), (False, 7), (True, 0)):
        readings = gyro_ekf.Readings(
            Reading(y[:3], valid(1, 0, 1)),
            Reading(y[3:7], valid(1, 1, third, 1)),
            Reading(y[7:], valid(1, 1, 1, 1)),
            jnp.ones(4),
            y[:3],
        )
        got = gyro_ekf.suspect(p, at(k, k * DT), computer, Belief(x, P), readings)
        usable = np.array([1, 0, third, 1, third]) * (k > 0)  # the second is dropped: its parity is still told
        moved = mean + 0.3 * usable * (np.r_[normal, parity] - mean)  # what is missing moves nothing
        np.testing.assert_allclose(got.mean, moved, rtol=1e-9)
        np.testing.assert_allclose([*got.gyro, got.parity], moved**2 * 1.7 / 0.3, rtol=1e-9)


# detection


@pytest.mark.slow
def test_loop_drops_the_faulty_gyro_by_itself():
    who = np.arange(8) % 4

    def day(who):
        return Scenario(gyro=Fault(bias=30e-6, onset=jnp.where(jnp.arange(4) == who, 30.0, jnp.inf)), announced=0.0)

    alert = gyro_ekf.consistent(params)._replace(threshold=40.0)
    key = jax.random.key(1)
    v = jaxatt.sweep(system, alert, jax.vmap(day)(who), key, ticks=480, score=gyro_ekf.score)
    caught = v.filter.caught[np.arange(8), who]
    assert ((caught >= 30) & (caught <= 30.5)).all()
    assert np.isinf(v.filter.caught).sum() == 3 * 8 and v.ok.all()


# refusals and scores


BAD = {
    "params.J": (params._replace(J=Mat3.of(np.diag([1.0, 1.0, -1.0]).tolist())), Scenario()),
    "params.Q": (params._replace(Q=np.full(17, -1e-9)), Scenario()),
    "params.R": (params._replace(R=np.repeat([1.0, 0.0, 1.0], [3, 4, 4])), Scenario()),
    "params.P0": (params._replace(P0=np.ones(16)), Scenario()),
    "params.memory": (params._replace(memory=0.0), Scenario()),
    "params.threshold": (params._replace(threshold=-1.0), Scenario()),
    "params.gamma": (params._replace(gamma=0.0), Scenario()),
    "params.slew_end": (params._replace(slew_start=10.0, slew_end=5.0), Scenario()),
    "scenario.beta": (params, Scenario(beta=2.0)),
    "scenario.std_gyro": (params, Scenario(std_gyro=-1e-6)),
    "scenario.announced": (params, Scenario(announced=0.5)),
    "scenario.h": (params, Scenario(h=np.zeros(3))),
    "scenario.gyro.tau": (params, Scenario(gyro=Fault(tau=0.0))),
    "scenario.momentum_max": (params, Scenario(momentum_max=0.0)),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_refused_by_name(name):
    with pytest.raises(ValueError, match=name):
        jaxatt.simulate(system, *BAD[name], jax.random.key(0), ticks=1)


@pytest.mark.parametrize("kept", [True, False])  # a filter, or none
def test_scores_are_those_of_a_made_up_log(kept):
    rng, dt = np.random.default_rng(5), 100.0
    three = lambda *size: Vec3(*(np.array(size) * rng.normal(size=(3, 9))))
    fade = np.array([9, 5, 3, 7, 2, 1, 4, 1, 0.1])
    f = gyro_ekf.FilterLog(
        *(rng.normal(size=(9, 17)) for _ in range(3)), *rng.random((2, 9)), rows=np.array([0, 11, 11, 5, 11, 0, 7, 11, 3]),
        nll=rng.random(9), statistic=rng.random((9, 4)), parity=np.sin(np.arange(9.0)), dropped=np.arange(9)[:, None] >= [2, 99, 0, 7],
    )  # fmt: skip
    log = gyro_ekf.Log(
        dt * np.arange(9),
        three(1.0),
        three(0.1),
        three(1e-4 * fade),
        three(1.0),
        rng.normal(size=(9, 4)),
        rng.normal(size=(9, 4)),
        three(1.0),
        f if kept else None,
    )
    got = tallied(gyro_ekf.score, params._replace(threshold=0.8), gyro_ekf.scenario, log, dt)
    t, error = dt * np.arange(9), np.stack(log.error)
    size, late = np.abs(error).max(axis=0), t >= 300
    rms = lambda a: np.sqrt(np.mean(a**2, axis=0))
    found = {
        "settling": t[size > 0.01 * DEG][-1], "peak_error": size.max(), "final_error": size[-1],
        "rms_error": np.sqrt(np.mean(np.sum(error[:, late] ** 2, axis=0))), "peak_h": np.abs(log.h).max(),
    }  # fmt: skip
    told = {}
    if kept:
        used = late & (f.rows > 0)
        told = {
            "rms_angle": rms(f.error[late, ANGLE]), "rms_w": rms(f.error[late, 6:9]), "nis": np.mean(f.nis[used] / f.rows[used]),
            "final_bias": f.error[-1, BIAS], "statistic": f.statistic.max(axis=0), "caught": [200, np.inf, 0, 700],
            "parity": 100.0,
        }  # fmt: skip
    assert {*got._fields} == {*found, "filter", "ok"} and got.ok
    assert {*(got.filter._fields if kept else ())} == {*told} and (got.filter is None) != kept
    for of, values in ((got, found), (got.filter, told)):
        for name, value in values.items():
            np.testing.assert_allclose(getattr(of, name), value, rtol=1e-12, err_msg=name)
    far = log._replace(angle=log.angle._replace(y=np.linspace(0, 1.5, 9)))  # the Euler angles are lost beyond 80 deg
    assert not tallied(gyro_ekf.score, params, gyro_ekf.scenario, far, dt).ok


def test_the_consistent_filter_believes_the_true_noise():
    R, s = gyro_ekf.consistent(params).R, gyro_ekf.scenario
    np.testing.assert_allclose(R, np.square([s.std_angle] * 3 + [s.std_gyro] * 4 + [s.std_tacho] * 4))


def test_the_error_reported_is_the_angle_less_the_commanded_one():
    slewing = params._replace(slew=Vec3(0.1, 0.2, 0.3), slew_start=0.0, slew_end=10.0)
    x = gyro_ekf.X(*[Vec3.of(np.array([0.3, 0.2, 0.1]))] * 3, h=np.zeros(4))
    z = gyro_ekf.init_direct(params, gyro_ekf.scenario)[1]
    log = gyro_ekf.report(slewing, gyro_ekf.scenario, at(0, 20.0), x, z, None)
    np.testing.assert_allclose(array(log.angle - log.error), array(gyro_ekf.target(slewing, 20.0).angle))
    assert np.abs(array(gyro_ekf.target(slewing, 20.0).angle)).max() > 0


def test_the_prior_of_a_gyro_is_that_of_the_rate_and_of_its_bias():
    P0 = np.full(17, 1e-3)
    P0[6:9] = P0[BIAS] = 1.0
    for R, warned in ((1.5e-6, True), (2.5e-6, False)):  # beside a variance of 2: below 1e-6 float32 is warned of
        single = jax.tree.map(np.float32, (params._replace(P0=P0, R=np.full(11, R)), gyro_ekf.scenario))
        with warnings.catch_warnings(record=True) as met:
            warnings.simplefilter("always")
            validated(system, *single)
        assert any("float32" in str(warning.message) for warning in met) is warned


def test_the_warning_of_float32_points_at_the_line_that_runs_the_loop():
    single = jax.tree.map(np.float32, (gyro_ekf.consistent(params), gyro_ekf.scenario))
    many, key = repeated(single, 1), jax.random.key(0)
    with warnings.catch_warnings(record=True) as met:  # each run is refused after the warning, before it is compiled
        warnings.simplefilter("always")
        here = sys._getframe().f_lineno
        with pytest.raises(ValueError, match="memory"):
            jaxatt.simulate(system, *single, noise_or_key=key, ticks=2**31 - 1)
        with pytest.raises(TypeError, match="key"):
            jaxatt.sweep(system, single[0], many[1], None, ticks=1, score=gyro_ekf.score)
        with pytest.raises(TypeError, match="key"):
            jaxatt.sweep(varied(system), (), many, None, ticks=1, score=varied(gyro_ekf.score))
    lines = [(w.filename, w.lineno - here) for w in met if "float32 loses" in str(w.message)]
    assert lines == [(__file__, 2), (__file__, 4), (__file__, 6)]
