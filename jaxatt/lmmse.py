"""Attitude from one star and a gyro by filters of few states: LMMSE with multiplicative noise, with a gyro bias,
and the multiplicative EKF they are held against. Yuan, He, Xing & Xiong.

A state is a flat tuple of components (`Quat`, `AttitudeBias`, `Vec3`); a matrix is a tuple of rows. A linear map is a
function on the state, which serves the estimate and the rows of its covariance alike.

May import: check, vec, attitude, faults, mounting, scores.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxatt import check
from jaxatt.attitude import quat_conjugate, quat_from_vector, quat_normalised, quat_rotate
from jaxatt.check import door
from jaxatt.vec import Mat3, Quat, Vec3, cross, det, diagonal, inverse, once


class Innovation(NamedTuple):
    """What a measurement said that was not expected."""

    r: Vec3  # residual [measurement unit]
    M: Mat3  # its covariance [measurement unit^2]
    nis: Any  # () [1] r' M^-1 r, chi-square with 3 degrees of freedom where the filter is consistent
    log_det: Any  # () log det M


@door
def symmetric(rows):
    """A symmetric matrix, given by rows, by its upper triangle: what rounding did to the lower one is not computed."""
    n = range(len(rows))
    return tuple(tuple(rows[min(i, j)][max(i, j)] for j in n) for i in n)


@door
def congruence(f: Callable, P):
    """F P F' of a symmetric P for the linear map f."""
    return symmetric(tuple(f(column) for column in zip(*(f(row) for row in _square(P)))))


def _square(P):
    """P, if it has as many columns as rows; asked before a function of the caller meets them."""
    if any(len(row) != len(P) for row in P):
        check.refuse("P", "be n rows of n", f"{len(P)} rows of {', '.join(str(len(row)) for row in P)}")
    return P


@door
def outer(x):
    """x x'."""
    return tuple(tuple(a * b for b in x) for a in x)


@door
def plus(P, W):
    """P + W of two matrices by rows."""
    return tuple(tuple(a + b for a, b in zip(*rows)) for rows in zip(P, W))


@door
def update_three(x, P, y: Vec3, h: Callable, expected: Vec3, variance):
    """Kalman update by three measurements at once: the state, its covariance and the `Innovation`.

    x, P: prediction, a tuple of n components and n rows; y: measurement; h: linear map of a state to the
    measurement, a `Vec3`; expected: the measurement expected of x, h(x) where the measurement is linear; variance
    of each component of the measurement, independent.
    """

    def gain(P):
        PH = tuple(Vec3(*h(row)) for row in P)  # P C', by rows
        CPC = symmetric(tuple(h(column) for column in zip(*PH)))
        M = Mat3(*(Vec3(*row) for row in CPC)) + diagonal((variance, variance, variance))
        M_inv = inverse(M)
        return PH, M, M_inv, tuple(M_inv @ row for row in PH)  # K = P C' M^-1

    PH, M, M_inv, K = once(gain, _square(P))
    r = y - expected
    x = type(x)(*(a + k @ r for a, k in zip(x, K)))
    P = symmetric(tuple(tuple(p - k @ c for p, c in zip(row, PH)) for row, k in zip(P, K)))  # P - K M K'
    return x, P, Innovation(r, M, r @ (M_inv @ r), jnp.log(det(M)))


class Moments(NamedTuple):
    """An LMMSE filter of the error quaternion."""

    x: Quat  # [1] estimate; not of unit length
    P: Any  # 4 rows of 4 [1] error covariance
    Q: Any  # 4 rows of 4 [1] second moment E[x x'] of the state


class AttitudeBias(NamedTuple):
    """Error quaternion and gyro bias in one flat state of seven."""

    w: Any  # () [1]
    x: Any  # () [1]
    y: Any  # () [1]
    z: Any  # () [1]
    bx: Any  # () [rad/s]
    by: Any  # () [rad/s]
    bz: Any  # () [rad/s]

    @property
    def q(self):
        """The quaternion."""
        return Quat(*self[:4])

    @property
    def b(self):
        """The gyro bias."""
        return Vec3(*self[4:])


class Estimate(NamedTuple):
    """A state and its error covariance."""

    x: Any  # n components of shape (*lanes)
    P: Any  # n rows of n, shape (*lanes) each


@door
def quaternion_step(x: Quat, w: Vec3, w_r: Vec3, dt) -> Quat:
    """A(k) x: Euler's step of x' = (x w - w_r x) / 2, eqs. (2) and (3); linear in x.

    w: body rate [rad/s]; w_r: rate of the reference frame, in its own components [rad/s]; dt [s].
    """
    o = jnp.zeros_like(x.w)
    return x + (0.5 * dt) * (x * Quat(o, *w) - Quat(o, *w_r) * x)


@door
def star_map(x, s: Vec3) -> Vec3:
    """C x with C = [s, 2 [s x]], eq. (7): the star seen in body axes, to first order in the vector part of x."""
    x = Quat(*x[:4])
    return x.w * s + 2 * cross(s, x.v)


@door
def rate_noise(S, std, dt):
    """sum_i std^2 B_i S B_i' = (dt std / 2)^2 (tr(S) I - S): what gyro noise does to a quaternion of moment S.

    B_i = -dt/2 R(e_i) as in eq. (3); S: 4 rows of 4; std [rad/s] of the noise on each axis, equal on the three.
    """
    c = (0.5 * dt * std) ** 2
    trace = S[0][0] + S[1][1] + S[2][2] + S[3][3]
    return tuple(tuple(c * ((trace if i == j else 0) - S[i][j]) for j in range(4)) for i in range(4))


