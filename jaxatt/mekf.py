"""Attitude and gyro bias: the multiplicative extended Kalman filter, and the clone that takes late samples.

The error of the attitude is a small turn a in body axes, q = qh exp(a); bh is the bias of the gyro, w = y - b. The
covariance is an array (6, 6) of turn and bias; a clone's turn follows them in (9, 9). Its equations: Markley & Crassidis
(2014), sec. 6.2; the exact noise of a step is derived for this convention (docs/guides/attitude_filters.md).

A sample that comes late must not be taken for one of now: at constant rate the innovations do not show it. Clone the
attitude at the exposure, `cloned`, and update by the clone at the arrival, ``late=True`` (Roumeliotis & Burdick, 2002).

Written and used for one scenario; in a batch what touches the covariance runs one kernel over all scenarios
(`jaxatt.batching`), and an update costs nothing at a tick at which no scenario has a reading. Reverse mode needs a
`jax.vmap` around it, which the engine always has.

May import: check, vec, attitude, faults, batching, compiling, filters.
"""

from __future__ import annotations

from functools import partial
from math import log, pi
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.attitude import (
    left_jacobian,
    quat_conjugate,
    quat_from_vector,
    quat_normalised,
    quat_to_body,
    vector_from_quat,
)
from jaxatt.batching import column, in_lanes, mask, matrix, times, transposed
from jaxatt.compiling import shared
from jaxatt.faults import Reading
from jaxatt.filters import Belief, Innovation, nees
from jaxatt.vec import Mat3, Quat, Vec3, array, diagonal, outer, polynomial, scaled_identity, skew, where, zeros

TURN, BIAS, CLONE = 0, 3, 6  # where their rows begin


class Mekf(NamedTuple):
    """What the filter believes."""

    q: Quat  # attitude, body to reference
    b: Vec3  # [rad/s] bias of the gyro
    P: Any  # (6, 6), or (9, 9) with a clone: covariance of turn [rad], bias [rad/s] and turn of the clone [rad]
    clone: Quat | None = None  # attitude at the exposure of a sample that is on its way


class Step(NamedTuple):
    """How a turn and a bias spread over a step: Phi = ((turn, drift), (0, I)), and the noise Q in blocks."""

    turn: Mat3
    drift: Mat3  # [s]
    aa: Mat3  # [rad^2]
    ab: Mat3  # [rad^2/s]
    bb: Mat3  # [rad^2/s^2]


def start(q: Quat, b: Vec3, sigma_turn, sigma_bias) -> Mekf:
    """The belief in attitude q and bias b [rad/s], off by sigma_turn [rad] and sigma_bias [rad/s] about every axis."""
    kind = jnp.result_type(float, *jax.tree.leaves((q, b, sigma_turn, sigma_bias)))
    q, b, sigma_turn, sigma_bias = jax.tree.map(lambda a: jnp.asarray(a, kind), (q, b, sigma_turn, sigma_bias))
    return Mekf(q, b, in_lanes(partial(_independent, 6), sigma_turn, sigma_bias))


def restarted(belief: Mekf, when, b: Vec3, sigma_turn, sigma_bias) -> Mekf:
    """The belief begun anew in its attitude where ``when`` (bool), else as it is.

    b [rad/s], sigma_turn [rad] and sigma_bias [rad/s] are those of `start`; a clone is the attitude.
    """
    P = in_lanes(_restarted, belief.P, when, jnp.asarray(sigma_turn), jnp.asarray(sigma_bias))
    clone = None if belief.clone is None else where(when, belief.q, belief.clone)
    return Mekf(belief.q, where(when, b, belief.b), P, clone)


