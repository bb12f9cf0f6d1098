import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt.faults import Fault, active, any_active, channel, check_fault, dead, first_onset, on_axes, read
from jaxatt.sensors import read_triad, triad
from jaxatt.vec import Vec3

TRUTH, STD, NORMAL, LAST = 2.0, 0.1, 1.5, -7.0
NOISY = TRUTH + STD * NORMAL


def reading(fault, t=10.0):
    return float(read(channel(fault, t, STD, NORMAL, LAST), TRUTH))


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (Fault(onset=4.0), NOISY),
        (Fault(onset=4.0, bias=0.3), NOISY + 0.3),
        (Fault(onset=4.0, drift=0.5, tau=3.0), NOISY + 0.5 * (1 - np.exp(-2.0))),
        (Fault(onset=4.0, random=0.24, growth=0.7), TRUTH + np.hypot(0.24, 0.7 * STD) * NORMAL),
        (Fault(onset=4.0, scale=0.6), 0.6 * TRUTH + STD * NORMAL),
        (Fault(onset=4.0, growth=5.0), TRUTH + 5 * STD * NORMAL),
        (Fault(onset=4.0, stuck=1.0), LAST),
        (dead(4.0), 0.0),
        (Fault(onset=4.0, bias=0.3, scale=0.5), 0.5 * TRUTH + 0.3 + STD * NORMAL),
    ],
)
def test_every_kind_between_onset_and_end_only(fault, expected):
    assert reading(fault) == pytest.approx(expected, rel=1e-12, abs=1e-15)
    assert reading(fault, t=3.9) == pytest.approx(NOISY)
    assert reading(fault._replace(end=10.0), t=10.0) == pytest.approx(NOISY)
    assert bool(active(fault, 4.0)) and not bool(active(fault._replace(end=4.0), 4.0))


def test_kinds_are_data_in_lanes_and_axes_are_apart():
    faults = Vec3(Fault(onset=jnp.array([0.0, jnp.inf]), bias=jnp.array([1.0, 1.0])), Fault(), dead())
    channels = triad(faults, 1.0, 0.0, jnp.zeros((3, 2)), Vec3(0.0, 0.0, 0.0))
    y = read_triad(channels, Vec3(5.0, 6.0, 7.0))
    np.testing.assert_array_equal(np.broadcast_arrays(*y), [[6, 5], [6, 6], [0, 0]])
    assert first_onset(faults).tolist() == [0, 0]
    assert any_active([faults.x, faults.y], 1.0).tolist() == [True, False]


def test_gradients_of_a_healthy_and_a_faulty_channel_are_finite():
    for fault in (Fault(), Fault(onset=0.0), Fault(onset=1.0, drift=1.0), dead(0.0)):
        loss = lambda f: read(channel(f, 1.0, 0.0, 0.0, 0.0), 0.0)
        gradient = jax.grad(loss)(jax.tree.map(jnp.asarray, fault))
        assert all(np.isfinite(g) for g in jax.tree.leaves(gradient))


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (Fault(onset=np.nan), r"`gyro\.onset` must be a number, but it is nan\."),
        (Fault(tau=0.0), r"`gyro\.tau` must be a positive number, but it is 0\."),
        (Fault(random=-1.0), r"`gyro\.random` must not be negative, but it is -1\."),
        (Fault(stuck=0.5), r"`gyro\.stuck` must be one of \(0, 1\), but it is 0\.5\."),
        (Fault(onset=5.0, end=4.0), r"`gyro\.end` must not lie before the onset, but it is 4\."),
        (Fault(bias=np.array([0.0, np.nan])), r"`gyro\.bias` must be a number, but it is nan in scenario 1\."),
    ],
)
def test_a_fault_that_makes_no_sense_is_refused(fault, message):
    with pytest.raises(ValueError, match=message):
        check_fault("gyro", fault)
    check_fault("gyro", on_axes(Fault(onset=3.0)).x)
