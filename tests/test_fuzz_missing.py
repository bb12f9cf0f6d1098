"""Abuse of what a filter is told: missing data and impossible variances.

No perfect fit, no NaN in what is believed, nothing moved by what is not there.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from abuse import fuzzed
from hypothesis import given
from hypothesis import strategies as st

from jaxatt import Now, Quat, Vec3, filters, mekf, star_filters
from jaxatt.attitude import vector_from_quat
from jaxatt.faults import Reading, known, present
from jaxatt.loops import observer_pd
from jaxatt.observers import AttitudeRate
from jaxatt.vec import array, zeros

VALUES = [0.0, 1.0, -3.0, 1e-6, 1e6, float("nan"), float("inf"), -float("inf")]
VARIANCES = [1.0, 1e-3, 0.0, 1e6, -1.0, -1e-9, float("nan")]
three = st.tuples(*[st.sampled_from(VALUES)] * 3)
spread = st.tuples(*[st.sampled_from(VARIANCES)] * 3)
flags = st.tuples(*[st.booleans()] * 3)


@jax.jit
def dense(P, R, y, valid):
    belief = filters.Belief(jnp.zeros(3), jnp.diag(P))
    return filters.update(belief, Reading(y, valid), lambda x: x, jnp.broadcast_to(R, (3,)))


@jax.jit
def few(P, R, y, valid):
    belief = star_filters.Belief(Vec3(0.0, 0.0, 0.0), star_filters.diagonal(*P))
    reading = Reading(Vec3(*y), valid[0])
    mean, cov, told = star_filters.update_three(belief, reading, lambda a: Vec3(*a), belief.mean, R)
    return star_filters.Belief(array(mean), jnp.array(cov)), told


@jax.jit
def by_vector(P, R, y, valid):
    belief = mekf.Mekf(Quat(1.0, 0.0, 0.0, 0.0), zeros(), jnp.diag(jnp.concatenate([P, jnp.ones(3)])))
    belief = jax.tree.map(lambda a: jnp.asarray(a, float), belief)
    after, told = mekf.update_vector(belief, Reading(Vec3(*y), valid[0]), Vec3(0.2, -0.9, 0.4), R)
    return filters.Belief(array(vector_from_quat(after.q)), after.P[:3, :3]), told


@pytest.mark.parametrize("update", [dense, few, by_vector])
def test_updates(update):
    @fuzzed
    @given(spread, st.sampled_from(VARIANCES), three, flags)
    def run(P, R, y, valid):
        P, y, valid = np.array(P), np.array(y), np.array(valid)
        belief, told = update(P, R, y, valid)
        there = valid & np.isfinite(y) if update is dense else np.full(3, valid[0] & np.isfinite(y).all())
        possible = (P >= 0).all() and (R >= 0 or not there.any())
        if possible and there.any() and (P + R > 0).all():
            assert told.nis >= 0 and np.isfinite(told.nll) and np.isfinite(belief.mean).all()
            assert (np.diag(belief.cov) >= 0).all() and (np.diag(belief.cov) <= P).all()
        elif there.any() and not possible:
            assert np.isnan(told.nis) and np.isnan(told.nll)
        if not there.any() or not possible:
            assert (belief.mean == 0).all()
            np.testing.assert_array_equal(np.diag(belief.cov), P)

    run()


@jax.jit
def completed(value, valid, other):
    return known(Reading(value, valid), other), present(Reading(value, valid)), jax.grad(
        lambda v, o: jnp.sum(known(Reading(v + value, valid), o) ** 2), argnums=(0, 1)
    )(jnp.zeros(3), other)  # fmt: skip


def test_missing_readings():
    @fuzzed
    @given(three, flags, st.sampled_from([0.5, -2.0]))
    def run(value, valid, other):
        value, valid = np.array(value), np.array(valid)
        there = valid & np.isfinite(value)
        got, is_there, slopes = completed(value, valid, np.full(3, other))
        np.testing.assert_array_equal(got, np.where(there, value, other))
        np.testing.assert_array_equal(is_there, there)
        assert all(np.isfinite(a).all() for a in slopes)

    run()


@jax.jit
def looked(y, valid, estimate):
    y = AttitudeRate(Reading(Vec3(*y[:3]), valid[0]), Reading(Vec3(*y[3:]), valid[1]))
    computer = observer_pd.Computer(AttitudeRate(Vec3(*estimate[:3]), Vec3(*estimate[3:])), 100.0)
    after, (xi, alarmed) = observer_pd.decide(observer_pd.params, Now(jnp.asarray(3), 0.3, 0.1), computer, y)
    return after, xi, alarmed, observer_pd.computer_flow(observer_pd.params, after, y)


def test_an_observer_without_readings():
    @fuzzed
    @given(three, three, flags)
    def run(q, w, valid):
        y, valid = np.concatenate([q, w]), np.array(valid[:2])
        there = valid & np.isfinite(y.reshape(2, 3)).all(axis=1)
        after, xi, alarmed, rate = looked(y, valid, np.array([0.1, 0.2, -0.3, 0.01, 0.02, 0.03]))
        assert all(np.isfinite(a).all() for a in jax.tree.leaves((after, xi, rate)))
        assert there.any() or (xi == 0 and not alarmed)

    run()
