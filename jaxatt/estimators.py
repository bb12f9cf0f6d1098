"""Estimators: what on-board code believes of the state."""

from __future__ import annotations

from collections.abc import Callable
from math import log, pi
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxatt.attitude import (
    mrp_rate,
    mrp_rate_transposed,
    quat_conjugate,
    quat_from_vector,
    quat_normalised,
    quat_rotate,
)
from jaxatt.faults import Reading
from jaxatt.vec import Mat3, Quat, Vec3, cross, det, diagonal, inverse, once, safe_sqrt


class AttitudeRate(NamedTuple):
    """An attitude and a body rate: truth, reading, estimate or residual."""

    q: Any  # Vec3 [1] MRP
    w: Any  # Vec3 [rad/s]


def mrp_observer(
    estimate: AttitudeRate, y: AttitudeRate, u: Vec3, J: Mat3, J_inv: Mat3, alpha, beta, sign=-1
) -> AttitudeRate:
    """Rate of change of the nonlinear MRP observer's estimate, Yun & Kang (2020), eq. (7).

    y: readings; u: torque [N m]; J: inertia [kg m^2]; alpha [1/s], beta [N m s]: gains; sign: -1 for Euler's
    equation, +1 for the dynamics as printed. Eq. (6) prints S(w) J wh in place of S(wh) J w, for which the Lyapunov
    identity fails. Errata 1 and 2 of docs/loops/observer_pd.md.
    """
    xi_q, xi_w = y.q - estimate.q, y.w - estimate.w

    def torque(xi_q, xi_w, u):
        return sign * cross(estimate.w, J @ y.w) + beta * xi_w + mrp_rate_transposed(y.q, xi_q) + u

    return AttitudeRate(q=mrp_rate(y.q, estimate.w) + alpha * xi_q, w=J_inv @ once(torque, xi_q, xi_w, u))


def residual_norm(y: AttitudeRate, estimate: AttitudeRate):
    """|xi|: norm of reading minus estimate, MRP and rad/s added without weights as in the paper."""
    xi_q, xi_w = y.q - estimate.q, y.w - estimate.w
    return safe_sqrt(xi_q @ xi_q + xi_w @ xi_w)


# recursive least squares


class LeastSquares(NamedTuple):
    """An estimate of a in y = W a and its gain. Shapes (*lanes)."""

    a: Any  # [y / W] estimate of the parameter
    P: Any  # [1/(W^2 s)] gain


def least_squares(estimate: LeastSquares, W, y, dt, forget=0.0) -> LeastSquares:
    """The estimate after dt [s] in which the regressor W and the output y were constant.

    Eun et al. (2016), eqs. (9), (10): a' = -P W (W a - y), P' = -P W^2 P, here in the rational form that is their
    exact solution, stable for every dt and never P < 0; forward Euler makes P negative once P W^2 dt > 1
    (docs/loops/wheel_mrac.md, choice 4). forget [1/s]: rate at which old data lose weight; without excitation P then
    grows without bound, and the caller limits it.
    """
    P = estimate.P / (jnp.exp(-forget * dt) + estimate.P * W * W * dt)
    return LeastSquares(a=estimate.a - P * W * (W * estimate.a - y) * dt, P=P)


# Kalman filter: components lead, lanes trail; rolled loops, because unrolled or reduced covariances are slow


class Belief(NamedTuple):
    """What a Kalman filter believes: a Gaussian."""

    mean: Any  # (n, *lanes)
    cov: Any  # (n, n, *lanes), symmetric to the last bit


class Evidence(NamedTuple):
    """What an update met. All of shape (*lanes)."""

    nis: Any  # [1] normalised innovation squared: chi-square with ``rows`` degrees of freedom if the filter is honest
    rows: Any  # [1] number of measurements used
    nll: Any  # [1] negative log-likelihood of the measurements used


