"""Orbits and what they meet: Kepler, field, Sun, shadow and air, against integration, libraries and by component."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from jaxatt import fields, orbit
from jaxatt.orbit import EARTH, MU, SUN_RADIUS, Elements, along, kepler

EPOCH = "2026-03-21T00:00"
LOW = Elements(a=EARTH + 500e3, i=np.deg2rad(97.4), node=np.deg2rad(50))  # circular, 500 km
PERIOD = 2 * np.pi * np.sqrt(LOW.a**3 / MU)
T = np.arange(0.0, PERIOD, 60.0)
R, V = kepler(LOW, T)


def angle(a, b):
    """Angles [rad] between vectors (n, 3)."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))


# orbits


@pytest.mark.parametrize("e", [0.0, 0.3, 0.85])
def test_keplers_orbit_is_that_of_the_equation_of_motion(e):
    elements = Elements(2e7, e, 1.1, 0.7, -0.4, 0.3)
    t = np.linspace(0, 40_000, 9)
    r, v = kepler(elements, t)
    pull = lambda _, x: np.concatenate([x[3:], -MU * x[:3] / np.linalg.norm(x[:3]) ** 3])
    found = solve_ivp(pull, (0, t[-1]), np.concatenate([r[0], v[0]]), "DOP853", t, rtol=1e-13, atol=1e-6)
    np.testing.assert_allclose(r, found.y[:3].T, atol=1e-9 * elements.a)
    np.testing.assert_allclose(v, found.y[3:].T, atol=1e-5)


def test_keplers_orbit_has_its_elements():
    a, e, i, node, perigee, anomaly = Elements(2e7, 0.3, 1.1, 0.7, -0.4, 0.3)
    (r,), (v,) = kepler(Elements(a, e, i, node, perigee, anomaly), [0.0])
    h = np.cross(r, v)
    assert np.arccos(h[2] / np.linalg.norm(h)) == pytest.approx(i, rel=1e-12)
    assert np.arctan2(h[0], -h[1]) == pytest.approx(node, rel=1e-12)
    apse = np.cross(v, h) / MU - r / np.linalg.norm(r)
    assert np.linalg.norm(apse) == pytest.approx(e, rel=1e-12)
    ascending = np.array([np.cos(node), np.sin(node), 0])
    assert np.arctan2(apse @ np.cross(h / np.linalg.norm(h), ascending), apse @ ascending) == pytest.approx(perigee)
    assert v @ v / 2 - MU / np.linalg.norm(r) == pytest.approx(-MU / (2 * a), rel=1e-12)
    E: Any = brentq(lambda E: E - e * np.sin(E) - anomaly, -4, 4, xtol=1e-15)
    assert np.linalg.norm(r) == pytest.approx(a * (1 - e * np.cos(E)), rel=1e-12)


@pytest.mark.parametrize("e", [0.0, 0.5, 0.95, 0.999])
def test_keplers_equation_is_solved_at_every_anomaly(e):
    """Backwards: the anomaly of the position is the mean one that was asked for."""
    mean = np.linspace(-9, 9, 401)
    r, _ = kepler(Elements(1e7, e), mean / np.sqrt(MU / 1e21))
    E = np.arctan2(r[:, 1] / np.sqrt(1 - e * e), r[:, 0] + 1e7 * e)
    back = E - e * np.sin(E) - mean
    np.testing.assert_allclose(back - 2 * np.pi * np.round(back / (2 * np.pi)), 0, atol=1e-9)


def test_the_low_orbit_is_that_of_the_numbers():
    assert pytest.approx(5676.98, abs=5e-3) == PERIOD and 2 * np.pi / PERIOD == pytest.approx(1.1067836e-3, rel=1e-7)
    np.testing.assert_allclose(np.linalg.norm(R, axis=1), EARTH + 500e3, rtol=1e-12)


# fields, by component: a flipped sign passes every test of the magnitude


def test_over_the_north_pole_the_field_points_down_and_over_the_equator_north():
    pole = np.array([[0, 0, 7e6], [0, 0, -7e6]])
    B = orbit.dipole_field(np.zeros(2), pole, EPOCH)
    assert B[0, 2] < -4e-5 and B[1, 2] < -4e-5  # down over the north, up over the south: along -z at both
    equator = 7e6 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0.0]])
    assert (orbit.dipole_field(np.zeros(3), equator, EPOCH)[:, 2] > 2e-5).all()


