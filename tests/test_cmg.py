"""Control moment gyros: axes and triads, motion against the laws, steering laws."""

import inspect

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from clusters import FOUR, THREE, angles  # noqa: E402

from jaxatt import cmg, fields  # noqa: E402
from jaxatt.attitude import quat_rate, quat_rotate  # noqa: E402
from jaxatt.cmg import (  # noqa: E402
    GimbalAxes,
    ModuleInertia,
    Steering,
    check_cluster,
    cluster_inertia,
    cluster_momentum,
    cmg_axes,
    cmg_triads,
    steer,
)
from jaxatt.compiling import shared  # noqa: E402
from jaxatt.engine import rk4  # noqa: E402
from jaxatt.torque_matrix import gram_determinant  # noqa: E402
from jaxatt.vec import Mat3, Quat, Vec3  # noqa: E402

# mounting


@pytest.mark.parametrize("beta", [54.7, 90.0, 17.2])
def test_triads_are_those_of_the_paper(beta):
    g = angles(4, 50)
    axes = cmg_axes(np.radians(beta), np.radians([0.0, 90, 180, 270]))
    got = cmg_triads(jax.tree.map(lambda a: a[:, None], axes), g)
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


def test_axes_that_are_none_are_refused():
    box = THREE["box"]
    long = GimbalAxes(Vec3(*(2 * c for c in box.r)), box.s0)
    slanted, uneven = GimbalAxes(box.r, box.r), GimbalAxes(Vec3(box.r.x[:2], *box.r[1:]), box.s0)
    bad = ((long, r"`\|axes.r\|\[0\]` must be 1, but it is 2"), (slanted, "right angles"), (uneven, r"shape \(2,\)"))
    for axes, words in bad:
        with pytest.raises(ValueError, match=words):
            fields.validate("axes", axes)
    fields.validate("axes", jax.tree.map(np.float32, FOUR["pyramid"]))


def test_a_cluster_needs_three_healthy_modules_that_are_not_parallel():
    check_cluster("axes", FOUR["box"], [True, True, False, True])
    check_cluster("axes", cmg_axes(np.r_[0.0, 0, 0, 1], np.arange(4.0)))
    with pytest.raises(ValueError, match="`number of healthy modules of axes` must be at least 3, but it is 2"):
        check_cluster("axes", FOUR["box"], [True, False, False, True])
    with pytest.raises(ValueError, match=r"`axes\.r` must not all be parallel"):
        check_cluster("axes", cmg_axes(np.r_[0.0, 0, 0, 1], np.arange(4.0)), [True, True, True, False])


# motion


J_FULL = Mat3.of([[5.0, 0.4, -0.3], [0.4, 6.0, 0.2], [-0.3, 0.2, 3.0]])
INERTIA = ModuleInertia(5e-4, 1e-3, 7e-4, 1e-3)  # I_cs, I_ct and I_cr all different
AXES = cmg_axes(np.radians(54.7), np.radians([0.0, 90.0, 180.0, 270.0]))
LAST, HEALTHY = np.array([0.0, 0, 0, 1]), np.array([1.0, 1, 1, 0])


def free_flow(motion, t, x, brake=1e-3, free=0.0):
    """Rate of change of x = (attitude, w, gamma, rates, spins) while the gimbals swing, and the motors' power."""
    q, w, gamma, rate, spin = x
    at = cmg_triads(AXES, gamma)
    servo = (HEALTHY * jnp.sin(2 * t + jnp.arange(4.0)) - rate) / 0.05
    m = motion(w, rate, spin, at, J_FULL, INERTIA, servo, brake * LAST, free * np.ones(4), np.zeros(4))
    power = jnp.sum(INERTIA.I_ws * spin * (rate * (at.t @ w) + at.s @ m.w))  # of the motors that hold the wheels
    return (quat_rate(q, w), m.w, rate, m.rate, m.spin), power


