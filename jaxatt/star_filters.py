"""Attitude from one star and a gyro by filters of few states. Source: Yuan, He, Xing & Xiong.

Linear minimum-mean-square-error filters (LMMSE) with multiplicative gyro noise, without and with a gyro bias, and the
multiplicative extended Kalman filter (MEKF) they are compared with. A state is a flat tuple of components (`Quat`,
`AttitudeBias`, `Vec3`), a matrix a tuple of rows. A linear map is a function of a state, which serves the estimate and the
rows of its covariance alike. A star that is not valid or not finite leaves the prediction as it is.

May import: check, compiling, vec, attitude, faults, scores.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from math import log, pi
from operator import and_
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxatt import check, scores
from jaxatt.attitude import quat_conjugate, quat_error, quat_from_vector, quat_matrix, quat_normalised, quat_to_body
from jaxatt.compiling import shared
from jaxatt.faults import Reading
from jaxatt.vec import Mat3, Quat, Vec3, cross, det, inverse, where, zeros


class Belief(NamedTuple):
    """What a filter believes: a state of n components and its error covariance."""

    mean: Any  # (n,) components
    cov: Any  # (n,) rows of n


class Moments(NamedTuple):
    """What an LMMSE filter of the error quaternion believes."""

    mean: Quat  # [1] estimate; not of unit length
    cov: Any  # 4 rows of 4 [1] error covariance
    moment: Any  # 4 rows of 4 [1] second moment E[x x'] of the state


class AttitudeBias(NamedTuple):
    """Error quaternion and gyro bias in one flat state of seven."""

    w: Any  # [1]
    x: Any  # [1]
    y: Any  # [1]
    z: Any  # [1]
    bx: Any  # [rad/s]
    by: Any  # [rad/s]
    bz: Any  # [rad/s]

    @property
    def q(self):
        """The quaternion."""
        return Quat(*self[:4])

    @property
    def b(self):
        """The gyro bias."""
        return Vec3(*self[4:])


class Innovation(NamedTuple):
    """What a star told. NaN in nis and nll: no covariance allows them (see `update_three`)."""

    value: Vec3  # [1] residual r, measured less expected; 0 where there was no star
    covariance: Mat3  # [1] expected covariance M of the residual, whether there was a star or not
    nis: Any  # [1] r' M^-1 r: chi-square with ``rows`` degrees of freedom if the filter is consistent
    rows: Any  # [1] number of measurements used, 3 or 0
    nll: Any  # [1] negative log-likelihood of the measurements used


# matrices by rows


def symmetric(n: int, entry: Callable):
    """The symmetric n x n matrix of entry(i, j), asked for its upper triangle only: rounding cannot split it."""
    upper = {(i, j): entry(i, j) for i in range(n) for j in range(i, n)}
    return tuple(tuple(upper[min(i, j), max(i, j)] for j in range(n)) for i in range(n))


def congruence(f: Callable, P):
    """F P F' of a symmetric P for the linear map f."""
    rows = [f(column) for column in zip(*(f(row) for row in _square(P)))]
    return symmetric(len(rows), lambda i, j: rows[i][j])


def _square(P):
    """P, if it has as many columns as rows: where it has not, zip would drop some."""
    if any(len(row) != len(P) for row in P):
        check.refuse("P", "be n rows of n", f"{len(P)} rows of {', '.join(str(len(row)) for row in P)}")
    return P


def outer(x):
    """x x'."""
    return symmetric(len(x), lambda i, j: x[i] * x[j])


def plus(P, W):
    """P + W of two symmetric matrices."""
    return symmetric(len(P), lambda i, j: P[i][j] + W[i][j])


def diagonal(*variances):
    """The diagonal matrix, by rows."""
    return symmetric(len(variances), lambda i, j: variances[i] if i == j else jnp.zeros_like(variances[i]))