@door
def noise_moment(law, x, P, Q):
    """The second moment at which the multiplicative noise is evaluated, 4 rows of 4.

    law: 0 second moment of the state, as the LMMSE filter has it, eq. (11); 1 at the estimate and 2 at the
    identity, which make the noise additive; 3 the second moment of the estimate, Q - P, right where the true rate
    and not the gyro's is given (docs/loops/star_isolation.md, choice 5).
    """
    xx = outer(x)

    def one(i, j):
        identity = 1.0 if i == j == 0 else 0.0
        additive = jnp.where(law == 1, xx[i][j], jnp.where(law == 2, identity, Q[i][j] - P[i][j]))
        return jnp.where(law == 0, Q[i][j], additive)

    return symmetric(tuple(tuple(one(i, j) for j in range(4)) for i in range(4)))


@door
def lmmse_start(x: Quat, P) -> Moments:
    """The filter at the start: Q(0) = P(0) + x(0) x(0)'."""
    return Moments(x, P, plus(P, outer(x)))


@door
def lmmse_predict(e: Moments, w: Vec3, w_r: Vec3, std, dt, law=0.0) -> Moments:
    """Prediction over dt [s] with the gyro's reading w [rad/s] at its start; (11), (13), (15).

    w_r: rate of the reference frame; std: standard deviation of the gyro's noise [rad/s] per sample; law: see
    `noise_moment`. Eq. (14) prints A(k), which must be A(k-1) (docs/loops/star_isolation.md,
    erratum 1).
    """
    A = lambda x: quaternion_step(Quat(*x), w, w_r, dt)
    W = rate_noise(noise_moment(law, e.x, e.P, e.Q), std, dt)
    return Moments(A(e.x), plus(congruence(A, e.P), W), plus(congruence(A, e.Q), rate_noise(e.Q, std, dt)))


@door
def lmmse_update(e: Moments, y: Vec3, s: Vec3, std) -> tuple[Moments, Innovation]:
    """Update by the reading y of a star in direction s, reference components; (12), (14), (16).

    std: standard deviation of each component's noise [1].
    """
    C = lambda x: star_map(x, s)
    x, P, innovation = update_three(e.x, e.P, y, C, C(e.x), std * std)
    return Moments(x, P, e.Q), innovation


@door
def bias_predict(e: Estimate, w: Vec3, w_r: Vec3, std, walk, dt) -> Estimate:
    """Prediction of `AttitudeBias` over dt [s]: `lmmse_predict` about the reading less the estimated bias.

    std: of the gyro's noise [rad/s] per sample; walk: of the bias's random walk [rad/s/sqrt(s)]. The second moment of
    the quaternion is taken as P + x x', for with a bias its own recursion is not closed.
    """
    x = e.x
    rate = w - x.b

    def F(d):
        d = AttitudeBias(*d)
        moved = quaternion_step(d.q, rate, w_r, dt) - (0.5 * dt) * (x.q * Quat(jnp.zeros_like(x.w), *d.b))
        return (*moved, *d.b)

    moment = plus([row[:4] for row in e.P[:4]], outer(x.q))
    W = rate_noise(moment, std, dt)
    drift = walk * walk * dt
    W = [[*row, 0, 0, 0] for row in W] + [[drift if i == j else 0 for j in range(7)] for i in range(4, 7)]
    return Estimate(AttitudeBias(*quaternion_step(x.q, rate, w_r, dt), *x.b), plus(congruence(F, e.P), W))


@door
def bias_update(e: Estimate, y: Vec3, s: Vec3, std) -> tuple[Estimate, Innovation]:
    """Update of `AttitudeBias` by the reading of a star with noise std [1], as `lmmse_update`."""
    C = lambda x: star_map(x, s)
    x, P, innovation = update_three(e.x, e.P, y, C, C(e.x), std * std)
    return Estimate(x, P), innovation


@door
def turn_predict(e: Estimate, w: Vec3, w_r: Vec3, std, dt) -> Estimate:
    """Prediction of a multiplicative EKF: x a unit `Quat`, P of the small turn a in q = x exp(a / 2), 3 rows.

    Exact for rates that are constant over dt: no small angle is assumed. std: of the gyro's noise [rad/s] per sample.
    """
    ahead = quat_from_vector(dt * w)
    x = quat_conjugate(quat_from_vector(dt * w_r)) * e.x * ahead
    rotate = lambda a: quat_rotate(quat_conjugate(ahead), Vec3(*a))
    W = [[(dt * std) ** 2 if i == j else 0 for j in range(3)] for i in range(3)]
    return Estimate(x, plus(congruence(rotate, e.P), W))


@door
def turn_update(e: Estimate, y: Vec3, s: Vec3, std) -> tuple[Estimate, Innovation]:
    """Update of a multiplicative EKF by the reading y of a star in direction s, with the exact residual y - A(x) s.

    std: of the noise of each component [1].
    """
    h = quat_rotate(quat_conjugate(e.x), s)
    o = jnp.zeros_like(e.x.x)
    turn, P, innovation = update_three(Vec3(o, o, o), e.P, y, lambda a: cross(h, Vec3(*a)), h, std * std)
    return Estimate(quat_normalised(e.x * quat_from_vector(turn)), P), innovation
