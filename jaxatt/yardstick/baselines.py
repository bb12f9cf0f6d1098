"""The classical baselines and the reference rows, each a `Detector`; the bank of filters is in `bank`.

z = L^-1 r of the residuals r (`telemetry.residuals_step`), L L' = Sigma, their covariance in healthy runs.

May import: leo4, leo4_days, telemetry, references, products, vec, attitude, detection.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt.attitude import mrp_from_quat, mrp_rate, mrp_rate_transposed
from jaxatt.detection import Cusum, chi_square, cusum, smoothed
from jaxatt.vec import Quat, Vec3, cross, norm
from jaxatt.yardstick import leo4, leo4_days
from jaxatt.yardstick.leo4 import Telemetry
from jaxatt.yardstick.products import correlations, product, pushed
from jaxatt.yardstick.references import references, summed, window_of
from jaxatt.yardstick.telemetry import (
    Detector,
    OnResiduals,
    Verdict,
    blame,
    with_residuals,
)

LAGS = (1, 2, 4, 8, 16, 32, 64, 128)  # [packets] of the GLR
CHANNELS = sum(leo4_days.UNITS.values())


def everyone(like):
    """The blame of a detector that cannot tell."""
    return jnp.ones(CHANNELS, like.dtype)


# the published observer


class Observer(NamedTuple):
    """State of the MRP observer."""

    q: Vec3  # MRP
    w: Vec3  # [rad/s]
    seen: Any  # [packets]


class ObserverParams(NamedTuple):
    """Gains of the observer, and where its blame turns from gyros to the star tracker."""

    alpha: Any = 1.1  # [1/s]
    beta: Any = 15.0  # [N m s]
    ratio: Any = 0.832  # [s] of the residuals of attitude and rate


def mrp_init(params: ObserverParams) -> Observer:
    """Before the first packet, from which it takes the MEKF's estimate."""
    zero = jnp.zeros(())
    three = Vec3(zero, zero, zero)
    return Observer(three, three, zero)


def mrp_step(params: ObserverParams, z: Observer, telemetry: Telemetry) -> tuple[Observer, Verdict]:
    """Yun & Kang (2020), eq. (7), by Euler's rule at 10 Hz with the star sample held; the largest |xi| of five ticks."""
    first = z.seen == 0
    begun = mrp_from_quat(Quat.of(telemetry.attitude)), leo4.rate_of(telemetry.gyro[0]) - Vec3.of(telemetry.bias)
    q, w = (Vec3(*(jnp.where(first, a, b) for a, b in zip(new, old))) for new, old in zip(begun, z[:2]))
    measured = mrp_from_quat(Quat.of(telemetry.star))
    x_q = measured - q
    worst, ratio = 0.0 * z.seen, 0.0 * z.seen
    for i in range(leo4.TICKS):
        y = leo4.rate_of(telemetry.gyro[i])
        x_w, at = y - w, measured if i == 0 else q
        size = jnp.sqrt(x_q @ x_q + x_w @ x_w)
        ratio = jnp.where(size > worst, norm(x_q) / norm(x_w), ratio)
        worst = jnp.where(size > worst, size, worst)
        u = leo4.summed(telemetry.torque[i]) + params.beta * x_w + mrp_rate_transposed(at, x_q)
        q_next = q + leo4.DT * mrp_rate(at, w)
        if i == 0:
            q_next = q_next + (params.alpha * leo4.PACKET) * x_q
        q, w = q_next, w + leo4.DT * (leo4.INVERSE @ (u - cross(w, leo4.INERTIA @ y)))
    star = jnp.where(ratio > params.ratio, 1.0, 0.0).astype(worst.dtype)
    return Observer(q, w, z.seen + 1), Verdict(worst, blame(gyro=1 - star, star=star))


# chi-square of the MEKF's innovation


def chi2_step(params, z, telemetry: Telemetry):
    """Sum of nu'nu / S over the window; params: S [rad^2]."""
    nu = telemetry.innovation
    z, score = summed(z, jnp.sum(nu * nu) / params)
    return z, Verdict(score, everyone(score))


# residuals


def parity_step(params, recent, r, telemetry: Telemetry):
    """|sum of the parity over the window| / (sd sqrt N); params: sd [rad/s]."""
    recent, total = summed(recent, r[3])
    score = jnp.abs(total) / (params * np.sqrt(len(recent)).item())
    return recent, Verdict(score, blame(gyro=jnp.ones_like(score), star=0.0, wheel=0.0))


class CusumParams(NamedTuple):
    """Scale and slack."""

    std: Any  # (7,)
    slack: Any = 0.25  # [1] half the shift that matters


def cusum_init(params: CusumParams) -> Cusum:
    """No sums yet, (7,) each."""
    return Cusum(jnp.zeros(7), jnp.zeros(7))


