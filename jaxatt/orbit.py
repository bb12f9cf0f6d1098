"""Off line, in NumPy: what an orbit meets, as a `jaxatt.environment.Table` for the loop.

Positions and directions are in the mean equator and equinox of date. t: times [s] since the epoch; r: positions (n, 3)
[m]; epoch: UTC. The models built in need nothing but NumPy: Kepler's orbit, a tilted dipole, the Sun to .01 deg, an
exponential atmosphere. The functions of the last section call well-kept libraries instead (extra ``orbit``).

A dipole is 23 % off the field (rms, a day at 500 km over the poles) and up to 34 deg in direction: good for detumbling and
unloading wheels, not as the on-board model of an attitude filter.

May import: check, vec, environment.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from datetime import datetime
from typing import Any, NamedTuple

import numpy as np

from jaxatt import check
from jaxatt.environment import Table
from jaxatt.vec import Vec3

MU = 3.986004415e14  # [m^3/s^2] of the Earth, EGM96
EARTH = 6378136.3  # [m] equatorial radius, EGM96
WGS84 = 6378137.0, 1 / 298.257223563  # [m] equatorial radius, [1] flattening of the ellipsoid
SUN_RADIUS = np.deg2rad(0.26656)  # [rad] apparent, at one astronomical unit

# The dipole terms g11, h11, g10 [T] of IGRF-14 at 2025.0, in Earth-fixed axes: the moment points south.
DIPOLE = 1e-9 * np.array([-1410.3, 4545.5, -29350.0])
DIPOLE_RADIUS = 6371.2e3  # [m]

# Altitude [km], density [kg/m^3] and scale height [km] of the exponential atmosphere, CIRA-72 in Vallado's table 8-4.
_ATMOSPHERE = np.array(
    [(150, 2.070e-9, 22.523), (180, 5.464e-10, 29.740), (200, 2.789e-10, 37.105), (250, 7.248e-11, 45.546),
     (300, 2.418e-11, 53.628), (350, 9.518e-12, 53.298), (400, 3.725e-12, 58.515), (450, 1.585e-12, 60.828),
     (500, 6.967e-13, 63.822), (600, 1.454e-13, 71.835), (700, 3.614e-14, 88.667), (800, 1.170e-14, 124.64),
     (900, 5.245e-15, 181.05), (1000, 3.019e-15, 268.00)]
)  # fmt: skip


class Elements(NamedTuple):
    """A Kepler orbit at its epoch."""

    a: float  # [m] semi-major axis
    e: float = 0.0  # [1] eccentricity, below 1
    i: float = 0.0  # [rad] inclination
    node: float = 0.0  # [rad] right ascension of the ascending node
    perigee: float = 0.0  # [rad] argument of perigee
    anomaly: float = 0.0  # [rad] mean anomaly


def along(
    t, r, v, epoch, *, field: Callable | None = None, sun: Callable | None = None, density: Callable | None = None
) -> Table:
    """The table of surroundings along an orbit.

    Args:
        t: (n,) [s] since the epoch, at equal steps; what the table serves is one step shorter before and behind.
        r: (n, 3) [m] positions.
        v: (n, 3) [m/s] velocities.
        epoch: UTC, such as "2026-03-21T00:00".
        field: (t, r, epoch) -> (n, 3) [T]; `dipole_field` if not given.
        sun: (t, epoch) -> (n, 3), unit vectors; `almanac_sun` if not given.
        density: (t, r, epoch) -> (n,) [kg/m^3]; `exponential_density` if not given.

    Returns:
        The table, float64.

    Raises:
        ValueError: fewer than four rows, steps that are not equal, arrays of other shapes, numbers that are not finite.

    Example:
        >>> t = np.arange(-10.0, 6021.0, 10.0)
        >>> r, v = kepler(Elements(a=EARTH + 500e3, i=np.deg2rad(97.4)), t)
        >>> table = along(t, r, v, "2026-03-21T00:00")
    """
    t = np.asarray(t, float)
    if t.ndim != 1 or len(t) < 4:
        check.refuse("t", "be four times or more", f"of shape {t.shape}")
    step = (t[-1] - t[0]) / (len(t) - 1)
    if not (step > 0 and np.allclose(np.diff(t), step, rtol=1e-6, atol=0)):
        check.refuse("t", "have equal steps forward", f"one with steps from {np.diff(t).min()} to {np.diff(t).max()}")
    r, v = _column("r", r, (len(t), 3)), _column("v", v, (len(t), 3))
    magnetic = _column("field", (field or dipole_field)(t, r, epoch), r.shape)
    towards = _column("sun", (sun or almanac_sun)(t, epoch), r.shape)
    air = _column("density", (density or exponential_density)(t, r, epoch), t.shape)
    magnetic, towards, lit, r, v = Vec3(*magnetic.T), Vec3(*towards.T), sunlit(r, towards), Vec3(*r.T), Vec3(*v.T)
    return Table(float(t[0]), float(step), magnetic, towards, lit, r, v, air)


def _column(name: str, column, shape: tuple) -> np.ndarray:
    column = check.real(name, column).astype(float)
    if column.shape != shape:
        check.refuse(name, f"have shape {shape}", f"of shape {column.shape}")
    check.finite(name, column)
    return column


# orbits


def kepler(elements: Elements, t) -> tuple[np.ndarray, np.ndarray]:
    """Position [m] and velocity [m/s], (n, 3) each, of a Kepler orbit at t (n,) [s] since its epoch.

    Raises ValueError for an orbit that is no ellipse.
    """
    a, e, i, node, perigee, anomaly = map(float, elements)
    if not (a > 0 and 0 <= e < 1):
        check.refuse("elements", "be an ellipse, a > 0 and 0 <= e < 1", f"a = {a:g}, e = {e:g}")
    n = np.sqrt(MU / a**3)
    mean = anomaly + n * np.asarray(t, float)
    wanted = np.remainder(mean + np.pi, 2 * np.pi) - np.pi
    E = wanted + np.copysign(e, wanted) * (e > 0)  # from the far side Newton's steps do not overshoot
    for _ in range(50):
        E = E - (E - e * np.sin(E) - wanted) / (1 - e * np.cos(E))
    c, s, root = np.cos(E), np.sin(E), np.sqrt(1 - e * e)
    radius = a * (1 - e * c)
    plane = np.stack([a * (c - e), a * root * s])
    speed = n * a * a / radius * np.stack([-s, root * c])
    cw, sw, ci, si, cn, sn = (f(x) for x in (perigee, i, node) for f in (np.cos, np.sin))
    p = np.array([cn * cw - sn * sw * ci, sn * cw + cn * sw * ci, sw * si])
    q = np.array([-cn * sw - sn * cw * ci, -sn * sw + cn * cw * ci, cw * si])
    axes = np.stack([p, q])
    return plane.T @ axes, speed.T @ axes


# models built in


def days(t, epoch) -> np.ndarray:
    """Days [d], UTC, from 2000-01-01T12:00 (Julian date 2451545) to t [s] after the epoch, such as "2026-03-21T00:00".

    Raises ValueError for an epoch that is no date.
    """
    since = (_date(epoch) - np.datetime64("2000-01-01T12:00", "us")) / np.timedelta64(1, "s")
    return (since + np.asarray(t, float)) / 86400


def _date(epoch: Any) -> np.datetime64:
    try:
        date = np.datetime64("NaT" if isinstance(epoch, (int, float)) else epoch, "us")
    except (ValueError, TypeError):
        date = np.datetime64("NaT")
    if np.isnat(date):
        check.refuse("epoch", 'be a date like "2026-03-21T00:00"', check.short(epoch))
    return date


def sidereal_angle(t, epoch) -> np.ndarray:
    """Greenwich mean sidereal time [rad], in [0, 2 pi), UT1 taken for UTC."""
    return np.deg2rad(np.remainder(280.46061837 + 360.98564736629 * days(t, epoch), 360))


def to_earth_fixed(vectors, t, epoch) -> np.ndarray:
    """Inertial vectors (n, 3) in axes that turn with the Earth: x to the meridian of Greenwich, z to the north pole."""
    return _about_z(vectors, -sidereal_angle(t, epoch))


def to_inertial(vectors, t, epoch) -> np.ndarray:
    """The vectors (n, 3), given in Earth-fixed axes, in inertial ones: the inverse of `to_earth_fixed`."""
    return _about_z(vectors, sidereal_angle(t, epoch))


def _about_z(vectors, angle) -> np.ndarray:
    x, y, z = np.asarray(vectors, float).T
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * x - s * y, s * x + c * y, z], -1)


def dipole_field(t, r, epoch) -> np.ndarray:
    """Field [T] of the tilted dipole, B = (a/|r|)^3 (3 (c.e) e - c) with e = r/|r|; c turns with the Earth and points south."""
    r = np.asarray(r, float)
    c = to_inertial(np.broadcast_to(DIPOLE, r.shape), t, epoch)
    length = np.linalg.norm(r, axis=-1, keepdims=True)
    e = r / length
    return (DIPOLE_RADIUS / length) ** 3 * (3 * (c * e).sum(-1, keepdims=True) * e - c)


def almanac_sun(t, epoch) -> np.ndarray:
    """Unit vectors to the Sun, within .01 deg from 1950 to 2050: the Astronomical Almanac's low-precision formulas."""
    n = days(t, epoch)
    g = np.deg2rad(357.528 + 0.9856003 * n)
    longitude = np.deg2rad(280.460 + 0.9856474 * n + 1.915 * np.sin(g) + 0.020 * np.sin(2 * g))
    tilt = np.deg2rad(23.439 - 4e-7 * n)
    s = np.sin(longitude)
    return np.stack([np.cos(longitude), np.cos(tilt) * s, np.sin(tilt) * s], -1)


