"""Reaction wheels: a drive and what spoils it, friction, motors, and how several wheels share a torque."""

from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import linprog

from jaxatt import fields
from jaxatt.bodies import body_acceleration
from jaxatt.engine import rk4
from jaxatt.vec import Mat3, Vec3, array, project, resultant
from jaxatt.wheels import (
    Friction,
    TorqueWheel,
    Wheel,
    allocation,
    beyond,
    coasting,
    gated,
    held_torque,
    minimax,
    motor_torque,
    null_part,
    park_pyramid,
    pyramid,
    refuse_flat,
    relative_speed,
    wheel_acceleration,
    wheel_drive,
    wheel_rate,
    wheel_torque,
)

# one wheel and its drive


def test_wheel_is_equation_3_where_nothing_spoils_it():
    y, u = np.random.default_rng(0).normal(size=(2, 50)) * 5000
    np.testing.assert_allclose(wheel_acceleration(Wheel(), y, u), -10 * y + 20 * u, rtol=1e-13)


def test_friction_takes_energy_and_fades_with_speed():
    wheel = Wheel(friction=25000.0)
    y = np.array([-3000.0, -700.0, -50.0, 50.0, 700.0, 3000.0])
    lost = wheel_acceleration(Wheel(), y, 0.0) - wheel_acceleration(wheel, y, 0.0)
    assert np.all(lost * y > 0)
    np.testing.assert_allclose(lost, 25000 * np.exp(-((y / 1500) ** 2)) * np.tanh(y / 100), rtol=1e-12)


def test_coulomb_friction_is_a_dead_zone_of_the_command_while_the_wheel_turns():
    y, u = 4000.0, 3000.0
    coulomb = wheel_acceleration(Wheel(friction=25000.0, slow=jnp.inf), y, u)
    np.testing.assert_allclose(coulomb, wheel_acceleration(Wheel(dead_zone=1250.0), y, u), rtol=1e-12)


def test_dead_zone_gate_and_bound():
    u = np.array([-3.0, -0.5, 0.0, 0.5, 3.0])
    np.testing.assert_allclose(beyond(u, 1.0), [-2, 0, 0, 0, 2])
    assert jax.grad(beyond)(0.0, 0.0) == 1  # no dead zone: no kink at zero either
    np.testing.assert_allclose(gated(u, 1.0), [-3, 0, 0, 0, 3])
    np.testing.assert_allclose(gated(u, 0.0), u)
    np.testing.assert_allclose(wheel_acceleration(Wheel(u_max=1.0), 0.0, u), 20 * np.clip(u, -1, 1))
    assert np.all(np.diff(gated(np.linspace(0.9, 1.2, 400), 1.0)) >= 0)


@pytest.mark.parametrize(
    "wheel",
    [
        Wheel(),
        Wheel(friction=25000.0, slow=np.inf),
        Wheel(dead_zone=1250.0),
        Wheel(gate=2000.0),
        Wheel(weakness=0.98),
        Wheel(dead_drive=3e4),
        Wheel(friction=100.0, stiction=300.0, viscous=0.1),
        Wheel(u_max=1000.0),
    ],
)
def test_wheel_has_finite_gradients_everywhere(wheel):
    for y in (0.0, 1e-3, 1500.0, 1e9):
        for u in (0.0, 1000.0, 2000.0):
            grads = jax.grad(wheel_acceleration, (0, 1, 2))(jax.tree.map(float, wheel), y, u)
            assert np.isfinite(jax.tree.leaves(grads)).all()


# friction in the flow


@partial(jax.jit, static_argnums=4)
def turned(wheel, y, u, h, steps):
    """Speeds of a wheel under the command u, step by step."""
    step = lambda y, _: (rk4(lambda t, y: wheel_acceleration(wheel, y, u), 0.0, y, h),) * 2
    return jax.lax.scan(step, y, length=steps)[1]


def run(wheel, y, u, seconds, h=1e-3):
    return np.asarray(turned(jax.tree.map(float, wheel), float(y), float(u), h, round(seconds / h)))


STICKY = Wheel(a=0.0, friction=100.0, stiction=300.0, slow=np.inf)