def cusum_step(params: CusumParams, sums: Cusum, r, telemetry: Telemetry):
    """Page's sums of the seven standardised residuals; the blame is on the unit of the largest."""
    sums, channels = cusum(sums, r / params.std, params.slack)
    score = jnp.max(channels)
    parts = [jnp.max(channels[3:4]), jnp.max(channels[:3]), jnp.max(channels[4:])]
    guilty = [jnp.where(part >= score, 1.0, 0.0).astype(score.dtype) for part in parts]
    return sums, Verdict(score, blame(*guilty))


class GlrParams(NamedTuple):
    """What the GLR is fitted to. The geometry is isotropic: all axes answer alike, by three laws of time."""

    whiten: Any  # (4,) of an axis: z = (a nu, b nu + c dyn), and 1 / sd of the parity
    axis: tuple  # for each lag l (l, 3, 2): steps of gyro, star and wheel as seen by the two z of an axis, oldest first
    parity: tuple  # (l, 1, 1) a gyro's step as seen by the parity
    gyro: Any  # (lags, 4, 4) each channel's share of three axes and of the parity, over the length of its filter
    star: Any  # (lags,)
    wheel: Any  # (lags, 4, 3)


class GlrState(NamedTuple):
    """The whitened past of the residuals."""

    axes: Any  # (128, 2, 3) oldest first
    parity: Any  # (128, 1, 1)


def glr_params(covariance, laws, lags: tuple = LAGS) -> GlrParams:
    """Filters of unit steps of the eleven channels.

    covariance: (7, 7) of the residuals; laws: responses in time to a unit step, `bank.laws`.
    """
    of_axis, of_parity = laws
    nu, dyn = np.diag(covariance)[:3].mean(), np.diag(covariance)[4:].mean()
    both = np.mean([covariance[i, 4 + i] for i in range(3)])
    inverse_root = np.linalg.inv(np.linalg.cholesky([[nu, both], [both, dyn]]))
    parity = of_parity / np.sqrt(covariance[3, 3])
    white = of_axis @ inverse_root.T  # (packets, 3, 2)
    mean, push = 0.75 * np.array(leo4.AXES).T, -np.linalg.solve(np.array(leo4.INERTIA), np.array(leo4.AXES)).T
    gyro, star, wheel = [], [], []
    for lag in lags:
        square, across = np.sum(white[:lag] ** 2, axis=(0, 2)), np.sum(parity[:lag] ** 2)
        shares = np.hstack([mean, np.array(leo4.PARITY)[:, None]])
        length = np.sqrt(np.sum(mean**2, axis=1) * square[0] + np.array(leo4.PARITY) ** 2 * across)
        gyro.append(shares / length[:, None])
        star.append(1 / np.sqrt(square[1]))
        wheel.append(push / np.sqrt(np.sum(push**2, axis=1, keepdims=True) * square[2]))
    whiten = [inverse_root[0, 0], inverse_root[1, 0], inverse_root[1, 1], 1 / np.sqrt(covariance[3, 3])]
    short = lambda a: np.asarray(a, np.float32)
    axis, across = (tuple(short(a[:k]) for k in lags) for a in (white, parity[:, None, None]))
    return GlrParams(short(whiten), axis, across, short(gyro), short(star), short(wheel))


def glr_init(params: GlrParams) -> GlrState:
    longest = max(map(len, params.axis))
    return GlrState(jnp.zeros((longest, 2, 3)), jnp.zeros((longest, 1, 1)))


def glr_step(params: GlrParams, z: GlrState, r, telemetry: Telemetry):
    """max over channels h and lags l of |f_hl . z| / |f_hl| over the last l packets; blame: softmax of its square / 2."""
    a, b, c, d = params.whiten
    axes = pushed(z.axes, jnp.stack([a * r[:3], b * r[:3] + c * r[4:]]))
    parity = pushed(z.parity, d * r[3:4, None])
    best = jnp.zeros(11, r.dtype)
    seen = zip(correlations(params.axis, axes), correlations(params.parity, parity))
    for (of_axes, of_parity), gyro, star, wheel in zip(seen, params.gyro, params.star, params.wheel):
        gyros = product(gyro, jnp.concatenate([of_axes[0], of_parity[0]]))
        found = jnp.concatenate([gyros, star * of_axes[1], product(wheel, of_axes[2])])
        best = jnp.maximum(best, jnp.abs(found))
    score = jnp.max(best)
    return GlrState(axes, parity), Verdict(score, jax.nn.softmax(0.5 * best * best))


# the gyro tests of `gyro_ekf`


class GyroParams(NamedTuple):
    """The normalised innovations of the residuals, and the share of a new one in the mean."""

    seen: Any  # (4, 7) of four gyros, or (1, 7) of their parity
    memory: Any = 0.25  # that of the loop


