"""The unscented quaternion estimator (USQUE) of attitude and gyro bias; Crassidis & Markley (2003).

It bears initial errors of tens of degrees, where the MEKF converges slowly or not at all. The belief is that of
`jaxatt.mekf`; the spread is held in Rodrigues parameters p = 4 tan(angle / 4) axis, which is the small turn to second
order. The paper's attitude takes reference to body, ours body to reference: the same numbers, quaternion products
reversed.

In a batch the step runs one kernel over all scenarios (`jaxatt.batching`); reverse mode needs a `jax.vmap` around it,
which the engine always has.

May import: check, batching, compiling, vec, attitude, faults, filters, mekf.
"""

from __future__ import annotations

from math import log, pi, sqrt
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.attitude import quat_conjugate, quat_from_mrp, quat_from_vector, quat_normalised, quat_to_body
from jaxatt.batching import column, in_lanes, mask, matrix, times, transposed
from jaxatt.compiling import shared
from jaxatt.faults import Reading
from jaxatt.filters import Innovation
from jaxatt.mekf import Mekf, not_negative
from jaxatt.vec import Mat3, Quat, Vec3, cross, det, inverse, safe_sqrt, scaled_identity, where, zeros

_OTHERS = 1 / 14  # weight of each of twelve points; the one of the centre is 1/7: six numbers and lambda = 1


def refuse_unfit(arw, rrw, dt) -> None:
    """Refuse, with ValueError, a gyro whose bias walks too fast for the split noise: rrw dt >= sqrt(6) arw."""
    most = sqrt(6) * np.asarray(arw) / np.asarray(dt) if check.concrete((arw, rrw, dt)) else jnp.inf
    check.pair("rrw", "stay below sqrt(6) arw / dt, lest the noise before a step be negative", rrw, most, np.less)


def usque_step(
    belief: Mekf, rate: Vec3, dt, arw, rrw, reading: Reading, reference: Vec3, std
) -> tuple[Mekf, Innovation]:
    """The belief after dt [s] at the gyro's reading, and after a vector measured at its end.

    Thirteen points, the mean and the columns of +-sqrt(7 (P + Q)), are turned by the gyro; P+ is their covariance plus Q
    once more, where Q = dt/2 diag((arw^2 - rrw^2 dt^2 / 6) I, rrw^2 I): at rest both together are the exact noise of a
    step (`jaxatt.mekf.farrenkopf`). As in the paper the gain knows the first half only.

    Args:
        belief: prior, without a clone.
        rate: reading of the gyro over dt [rad/s].
        dt: [s].
        arw, rrw: of the gyro [rad/s^0.5], [rad/s^1.5]; rrw dt < sqrt(6) arw (`refuse_unfit`).
        reading: `Vec3` in body axes and whether it is valid.
        reference: the same vector in reference axes.
        std: of each component [unit of the vector].

    Returns:
        The belief and what the measurement told, as of `jaxatt.mekf.update_vector`.

    Raises:
        ValueError: a belief with a clone.
    """
    if belief.clone is not None:
        check.refuse("belief", "be without a clone", "one with a clone")
    operands = belief, rate, dt, arw, rrw, reading.value, reference, std
    kind = jnp.result_type(float, *jax.tree.leaves(operands))
    operands = jax.tree.map(lambda a: jnp.asarray(a, kind), operands)
    return in_lanes(_step, *operands, jnp.asarray(reading.valid))


