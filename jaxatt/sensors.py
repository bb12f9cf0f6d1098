"""Sensors: how gyros, star trackers and sun sensors read, faults included, and where gyros point.

May import: check, vec, attitude, faults, scores.
"""

from __future__ import annotations

from math import factorial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.attitude import quat_from_vector
from jaxatt.check import finite, not_negative, positive
from jaxatt.check import limit as positive_or_inf
from jaxatt.faults import Fault, Reading, active, channel, heard, present, read
from jaxatt.vec import (
    Mat3,
    Quat,
    Vec3,
    array,
    columns,
    cross,
    det,
    diagonal,
    inverse,
    norm,
    polynomial,
    resultant,
    safe_sqrt,
    scaled_identity,
    where,
    zeros,
)


def triad(faults: Vec3, t, std, normals, last: Vec3) -> Vec3:
    """The three channels of a star sensor or rate gyro from tick time t [s] on, a `Vec3` of `Channel`.

    faults: `Vec3` of `Fault`; std: standard deviation of each channel's noise; normals: three standard normal numbers;
    last: the previous reading.
    """
    return Vec3(*(channel(f, t, std, n, v) for f, n, v in zip(faults, normals, last)))


def read_triad(channels: Vec3, truth: Vec3) -> Vec3:
    """The reading of a triad whose true signals are ``truth``."""
    return Vec3(*map(read, channels, truth))


def heard_triad(faults: Vec3, t):
    """Whether a triad gives a reading at t [s]: it counts as a whole, and is missing where one of its channels is."""
    x, y, z = (heard(f, t) for f in faults)
    return x & y & z


def quantised(y, step):
    """y rounded to whole multiples of step, 0 for no rounding; gradients pass the rounding over."""
    coarse = step > 0
    safe = jnp.where(coarse, step, 1)
    return y + jax.lax.stop_gradient(jnp.where(coarse, safe * jnp.round(y / safe) - y, 0))


# where gyros point