def farrenkopf(w: Vec3, dt, arw, rrw) -> Step:
    """Transition and noise of turn and bias over dt [s] at the constant rate w [rad/s]; exact.

    a' = -w x a - db - n_v, db' = n_u, with densities arw^2 and rrw^2. With r = w dt, x = |r|:
    Phi = ((exp(-[r x]), -dt J_l(-r)), (0, I)), Q_aa = arw^2 dt I + rrw^2 dt^3 (2 f I + (1/3 - 2 f) r r' / x^2),
    Q_ab = -rrw^2 dt^2 (I/2 - f [r x] + g [r x]^2), Q_bb = rrw^2 dt I, where f = (x - sin x) / x^3 and
    g = (1/2 - (1 - cos x) / x^2) / x^2. At w = 0 it is Farrenkopf (1978); the minus of Q_ab belongs to w = y - b.
    """
    r = dt * w
    xx = r @ r
    k, g = shared(_shapes, xx)
    f, h = 1 / 6 - 0.5 * xx * k, 0.5 - xx * g  # h = (1 - cos x) / x^2, k = (1/3 - 2 f) / x^2
    one, S, rr = scaled_identity(), skew(r), outer(r, r)
    SS = rr - xx * one
    u = rrw * rrw * dt
    return Step(
        turn=one - (1 - xx * f) * S + h * SS,
        drift=-dt * (one - h * S + f * SS),
        aa=(arw * arw * dt + u * dt * dt * 2 * f) * one + (u * dt * dt * k) * rr,
        ab=(-u * dt) * (0.5 * one - f * S + g * SS),
        bb=u * one,
    )


def predict(belief: Mekf, rate: Vec3, dt, arw, rrw) -> Mekf:
    """The belief after dt [s] at the gyro's reading ``rate`` [rad/s] over it; arw [rad/s^0.5], rrw [rad/s^1.5].

    The bias stays, the covariance is Phi P Phi' + Q (`farrenkopf`), the clone rests.
    """
    kind = jnp.result_type(float, *jax.tree.leaves((belief, rate)))
    dt, arw, rrw = (jnp.asarray(a, kind) for a in (dt, arw, rrw))
    w = rate - belief.b
    step = shared(farrenkopf, w, dt, arw, rrw)
    return belief._replace(q=_moved(belief.q, dt * w), P=in_lanes(_spread, belief.P, step))


def _moved(q: Quat, turn: Vec3) -> Quat:
    """q after a small turn in body axes [rad]."""
    return quat_normalised(q * quat_from_vector(turn))


def update_vector(
    belief: Mekf, reading: Reading, reference: Vec3, std, gate: Any = jnp.inf, spread: bool = False
) -> tuple[Mekf, Innovation]:
    """The belief after a direction or field measured in body axes, y = A(q)' r + std N; linearised at the belief.

    Args:
        belief: prior.
        reading: `Vec3` in body axes and whether it is valid.
        reference: the same vector in reference axes.
        std: of each component [unit of the vector]; all three are used, which for a unit vector is the safe choice.
        gate: a measurement whose nis lies above it moves nothing, its rows are 0; its nis is told.
        spread: turn the covariance with the correction, to first order in the spread; it matters above .1 rad.

    Returns:
        The belief and what the measurement told; nis is chi-square of three degrees. What is not valid or not finite
        is missing: it moves nothing, nis 0 and rows 0. A negative or NaN variance, in P or of the measurement, gives NaN
        in nis and nll and no update.
    """
    expected = quat_to_body(belief.q, reference)
    R = jnp.where(std >= 0, std * std, jnp.nan)  # else XLA takes the square of a NaN for positive
    return _update(belief, TURN, skew(expected), reading.value - expected, Vec3(R, R, R), reading.valid, gate, spread)


def update_attitude(
    belief: Mekf,
    reading: Reading,
    axes: Mat3,
    variance: Vec3,
    late: bool = False,
    gate: Any = jnp.inf,
    spread: bool = False,
) -> tuple[Mekf, Innovation]:
    """The belief after a star tracker's sample, y = q exp(C n), n of independent components.

    Args:
        belief: prior.
        reading: `Quat` and whether it is valid.
        axes: C, the axes of the sample's errors as columns, in body axes (`jaxatt.sensors.star_axes`).
        variance: of the three components [rad^2].
        late: the sample is of the clone's instant.
        gate, spread: as of `update_vector`.

    Returns:
        The belief and what the measurement told; its value is in the axes C.

    Raises:
        ValueError: ``late`` for a belief without a clone.
    """
    held = belief.clone if late else belief.q
    if held is None:
        check.refuse("late", "be False for a belief without a clone", late)
    length = reading.value @ reading.value
    due = reading.valid & (length > 0) & (length < jnp.inf)  # a dead tracker reads zeros
    rows, seen = axes.T, where(due, reading.value, held)
    residual = rows @ vector_from_quat(quat_conjugate(held) * seen)
    return _update(belief, CLONE if late else TURN, rows, residual, variance, due, gate, spread)