def _step(belief: Mekf, rate, dt, arw, rrw, value, reference, std, valid) -> tuple[Mekf, Innovation]:
    """The step for one scenario or many, scenarios last; the twelve points about the mean lie in the first axis.

    Every point is held as what it differs from the mean's, which keeps the digits of small spreads in float32.
    """
    early, late = 0.5 * dt * (arw * arw - (rrw * dt) ** 2 / 6), 0.5 * dt * rrw * rrw  # of turn and bias
    w = rate - belief.b
    turn = quat_from_vector(dt * w)
    q = belief.q * turn
    expected = quat_to_body(q, reference)
    offsets = shared(_spread, belief.P, jnp.stack([early] * 3 + [late] * 3))
    D = shared(_points, offsets, w, dt, turn, expected)
    G, mean = shared(_moments, D)
    biases = mask(np.outer(np.arange(6) >= 3, np.arange(6) >= 3), std)  # the bias's block is known without the points
    both = jnp.stack([early] * 3 + [2 * late] * 3)
    P = jnp.where(biases, belief.P, G[:6, :6]) + jnp.where(mask(np.eye(6, dtype=bool), std), both, 0)
    S = Mat3.of(G[6:, 6:]) + scaled_identity(std * std)

    sound = not_negative(belief.P)
    possible = sound & ~(valid & ~(std >= 0))  # XLA takes the square of a NaN for positive
    due = valid & jnp.isfinite(value @ value) & possible & (std < jnp.inf)
    residual = where(due, value - expected - Vec3.of(mean[6:]), zeros())
    safe = where(due, S, scaled_identity(jnp.ones_like(std)))
    inv = inverse(safe)
    across = transposed(G[:6, 6:])  # (3, 6, ...)
    gain = jnp.where(due, jnp.stack(times(inv, across)), 0)  # transposed
    moved = times([residual], gain)[0] + jnp.where(mask(np.arange(6) < 3, std), mean[:6], 0)
    less = jnp.stack(times(transposed(gain), across))
    ahead = Mekf(
        quat_normalised(q * quat_from_mrp(Vec3.of(moved[:3]) / 4)),
        belief.b + Vec3.of(moved[3:]),
        P - 0.5 * (less + transposed(less)),
    )
    nis, rows = residual @ (inv @ residual), 3 * due.astype(std.dtype)
    nll = 0.5 * (nis + jnp.where(due, jnp.log(det(safe)), 0) + rows * log(2 * pi))
    impossible = jnp.where(possible, 0, jnp.nan)
    told = Innovation(column(residual, std), matrix(S, std), nis + impossible, rows, nll + impossible, transposed(gain))
    return where(sound, ahead, belief._replace(q=q)), told


def _spread(P, noise):
    """The twelve columns of +-sqrt(7 (P + diag(noise))), an array (6, 12, ...): Cholesky's factor, column by column."""

    def next_column(j, carry):
        S, L = carry
        root = safe_sqrt(jnp.maximum(S[j, j], 0))
        below = jnp.where(mask(np.arange(6), noise[0]) >= j, S[j], 0) / jnp.where(root > 0, root, 1)
        return S - below[:, None] * below, L.at[j].set(below)

    S = 7 * (P + jnp.where(mask(np.eye(6, dtype=bool), noise[0]), noise, 0))
    half = transposed(jax.lax.fori_loop(0, 6, next_column, (S, jnp.zeros_like(S)))[1])
    return jnp.concatenate([half, -half], axis=1)


def _points(offsets, w: Vec3, dt, turn: Quat, expected: Vec3):
    """Turn, bias and vector of the twelve points less those of the mean, an array (9, 12, ...)."""
    p, db = Vec3(*offsets[:3]), Vec3(*offsets[3:])
    away = quat_conjugate(turn) * quat_from_mrp(p / 4) * quat_from_vector(dt * (w - db))
    dp = 4 / (1 + away.w) * away.v  # never the shadow, so that points more than 180 deg away stay apart
    t = 2 * cross(away.v, expected)
    return jnp.stack([*dp, *db, *(cross(away.v, t) - away.w * t)])


def _moments(D):
    """Covariance (9, 9, ...) of the points and their mean (9, ...)."""
    total = lambda some: _OTHERS * sum(some[1:], some[0])
    mean: Any = total([D[:, k] for k in range(12)])
    row = lambda i: total([D[i, k] * D[:, k] for k in range(12)]) - mean[i] * mean
    return jax.lax.map(row, jnp.arange(9)), mean