def sunlit(r, sun) -> np.ndarray:
    """Share of the Sun's disc that is seen from r (n, 3) [m], sun (n, 3) unit vectors: linear in the penumbra of the cone."""
    distance = np.linalg.norm(r, axis=-1)
    towards = np.clip(-(r * sun).sum(-1) / distance, -1, 1)
    earth = np.arcsin(np.minimum(EARTH / distance, 1))
    return np.clip((np.arccos(towards) - (earth - SUN_RADIUS)) / (2 * SUN_RADIUS), 0, 1)


def exponential_density(t, r, epoch) -> np.ndarray:
    """Air density [kg/m^3] above 150 km over a spherical Earth: CIRA-72 as exponentials between the rows of Vallado's table.

    Moderate solar activity; the true density is up to ten times more or less.
    """
    altitude = (np.linalg.norm(r, axis=-1) - EARTH) / 1e3
    if (altitude < 150).any():
        check.refuse("r", "lie above 150 km", f"at {altitude.min():.1f} km")
    base, density, height = _ATMOSPHERE[np.searchsorted(_ATMOSPHERE[:, 0], altitude, side="right") - 1].T
    return density * np.exp(-(altitude - base) / height)


# models of libraries


def sgp4(line1: str, line2: str, t, epoch) -> tuple[np.ndarray, np.ndarray]:
    """Position [m] and velocity [m/s], (n, 3) each, of a two-line element set, line1 and line2, at t (n,) [s] after the epoch.

    By sgp4, in the frame TEME.

    Raises ValueError for lines that are no element set, and where SGP4 gives no position, such as after decay.
    """
    from sgp4.api import Satrec  # pyright: ignore[reportMissingImports]

    satellite = Satrec.twoline2rv(line1, line2)
    if satellite.error:
        check.refuse("line1, line2", "be a two-line element set", check.short((line1, line2)))
    since = np.atleast_1d(days(t, epoch))
    error, r, v = satellite.sgp4_array(np.full_like(since, 2451545.0), since)
    if error.any():
        first = int(np.argmax(error > 0))
        check.refuse("t", "be times at which SGP4 gives a position", f"{np.ravel(t)[first]:g} s (error {error[first]})")
    return 1e3 * r, 1e3 * v