def cloned(belief: Mekf, when: Any = True) -> Mekf:
    """The belief with its present attitude cloned, at the exposure of a sample; an older clone is replaced where ``when``."""
    if belief.clone is None:
        return Mekf(belief.q, belief.b, in_lanes(_with_clone, belief.P), belief.q)
    P = in_lanes(lambda P, when: jnp.where(when, _with_clone(P), P), belief.P, jnp.asarray(when))
    return Mekf(belief.q, belief.b, P, where(when, belief.q, belief.clone))


def mekf_nees(belief: Mekf, q: Quat, b: Vec3):
    """Normalised estimation error squared of the belief against the true q and b [rad/s]: chi-square of 6 degrees.

    The clone is left out: right after cloning the whole covariance is singular. NaN: P is no covariance.
    """
    turn = shared(lambda p, q: vector_from_quat(quat_conjugate(p) * q), belief.q, q)  # rounded alike in every program
    error = jnp.concatenate([array(turn), array(b - belief.b)])
    return nees(Belief(jnp.zeros_like(error), belief.P[:CLONE, :CLONE]), error)


def _update(belief: Mekf, at: int, H: Mat3, value: Vec3, R: Vec3, due, gate, spread: bool) -> tuple[Mekf, Innovation]:
    """The three rows of H, which see the turn ``at``, one after the other; all residuals are taken at the prior."""
    kind = jnp.result_type(float, *jax.tree.leaves((belief, value)))
    H, value, R, gate = jax.tree.map(lambda a: jnp.asarray(a, kind), (H, value, R, gate))
    P, moved, told = in_lanes(partial(_told, at, spread), belief.P, H, value, R, jnp.asarray(due), gate)
    turn, bias, *of_clone = (Vec3.of(moved[i : i + 3]) for i in range(0, len(moved), 3))
    clone = None if belief.clone is None else _moved(belief.clone, *of_clone)
    ahead = Mekf(_moved(belief.q, turn), belief.b + bias, P, clone)
    return where(told.rows > 0, ahead, belief._replace(P=P)), told


# The kernels. Every array may have trailing lanes: P is (n, n, ...), the components of a vector are (...).


def not_negative(P):
    """Whether no variance on the diagonal is negative or NaN."""
    return jnp.all(jnp.stack([P[i, i] >= 0 for i in range(len(P))]), axis=0)


def _independent(n: int, sigma_turn, sigma_bias):
    """P of independent errors of turn and bias, of these deviations about every axis; the clone is the turn."""
    same = np.arange(n) % CLONE
    variances = jnp.stack([(sigma_turn if i < BIAS else sigma_bias) ** 2 for i in same])
    return jnp.where(mask(same[:, None] == same, sigma_turn), variances[:, None], 0)


def _restarted(P, when, sigma_turn, sigma_bias):
    anew = lambda P: jnp.where(when, _independent(len(P), sigma_turn, sigma_bias), P)
    return jax.lax.cond(jnp.any(when), anew, lambda P: P, P)


def _with_clone(P):
    """P with the turn's rows and columns as those of the clone."""
    rows = jnp.concatenate([P[:CLONE], P[:BIAS]])
    return jnp.concatenate([rows[:, :CLONE], rows[:, :BIAS]], axis=1)


def _spread(P, step: Step):
    """Phi P Phi' + Q."""
    like, joint = P[0, 0], [(*a, *b) for a, b in zip(step.turn, step.drift)]
    top = jnp.stack(times(joint, P[:CLONE]))  # of Phi P
    aa = jnp.stack(times(joint, transposed(top[:, :CLONE])))
    top = top.at[:, :BIAS].set(0.5 * (aa + transposed(aa)) + matrix(step.aa, like))
    top = top.at[:, BIAS:CLONE].add(matrix(step.ab, like))
    P = P.at[:BIAS].set(top).at[BIAS:, :BIAS].set(transposed(top[:, BIAS:]))
    return P.at[BIAS:CLONE, BIAS:CLONE].add(matrix(step.bb, like))