def test_a_coasting_wheel_stops_when_coulomb_friction_says_and_stays():
    """From 500 deg/s at 100 deg/s^2 after 5 s, less what stiction takes off at the end: at most stribeck + width."""
    y = run(STICKY, 500.0, 0.0, 10.0)
    stop = np.argmax(np.abs(y) < 0.01) * 1e-3
    assert 4.8 < stop < 5.1 and (np.abs(y[5200:]) < 1e-3).all()
    np.testing.assert_allclose(y[:4500], 500 - 100 * 1e-3 * np.arange(1, 4501), rtol=1e-9)  # no stiction at speed


def test_a_braked_wheel_stops_and_stays_under_the_brake():
    y = run(STICKY, 50.0, -10.0, 2.0)  # the drive brakes by 200 deg/s^2, which stiction holds at rest
    assert 0.1 < np.argmax(y < 0.01) * 1e-3 < 50 / 300 + 1e-3 and np.abs(y[-1]) < 1e-6
    assert run(STICKY, 50.0, -16.0, 2.0)[-1] < -100  # 320 turn it round


@pytest.mark.parametrize("h", [1e-3, 2e-2])
def test_a_wheel_breaks_away_at_its_stiction(h):
    assert run(STICKY, 0.0, 298 / 20, 2.0, h)[-1] == 0
    assert run(STICKY, 0.0, 302 / 20, 2.0, h)[-1] > 2
    freed = run(STICKY, 0.0, 302 / 20, 5.0, h)
    np.testing.assert_allclose((freed[-1] - freed[-2]) / h, 202, rtol=1e-6)  # once it turns only friction is left


def test_friction_gives_no_power_and_a_wheel_at_rest_rests_in_every_direction():
    rng = np.random.default_rng(0)
    y, u = rng.normal(size=(2, 4000)) * 10.0 ** rng.uniform(-6, 3, (2, 4000))
    y[::10] = 0
    friction, stiction, viscous = 200 * rng.uniform(size=(3, 4000))
    stiction[::3] = 0
    wheel = Wheel(a=0.0, friction=friction, stiction=stiction, viscous=viscous)
    rubbed = wheel_acceleration(wheel, y, u) - wheel_acceleration(Wheel(a=0.0), y, u)
    assert (rubbed * y <= 1e-12 * np.abs(20 * u * y)).all()
    asked = np.abs(20 * u)
    held = (y == 0) & (stiction > 0) & (asked < np.maximum(stiction, friction))
    assert held.sum() > 50 and not wheel_acceleration(wheel, y, u)[held].any()


def test_friction_at_speed_is_coulombs_stribecks_and_viscous():
    wheel = Wheel(a=0.0, friction=100.0, stiction=300.0, viscous=0.5, stribeck=40.0, slow=np.inf)
    y = np.array([-500.0, 30.0, 70.0, 500.0])
    level = 100 + 200 * np.exp(-(((np.abs(y) - 3) / 40) ** 2)) + 0.5 * np.abs(y)  # beyond the layer of 3 deg/s
    np.testing.assert_allclose(wheel_acceleration(wheel, y, 0.0), -np.sign(y) * level, rtol=1e-8)


# friction held over a tick

BEARING = Friction(coulomb=3e-4, stiction=6e-4, stribeck=3.0, viscous=1.2e-6)
UNIT = TorqueWheel(J=6.366e-4, torque_max=0.015, speed_max=628.3, knee=500.0, friction=BEARING)


@partial(jax.jit, static_argnums=2)
def coasted(wheel, dt, steps):
    """Speeds after each of the steps, from 300 rad/s without motor."""
    step = lambda speed, _: (speed + dt * held_torque(wheel, 0.0, speed, dt) / wheel.J,) * 2
    return jax.lax.scan(step, 300.0, length=steps)[1]