def ekf_predict(belief: Belief, f: Callable, steady, Q, dt) -> Belief:
    """The belief after dt [s] of x' = (f(x), steady), P' = A P + P A' + Q: one joint RK4 step, A at every stage.

    f: (n, *lanes) -> (m, *lanes), the rates of the first m states; steady: (n - m, *lanes), those of the others,
    which depend on no state; Q: (n,) or (n, *lanes), the diagonal spectral density of the process noise. A is
    never written down: `jax.linearize` of f takes the rows of P, which is symmetric, so A P is W' below.
    """
    x, P = belief
    n, m = x.shape[0], jax.eval_shape(f, x).shape[0]
    index = jnp.arange(n).reshape(n, *(1,) * (x.ndim - 1))
    steady = jnp.broadcast_to(steady, (n - m, *x.shape[1:]))
    Q = jnp.broadcast_to(Q.reshape(Q.shape + (1,) * (x.ndim - Q.ndim)), x.shape)

    def grown(W, r, by):
        """Row r of P + by (W + W' + Q), summed in an order that keeps it symmetric."""
        column = jnp.where(r < m, W[:, jnp.minimum(r, m - 1)], 0)
        row = jnp.pad(W[r], [(0, n - m)] + [(0, 0)] * (W.ndim - 2))
        return P[r] + by * (column + row + jnp.where(index == r, Q, 0))

    def stage(x_s, W, by):
        k, A = jax.linearize(f, x_s)
        return jnp.concatenate([k, steady]), jax.lax.map(lambda r: A(grown(W, r, by)), jnp.arange(n))

    k1, A1 = jax.linearize(f, x)
    k1 = jnp.concatenate([k1, steady])
    W1 = jax.lax.map(A1, P)
    k2, W2 = stage(x + dt / 2 * k1, W1, dt / 2)
    k3, W3 = stage(x + dt / 2 * k2, W2, dt / 2)
    k4, W4 = stage(x + dt * k3, W3, dt)
    W = (W1 + 2 * (W2 + W3) + W4) / 6
    return Belief(x + dt / 6 * (k1 + 2 * (k2 + k3) + k4), jax.lax.map(lambda r: grown(W, r, dt), jnp.arange(n)))


def innovation(belief: Belief, value, h: Callable, R):
    """Residual value - h(mean) and its variance, both (k, *lanes), each measurement for itself.

    h: a linear map that takes components in the leading axis, of a mean and of a covariance alike; R: (k,) or
    (k, *lanes) variances of the measurements.
    """
    rows = h(belief.cov)
    variance = jax.lax.map(lambda ir: h(ir[1])[ir[0]], (jnp.arange(rows.shape[0]), rows))
    return value - h(belief.mean), variance + R.reshape(R.shape + (1,) * (variance.ndim - R.ndim))


def kalman_update(belief: Belief, y: Reading, h: Callable, R) -> tuple[Belief, Evidence]:
    """The belief after the measurements that are valid and finite; the others move neither mean nor covariance.

    y: value and valid of shape (k, *lanes); h: linear map (n, ...) -> (k, ...) on the leading axis; R: (k,) or
    (k, *lanes) variances of independent noise. One scalar measurement after the other: row i of D is the gain
    of measurement i, whitened, so that P+ = P - D' D is symmetric by construction, and e the whitened innovation.
    float32 is precise while R exceeds 1e-6 of the prior variance (Table 5 of Park, 2005); below, take float64.
    """
    x, P = belief
    HP = h(P)
    k = HP.shape[0]
    lanes = x.shape[1:]
    R = jnp.broadcast_to(R.reshape(R.shape + (1,) * (x.ndim - R.ndim)), (k, *lanes))
    due = jnp.broadcast_to(y.valid & jnp.isfinite(y.value), (k, *lanes))
    residual = jnp.where(due, jnp.where(due, y.value, 0) - h(x), 0)

    def one(i, carry):
        D, E, e, S = carry  # E[j] = h(D[j])

        def less(j, gr):
            share = E[j, i]
            return gr[0] - share * D[j], gr[1] - share * e[j]

        g, r = jax.lax.fori_loop(0, i, less, (HP[i], residual[i]))
        s = h(g)[i] + R[i]
        use = due[i] & (s > 0)
        s = jnp.where(use, s, 1)
        scale = jnp.where(use, jax.lax.rsqrt(s), 0)
        d = scale * g
        return D.at[i].set(d), E.at[i].set(h(d)), e.at[i].set(scale * r), S.at[i].set(s)

    start = (jnp.zeros_like(HP), jnp.zeros((k, k, *lanes), x.dtype), jnp.zeros_like(residual), jnp.ones_like(residual))
    D, _, e, S = jax.lax.fori_loop(0, k, one, start)
    mean = jax.lax.fori_loop(0, k, lambda j, x: x + e[j] * D[j], x)
    subtract = lambda r: jax.lax.fori_loop(0, k, lambda j, row: row - D[j, r] * D[j], P[r])
    cov = jax.lax.map(subtract, jnp.arange(x.shape[0]))
    nis, rows = jnp.sum(e * e, axis=0), jnp.sum(due, axis=0, dtype=x.dtype)
    nll = 0.5 * (nis + jnp.sum(jnp.log(S), axis=0) + rows * log(2 * pi))
    return Belief(mean, cov), Evidence(nis, rows, nll)