def test_the_dipole_is_minus_the_gradient_of_its_potential():
    """V = a^3 (g11 x + h11 y + g10 z) / r^3 in Earth-fixed axes, B = -grad V, by central differences."""
    g11, h11, g10 = -1410.3e-9, 4545.5e-9, -29350.0e-9
    t, r = np.array([0.0, 4000.0]), np.array([[5e6, -4e6, 2e6], [-3e6, 1e6, 6.5e6]])
    fixed = orbit.to_earth_fixed(r, t, EPOCH)
    V = lambda x: 6371.2e3**3 * (x @ [g11, h11, g10]) / np.linalg.norm(x, axis=-1) ** 3
    B = -np.stack([(V(fixed + d) - V(fixed - d)) / 200 for d in 100 * np.eye(3)], -1)
    found = orbit.to_earth_fixed(orbit.dipole_field(t, r, EPOCH), t, EPOCH)
    np.testing.assert_allclose(found, B, rtol=1e-7, atol=1e-14)


def test_the_earth_turns_eastwards_once_a_sidereal_day():
    """The Earth-fixed x axis crosses inertial axes counter-clockwise; in at the epoch 2000-01-01T12:00 it is at 280.46 deg."""
    assert orbit.sidereal_angle(0.0, "2000-01-01T12:00") == pytest.approx(np.deg2rad(280.46061837), rel=1e-12)
    day = 86164.0905
    angles = np.unwrap(orbit.sidereal_angle(day / 4 * np.arange(5), EPOCH))
    np.testing.assert_allclose(np.diff(angles), np.pi / 2, atol=1e-7)
    r = np.array([[7e6, 1e6, -2e6]])
    np.testing.assert_allclose(orbit.to_inertial(orbit.to_earth_fixed(r, 1e4, EPOCH), 1e4, EPOCH), r, rtol=1e-14)
    east = orbit.to_inertial(np.array([[1.0, 0, 0]]), np.array([0.0]), EPOCH)[0]
    angle = float(orbit.sidereal_angle(0.0, EPOCH))
    np.testing.assert_allclose(east, [np.cos(angle), np.sin(angle), 0], atol=1e-15)


# light


def test_the_sun_stands_where_the_seasons_put_it():
    """Equinox of 20 March 2026, 14:46 UTC, and solstice of 21 June 2026, 08:24 UTC: declination 0 and 23.44 deg."""
    (equinox,) = orbit.almanac_sun(np.array([0.0]), "2026-03-20T14:46")
    np.testing.assert_allclose(equinox, [1, 0, 0], atol=np.deg2rad(0.01))
    (solstice,) = orbit.almanac_sun(np.array([0.0]), "2026-06-21T08:24")
    np.testing.assert_allclose(solstice, [0, np.cos(np.deg2rad(23.436)), np.sin(np.deg2rad(23.436))], atol=2e-4)


def test_the_shadow_is_a_cone_with_a_penumbra():
    """Behind the Earth the disc vanishes over the Sun's diameter, seen from the satellite, about the Earth's limb."""
    d = 7e6
    limb = np.arcsin(EARTH / d)
    off = limb + np.array([-3, -1.001, -0.999, -0.5, 0, 0.5, 0.999, 1.001, 3]) * SUN_RADIUS
    r = d * np.stack([-np.cos(off), np.sin(off), 0 * off], -1)
    lit = orbit.sunlit(r, np.array([1.0, 0, 0]))
    np.testing.assert_allclose(lit, [0, 0, 0.0005, 0.25, 0.5, 0.75, 0.9995, 1, 1], atol=1e-6)
    ahead = d * np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]])
    assert orbit.sunlit(ahead, np.array([1.0, 0, 0])).tolist() == [1, 1, 1]


def test_the_low_orbit_is_lit_for_69_percent():
    t = np.arange(0.0, PERIOD, 1.0)
    lit = orbit.sunlit(kepler(LOW, t)[0], orbit.almanac_sun(t, EPOCH))
    assert lit.mean() == pytest.approx(0.693, abs=5e-4 + 1e-3)  # to three digits, and one second of the orbit


# air


def test_the_air_is_that_of_the_table_and_falls_between_its_rows():
    at = lambda *km: orbit.exponential_density(0.0, np.array([[EARTH + 1e3 * h, 0, 0] for h in km]), EPOCH)
    np.testing.assert_allclose(at(500, 400, 1000), [6.967e-13, 3.725e-12, 3.019e-15], rtol=1e-9)
    np.testing.assert_allclose(at(530), 6.967e-13 * np.exp(-30 / 63.822), rtol=1e-9)
    assert (np.diff(at(*range(150, 1500, 10))) < 0).all()
    assert at(599.999)[0] == pytest.approx(at(600.001)[0], rel=0.01)  # the rows join
    with pytest.raises(ValueError, match="`r` must lie above 150 km, but it is at 100"):
        at(100)


# tables


