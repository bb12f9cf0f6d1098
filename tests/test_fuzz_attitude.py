"""Abuse of conversions: near lock, half turns and whole turns, quaternions of any length, in both precisions."""

import jax
import numpy as np
from abuse import fuzzed
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxatt import attitude
from jaxatt.vec import Mat3, Quat, Vec3, array

TRICKY = [0.0, 1e-12, 1e-8, 1e-6, 1e-4, 1e-2]
ANGLES = st.one_of(
    st.floats(-10, 10),
    st.builds(lambda n, off, sign: n * np.pi / 2 + sign * off, st.integers(-4, 4), st.sampled_from(TRICKY), st.sampled_from([-1, 1])),
)  # fmt: skip
THREE = st.tuples(ANGLES, ANGLES, ANGLES)
REAL = st.sampled_from([np.float32, np.float64])
BACK = jax.jit(lambda q: attitude.quat_from_euler(attitude.euler_from_quat(q)))
TRIPS = {
    "MRP": jax.jit(lambda q: attitude.quat_from_mrp(attitude.mrp_from_quat(q))),
    "matrix": jax.jit(lambda q: attitude.quat_from_matrix(attitude.quat_matrix(q))),
    "vector": jax.jit(lambda q: attitude.quat_from_vector(attitude.vector_from_quat(q))),
    "3-2-1": BACK,
    "3-1-3": jax.jit(lambda q: attitude.quat_from_angles(attitude.angles_from_quat(q, "313"), "313")),
}
EULER = jax.jit(lambda a: (attitude.quat_from_euler(a), attitude.euler_from_quat(attitude.quat_from_euler(a))))
WRAPPED = jax.jit(attitude.wrapped)


def apart(p, q):
    """Angle [rad] between two attitudes given as arrays, scalar first, of any length."""
    a, b = (Rotation.from_quat(np.asarray(c, float), scalar_first=True) for c in (p, q))
    return (a.inv() * b).magnitude()


@fuzzed
@given(THREE, st.floats(0.2, 5.0), REAL, st.sampled_from(sorted(TRIPS)))
def test_every_round_trip_keeps_the_attitude(turn, length, real, kind):
    q = Rotation.from_euler("ZYX", turn).as_quat(scalar_first=True).astype(real)
    back = TRIPS[kind](Quat(*(q * real(length))))
    assert apart(array(back), q) < 20 * np.finfo(real).eps ** (1.0 if real == np.float64 else 0.95)


@fuzzed
@given(THREE, REAL)
def test_euler_angles_come_back_as_the_same_attitude_and_finite(turn, real):
    start = Vec3(*(real(a) for a in turn))
    q, a = EULER(start)
    assert all(np.isfinite(c) for c in a)
    assert abs(float(a.y)) <= np.pi / 2 + 1e-6
    assert apart(array(EULER(a)[0]), array(q)) < 20 * np.finfo(real).eps


@fuzzed
@given(st.floats(-1e4, 1e4), st.sampled_from([2 * np.pi, 360.0]))
def test_a_difference_modulo_a_turn_is_short_and_whole_turns_off(a, turn):
    short = float(WRAPPED(np.float64(a), turn))
    assert abs(short) <= turn / 2 * (1 + 1e-9)
    turns = (a - short) / turn
    assert abs(turns - round(turns)) < 1e-9


@fuzzed
@given(THREE, st.floats(1e-9, 1e-6), st.integers(0, 2**31))
def test_a_matrix_of_few_digits_gives_the_nearest_rotation(turn, size, seed):
    exact = Rotation.from_euler("ZYX", turn).as_matrix()
    spoiled = exact + size * np.random.default_rng(seed).normal(size=(3, 3))
    u, _, vt = np.linalg.svd(spoiled)
    near = array(attitude.nearest_rotation(Mat3.of(spoiled)))
    np.testing.assert_allclose(near, u @ vt, atol=1e-13)