def gyro_pyramid(alpha, beta) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Input axes of the gyros A, B, C about -z and of the spare D along z; Park (2005), eq. (1).

    alpha: [rad] between A, B, C and -z; 54.7356 deg with beta = 60 deg makes the three an orthogonal triad;
    beta: [rad] azimuth of B and C from y.
    """
    sa, ca, sb, cb = jnp.sin(alpha), jnp.cos(alpha), jnp.sin(beta), jnp.cos(beta)
    return Vec3(0.0, -sa, -ca), Vec3(sb * sa, cb * sa, -ca), Vec3(-sb * sa, cb * sa, -ca), Vec3(0.0, 0.0, 1.0)


def parity_vector(axes):
    """Unit v, shape (4,), with v' G = 0 for four axes that span space; its first number is not negative.

    A gyro whose number is 0, for the other three lie in a plane, is not watched; NaN where all four lie in one.

    v' y of four gyros is free of the body rate: it holds errors only, but one number cannot tell whose.
    """
    a, b, c, d = columns(axes)
    v = jnp.stack([cross(b, c) @ d, -(cross(a, c) @ d), cross(a, b) @ d, -(cross(a, b) @ c)])
    return v * (jnp.where(v[0] < 0, -1, 1) / jnp.sqrt(jnp.sum(v * v)))


def rate_maps(axes):
    """Pseudo-inverses, (2^n, 3, n), of n gyro axes for every subset in use; gyro i counts 2^i in its number."""
    rows = jnp.stack([array(axis) for axis in columns(axes)])
    n = len(rows)
    in_use = np.arange(2**n)[:, None] >> np.arange(n) & 1  # (2^n, n)
    return jnp.linalg.pinv(rows * in_use[..., None])


def rate_from(maps, gyro: Reading) -> Vec3:
    """The body rate [rad/s] that explains the valid, finite ones of n gyro readings (n,) best; maps: of `rate_maps`."""
    there = present(gyro)
    subset = sum(valid << i for i, valid in enumerate(there.astype(int)))
    return resultant(maps[subset], jnp.where(there, gyro.value, 0))


# a rate gyro by its data sheet


class Gyro(NamedTuple):
    """Three rate gyros of one kind in SI units; `gyro_from_sheet` converts what data sheets print."""

    arw: Annotated[Any, "rad/s^0.5", finite, not_negative] = 0.0  # angle random walk: white noise of the rate
    rrw: Annotated[Any, "rad/s^1.5", finite, not_negative] = 0.0  # rate random walk of the bias
    wander: Annotated[Any, "rad/s", finite, not_negative] = 0.0  # std of a bias that forgets itself (Gauss-Markov)
    tau: Annotated[Any, "s", positive] = 1000.0  # after this time
    scale: Annotated[Vec3, "1", finite] = zeros()  # scale-factor errors
    misalignment: Annotated[Mat3, "rad", finite] = Mat3(zeros(), zeros(), zeros())  # axis i sees rate j
    lsb: Annotated[Any, "rad", finite, not_negative] = 0.0  # angle increment that a count stands for; 0: none
    limit: Annotated[Any, "rad/s", positive_or_inf] = jnp.inf  # rates beyond it are clipped


class GyroState(NamedTuple):
    """What a gyro carries from tick to tick."""

    bias: Vec3  # [rad/s] by rate random walk
    wander: Vec3  # [rad/s]


def gyro_from_sheet(arw, rrw=0.0, instability=0.0, **others) -> Gyro:
    """A gyro by the numbers that data sheets print.

    Noise of a rate per sample is arw / sqrt(dt), not arw. A density n [deg/h/sqrt(Hz)] is an arw of n / 60; a sheet with
    a two-sided density is sqrt(2) off.

    Args:
        arw: angle random walk [deg/sqrt(h)].
        rrw: rate random walk [deg/h/sqrt(h)].
        instability: bias instability [deg/h], read off the flat of the Allan plot, which lies at .61736 of the standard
            deviation of a Gauss-Markov bias, at 1.8926 tau. For sheets that print B of IEEE 952, whose flat is .664 B,
            hand in .664 B.
        others: further fields of `Gyro`, in SI units.

    Raises:
        ValueError: a negative number.

    Example:
        >>> gyro = gyro_from_sheet(arw=0.15, rrw=0.3, tau=3600.0)
    """
    for name, value in (("arw", arw), ("rrw", rrw), ("instability", instability)):
        check.not_negative(name, value)
    degree = jnp.pi / 180
    return Gyro(arw * degree / 60, rrw * degree / 3600 / 60, instability * degree / 3600 / 0.61736, **others)


def gyro_read(gyro: Gyro, state: GyroState, turn: Vec3, dt, white, walk, wander=None) -> tuple[GyroState, Vec3]:
    """The mean rate [rad/s] that an integrating gyro reports over the last dt, its noises exact over the step.

    y = (I + scale + misalignment) turn / dt + (b + b+) / 2 + g + sqrt(arw^2 / dt + rrw^2 dt / 12) N, where the bias walks
    from b to b+ = b + rrw sqrt(dt) N' and g is the mean of the wander; then counted in lsb and limited. The mean of both
    biases and dt / 12 belong together (Crassidis & Markley, 2003).

    Args:
        gyro: its data sheet.
        state: of the last tick.
        turn: integral of the body rate since the last tick [rad]: let the flow carry it, theta' = w.
        dt: since the last tick [s].
        white, walk: three standard normal numbers each.
        wander: six more; None for a gyro without.

    Returns:
        The state and the reading; faults of the box come after it: `triad`, `read_triad`.
    """
    walk, white = Vec3(*walk), Vec3(*white)
    bias = state.bias + gyro.rrw * jnp.sqrt(dt) * walk
    mean, drifted = 0.5 * (state.bias + bias), state.wander
    if wander is not None:
        pairs = [
            gauss_markov(g, gyro.wander, gyro.tau, dt, *n) for g, n in zip(state.wander, zip(wander[:3], wander[3:]))
        ]
        drifted, means = (Vec3(*some) for some in zip(*pairs))
        mean = mean + means
    seen = turn + Vec3(*(k * a for k, a in zip(gyro.scale, turn))) + gyro.misalignment @ turn
    noise = safe_sqrt(gyro.arw**2 / dt + gyro.rrw**2 * dt / 12) * white
    rate = seen / dt + mean + noise
    return GyroState(bias, drifted), Vec3(
        *(jnp.clip(quantised(a, gyro.lsb / dt), -gyro.limit, gyro.limit) for a in rate)
    )


# Taylor coefficients of (x - 2 (1 - exp(-x)) + (1 - exp(-2 x)) / 2) / x^2, those of x, x^2, ...
_MEAN_SQUARE = [(-1) ** k * (2 - 2 ** (k - 1)) / factorial(k) for k in range(3, 20)]


def gauss_markov(g, std, tau, dt, first, second):
    """A Gauss-Markov process g' = -g / tau + noise, of stationary std, after dt [s], and its mean on the way; exact.

    first, second: two standard normal numbers.
    """
    x = dt / tau
    e = -jnp.expm1(-x)
    ahead = e * (2 - e)  # variance of what is new at the end, in units of std^2
    shared = e * e / x  # its covariance with the mean
    small = x < 0.5
    near = jnp.where(small, x, 0.5)
    series = near * polynomial(_MEAN_SQUARE, near)
    far = jnp.where(small, 1, x)
    mean = 2 * jnp.where(small, series, (far - 2 * e + ahead / 2) / (far * far))
    g_mean = g * e / x + std * (shared / jnp.sqrt(ahead) * first + jnp.sqrt(mean - shared * shared / ahead) * second)
    return g * (1 - e) + std * jnp.sqrt(ahead) * first, g_mean


def allan_deviation(rates, dt, spans):
    """Overlapping Allan deviation of n rates (n, ...), dt [s] apart, at the averaging times [s] of spans; NumPy, off line.

    sqrt(arw^2 / T + rrw^2 T / 3) for a gyro that walks. Raises ValueError for a time of less than dt or more than n dt / 2.
    """
    rates = np.asarray(rates, float)
    angle = np.concatenate([np.zeros((1, *rates.shape[1:])), np.cumsum(rates, axis=0) * dt])
    found = []
    for span in np.atleast_1d(spans):
        m = round(float(span) / dt)
        if not 1 <= m <= len(rates) // 2:
            check.refuse("spans", f"lie between dt = {dt:g} s and half the record, {len(rates) * dt / 2:g} s", span)
        second = angle[2 * m :] - 2 * angle[m:-m] + angle[: -2 * m]
        found.append(np.sqrt(np.mean(second**2, axis=0) / 2) / (m * dt))
    return np.array(found)


# star tracker


class StarTracker(NamedTuple):
    """A star tracker's errors; ``boresight`` and ``across`` are unit vectors in body axes, at right angles."""

    boresight: Annotated[Vec3, "1", finite]
    across: Annotated[Vec3, "1", finite]  # first cross axis
    cross: Annotated[Any, "rad", finite, not_negative]  # std of a sample about the two cross axes
    roll: Annotated[Any, "rad", finite, not_negative]  # std of a sample about the boresight
    rate_limit: Annotated[Any, "rad/s", positive_or_inf] = jnp.inf  # turning faster it gives no attitude

    def check(self, name: str) -> None:
        """Refuse, with ValueError, axes that are no unit vectors at right angles."""
        if check.concrete((self.boresight, self.across)):
            check.unit(f"{name}.boresight", self.boresight)
            check.unit(f"{name}.across", self.across)
            product = sum(np.multiply(a, b) for a, b in zip(self.across, self.boresight))
            check.each(f"{name}.across", "lie across the boresight (product)", product, np.abs(product) <= 1e-5)