def _told(at: int, spread: bool, P, H: Mat3, value: Vec3, R: Vec3, due, gate):
    """P after the measurement, the moves (n, ...) of turn, bias and clone, and the `Innovation`.

    The rows of M H P are what each row of H finds after those before it, where M S M' = diag(1 / w), M of units and lower
    triangular: P - sum of w c c' over these rows c. w is 0 for a row that is missing, or determined by those before it.
    """
    n, like = len(P), value.x
    prior = H @ Mat3.of(P[at : at + 3, at : at + 3]) @ H.T
    possible = not_negative(P) & ~(due & ~(jnp.minimum(jnp.minimum(R.x, R.y), R.z) >= 0))
    due = due & possible & jnp.isfinite(value @ value)
    value = where(due, value, zeros())
    M, weights, residuals, nis, rows, logs = shared(_whitened, prior, R, value, due)
    use = due & (nis <= gate)

    def learnt(P, M, H, weights, residuals):
        found = shared(times, M @ H, P[at : at + 3])  # three rows (n, ...)
        weighed = [w * c for w, c in zip(weights, found)]
        moved = times([residuals], weighed)[0]
        gain = transposed(jnp.stack(times(M.T, weighed)))
        after = P - sum(w * (c[:, None] * c) for w, c in zip(weights, found))
        least = jnp.minimum(P, 0)  # rounding makes no variance negative
        after = jnp.where(mask(np.eye(n, dtype=bool), like), jnp.maximum(after, least), after)
        return where(use, (_as_seen_after(after, moved) if spread else after, moved, gain), nothing(P))

    def nothing(P, *_):
        return P, jnp.zeros_like(P[0]), jnp.zeros_like(P[:, :3])

    P, moved, gain = jax.lax.cond(jnp.any(use), learnt, nothing, P, M, H, weights, residuals)
    rows, logs = jnp.where(use, rows, 0), jnp.where(use, logs, 0)
    nis = jnp.where(possible, nis, jnp.nan)
    nll = 0.5 * (jnp.where(use | ~possible, nis, 0) + logs + rows * log(2 * pi))
    told = Innovation(column(value, like), matrix(prior + diagonal(R), like), nis, rows, nll, gain)
    return P, moved, told


def _whitened(prior: Mat3, R: Vec3, value: Vec3, due):
    """M, weights w and whitened residuals M value of S = prior + diag(R), `_told`; NIS, rows used and sum of log 1 / w."""
    kind = value.x.dtype
    number = jnp.finfo(kind)
    units = scaled_identity(jnp.ones((), kind))
    M, weights, nis, rows, logs = [], [], 0.0, jnp.zeros((), kind), 0.0
    for i, (m, row, r) in enumerate(zip(units, prior, R)):
        for w, before in zip(weights, M):
            m = m - (w * (row @ before)) * before
        s = row @ m + r
        least = jnp.maximum(8 * number.eps * jnp.abs(row[i] + r), number.tiny ** (2 / 3))
        here = due & ~jnp.isposinf(r)
        new = here & (s > least)
        s, e = jnp.where(here, jnp.maximum(s, least), 1), m @ value
        M, weights = [*M, m], [*weights, jnp.where(new, 1 / s, 0)]
        nis = nis + jnp.where(here, e * e / s, 0)
        rows, logs = rows + new.astype(kind), logs + jnp.where(new, jnp.log(s), 0)
    return Mat3(*M), weights, [m @ value for m in M], nis, rows, logs


def _as_seen_after(P, moved):
    """G P G' with G = J_r(a) on the turns: the spread as seen from the corrected attitude, Mueller et al. (2017)."""
    for at in range(0, len(P), CLONE):
        G = left_jacobian(-Vec3.of(moved[at : at + 3]))
        for _ in range(2):  # G P, then its transpose times G'
            P = transposed(P.at[at : at + 3].set(jnp.stack(times(G, P[at : at + 3]))))
    return 0.5 * (P + transposed(P))


def _shapes(xx):
    """(1/3 - 2 (x - sin x) / x^3) / x^2 and (1/2 - (1 - cos x) / x^2) / x^2 of x^2."""
    small = xx < 0.25  # below, eight terms of the series are exact to rounding, and the closed forms are not
    near, far = jnp.where(small, xx, 0.25), jnp.where(small, 0.25, xx)
    x = jnp.sqrt(far)
    f, h = (x - jnp.sin(x)) / (x * far), (1 - jnp.cos(x)) / far
    k, g = (polynomial(c, near) for c in _SERIES)
    return jnp.where(small, k, (1 / 3 - 2 * f) / far), jnp.where(small, g, (0.5 - h) / far)


def _factorials(first: int, terms: int, factor: float = 1.0) -> list[float]:
    value, found = factor, []
    for k in range(1, first + 1):
        value /= k
    for k in range(terms):
        found.append(value)
        value /= -(first + 2 * k + 1) * (first + 2 * k + 2)
    return found


_SERIES = _factorials(5, 8, 2.0), _factorials(4, 8)