def gyro_rows(covariance) -> tuple[Detector, Detector]:
    """The chi-squares of `jaxatt.loops.gyro_ekf`: of each gyro's innovation, and of the parity.

    What a gyro reads beyond the rate that the model expects is the rate observer's innovation along its axis and its share
    of the parity, y = G w + V p. covariance: (7, 7) of the residuals in healthy runs.
    """
    seen = np.zeros((5, 7))
    seen[:4, 3], seen[:4, 4:] = leo4.PARITY, np.array(leo4.AXES).T / leo4.TICKS
    seen[4, 3] = 1.0
    seen = (seen / np.sqrt(np.diag(seen @ covariance @ seen.T))[:, None]).astype(np.float32)

    def row(name: str, seen) -> Detector:
        params = GyroParams(seen, np.float32(0.25))
        return Detector(name, with_residuals(window_of(len(seen))), OnResiduals(gyro_step), params, 1)

    return row("gyro_chi2", seen[:4]), row("gyro_parity", seen[4:])


def gyro_step(params: GyroParams, mean, r, telemetry: Telemetry):
    """The largest chi-square of the smoothed innovations; the gyro that has it is blamed, as `detection.worst_above` does."""
    mean = smoothed(mean, product(params.seen, r), params.memory)
    found = chi_square(mean, params.memory)
    score = jnp.max(found)
    return mean, Verdict(score, blame(gyro=jnp.where(found >= score, 1.0, 0.0).astype(score.dtype)))


# ten packets' means, without dynamics


class PcaParams(NamedTuple):
    """A plane of healthy features, and the limits in it and off it."""

    mean: Any  # (13,)
    std: Any  # (13,)
    main: Any  # (k, 13) components with their scores of unit variance
    rest: Any  # (13, 13) projection off the plane
    limits: Any  # (2,) of T2 and Q


def features(residual, telemetry: Telemetry):
    """Features (13,) of a packet: innovation, mean readings of the gyros, dynamics, mean torque on the body."""
    gyro = sum(telemetry.gyro[i] for i in range(leo4.TICKS)) / leo4.TICKS
    torque = sum(telemetry.torque[i] for i in range(leo4.TICKS)) / leo4.TICKS
    return jnp.concatenate([residual[:3], gyro, residual[4:], jnp.stack(leo4.summed(torque))])


def pca_init(params):
    """Ten packets' features."""
    return jnp.zeros((10, 13))


def pca_step(params: PcaParams, recent, r, telemetry: Telemetry):
    """max(T2 / T2lim, Q / Qlim) of the ten packets' mean; blame: each unit's share of the squared residual."""
    recent, total = summed(recent, features(r, telemetry))
    standard = (total / 10 - params.mean) / params.std
    main, rest = product(params.main, standard), product(params.rest, standard)
    share = rest * rest
    score = jnp.maximum(jnp.sum(main * main) / params.limits[0], jnp.sum(share) / params.limits[1])
    parts = [jnp.sum(share[3:7]), jnp.sum(share[:3]), jnp.sum(share[7:])]
    return recent, Verdict(score, blame(*parts))


# readings that repeat themselves


class Flat(NamedTuple):
    """Last readings and for how long each has been the same."""

    gyro: Any  # (4,)
    star: Any  # (4,)
    gyro_same: Any  # (4,)
    star_same: Any


def flat_init(params) -> Flat:
    return Flat(jnp.zeros(4), jnp.zeros(4), jnp.zeros(4), jnp.zeros(()))


def flat_step(params, z: Flat, telemetry: Telemetry):
    """For how many readings in a row a gyro or the star tracker has repeated itself exactly."""
    last, same = z.gyro, z.gyro_same
    for i in range(leo4.TICKS):
        same = jnp.where(telemetry.gyro[i] == last, same + 1, 0)
        last = telemetry.gyro[i]
    star = jnp.where(jnp.all(telemetry.star == z.star), z.star_same + 1, 0)
    score = jnp.maximum(jnp.max(same), star)
    none = 0 * score
    guilty = blame(none, jnp.where(star > 0, 1.0, 0.0).astype(score.dtype), none).at[:4].set(same)
    return Flat(last, telemetry.star, same, star), Verdict(score, guilty + 1e-6)


# rows


S = leo4.STD_INNOVATION**2


def chi2(packets: int) -> Detector:
    """The chi-square row of so many packets."""
    return Detector(f"chi2_{packets}", window_of(packets), chi2_step, np.float32(S), 1)


def parity(packets: int, std) -> Detector:
    """The parity row of so many packets; std: of the parity residual [rad/s]."""
    name = "parity" if packets == 10 else f"parity {packets // 2} s"
    return Detector(name, with_residuals(window_of(packets)), OnResiduals(parity_step), np.float32(std), 1)


MRP = Detector("mrp", mrp_init, mrp_step, ObserverParams(*map(np.float32, ObserverParams())), 3)
REFERENCE = (
    *references(CHANNELS, chi2(10), *(round(s / leo4.PACKET) for s in (leo4_days.WARMUP, leo4_days.WINDOW))),
    Detector("flatline", flat_init, flat_step),
)