def update_three(belief, y: Reading, h: Callable, expected: Vec3, variance):
    """Kalman update by three measurements at once: mean, covariance and the `Innovation`.

    belief: prediction, n components and n rows; y: the measurement, a `Vec3`, and whether it is valid; h: linear map of a
    state to the measurement; expected: the measurement expected of the mean; variance of each component's noise, equal and
    independent. What is not valid or not finite moves neither mean nor covariance, nor does anything where M, the covariance
    of the residual, is not positive definite, or a variance, of the noise or on the diagonal of P, is negative or NaN.
    """

    there = y.valid & scores.finite(y.value)

    def gain(P, there):
        PH = tuple(Vec3(*h(row)) for row in P)  # P C', by rows
        CPC = [h(column) for column in zip(*PH)]
        M = Mat3(*(Vec3(*row) for row in symmetric(3, lambda i, j: CPC[i][j] + (variance if i == j else 0))))
        size = det(M)
        definite = _definite(M) & (variance >= 0)
        definite = reduce(and_, (P[i][i] >= 0 for i in range(len(P))), definite)
        M_inv, used = inverse(M), there & definite
        K = tuple(where(used, M_inv @ row, zeros()) for row in PH)  # P C' M^-1
        return PH, M, M_inv, size, definite, K

    x, P = belief.mean, _square(belief.cov)
    PH, M, M_inv, size, definite, K = shared(gain, P, there)
    r = where(there, y.value - expected, zeros())
    x = type(x)(*(a + k @ r for a, k in zip(x, K)))
    P = symmetric(len(P), lambda i, j: _less(P[i][j], K[i] @ PH[j], i == j))  # P - K M K'
    nis = jnp.where(definite, r @ (M_inv @ r), jnp.nan)
    nll = jnp.where(there, 0.5 * (nis + jnp.log(size) + 3 * log(2 * pi)), 0)
    return x, P, Innovation(r, M, nis, jnp.where(there, 3, jnp.zeros_like(nis)), nll)


def _less(p, q, is_variance: bool):
    """p - q; rounding makes no variance negative."""
    return jnp.maximum(p - q, jnp.minimum(p, 0)) if is_variance else p - q


# the filters


def quaternion_step(w: Vec3, w_r: Vec3, dt) -> Callable:
    """The linear map x -> A(k) x, Euler's step of x' = (x w - w_r x) / 2 over dt [s], eqs. (2) and (3).

    w: body rate [rad/s]; w_r: rate of the reference frame, in its own components [rad/s]. The two products of quaternions
    are taken together, so that their difference is rounded once.
    """
    less, more = (0.5 * dt) * (w - w_r), (0.5 * dt) * (w + w_r)

    def A(x):
        x = Quat(*x)
        return Quat(x.w - less @ x.v, *(x.v + x.w * less + cross(x.v, more)))

    return A


def star_map(s: Vec3) -> Callable:
    """The linear map x -> C x, C = [s, 2 [s x]], eq. (7): the star s in body axes, to first order in the vector part.

    x: a quaternion, or a state that begins with one.
    """
    twice = 2 * s

    def C(x):
        return x[0] * s + cross(twice, Vec3(*x[1:4]))

    return C


def rate_noise(S, std, dt):
    """sum_i std^2 B_i S B_i' = (dt std / 2)^2 (tr(S) I - S): what gyro noise does to a quaternion of moment S.

    B_i = -dt/2 R(e_i) as in eq. (3); S: 4 rows of 4; std [rad/s] of the noise on each axis, equal on the three.
    """
    c = (0.5 * dt * std) ** 2
    trace = S[0][0] + S[1][1] + S[2][2] + S[3][3]
    return symmetric(4, lambda i, j: c * (trace - S[i][j]) if i == j else -c * S[i][j])


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

    return symmetric(4, one)


def lmmse_start(x: Quat, P) -> Moments:
    """The filter at the start: Q(0) = P(0) + x(0) x(0)'."""
    return Moments(x, P, plus(P, outer(x)))


def lmmse_predict(belief: Moments, w: Vec3, w_r: Vec3, std, dt, law=0.0) -> Moments:
    """Prediction over dt [s] with the gyro's reading w [rad/s] at its start; (11), (13), (15).

    w_r: rate of the reference frame [rad/s]; std: of the gyro's noise [rad/s] per sample; law: see `noise_moment`. Eq. (14)
    prints A(k), which must be A(k-1) (docs/loops/star_isolation.md, erratum 1).
    """
    x, P, Q = belief
    A = quaternion_step(w, w_r, dt)
    W = rate_noise(noise_moment(law, x, P, Q), std, dt)
    return Moments(A(x), plus(congruence(A, P), W), plus(congruence(A, Q), rate_noise(Q, std, dt)))


