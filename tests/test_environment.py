"""The table of surroundings: its interpolation, its ends, its checks, its gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt import fields
from jaxatt.environment import Table, at, refuse_short, span
from jaxatt.orbit import EARTH, Elements, along, dipole_field, igrf_field, kepler
from jaxatt.vec import Vec3, array, norm

EPOCH = "2026-03-21T00:00"
LOW = Elements(a=EARTH + 500e3, i=np.deg2rad(97.4), node=np.deg2rad(50))
T = np.arange(-10.0, 6021.0, 10.0)
TABLE = along(T, *kepler(LOW, T), EPOCH)
BETWEEN = np.arange(0.0, 6000.0, 2.5)
EACH = jax.jit(jax.vmap(at, in_axes=(None, 0)))
FOUND = EACH(TABLE, BETWEEN)
ONE, SLOPE = jax.jit(at), jax.jit(jax.jacfwd(at, argnums=1))


def rows(v: Vec3):
    return np.asarray(array(v)).T


def test_the_cubic_goes_through_the_rows_with_the_slope_of_the_neighbours():
    """Catmull & Rom: a polynomial of second degree is met exactly; at a row the slope is that between its neighbours."""
    t = 3.0 + 0.5 * np.arange(7)
    square = Vec3(t * t, 2 * t - 1, 0 * t + 4)
    table = Table(3.0, 0.5, square, Vec3(0 * t + 1, 0 * t, 0 * t), 0 * t, square, square, np.abs(t))
    for s in (3.5, 3.7, 4.0, 4.9, 5.5):
        np.testing.assert_allclose(array(ONE(table, s).field), [s * s, 2 * s - 1, 4], rtol=1e-14)
    kinked = table._replace(r=Vec3(np.array([0, 1, 4, 2, 7, 5, 0.0]), t, t))
    for s in (4.0 - 1e-9, 4.0 + 1e-9):
        assert SLOPE(kinked, s).r.x == pytest.approx((2 - 1) / (2 * 0.5), abs=1e-7)


def test_ten_seconds_keep_the_field_within_a_hundredth_of_a_nanotesla():
    """.006 nT a component by the cubic, 2.05 nT by straight lines; position and velocity by the cubic's third-order term."""
    r, v = kepler(LOW, BETWEEN)
    true = dipole_field(BETWEEN, r, EPOCH)
    assert np.abs(rows(FOUND.field) - true).max() == pytest.approx(0.006e-9, abs=0.0005e-9)
    straight = np.stack([np.interp(BETWEEN, T, c) for c in TABLE.field], -1)
    assert np.abs(straight - true).max() == pytest.approx(2.05e-9, abs=0.01e-9)
    third = (
        (1.1067836e-3 * 10) ** 3 / 6 * np.sqrt(3) / 18
    )  # slopes are h^2/6 third derivatives off: s (1 - s) (1 - 2 s) of it
    np.testing.assert_allclose(rows(FOUND.r), r, atol=1.05 * third * LOW.a)
    np.testing.assert_allclose(rows(FOUND.v), v, atol=1.05 * third * 7613)


def test_the_table_of_a_library_keeps_its_field_too():
    """IGRF of degree 13 is rougher than a dipole: .03 nT a component, 4 nT by straight lines."""
    pytest.importorskip("ppigrf")
    table = along(T, *kepler(LOW, T), EPOCH, field=igrf_field)
    true = igrf_field(BETWEEN, kepler(LOW, BETWEEN)[0], EPOCH)
    assert np.abs(rows(EACH(table, BETWEEN).field) - true).max() < 0.03e-9
    straight = np.stack([np.interp(BETWEEN, T, c) for c in table.field], -1)
    assert np.abs(straight - true).max() > 4e-9