def igrf_field(t, r, epoch) -> np.ndarray:
    """Field [T] of the International Geomagnetic Reference Field, degree 13, of the day of the epoch; by ppigrf."""
    from ppigrf import igrf_gc  # pyright: ignore[reportMissingImports]

    x, y, z = to_earth_fixed(r, t, epoch).T
    length, longitude = np.sqrt(x * x + y * y + z * z), np.arctan2(y, x)
    colatitude = np.arccos(z / length)
    day = datetime.fromisoformat(str(_date(epoch))[:10])
    found = igrf_gc(length / 1e3, np.rad2deg(colatitude), np.rad2deg(longitude), day)
    up, south, east = map(np.ravel, found)
    st, ct, sp, cp = np.sin(colatitude), np.cos(colatitude), np.sin(longitude), np.cos(longitude)
    fixed = np.stack([up * st * cp + south * ct * cp - east * sp, up * st * sp + south * ct * sp + east * cp,
                      up * ct - south * st], -1)  # fmt: skip
    return 1e-9 * to_inertial(fixed, t, epoch)


def astropy_sun(t, epoch) -> np.ndarray:
    """Unit vectors to the Sun in the true equator and mean equinox of date; by astropy, without a download."""
    from astropy.coordinates import TEME, get_sun  # pyright: ignore[reportMissingImports]
    from astropy.time import Time  # pyright: ignore[reportMissingImports]
    from astropy.utils import iers  # pyright: ignore[reportMissingImports]

    offline = {"auto_download": False, "auto_max_age": None, "iers_degraded_accuracy": "ignore"}
    with ExitStack() as stack:
        for name, value in offline.items():
            stack.enter_context(iers.conf.set_temp(name, value))
        times = Time(2451545.0, days(t, epoch), format="jd", scale="utc")
        sun: Any = get_sun(times).transform_to(TEME(obstime=times))
    vectors = np.asarray(sun.cartesian.xyz.value).T
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def geodetic(r) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Geodetic latitude, longitude [rad] and height [m] over the ellipsoid WGS 84 of Earth-fixed positions r (n, 3) [m].

    Bowring's formula (1976), exact to a millimetre for orbits.
    """
    x, y, z = np.asarray(r, float).T
    a, f = WGS84
    across, square = np.hypot(x, y), f * (2 - f)
    reduced = np.arctan2(z, (1 - f) * across)
    latitude = np.arctan2(z + square / (1 - f) * a * np.sin(reduced) ** 3, across - square * a * np.cos(reduced) ** 3)
    s, c = np.sin(latitude), np.cos(latitude)
    return latitude, np.arctan2(y, x), across * c + z * s - a * np.sqrt(1 - square * s * s)


def msis_density(t, r, epoch, f107=150.0, ap=7.0) -> np.ndarray:
    """Air density [kg/m^3] of NRLMSIS 2.1 at a solar flux f107 [1e-22 W/m^2/Hz] and geomagnetic index ap [1]; by pymsis.

    The arguments that `along` does not hand over: ``density=functools.partial(msis_density, f107=200.0)``.
    """
    from pymsis import Variable, calculate  # pyright: ignore[reportMissingImports]

    latitude, longitude, height = geodetic(to_earth_fixed(r, t, epoch))
    dates = _date(epoch) + (1e6 * np.asarray(t, float)).astype("timedelta64[us]")
    flux, indices = np.full(len(dates), f107), np.full((len(dates), 7), ap)
    out = calculate(dates, np.rad2deg(longitude), np.rad2deg(latitude), height / 1e3, flux, flux, indices)
    return np.asarray(out)[..., Variable.MASS_DENSITY]
