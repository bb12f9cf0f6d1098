import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt import fields
from jaxatt.faults import (
    Fault,
    Reading,
    active,
    any_active,
    channel,
    dead,
    dead_where,
    faults_of,
    first_onset,
    healthy,
    heard,
    known,
    on_axes,
    present,
    read,
)
from jaxatt.sensors import heard_triad, read_triad, triad
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


def test_a_kind_without_an_onset_is_there_from_the_start():
    assert Fault(bias=0.1) == Fault(onset=0.0, bias=0.1) and Fault(end=3.0).onset == 0
    assert Fault().onset == np.inf and not bool(active(Fault(), 1e9))
    assert Fault()._replace(bias=0.1).onset == np.inf
    assert jax.tree.map(lambda a: a, Fault(bias=0.1)) == Fault(bias=0.1)
    assert jax.tree.map(lambda a: None, Fault()).onset is None  # given is given
    with pytest.raises(TypeError, match="colour"):
        Fault(colour=3.0)  # pyright: ignore[reportCallIssue]


def test_a_healthy_and_a_dead_channel():
    assert read(healthy(), TRUTH) == TRUTH
    assert reading(dead(2.0, 9.0)) == pytest.approx(NOISY) and reading(dead()) == 0


def test_axes_are_apart():
    faults = Vec3(Fault(0.0, bias=1.0), Fault(), dead())
    y = read_triad(triad(faults, 1.0, 0.0, jnp.zeros(3), Vec3(0.0, 0.0, 0.0)), Vec3(5.0, 6.0, 7.0))
    assert jax.tree.leaves(jax.tree.map(float, y)) == [6.0, 6.0, 0.0]
    assert on_axes(dead()) == Vec3(dead(), dead(), dead())


def test_kinds_are_data():
    one = lambda *kinds: read(channel(Fault(kinds[0], bias=1.0, scale=kinds[1]), 1.0, 0.0, 0.0, 0.0), TRUTH)
    found = jax.vmap(one)(jnp.array([0.0, jnp.inf, 0.0]), jnp.array([1.0, 1.0, 0.5]))
    assert found.tolist() == [3.0, 2.0, 2.0]


def test_the_faults_of_any_tree_are_found():
    early, late = Fault(2.0, 3.0, bias=1.0), Fault(5.0)
    tree = dict(gyro=on_axes(late), star=(early, 7.0), wheel=Reading(1.0, True))
    assert faults_of(tree) == [late, late, late, early] and faults_of(early) == [early]
    assert first_onset(tree) == 2 and first_onset(Fault()) == np.inf
    assert [bool(any_active(tree, t)) for t in (1.0, 2.0, 3.0, 5.0)] == [False, True, False, True]


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
        (Fault(drift=np.nan), r"`gyro\.drift` must be a number, but it is nan\."),
    ],
)
def test_a_fault_that_makes_no_sense_is_refused(fault, message):
    with pytest.raises(ValueError, match=message):
        fields.validate("gyro", fault)
    fields.validate("gyro", on_axes(Fault(onset=3.0)))


def test_those_of_a_mask_are_dead_from_the_onset_on():
    fault = dead_where([0, 1, 0], 5.0)
    assert all(np.shape(leaf) == (3,) for leaf in jax.tree.leaves(fault))
    for t, kept in ((4.9, [1, 1, 1]), (5.0, [1, 0, 1]), (1e6, [1, 0, 1])):
        np.testing.assert_array_equal(read(channel(fault, t, 0.0, 0.0, 0.0), 7.0), 7.0 * np.array(kept))


# missing readings


def test_a_missing_channel_is_not_heard_and_holds_its_last_reading():
    gap = Fault(onset=4.0, end=9.0, missing=1.0, bias=0.3)
    for t, there in ((3.9, True), (4.0, False), (8.9, False), (9.0, True)):
        assert bool(heard(gap, t)) == there
        assert reading(gap, t) == pytest.approx(NOISY if there else LAST)
    assert bool(heard(Fault(), 1e9)) and bool(heard(Fault(stuck=1.0), 5.0))
    triad_ = Vec3(Fault(), gap, Fault())
    assert not bool(heard_triad(triad_, 5.0)) and bool(heard_triad(triad_, 9.0))
    with pytest.raises(ValueError, match=r"`gyro\.missing` must be one of \(0, 1\), but it is 2\."):
        fields.validate("gyro", Fault(missing=2.0))


def test_known_is_the_reading_where_it_is_present():
    """One flag for an array, for a vector, for each of two vectors; NaN and inf are missing; gradients are finite."""
    value = np.array([1.0, np.nan, 3.0, np.inf, 5.0])
    valid = np.array([1, 1, 0, 1, 1], bool)
    np.testing.assert_array_equal(present(Reading(value, valid)), [1, 0, 0, 0, 1])
    np.testing.assert_array_equal(known(Reading(value, valid), 7.0 + np.zeros(5)), [1, 7, 7, 7, 5])
    other = Vec3(7.0, 8.0, 9.0)
    assert known(Reading(Vec3(1.0, 2.0, 3.0), True), other) == (1, 2, 3)
    for gone in (Reading(Vec3(1.0, 2.0, 3.0), False), Reading(Vec3(1.0, jnp.nan, 3.0), True)):
        assert known(gone, other) == other
    two = Reading(Vec3(*np.array([[1.0, 2.0], [3.0, np.nan], [5.0, 6.0]])), np.ones(2, bool))
    np.testing.assert_array_equal(present(two), [1, 0])
    np.testing.assert_array_equal(known(two, Vec3(*np.zeros((3, 2)))), [[1, 0], [3, 0], [5, 0]])
    slope = jax.grad(lambda a, b: known(Reading(a + jnp.nan, True), b), argnums=(0, 1))(2.0, 3.0)
    assert slope == (0, 1)