def test_a_table_holds_its_columns():
    t = np.arange(-10.0, 301.0, 10.0)
    r, v = kepler(LOW, t)
    table = along(t, r, v, EPOCH)
    fields.validate("table", table)
    assert (table.start, table.step) == (-10, 10)
    np.testing.assert_array_equal(np.stack(table.field, -1), orbit.dipole_field(t, r, EPOCH))
    np.testing.assert_array_equal(np.stack(table.sun, -1), orbit.almanac_sun(t, EPOCH))
    np.testing.assert_array_equal(np.stack(table.r, -1), r)
    np.testing.assert_array_equal(np.stack(table.v, -1), v)
    np.testing.assert_array_equal(table.density, orbit.exponential_density(t, r, EPOCH))
    np.testing.assert_array_equal(table.lit, orbit.sunlit(r, orbit.almanac_sun(t, EPOCH)))
    own = along(t, r, v, EPOCH, field=lambda t, r, epoch: 0 * r + 1e-5, density=lambda t, r, epoch: 1e-12 + 0 * t)
    assert (own.field.x == 1e-5).all() and (own.density == 1e-12).all()


FOUR = np.arange(4.0)
GOOD = np.tile([7e6, 0, 0], (4, 1))


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: along(FOUR[:3], GOOD[:3], GOOD[:3], EPOCH), "`t` must be four times or more"),
        (
            lambda: along(FOUR**2, GOOD, GOOD, EPOCH),
            "`t` must have equal steps forward, but it is one with steps from 1",
        ),
        (lambda: along(-FOUR, GOOD, GOOD, EPOCH), "`t` must have equal steps forward"),
        (lambda: along(FOUR * np.nan, GOOD, GOOD, EPOCH), "`t` must have equal steps forward"),
        (lambda: along(FOUR, GOOD.T, GOOD, EPOCH), r"`r` must have shape \(4, 3\), but it is of shape \(3, 4\)"),
        (lambda: along(FOUR, GOOD, np.nan * GOOD, EPOCH), r"`v\[0, 0\]` must be finite"),
        (lambda: along(FOUR, GOOD, GOOD, "21.3.2026"), "`epoch` must be a date like"),
        (lambda: along(FOUR, GOOD, GOOD, 2026), "`epoch` must be a date like .* but it is 2026"),
        (lambda: along(FOUR, GOOD, GOOD, None), "`epoch` must be a date like .* but it is None"),
        (lambda: along(FOUR, GOOD, GOOD, EPOCH, density=lambda *_: 1e-12), r"`density` must have shape \(4,\)"),
        (lambda: along(FOUR, GOOD, GOOD, EPOCH, sun=lambda *_: np.ones(3)), r"`sun` must have shape \(4, 3\)"),
        (lambda: kepler(Elements(7e6, 1.2), [0.0]), "`elements` must be an ellipse"),
        (lambda: kepler(Elements(-7e6), [0.0]), "`elements` must be an ellipse"),
    ],
)
def test_what_makes_no_table_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# libraries: their own numbers, and ours beside them


def test_the_field_is_that_of_ppigrf():
    """By its geodetic face, over the poles and along the low orbit; our frames turn it, component by component."""
    igrf = pytest.importorskip("ppigrf").igrf
    from datetime import datetime

    B = orbit.to_earth_fixed(orbit.igrf_field(T, R, EPOCH), T, EPOCH)
    latitude, longitude, height = orbit.geodetic(orbit.to_earth_fixed(R, T, EPOCH))
    east, north, up = (a.ravel() for a in igrf(np.rad2deg(longitude), np.rad2deg(latitude), height / 1e3, datetime(2026, 3, 21)))  # fmt: skip
    sl, cl, sp, cp = np.sin(longitude), np.cos(longitude), np.sin(latitude), np.cos(latitude)
    axes = [
        np.stack([-sl, cl, 0 * sl], -1),
        np.stack([-sp * cl, -sp * sl, cp], -1),
        np.stack([cp * cl, cp * sl, sp], -1),
    ]
    expected = 1e-9 * sum(b[:, None] * axis for b, axis in zip((east, north, up), axes))
    np.testing.assert_allclose(B, expected, atol=1e-10)  # .1 nT


def test_the_dipole_is_off_the_field_by_what_the_module_says():
    """A day at 500 km over the poles: 23 % (rms over rms), up to 34 deg in direction, over the South Atlantic."""
    pytest.importorskip("ppigrf")
    t = np.arange(0.0, 86400.0, 120.0)
    r, _ = kepler(LOW, t)
    true, dipole = orbit.igrf_field(t, r, EPOCH), orbit.dipole_field(t, r, EPOCH)
    assert np.linalg.norm(dipole - true) / np.linalg.norm(true) == pytest.approx(0.23, abs=5e-3)
    assert np.rad2deg(angle(dipole, true).max()) == pytest.approx(34, abs=1)