def lmmse_update(belief: Moments, y: Reading, s: Vec3, std) -> tuple[Moments, Innovation]:
    """Update by the reading y of a star in direction s, reference components; (12), (14), (16).

    y: a `Vec3` [1] and whether it is valid; std: of each component's noise [1].
    """
    C = star_map(s)
    x, P, innovation = update_three(belief, y, C, C(belief.mean), std * std)
    return belief._replace(mean=x, cov=P), innovation


def bias_predict(belief: Belief, w: Vec3, w_r: Vec3, std, walk, dt) -> Belief:
    """Prediction of `AttitudeBias` over dt [s]: `lmmse_predict` about the reading less the estimated bias.

    std: of the gyro's noise [rad/s] per sample; walk: of the bias's random walk [rad/s/sqrt(s)]. The second moment of
    the quaternion is taken as P + x x', for with a bias its own recursion is not closed.
    """
    x, P = belief
    A, half = quaternion_step(w - x.b, w_r, dt), (0.5 * dt) * x.q
    o = jnp.zeros_like(x.w)

    def F(d):
        d = AttitudeBias(*d)
        return (*(A(d.q) - half * Quat(o, *d.b)), *d.b)

    W = rate_noise(plus([row[:4] for row in P[:4]], outer(x.q)), std, dt)
    drift = walk * walk * dt
    noise = lambda i, j: W[i][j] if j < 4 else drift if i == j else o
    return Belief(AttitudeBias(*A(x.q), *x.b), plus(congruence(F, P), symmetric(7, noise)))


def bias_update(belief: Belief, y: Reading, s: Vec3, std) -> tuple[Belief, Innovation]:
    """Update of `AttitudeBias` by a star in direction s with noise std [1] per component, as `lmmse_update`."""
    C = star_map(s)
    x, P, innovation = update_three(belief, y, C, C(belief.mean), std * std)
    return Belief(x, P), innovation


def mekf_predict(belief: Belief, w: Vec3, w_r: Vec3, std, dt) -> Belief:
    """Prediction of a multiplicative EKF: a unit `Quat` q, covariance of the small turn a in q exp(a / 2), 3 rows.

    Exact for rates that are constant over dt: no small angle is assumed. std: of the gyro's noise [rad/s] per sample.
    """
    ahead = quat_from_vector(dt * w)
    x = quat_conjugate(quat_from_vector(dt * w_r)) * belief.mean * ahead
    turn = quat_matrix(quat_conjugate(ahead))
    W = diagonal(*[jnp.square(dt * std)] * 3)
    return Belief(x, plus(congruence(lambda a: turn @ Vec3(*a), belief.cov), W))


def mekf_update(belief: Belief, y: Reading, s: Vec3, std) -> tuple[Belief, Innovation]:
    """Update of a multiplicative EKF by a star with noise std [1], as `lmmse_update`, with the exact residual y - A(x) s."""
    h = quat_to_body(belief.mean, s)
    o = jnp.zeros_like(h.x)
    level = Belief(Vec3(o, o, o), belief.cov)
    turn, P, innovation = update_three(level, y, lambda a: cross(h, Vec3(*a)), h, std * std)
    return Belief(quat_normalised(belief.mean * quat_from_vector(turn)), P), innovation


# how wrong an estimate is


def _definite(M: Mat3):
    """Whether a symmetric matrix is positive definite, by its leading minors."""
    return (M.x.x > 0) & (M.x.x * M.y.y > M.x.y * M.x.y) & (det(M) > 0)


def quaternion_error(x: Quat, P, q: Quat):
    """How far the estimate x of the quaternion q is off: turn [rad], its deviation [rad], NEES of three and of four.

    P: covariance of x, 4 rows of 4 [1]. The turn is taken to first order. NEES: error squared in units of its covariance, of
    the vector part and of all four components; NaN: P is no covariance.
    """
    e = x - q * jnp.where(x @ q < 0, -1, 1)  # q and -q are one attitude
    b = Vec3(*P[0][1:4])
    D = Mat3(*(Vec3(*row[1:4]) for row in P[1:4]))
    D_inv = inverse(D)
    nees = jnp.where(_definite(D), e.v @ (D_inv @ e.v), jnp.nan)
    rest = e.w - b @ (D_inv @ e.v)  # block elimination of the vector part leaves the scalar part's own share
    own = P[0][0] - b @ (D_inv @ b)
    nees_q = nees + jnp.where(own > 0, rest * rest / own, jnp.nan)
    std = Vec3(*(2 * jnp.sqrt(P[i][i]) for i in (1, 2, 3)))
    return 2 * e.v, std, nees, nees_q


