"""Reaction wheels: the drive of one wheel and what spoils it, limits and allocation of several."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt.vec import Vec3, project
from jaxatt.wheels import Wheel, allocation, beyond, gated, wheel_acceleration, wheel_pyramid, wheel_rate

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
        Wheel(stiction=3e4),
        Wheel(u_max=1000.0),
    ],
)
def test_wheel_has_finite_gradients_everywhere(wheel):
    for y in (0.0, 1e-3, 1500.0, 1e9):
        for u in (0.0, 1000.0, 2000.0):
            grads = jax.grad(wheel_acceleration, (0, 1, 2))(jax.tree.map(float, wheel), y, u)
            assert np.isfinite(jax.tree.leaves(grads)).all()


# several wheels


def wheel_matrix(gamma):
    """W (3, 4) of the pyramid."""
    return np.asarray(project(wheel_pyramid(gamma), Vec3.of(np.eye(3)))).T


def test_wheel_axes_are_unit_and_as_the_paper_says():
    W = wheel_matrix(np.pi / 4)
    np.testing.assert_allclose(W @ W.T, np.diag([1, 1, 2]), atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(wheel_matrix(0.3), axis=0), 1, atol=1e-15)


@pytest.mark.parametrize("up", [(1, 1, 1, 1), (0, 1, 1, 1), (0, 1, 1, 0)])
def test_allocation_is_the_pseudo_inverse_of_the_wheels_that_are_up(up):
    T = np.array([0.3, -0.2, 0.5])
    u = allocation(Vec3.of(T), wheel_pyramid(np.pi / 4), jnp.asarray(up, float))
    np.testing.assert_allclose(u, np.linalg.pinv(wheel_matrix(np.pi / 4) * np.array(up)) @ T, atol=3e-6)


def test_allocation_without_any_wheel_is_zero():
    u = allocation(Vec3(0.3, -0.2, 0.5), wheel_pyramid(np.pi / 4), jnp.zeros(4))
    np.testing.assert_array_equal(u, np.zeros(4))


def test_a_wheel_is_limited_and_gives_nothing_outward_when_it_is_full():
    u, h = np.array([3.0, -3.0, 1.0, -1.0, 1.0]), np.array([0.0, 9.0, 10.0, 10.0, -11.0])
    np.testing.assert_array_equal(wheel_rate(u, h, 2.0, 10.0), [2, -2, 0, -1, 1])
    np.testing.assert_array_equal(wheel_rate(u, h, np.inf, np.inf), u)