def test_the_sun_stays_a_unit_vector_and_shadow_edges_do_not_overshoot():
    np.testing.assert_allclose(np.linalg.norm(rows(FOUND.sun), axis=1), 1, rtol=1e-14)
    np.testing.assert_allclose(FOUND.lit, np.interp(BETWEEN, T, TABLE.lit), atol=1e-12)
    assert FOUND.lit.min() == 0 and FOUND.lit.max() == 1
    np.testing.assert_allclose(FOUND.density, np.interp(BETWEEN, T, TABLE.density), rtol=1e-12)


def test_outside_its_span_the_table_stays_at_the_ends():
    first, last = span(TABLE)
    assert (first, last) == (0, 6010)
    for t, row in ((-1e9, 1), (-3.0, 1), (0.0, 1), (6010.0, -2), (6015.0, -2), (1e9, -2)):
        found = ONE(TABLE, t)
        np.testing.assert_allclose(array(found.field), [c[row] for c in TABLE.field], rtol=1e-12)
        assert found.density == TABLE.density[row]
        assert np.isfinite(jax.tree.leaves(SLOPE(TABLE, t))).all()


@pytest.mark.parametrize("first, last", [(-1.0, 100.0), (0.0, 6011.0), (np.zeros(3), np.array([1.0, 7000.0, 2.0]))])
def test_a_table_shorter_than_the_run_is_refused(first, last):
    refuse_short("table", TABLE, 0.0, 6010.0)
    with pytest.raises(ValueError, match=r"`table` must reach from .* but it is good from 0 s to 6010 s"):
        refuse_short("table", TABLE, first, last)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda t: jax.tree.map(lambda a: a[:3] if np.ndim(a) else a, t), "`table` must have four rows or more"),
        (lambda t: t._replace(sun=2 * t.sun), r"`\|table.sun\|\[0\]` must be 1"),
        (lambda t: t._replace(step=0.0), r"`table\.step` must be a positive number"),
        (lambda t: t._replace(lit=t.lit + 1), r"`table\.lit\[0\]` must lie in \[0, 1\]"),
        (lambda t: t._replace(density=t.density[1:]), r"`table\.density` must have shape"),
        (lambda t: t._replace(field=np.nan * t.field), r"`table\.field"),
    ],
)
def test_a_table_that_is_none_is_refused(change, message):
    fields.validate("table", TABLE)
    with pytest.raises(ValueError, match=message):
        fields.validate("table", change(TABLE))


def test_gradients_are_those_of_central_differences_and_float32_does():
    """A cubic's central difference is off by h^2 times its third-order term alone: 1e-8 of the slope at 1 ms."""
    h = 1e-3
    for t in (3.0, 1237.0, 5999.0):
        central = jax.tree.map(lambda a, b: (a - b) / (2 * h), ONE(TABLE, t + h), ONE(TABLE, t - h))
        for name, slope, expected in zip(central._fields, SLOPE(TABLE, t), central):
            size = float(norm(expected) if isinstance(expected, Vec3) else abs(expected))
            rounding = 1e-13 * float(norm(getattr(ONE(TABLE, t), name))) if isinstance(expected, Vec3) else 1e-28
            np.testing.assert_allclose(slope, expected, atol=1e-6 * size + rounding / h)
    by_row = jax.jit(jax.grad(lambda B, t: at(TABLE._replace(field=B), t).field.y))(TABLE.field, 1237.0)
    assert float(sum(by_row.y)) == pytest.approx(1) and not np.any(by_row.x)
    single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), TABLE)
    found = ONE(single, jnp.float32(1237.0))
    assert found.field.x.dtype == jnp.float32
    np.testing.assert_allclose(array(found.field), array(ONE(TABLE, 1237.0).field), atol=1e-6 * 5e-5)


def test_scenarios_behind_one_table_are_each_served_at_their_own_time():
    for i in (0, 5, 2360):
        for a, b in zip(jax.tree.leaves(FOUND), jax.tree.leaves(ONE(TABLE, BETWEEN[i]))):
            np.testing.assert_allclose(a[i], b, rtol=1e-12, atol=1e-18)