def mekf_error(x: Quat, P, q: Quat):
    """The same of a multiplicative EKF, P its covariance of the turn [rad^2], 3 rows; its two NEES are one number."""
    error = quat_error(x, q)
    turn = error.v * jnp.where(error.w < 0, -2, 2)
    D = Mat3(*(Vec3(*row) for row in P))
    nees = jnp.where(_definite(D), turn @ (inverse(D) @ turn), jnp.nan)
    return turn, Vec3(*(jnp.sqrt(P[i][i]) for i in range(3))), nees, nees


# the filters as a loop takes them


class StarFilter(NamedTuple):
    """A filter for one star sensor, as functions; what it believes is `Moments` or `Belief`.

    params: anything with the fields std_q0, std_qv, std_bias, std_gyro, std_star, walk, law and orbit_rate, as the
    `Params` of `jaxatt.loops.star_isolation`.
    """

    start: Callable  # (params, q_hat) -> belief
    predict: Callable  # (params, belief, gyro reading, dt) -> belief
    update: Callable  # (params, belief, Reading y, s) -> belief, Innovation
    attitude: Callable  # (mean) -> unit Quat
    bias: Callable  # (mean) -> Vec3 [rad/s]
    error: Callable  # (belief, q) -> turn Vec3 [rad], std Vec3 [rad], nees, nees_q
    linear: bool  # whether it holds only for a body frame near the reference frame


def orbit_rate(rate) -> Vec3:
    """w_r = (0, -wo, 0): rate of the orbit frame in its own axes [rad/s]."""
    o = jnp.zeros_like(rate)
    return Vec3(o, -rate, o)


def _no_bias(mean) -> Vec3:
    o = jnp.zeros_like(mean.w)
    return Vec3(o, o, o)


def _prior(params):
    return params.std_q0**2, *[params.std_qv**2] * 3


LMMSE = StarFilter(  # the paper's, eqs. (11) to (16)
    start=lambda params, q: lmmse_start(q, diagonal(*_prior(params))),
    predict=lambda params, belief, w, dt: lmmse_predict(
        belief, w, orbit_rate(params.orbit_rate), params.std_gyro, dt, params.law
    ),
    update=lambda params, belief, y, s: lmmse_update(belief, y, s, params.std_star),
    attitude=quat_normalised,
    bias=_no_bias,
    error=lambda belief, q: quaternion_error(belief.mean, belief.cov, q),
    linear=True,
)
WITH_BIAS = StarFilter(  # seven states: the gyro's bias is estimated too
    start=lambda params, q: Belief(
        AttitudeBias(*q, *[jnp.zeros_like(q.w)] * 3), diagonal(*_prior(params), *[params.std_bias**2] * 3)
    ),
    predict=lambda params, belief, w, dt: bias_predict(
        belief, w, orbit_rate(params.orbit_rate), params.std_gyro, params.walk, dt
    ),
    update=lambda params, belief, y, s: bias_update(belief, y, s, params.std_star),
    attitude=lambda mean: quat_normalised(mean.q),
    bias=lambda mean: mean.b,
    error=lambda belief, q: quaternion_error(belief.mean.q, belief.cov, q),
    linear=True,
)
MEKF = StarFilter(  # multiplicative EKF with the exact residual, for large pointing offsets
    start=lambda params, q: Belief(quat_normalised(q), diagonal(*[4 * params.std_qv**2] * 3)),
    predict=lambda params, belief, w, dt: mekf_predict(belief, w, orbit_rate(params.orbit_rate), params.std_gyro, dt),
    update=lambda params, belief, y, s: mekf_update(belief, y, s, params.std_star),
    attitude=lambda mean: mean,
    bias=_no_bias,
    error=lambda belief, q: mekf_error(belief.mean, belief.cov, q),
    linear=False,
)


# without a filter


def star_angle(a: Vec3, b: Vec3, s: Vec3, p: Vec3, std):
    """Squared error of the cosine between two measured stars a, b in units of its variance: chi-square, one degree.

    a, b: readings made unit vectors; s, p: the stars' true directions; std: of each component's noise [1]. It needs no
    gyro. 0 where a star is missing (NaN).
    """
    error = a @ b - s @ p
    error = jnp.where(jnp.isnan(error), 0, error)
    variance = 2 * std**2 * (1 - (s @ p) ** 2)
    return error * error / variance