def test_the_sun_is_within_a_hundredth_of_a_degree_of_astropy():
    pytest.importorskip("astropy")
    for epoch in ("1995-08-01T03:00", EPOCH, "2035-11-05T18:00"):
        t = np.arange(0, 300 * 86400.0, 20 * 86400)
        off = np.rad2deg(angle(orbit.almanac_sun(t, epoch), orbit.astropy_sun(t, epoch)))
        assert off.max() < 0.0125  # .01 deg of the formulas, .0025 deg of nutation between mean and true equator


def test_sidereal_time_is_that_of_astropy():
    time = pytest.importorskip("astropy.time")
    from astropy.utils import iers  # pyright: ignore[reportMissingImports]

    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        times = time.Time("2026-03-21T00:00:00", scale="ut1") + time.TimeDelta([0.0, 0.3, 40.0], format="jd")
        theirs = times.sidereal_time("mean", "greenwich").rad
    ours = orbit.sidereal_angle(86400 * np.array([0.0, 0.3, 40.0]), EPOCH)
    np.testing.assert_allclose(ours, theirs, atol=np.deg2rad(0.1 / 3600))


def test_geodetic_height_is_that_of_astropy():
    coordinates = pytest.importorskip("astropy.coordinates")
    r = np.vstack([R, 6.6e6 * np.eye(3), -4.3e7 * np.eye(3)])
    r[:, 0] += 2.0  # at the pole itself there is no longitude
    theirs = coordinates.EarthLocation.from_geocentric(*r.T, unit="m").to_geodetic("WGS84")
    latitude, longitude, height = orbit.geodetic(r)
    np.testing.assert_allclose(latitude, theirs.lat.rad, atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * longitude), np.exp(1j * theirs.lon.rad), atol=1e-12)
    np.testing.assert_allclose(height, theirs.height.to_value("m"), atol=5e-3)


def test_the_air_is_that_of_pymsis():
    pymsis = pytest.importorskip("pymsis")
    t = np.array([0.0, 3000.0])
    r = np.array([[EARTH + 500e3, 0, 0], [0, 0, 6856.8e3]])
    found = orbit.msis_density(t, r, EPOCH)
    longitude = np.rad2deg(np.arctan2(*orbit.to_earth_fixed(r, t, EPOCH).T[1::-1]))
    for i, (latitude, height) in enumerate([(0.0, 500 - 0.0007), (90.0, 6856.8 - 6356.752)]):
        date = np.datetime64(EPOCH) + np.timedelta64(int(t[i]), "s")
        theirs = pymsis.calculate(date, longitude[i], latitude, height, 150.0, 150.0, [[7.0] * 7])
        assert found[i] == pytest.approx(float(np.ravel(theirs)[0]), rel=1e-4)
    assert 3e-13 < found[0] < 1.5e-12 and orbit.msis_density(t, r, EPOCH, f107=80.0)[0] < found[0] / 2
    # solar flux 150: within a factor of two of the exponential atmosphere


ISS = (
    "1 25544U 98067A   26079.50000000  .00016717  00000-0  30000-3 0  9991",
    "2 25544  51.6400 208.0000 0006703 130.0000 325.0000 15.50000000    10",
)


def test_a_two_line_element_set_gives_the_positions_of_sgp4():
    api = pytest.importorskip("sgp4.api")
    t = np.array([0.0, 777.7, 5400.0])
    r, v = orbit.sgp4(*ISS, t, "2026-03-20T13:00")
    day, fraction = api.jday(2026, 3, 20, 13, 0, 0.0)
    satellite = api.Satrec.twoline2rv(*ISS)
    for i in range(3):
        error, r_km, v_km = satellite.sgp4(day, fraction + t[i] / 86400)
        assert error == 0
        np.testing.assert_allclose(r[i], 1e3 * np.array(r_km), atol=1e-3)
        np.testing.assert_allclose(v[i], 1e3 * np.array(v_km), atol=1e-6)
    n = 15.5 * 2 * np.pi / 86400  # near Kepler's orbit of the same mean motion and inclination
    assert np.linalg.norm(r, axis=1) == pytest.approx((MU / n**2) ** (1 / 3), rel=5e-3)
    h = np.cross(r, v)
    np.testing.assert_allclose(np.rad2deg(np.arccos(h[:, 2] / np.linalg.norm(h, axis=1))), 51.64, atol=0.1)


def test_elements_that_give_no_position_are_refused():
    pytest.importorskip("sgp4")
    with pytest.raises(ValueError, match="`line1, line2` must be a two-line element set"):
        orbit.sgp4("1 25544U", "2 25544", [0.0], EPOCH)
    with pytest.raises(ValueError, match="`t` must be times at which SGP4 gives a position, but it is 3e"):
        orbit.sgp4(*ISS, [0.0, 3e10], EPOCH)
