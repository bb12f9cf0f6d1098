"""Sensors: where gyros point."""

import jax
import numpy as np

from jaxatt.faults import Fault, Reading, on_axes
from jaxatt.loops.gyro_ekf import DEG
from jaxatt.sensors import gyro_pyramid, parity_vector, quantised, rate_from, rate_maps, read_triad, triad
from jaxatt.vec import Vec3, array, project

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
    np.testing.assert_array_equal(rate_maps(G.T), rate_maps(axes))  # an array (3, n) is read by columns


def test_the_parity_vector_watches_what_it_can_where_three_axes_lie_in_a_plane():
    a, b, c = (Vec3.of(row) for row in np.eye(3))
    v = np.asarray(parity_vector((a, b, c, (b + c) / np.sqrt(2))))  # the last three lie in a plane
    np.testing.assert_allclose(np.abs(v), [0, 0.5, 0.5, np.sqrt(0.5)], atol=1e-15)
    np.testing.assert_allclose(v @ np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0.5**0.5, 0.5**0.5]]), 0, atol=1e-15)