def test_a_wheel_coasts_to_rest_when_its_differential_equation_does():
    c = lambda W: 3e-4 + 3e-4 * np.exp(-((W / 3) ** 2)) + 1.2e-6 * W
    rest = lambda t, W: W[0]
    rest.terminal = True
    exact = solve_ivp(lambda t, W: -c(W) / 6.366e-4, (0, 500), [300.0], "DOP853", events=rest, rtol=1e-12, atol=1e-12)
    assert exact.t_events[0][0] == pytest.approx(414.909, abs=1e-3)
    for dt, stop in ((0.1, 415.0), (0.01, 414.92)):
        speed = np.asarray(coasted(UNIT, dt, 42000 if dt == 0.01 else 4200))
        assert (np.argmax(speed == 0) + 1) * dt == pytest.approx(stop, abs=dt / 2) and not speed[-1]
    plain = UNIT._replace(friction=BEARING._replace(stiction=3e-4))
    speed = np.asarray(coasted(plain, 0.01, 42000))
    assert (np.argmax(speed == 0) + 1) * 0.01 == pytest.approx(
        418.277, abs=0.03
    )  # first order in dt: within three steps
    assert 6.366e-4 / 1.2e-6 * np.log(1 + 1.2e-6 * 300 / 3e-4) == pytest.approx(418.277, abs=1e-3)


def test_held_friction_gives_no_power_and_the_wheel_rests_where_it_may():
    rng = np.random.default_rng(1)
    speed, motor = rng.normal(size=(2, 2000)) * 10.0 ** rng.uniform(-4, 1, (2, 2000)) * [[1.0], [1e-3]]
    speed[::4] = 0
    n = np.asarray(held_torque(UNIT, motor, speed, 0.1))
    after = speed + 0.1 * n / 6.366e-4
    assert ((n - motor) * after <= 1e-18).all()
    level = 3e-4 + 3e-4 * np.exp(-((speed / 3) ** 2))
    may = np.abs(speed + 0.1 * motor / 6.366e-4) <= 0.1 * level / 6.366e-4
    np.testing.assert_array_equal(np.abs(after) < 1e-13, may)
    assert 100 < may.sum() < 1900
    assert jax.grad(lambda m: held_torque(UNIT, m, 0.0, 0.1))(5e-4) == 0  # held at rest
    assert np.isfinite(jax.grad(lambda W: held_torque(UNIT, 1e-3, W, 0.1))(0.0))


def test_the_motor_brakes_at_any_speed_and_gives_nothing_outward_at_the_limit():
    speed = np.array([0.0, 500.0, 564.15, 628.3, 700.0, -628.3])
    np.testing.assert_allclose(motor_torque(UNIT, 0.02, speed), [0.015, 0.015, 0.0075, 0, 0, 0.015], atol=1e-12)
    np.testing.assert_allclose(motor_torque(UNIT, -0.02, speed), [-0.015] * 5 + [0], atol=1e-12)
    assert motor_torque(TorqueWheel(J=1.0), 3.0, 1e6) == 3.0  # no limits
    with pytest.raises(ValueError, match=r"`wheel\.knee` must be below wheel\.speed_max, but it is 700"):
        fields.validate("wheel", UNIT._replace(knee=700.0))
    with pytest.raises(ValueError, match=r"`wheel\.friction\.stiction` must not be below wheel\.friction\.coulomb"):
        fields.validate("wheel", UNIT._replace(friction=BEARING._replace(stiction=1e-4)))


def test_faults_of_a_wheel():
    give = partial(wheel_torque, UNIT, 0.01, 100.0, 0.1)
    loss = 3e-4 + 1.2e-6 * 100
    assert give() == pytest.approx(0.01 - loss, abs=3e-6)
    assert give(drive=0.5) == pytest.approx(0.005 - loss, abs=3e-6)
    assert give(drive=0.0) == pytest.approx(-loss, abs=3e-6)  # a dead wheel keeps its friction
    assert give(wear=5.0) == pytest.approx(0.01 - 5 * loss, abs=2e-5)
    assert give(seized=True) == 0