def star_axes(tracker: StarTracker) -> Mat3:
    """Columns: the two cross axes and the boresight, in body axes."""
    return Mat3(tracker.across, cross(tracker.boresight, tracker.across), tracker.boresight).T


def star_covariance(tracker: StarTracker) -> Mat3:
    """Covariance of the small turn of a sample, in body axes [rad^2]: C diag(s^2) C'."""
    axes = star_axes(tracker)
    s, r = tracker.cross**2, tracker.roll**2
    return axes @ diagonal(Vec3(s, s, r)) @ axes.T


def star_read(tracker: StarTracker, q: Quat, w: Vec3, error: Vec3) -> Reading:
    """The attitude that a star tracker reports, q exp(C error), valid below its rate limit.

    q: true attitude; w: true rate [rad/s]; error: small turn about its two cross axes and its boresight [rad], which
    `star_error` gives. Faults of the whole box come after it: `interrupted`.
    """
    value = q * quat_from_vector(star_axes(tracker) @ error)
    return Reading(value, w @ w < tracker.rate_limit**2)


def star_error(tracker: StarTracker, faults: Vec3, t, normals, last: Vec3) -> Vec3:
    """The small turn [rad] by which a sample is wrong, noise and faults (each a `Fault`) about its two cross axes and boresight.

    normals: three standard normal numbers; last: the error of the sample before.
    """
    std = tracker.cross, tracker.cross, tracker.roll
    return Vec3(*(channel(f, t, s, n, v).offset for f, s, n, v in zip(faults, std, normals, last)))