def inertial_momentum(x):
    q, w, gamma, rate, spin = x
    at = cmg_triads(AXES, gamma)
    return quat_rotate(q, cluster_momentum(w, rate, spin, at, cluster_inertia(J_FULL, at, INERTIA), INERTIA))


def kinetic_energy(x):
    _, w, gamma, rate, spin = x
    at, m = cmg_triads(AXES, gamma), INERTIA
    along = m.I_ws * spin * (at.s @ w) + m.I_cr * rate * (at.r @ w)
    own = 0.5 * m.I_ws * spin**2 + 0.5 * m.I_cr * rate**2
    return 0.5 * w @ (cluster_inertia(J_FULL, at, m) @ w) + jnp.sum(along + own)


def some_state(seed=0, spin=600.0):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    rates = jnp.asarray(rng.normal(size=4)) * (HEALTHY if spin else 1)
    q = Quat(*(q / np.linalg.norm(q)))
    return q, Vec3(0.3, -0.4, 0.25), jnp.asarray(rng.normal(size=4)), rates, spin * jnp.ones(4)


def momentum_leak(motion, x, **kind):
    """|dH/dt| / |H| of the inertial momentum along the flow [1/s]: zero to rounding where it is conserved."""
    H, leak = jax.jvp(inertial_momentum, (x,), (free_flow(motion, 0.7, x, **kind)[0],))
    return np.linalg.norm(np.stack(leak)) / np.linalg.norm(np.stack(H))