def test_body_and_wheels_keep_their_momentum():
    """And one tick is that of a far finer integration, for the torques are held."""
    axes, h = pyramid(0.9), np.array([0.1, -0.1, 0.05, 0.02])
    J = np.array([[3.7, 0.06, -0.04], [0.06, 3.5, 0.05], [-0.04, 0.05, 2.5]])
    W, w = np.asarray(project(axes, Vec3.of(np.eye(3)))).T, np.array([0.05, -0.06, 0.05])

    def rates(n, q_w_h):
        w, h = q_w_h
        return body_acceleration(w, -resultant(axes, n), Mat3.of(J), resultant(axes, h)), n

    @jax.jit
    def flown(w, h):
        def tick(state, _):
            w, h = state
            n = wheel_torque(UNIT, jnp.array([1e-3, -2e-3, 0.0, 5e-4]), relative_speed(UNIT.J, h, axes, w), 0.1)
            return (rk4(lambda t, x: rates(n, x), 0.0, state, 0.1),) * 2

        return jax.lax.scan(tick, (w, h), length=1000)[1]

    ws, hs = flown(Vec3.of(w), jnp.asarray(h))
    total = J @ np.array(ws) + W @ np.asarray(hs).T
    size = np.linalg.norm(total, axis=0)  # in body axes it turns, its length stays
    np.testing.assert_allclose(size, size[0], rtol=1e-9)
    n = np.asarray(
        wheel_torque(UNIT, np.array([1e-3, -2e-3, 0.0, 5e-4]), relative_speed(UNIT.J, h, axes, Vec3.of(w)), 0.1)
    )
    plain = lambda t, w: np.linalg.solve(J, -W @ n - np.cross(w, J @ w + W @ (h + n * t)))
    fine = solve_ivp(plain, (0, 0.1), w, "DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    np.testing.assert_allclose(array(jax.tree.map(lambda a: a[0], ws)), fine, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(hs[0], h + 0.1 * n, rtol=1e-12)


def test_the_drive_integrates_no_further_than_its_windup_and_overcomes_friction():
    np.testing.assert_allclose(wheel_drive(0.1, 0.01, 0.1, 0.1, 1.0, 0.005), (0.101, 0.011))
    np.testing.assert_allclose(wheel_drive(0.1, 0.2, 0.1, 0.1, 1.0, 0.005), (0.105, 0.205))
    np.testing.assert_allclose(wheel_drive(0.0, 0.0, 0.1, 0.1, 2.0, 0.005), (0.095, -0.01))


# where wheels point


def wheel_matrix(axes):
    """W (3, n)."""
    return np.asarray(project(axes, Vec3.of(np.eye(3)))).T


def test_the_pyramid_is_where_everyone_expects_it():
    W, s = wheel_matrix(pyramid(np.radians(54.7356103))), np.sqrt(1 / 3)
    np.testing.assert_allclose(W, s * np.array([[1, -1, -1, 1], [1, 1, -1, -1], [1, 1, 1, 1]]), atol=1e-8)
    np.testing.assert_allclose(W @ W.T, 4 / 3 * np.eye(3), atol=1e-8)
    W = wheel_matrix(pyramid(0.3, 0.2))
    np.testing.assert_allclose(np.linalg.norm(W, axis=0), 1, atol=1e-15)
    np.testing.assert_allclose(np.arccos(W[2]), 0.3, atol=1e-12)
    np.testing.assert_allclose(np.unwrap(np.arctan2(W[1], W[0])), 0.2 + np.pi / 2 * np.arange(4), atol=1e-12)


def test_parks_axes_are_unit_and_as_the_paper_says():
    W = wheel_matrix(park_pyramid(np.pi / 4))
    np.testing.assert_allclose(W @ W.T, np.diag([1, 1, 2]), atol=1e-15)
    np.testing.assert_allclose(W, wheel_matrix(pyramid(np.pi / 4)), atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(wheel_matrix(park_pyramid(0.3)), axis=0), 1, atol=1e-15)


# sharing a torque


SETS = {
    "pyramid": wheel_matrix(pyramid(np.radians(38.0))),
    "flat": wheel_matrix(pyramid(np.radians(5.0))),
    "six": np.concatenate([np.eye(3), wheel_matrix(pyramid(0.8))[:, :3]], axis=1),
    "twins": np.array([[1.0, 1, 0, 0.6], [0, 0, 1, 0.8], [0, 0, 0, 0]]),
    "one": np.array([[0.6], [0.0], [0.8]]),
}


@pytest.mark.parametrize("name", SETS)
def test_allocation_is_the_pseudo_inverse_of_every_subset(name):
    """To rounding: not to a part in a million, which is what a damped inverse gives."""
    W, T = SETS[name], np.array([0.3, -0.2, 0.5])
    ups = np.array(list(product((0.0, 1.0), repeat=W.shape[1])))
    shared = jax.jit(jax.vmap(lambda up: allocation(Vec3.of(T), W, up)))
    for dtype, tolerance in ((np.float64, 1e-13), (np.float32, 1e-5)):
        found = (
            shared(ups)
            if dtype is np.float64
            else jax.vmap(partial(allocation, Vec3.of(dtype(T)), dtype(W)))(dtype(ups))
        )
        for u, up in zip(found, ups):
            expected = np.linalg.pinv(W * up) @ T
            np.testing.assert_allclose(u, expected, atol=tolerance * (1 + np.abs(expected).max()))
            assert not np.asarray(u)[up == 0].any()


def test_allocation_has_exact_gradients_by_the_axes_and_finite_ones_at_every_rank():
    rng = np.random.default_rng(2)
    T, way = np.array([0.3, -0.2, 0.5]), rng.normal(size=(3, 4))
    cost = lambda W, up: jnp.sum(allocation(Vec3.of(T), W, up) ** 2)
    slopes = jax.jit(jax.vmap(jax.grad(cost), (None, 0)))
    ups = np.array(list(product((0.0, 1.0), repeat=4)))
    for W in (SETS["pyramid"], SETS["twins"]):
        assert np.isfinite(slopes(W, ups)).all()
    plain = lambda s, up: np.sum((np.linalg.pinv((SETS["pyramid"] + s * way) * up) @ T) ** 2)
    for up, slope in zip(ups, slopes(SETS["pyramid"], ups)):
        h = 1e-5  # any three or four span space, and one or two keep their rank
        assert np.sum(slope * way) == pytest.approx((plain(h, up) - plain(-h, up)) / (2 * h), rel=1e-6, abs=1e-9)


def test_axes_may_be_an_array_and_what_does_not_fit_is_refused():
    T, W, up = Vec3(0.3, -0.2, 0.5), SETS["pyramid"], np.ones(4)
    of_vectors = allocation(T, pyramid(np.radians(38.0)), up)
    np.testing.assert_allclose(allocation(T, W, up), of_vectors, atol=1e-15)
    np.testing.assert_allclose(allocation(T, Vec3(*W), up), of_vectors, atol=1e-15)
    for share in (allocation, minimax):
        with pytest.raises(ValueError, match=r"`axes` must have shape \(3, n\), but it is of shape \(4, 3\)"):
            share(T, W.T, up)
        with pytest.raises(
            ValueError, match=r"`up` must hold a number for each of the 4 axes, shape \(4,\), but it is of"
        ):
            share(T, W, np.ones(3))


@pytest.mark.parametrize("n", [4, 5, 6])
def test_minimax_is_the_linear_programs_on_every_subset(n):
    rng = np.random.default_rng(n)
    W = wheel_matrix(pyramid(np.radians(54.7))) if n == 4 else rng.normal(size=(3, n))
    W = W / np.linalg.norm(W, axis=0)
    ups = np.array([up for up in product((0.0, 1.0), repeat=n) if sum(up) >= 3])
    demands = rng.normal(size=(len(ups), 3))
    found = jax.jit(jax.vmap(lambda T, up: minimax(Vec3.of(T), W, up)))(demands, ups)
    for u, T, up in zip(np.asarray(found), demands, ups):
        used = up > 0
        m = int(used.sum())
        np.testing.assert_allclose(W @ u, T, atol=1e-12)
        assert not u[~used].any()
        above = np.concatenate([np.eye(m), -np.ones((m, 1))], axis=1)  # x - t <= 0 and -x - t <= 0
        below = np.concatenate([-np.eye(m), -np.ones((m, 1))], axis=1)
        least = linprog(
            np.append(np.zeros(m), 1.0), np.concatenate([above, below]), np.zeros(2 * m),
            np.append(W[:, used], np.zeros((3, 1)), axis=1), T, [(None, None)] * (m + 1), method="highs",
        )  # fmt: skip
        assert np.abs(u).max() == pytest.approx(least.fun, rel=1e-9)


def test_minimax_reaches_further_than_the_pseudo_inverse():
    """Of the pyramid with W W' = 4/3 I, wheels of unit torque: the ball inside each envelope, and the best direction."""
    axes, up = pyramid(np.arctan(np.sqrt(2))), np.ones(4)
    z = np.linspace(-1, 1, 60)[:, None]
    a = np.linspace(0, np.pi / 2, 61)
    rho = np.sqrt(1 - z * z)
    d = np.stack([rho * np.cos(a), rho * np.sin(a), z + 0 * a]).reshape(3, -1)
    d = np.concatenate([d, np.eye(3), np.array([[1, 1, 0], [1, -1, 1], [1, 1, 1]]).T / np.sqrt([2, 3, 3])], axis=1)
    largest = lambda f: jax.jit(jax.vmap(lambda T: jnp.abs(f(Vec3.of(T), axes, up)).max()))(d.T)
    far = {f: 1 / np.asarray(largest(f)) for f in (minimax, allocation)}
    assert far[minimax].min() == pytest.approx(1.63299, abs=2e-3) and far[minimax].max() == pytest.approx(
        4 / 3**0.5, abs=1e-5
    )
    assert far[allocation].min() == pytest.approx(4 / 3, abs=2e-3)
    gain = far[minimax] / far[allocation]
    assert gain.min() > 1 - 1e-9 and gain.max() == pytest.approx(1.5, abs=2e-2)


def test_minimax_without_three_independent_wheels_is_the_pseudo_inverse():
    T = Vec3(0.3, -0.2, 0.5)
    for W, up in ((SETS["pyramid"], [0, 1, 1, 0]), (SETS["pyramid"], [0, 0, 0, 0]), (SETS["twins"], [1, 1, 1, 1])):
        up = np.array(up, float)
        np.testing.assert_allclose(minimax(T, W, up), allocation(T, W, up), atol=1e-15)
        assert np.isfinite(jax.grad(lambda W, up: jnp.sum(minimax(T, W, up) ** 2))(W, up)).all()


@pytest.mark.parametrize(
    "axes, up",
    [
        (SETS["one"], 1.0),
        (SETS["twins"], 1.0),  # all in one plane
        (SETS["pyramid"], np.array([0, 1, 1, 0.0])),
        (SETS["pyramid"], np.zeros(4)),
        (np.repeat(SETS["one"], 4, axis=1), 1.0),  # parallel
    ],
)
def test_wheels_that_do_not_span_space_are_refused(axes, up):
    refuse_flat("params.axes", SETS["pyramid"])
    refuse_flat("params.axes", Vec3(*SETS["pyramid"]), np.array([1, 1, 0, 1.0]))
    refuse_flat("params.axes", pyramid(0.8))
    with pytest.raises(ValueError, match=r"`params\.axes` must span space \(least .* but it is [0-9.e-]+\.$"):
        refuse_flat("params.axes", axes, up)


def test_null_motion_moves_momentum_that_the_body_does_not_feel():
    W, u = SETS["pyramid"], np.array([1.0, 2.0, -3.0, 0.5])
    null = np.array([1, -1, 1, -1]) / 2
    np.testing.assert_allclose(null_part(u, W, np.ones(4)), null * (null @ u), atol=1e-14)
    np.testing.assert_allclose(null_part(u, W, np.array([1.0, 1, 0, 1])), 0, atol=1e-14)  # three wheels have none
    six = SETS["six"]
    moved = np.asarray(null_part(np.arange(6.0), six, np.array([1.0, 1, 1, 1, 1, 0])))
    np.testing.assert_allclose(six @ moved, 0, atol=1e-13)
    assert np.abs(moved).max() > 0.1 and moved[5] == 0


def test_the_other_wheels_undo_what_one_that_coasts_does_to_the_body():
    W, change = SETS["pyramid"], np.array([0.1, -2.0, 0.3, 0.4])
    up = np.array([1.0, 0, 1, 1])
    undone = coasting(change, W, up)
    np.testing.assert_allclose(W @ undone + W[:, 1] * change[1], 0, atol=1e-14)
    assert undone[1] == 0


def test_a_wheel_is_limited_and_gives_nothing_outward_when_it_is_full():
    u, h = np.array([3.0, -3.0, 1.0, -1.0, 1.0]), np.array([0.0, 9.0, 10.0, 10.0, -11.0])
    np.testing.assert_array_equal(wheel_rate(u, h, 2.0, 10.0), [2, -2, 0, -1, 1])
    np.testing.assert_array_equal(wheel_rate(u, h, np.inf, np.inf), u)