def interrupted(reading: Reading, t, last: Reading, box: Fault) -> Reading:
    """A reading of any kind at t [s], faults of its box included, of which ``stuck`` and ``missing`` count.

    A box that is stuck gives the last reading again, as valid as it was; one that is missing gives none that is valid.
    """
    shown = where(active(box, t) & (box.stuck > 0), last, reading)
    return Reading(shown.value, shown.valid & heard(box, t))


def apart(direction: Vec3, axis: Vec3, angle):
    """Whether a direction lies more than an angle [rad] from an axis: stars are seen where the Sun is not; unit vectors."""
    return direction @ axis < jnp.cos(angle)


# directions: fine sun sensor, horizon sensor


def direction_read(direction: Vec3, std, normals) -> Vec3:
    """A unit vector in body axes as a sensor reads it: direction + std N, no longer exactly of unit length.

    The Sun's direction for a fine sun sensor, nadir for a horizon sensor. std: of a component, a sample [rad]; normals:
    three standard normal numbers. The noise along the direction is harmless and leaves the covariance std^2 I.
    """
    return direction + std * Vec3(*normals)


def cell_currents(normals: Vec3, sun: Vec3, lit, noise):
    """Currents (n,) of n coarse sun cells as shares of their largest: max(0, n.sun) lit + noise.

    normals: outward unit vectors in body axes, components (n,); sun: unit vector in body axes. Light from the Earth,
    which costs several degrees, is not in it. noise (n,), as a share.
    """
    return jnp.maximum(normals @ sun, 0) * lit + noise


def sun_from_cells(normals: Vec3, currents) -> Reading:
    """The Sun's direction that explains the currents (n,) above a tenth best, a unit vector; valid if three or more see it.

    Least squares of n.s = current; cells whose normals lie in a plane tell no direction. normals: as in `cell_currents`.
    """
    seen = currents > 0.1
    currents = jnp.where(seen, currents, 0)
    one = jnp.where(seen, 1.0, 0.0).astype(jnp.result_type(currents, 1.0))
    n = Vec3(*(a * one for a in normals))
    total = lambda a: jnp.sum(a, axis=0)
    m = Mat3(*(Vec3(*(total(a * b) for b in n)) for a in n))
    good = (total(one) >= 3) & (det(m) > 1e-3)
    safe = where(good, m, scaled_identity())
    s = inverse(safe) @ Vec3(*(total(a * currents) for a in n))
    length = norm(s)
    return Reading(s / jnp.where(length > 0, length, 1), good & (length > 0))


def sun_from_six(currents) -> Reading:
    """The Sun's direction from six coarse cells along +x, -x, +y, -y, +z, -z: differences of opposite ones, made a unit vector.

    currents: (6,), as shares of their largest. Valid where the three differences together are longer than a tenth.
    """
    s = Vec3(currents[0] - currents[1], currents[2] - currents[3], currents[4] - currents[5])
    length = norm(s)
    bright = length > 0.1
    return Reading(s / jnp.where(bright, length, 1), bright)