def nees(belief: Belief, truth):
    """Normalised estimation error squared e' P^-1 e, shape (*lanes); chi-square with n degrees of freedom.

    truth: the state, (n, *lanes). It is the NIS of the whole state measured without noise, and needs no solver.
    """
    e = jnp.broadcast_to(truth - belief.mean, belief.mean.shape)
    at_zero = Belief(jnp.zeros_like(e), belief.cov)
    return kalman_update(at_zero, Reading(e, jnp.ones(e.shape, bool)), lambda x: x, jnp.zeros_like(e))[1].nis


# Kalman filters of few states: plain rows
#
# A state is a flat tuple of components (Quat, AttitudeBias, Vec3); a matrix is a tuple of rows. A linear map is a
# function on the state, which serves the estimate and the rows of its covariance alike.


class Innovation(NamedTuple):
    """What a measurement said that was not expected."""

    r: Vec3  # residual [measurement unit]
    M: Mat3  # its covariance [measurement unit^2]
    nis: Any  # () [1] r' M^-1 r, chi-square with 3 degrees of freedom where the filter is consistent
    log_det: Any  # () log det M


def symmetric(rows):
    """A symmetric matrix, given by rows, by its upper triangle: what rounding did to the lower one is not computed."""
    n = range(len(rows))
    return tuple(tuple(rows[min(i, j)][max(i, j)] for j in n) for i in n)


def congruence(f, P):
    """F P F' of a symmetric P for the linear map f."""
    return symmetric(tuple(f(column) for column in zip(*(f(row) for row in P))))


def outer(x):
    """x x'."""
    return tuple(tuple(a * b for b in x) for a in x)


def plus(P, W):
    """P + W of two matrices by rows."""
    return tuple(tuple(a + b for a, b in zip(*rows)) for rows in zip(P, W))


def update_three(x, P, y: Vec3, h, expected: Vec3, variance):
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

    PH, M, M_inv, K = once(gain, P)
    r = y - expected
    x = type(x)(*(a + k @ r for a, k in zip(x, K)))
    P = symmetric(tuple(tuple(p - k @ c for p, c in zip(row, PH)) for row, k in zip(P, K)))  # P - K M K'
    return x, P, Innovation(r, M, r @ (M_inv @ r), jnp.log(det(M)))


# attitude from one star and a gyro: linear minimum mean square error, Yuan, He, Xing & Xiong


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


def quaternion_step(x: Quat, w: Vec3, w_r: Vec3, dt) -> Quat:
    """A(k) x: Euler's step of x' = (x w - w_r x) / 2, eqs. (2) and (3); linear in x.

    w: body rate [rad/s]; w_r: rate of the reference frame, in its own components [rad/s]; dt [s].
    """
    o = jnp.zeros_like(x.w)
    return x + (0.5 * dt) * (x * Quat(o, *w) - Quat(o, *w_r) * x)