MISTAKES = {
    "sign of the brake reaction": (
        "torque -= times(at.s, m.I_ws * spin_change)",
        "torque += times(at.s, m.I_ws * spin_change)",
    ),
    "brake reaction dropped": ("torque -= times(at.s, m.I_ws * spin_change)", "pass"),
    "failed wheel dropped from w x h_T": ("(w, rate, spin, at", "(w, rate, jnp.where(brake > 0, 0, spin), at"),
    "gimbal acceleration dropped": ("torque -= times(at.r, m.I_cr * change)", "pass"),
    "J_T' dropped": ("torque -= (m.I_cs - m.I_ct) *", "0 *"),
    "gimbal momentum dropped from w x h_T": ("(w, rate, spin, at", "(w, 0 * rate, spin, at"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_conservation_catches_a_wrong_term(mistake):
    right, wrong = MISTAKES[mistake]
    source = inspect.getsource(cmg.cmg_motion)
    assert source.count(right) == 1
    scope = dict(vars(cmg))
    exec(source.replace(right, wrong), scope)
    assert momentum_leak(cmg.cmg_motion, some_state()) < 1e-14
    assert momentum_leak(scope["cmg_motion"], some_state()) > 1e-6


def test_momentum_is_conserved():
    h = 2e-3
    o = jnp.zeros(())
    gamma = jnp.radians(jnp.array([10.0, 55.0, 45.0, -10.0]))
    start = Quat(o + 1, o, o, o), Vec3.of(jnp.array([0.05, -0.1, 0.08])), gamma, jnp.zeros(4), 600 * jnp.ones(4)
    flow = lambda t, x: shared(lambda t, x: free_flow(cmg.cmg_motion, t, x)[0], t, x)
    run = jax.jit(lambda x: jax.lax.scan(lambda x, k: (rk4(flow, k * h, x, h), None), x, jnp.arange(5000))[0])
    end = run(start)
    H, H0 = (np.stack(inertial_momentum(x)) for x in (end, start))
    assert np.linalg.norm(H - H0) < 1e-9 and np.linalg.norm(H0) > 0.5
    np.testing.assert_allclose(end[4], 600 * np.array([1, 1, 1, np.exp(-10)]), rtol=1e-9)  # I_ws / b_r = 1 s


@pytest.mark.parametrize("spin", [0.0, 60.0])
def test_free_gimbals_conserve_momentum_and_energy(spin):
    """Wheels at rest relative to the body, and held at speed by motors whose work is counted."""
    for seed in range(3):
        x = some_state(seed, spin)
        assert momentum_leak(cmg.cmg_motion, x, brake=0.0, free=1.0) < 1e-13
        rate, power = free_flow(cmg.cmg_motion, 0.7, x, brake=0.0, free=1.0)
        energy, gain = jax.jvp(kinetic_energy, (x,), (rate,))
        assert abs(gain - power) < 1e-13 * energy
        assert (np.abs(rate[3]) > 1e-3).all()


# steering


def test_steering_laws():
    axes = cmg_axes(np.radians(54.7), np.radians([0.0, 90.0, 180.0, 270.0]))
    gamma, a, ones = jnp.array([0.3, -0.4, 1.1, 2.0]), Vec3(0.1, -0.2, 0.05), jnp.ones(4)
    T = np.stack([np.asarray(c) for c in cmg_triads(axes, gamma).t])
    pinv = steer(Steering(), a, axes, gamma, ones, 0.0)
    np.testing.assert_allclose(pinv, np.linalg.pinv(T) @ np.array(a), rtol=1e-10)
    moved = steer(Steering(null=0.5), a, axes, gamma, ones, 0.0)
    assert np.abs(moved - pinv).max() > 1e-3
    np.testing.assert_allclose(T @ moved, np.array(a), atol=1e-12)  # null motion gives no torque
    measure = lambda g: np.linalg.det((T_ := np.stack([np.asarray(c) for c in cmg_triads(axes, g).t])) @ T_.T)
    assert measure(gamma + 1e-3 * (moved - pinv)) > measure(gamma)
    three = steer(Steering(null=0.5), a, axes, gamma, jnp.array([1.0, 1, 1, 0]), 0.0)
    np.testing.assert_allclose(three, np.append(np.linalg.solve(T[:, :3], np.array(a)), 0), atol=1e-10)

    lam = 0.01 * np.exp(-10 * np.linalg.det(T @ T.T))
    for dither, t in ((0.0, 0.0), (0.1, 0.7)):
        e1, e2, e3 = dither * np.sin(np.pi / 2 * t + np.array([0, np.pi / 2, np.pi]))
        E = np.array([[1, e3, e2], [e3, 1, e1], [e2, e1, 1]])
        robust = steer(Steering(lam0=0.01, dither=dither), a, axes, gamma, ones, t)
        np.testing.assert_allclose(robust, T.T @ np.linalg.solve(T @ T.T + lam * E, np.array(a)), rtol=1e-9)


def test_null_motion_follows_the_gradient_of_the_gram_determinant():
    axes, gamma, healthy = cmg_axes(1.0, np.arange(5.0)), jnp.asarray(angles(5, 1)[:, 0]), jnp.array([1.0, 1, 0, 1, 1])
    gradient = jax.grad(lambda g: gram_determinant(healthy * cmg_triads(axes, g).t))(gamma)
    T = np.stack(healthy * cmg_triads(axes, gamma).t)
    expected = 0.5 * (gradient - np.linalg.pinv(T) @ (T @ gradient))
    got = steer(Steering(null=0.5), Vec3(0.0, 0.0, 0.0), axes, gamma, healthy, 0.0)
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-12)
    assert np.abs(got).max() > 0.1


def test_steering_has_finite_gradients_at_singularities():
    a, healthy = Vec3(0.1, -0.2, 0.05), np.array([1.0, 1, 1, 0])
    gammas = np.radians([[90.0, 0, -90, 0], [-90, 90, 90, 95], [0, 0, 0, 0]])
    both = jax.tree.map(lambda *c: np.stack(c), *FOUR.values())
    u = lambda axes, g: jnp.sum(steer(Steering(), a, axes, g, healthy, 0.0))
    slopes = jax.vmap(jax.vmap(jax.grad(u, 1), (None, 0)), (0, None))
    assert np.isfinite(jax.jit(slopes)(both, gammas)).all()