def star_map(x, s: Vec3) -> Vec3:
    """C x with C = [s, 2 [s x]], eq. (7): the star seen in body axes, to first order in the vector part of x."""
    x = Quat(*x[:4])
    return x.w * s + 2 * cross(s, x.v)


def rate_noise(S, std, dt):
    """sum_i std^2 B_i S B_i' = (dt std / 2)^2 (tr(S) I - S): what gyro noise does to a quaternion of moment S.

    B_i = -dt/2 R(e_i) as in eq. (3); S: 4 rows of 4; std [rad/s] of the noise on each axis, equal on the three.
    """
    c = (0.5 * dt * std) ** 2
    trace = S[0][0] + S[1][1] + S[2][2] + S[3][3]
    return tuple(tuple(c * ((trace if i == j else 0) - S[i][j]) for j in range(4)) for i in range(4))


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


def lmmse_start(x: Quat, P) -> Moments:
    """The filter at the start: Q(0) = P(0) + x(0) x(0)'."""
    return Moments(x, P, plus(P, outer(x)))


def lmmse_predict(e: Moments, w: Vec3, w_r: Vec3, std, dt, law=0.0) -> Moments:
    """Prediction over dt [s] with the gyro's reading w [rad/s] at its start; (11), (13), (15).

    w_r: rate of the reference frame; std: standard deviation of the gyro's noise [rad/s] per sample; law: see
    `noise_moment`. Eq. (14) prints A(k), which must be A(k-1) (docs/loops/star_isolation.md,
    erratum 1).
    """
    A = lambda x: quaternion_step(Quat(*x), w, w_r, dt)
    W = rate_noise(noise_moment(law, e.x, e.P, e.Q), std, dt)
    return Moments(A(e.x), plus(congruence(A, e.P), W), plus(congruence(A, e.Q), rate_noise(e.Q, std, dt)))


def lmmse_update(e: Moments, y: Vec3, s: Vec3, std) -> tuple[Moments, Innovation]:
    """Update by the reading y of a star in direction s, reference components; (12), (14), (16).

    std: standard deviation of each component's noise [1].
    """
    C = lambda x: star_map(x, s)
    x, P, innovation = update_three(e.x, e.P, y, C, C(e.x), std * std)
    return Moments(x, P, e.Q), innovation


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


def bias_update(e: Estimate, y: Vec3, s: Vec3, std) -> tuple[Estimate, Innovation]:
    """Update of `AttitudeBias` by the reading of a star with noise std [1], as `lmmse_update`."""
    C = lambda x: star_map(x, s)
    x, P, innovation = update_three(e.x, e.P, y, C, C(e.x), std * std)
    return Estimate(x, P), innovation


def turn_predict(e: Estimate, w: Vec3, w_r: Vec3, std, dt) -> Estimate:
    """Prediction of a multiplicative EKF: x a unit `Quat`, P of the small turn a in q = x exp(a / 2), 3 rows.

    Exact for rates that are constant over dt: no small angle is assumed. std: of the gyro's noise [rad/s] per sample.
    """
    ahead = quat_from_vector(dt * w)
    x = quat_conjugate(quat_from_vector(dt * w_r)) * e.x * ahead
    rotate = lambda a: quat_rotate(quat_conjugate(ahead), Vec3(*a))
    W = [[(dt * std) ** 2 if i == j else 0 for j in range(3)] for i in range(3)]
    return Estimate(x, plus(congruence(rotate, e.P), W))


def turn_update(e: Estimate, y: Vec3, s: Vec3, std) -> tuple[Estimate, Innovation]:
    """Update of a multiplicative EKF by the reading y of a star in direction s, with the exact residual y - A(x) s.

    std: of the noise of each component [1].
    """
    h = quat_rotate(quat_conjugate(e.x), s)
    o = jnp.zeros_like(e.x.x)
    turn, P, innovation = update_three(Vec3(o, o, o), e.P, y, lambda a: cross(h, Vec3(*a)), h, std * std)
    return Estimate(quat_normalised(e.x * quat_from_vector(turn)), P), innovation
