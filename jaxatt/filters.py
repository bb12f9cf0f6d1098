"""An extended Kalman filter of many states: prediction, update, consistency. Written and used for one scenario.

The model is two functions of the state, linearised at the mean: ``f``, the rates, and ``h``, the expected measurement.
Let them return trees such as tuples of `Vec3`: `jnp.stack` and `jnp.concatenate` in them cost a quarter of the speed.

In a batch the filter runs one kernel over all scenarios (`jaxatt.batching`): components lead, lanes trail, and every
loop over components is rolled, for unrolled or reduced covariances are slow. Reverse mode needs a `jax.vmap` around it,
which the engine always has. `star_filters` writes filters of few states as plain rows.

Angles: a row of h, or a component of the state, that is an angle states the length of its turn (`period`), 2 pi or 360 as
its unit is; its residual is then taken modulo a turn, as sensors wrap at +-180 deg and filters do not.

May import: check, compiling, batching, faults, attitude.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import log, pi
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.attitude import wrapped
from jaxatt.batching import lanes_last, mask
from jaxatt.compiling import shared
from jaxatt.faults import Reading


class Belief(NamedTuple):
    """What a Kalman filter believes: a Gaussian."""

    mean: Any  # (n,)
    cov: Any  # (n, n), symmetric to the last bit


class Innovation(NamedTuple):
    """What the k measurements of an update told; NaN in nis and nll: P or R is no covariance."""

    value: Any  # (k,) measured less expected, 0 where it is missing
    covariance: Any  # (k, k) S = H P H' + diag(R), missing measurements too
    nis: (
        Any  # () [1] normalised innovation squared: chi-square with ``rows`` degrees of freedom if the filter is honest
    )
    rows: Any  # () [1] number of measurements used
    nll: Any  # () [1] negative log-likelihood of the measurements used
    gain: Any  # (n, k) K: the mean moved by gain @ value; 0 for measurements that were not used


def predict(belief: Belief, f: Callable, steady, Q, dt) -> Belief:
    """The belief after dt: x' = (f(x), steady), P' = A P + P A' + Q with A = dx'/dx, one joint RK4 step.

    Args:
        belief: mean (n,) and covariance (n, n).
        f: rates of the first m states, as a function of the state (n,): an array (m,) or any tree of arrays, such as a
            tuple of `Vec3`, whose numbers in order are these rates. It may close over anything.
        steady: (n - m,) rates of the other states, which depend on no state.
        Q: (n,) diagonal of the spectral density of the process noise.
        dt: [s].

    Raises:
        ValueError: a belief whose mean and covariance do not fit each other.
    """
    x, P = _fitting(belief)
    rest = x.shape[0] - _count(f, x)
    steady = jnp.broadcast_to(jnp.asarray(steady, x.dtype), (rest,))
    Q = jnp.broadcast_to(jnp.asarray(Q, x.dtype), x.shape)
    return lanes_last(_predict, f, x, Belief(x, P), steady, Q, jnp.asarray(dt, x.dtype))


def update(belief: Belief, reading: Reading, h: Callable, R, period: Any = None) -> tuple[Belief, Innovation]:
    """The belief after the measurements that are valid and finite; the others move neither mean nor covariance.

    x + K (y - h(x)) and P - K S K' with S = H P H' + R, H = dh/dx and K = P H' S^-1, one measurement after the other.
    R = 0 is allowed: a measurement that those before it determine adds nothing, but a huge nis where it contradicts
    them; R = inf means missing. A negative or NaN variance, in R or on the diagonal of P, gives NaN in nis and nll and
    no update. float32 is precise while R exceeds 1e-6 of the prior variance (Table 5 of Park, 2005).

    Args:
        belief: mean (n,) and covariance (n, n).
        reading: value (k,) and valid (k,).
        h: the expected measurement as a function of the state (n,): an array (k,) or any tree of arrays with k numbers.
        R: (k,) variances of the independent measurement noises.
        period: (k,) one turn of each row that is an angle, in its unit (`jaxatt.attitude.full_turn`), inf for the others:
            residuals y - h(x) are then at most half a turn. None: no row is an angle.

    Returns:
        The belief and what the measurements told; fields of `Innovation` that nobody uses cost nothing in a jitted run.

    Raises:
        ValueError: a belief whose mean and covariance do not fit each other.
    """
    x, P = _fitting(belief)
    k = _count(h, x)
    y, R, period = _rows_of(k, x, reading.value, R, period)
    operands = Belief(x, P), Reading(y, jnp.broadcast_to(reading.valid, (k,))), R, period
    return lanes_last(_update, h, x, *operands, smooth=partial(_update, triangle=False))


def innovation(belief: Belief, value, h: Callable, R, period: Any = None):
    """Residual value - h(mean) and its variance, both (k,), of each measurement by itself.

    h, R (k,) and period (k,) as of `update`.
    """
    x, P = _fitting(belief)
    return lanes_last(_innovation, h, x, Belief(x, P), *_rows_of(_count(h, x), x, value, R, period))


@jax.jit  # which keeps its loops compiled from call to call
def nees(belief: Belief, truth, period: Any = None):
    """Normalised estimation error squared e' P^-1 e, e = truth - mean (n,); chi-square with n degrees of freedom.

    It is the NIS of the whole state measured without noise, and needs no solver. NaN: P is no covariance. period: (n,) one
    turn of each component that is an angle, inf for the others, as in `update`.
    """
    mean = jnp.asarray(belief.mean)
    e = _residual(jnp.asarray(truth, mean.dtype), mean, period)
    at_zero = Belief(jnp.zeros_like(e), belief.cov)
    return update(at_zero, Reading(e, jnp.ones(e.shape, bool)), lambda x: x, jnp.zeros_like(e))[1].nis


def _fitting(belief: Belief) -> tuple[Any, Any]:
    """Mean and covariance as arrays that fit each other."""
    x, P = map(jnp.asarray, belief)
    if x.ndim != 1 or P.shape != (*x.shape, *x.shape):
        check.refuse("belief", "hold a mean (n,) and a cov (n, n)", f"of shapes {x.shape} and {P.shape}")
    return x, P


def _rows_of(k: int, x, *numbers):
    """Numbers of k measurements, (k,), of the type of x; None stays None."""
    return tuple(None if a is None else jnp.broadcast_to(jnp.asarray(a, x.dtype), (k,)) for a in numbers)


def _residual(value, expected, period):
    """The difference, of angles modulo a turn."""
    return value - expected if period is None else wrapped(value - expected, period)


def _count(f: Callable, x) -> int:
    """How many numbers f returns."""
    return sum(a.size for a in jax.tree.leaves(jax.eval_shape(f, x)))


# The kernels. Every array may have trailing lanes: x is (n, ...), P is (n, n, ...).


def _stacked(f: Callable, lanes: tuple) -> Callable:
    """f, which returns a tree, as one that returns its numbers in the first axis."""
    return lambda x: jnp.concatenate([jnp.reshape(a, (-1, *lanes)) for a in jax.tree.leaves(f(x))])


def _rows(f: Callable, n: int):
    """f(0), ..., f(n - 1), stacked."""
    return jax.lax.map(f, jnp.arange(n))


def _predict(f: Callable, belief: Belief, steady, Q, dt) -> Belief:
    """A is never written down: the linearised f takes the rows of P, which is symmetric, so that A P is W' below."""
    x, P = belief
    n, m = x.shape[0], x.shape[0] - steady.shape[0]
    f = _stacked(f, x.shape[1:])
    index = jnp.arange(n).reshape(n, *(1,) * (x.ndim - 1))

    def grown(W, r, by):
        """Row r of P + by (W + W' + Q), summed in an order that keeps it symmetric."""
        column = jnp.where(r < m, W[:, jnp.minimum(r, m - 1)], 0)
        row = jnp.pad(W[r], [(0, n - m)] + [(0, 0)] * (W.ndim - 2))
        return P[r] + by * (column + row + jnp.where(index == r, Q, 0))

    def stage(carry, coefficients):
        (k, W), total = carry
        at, weight = coefficients
        k, A = jax.linearize(f, x + at * dt * jnp.concatenate([k, steady]))
        W = _rows(lambda r: shared(A, grown(W, r, at * dt)), n)
        return ((k, W), jax.tree.map(lambda a, b: a + weight * b, total, (k, W))), None

    k, A = jax.linearize(f, x)
    first = k, jax.lax.map(A, P)
    coefficients = jnp.array([0.5, 0.5, 1], x.dtype), jnp.array([2, 2, 1], x.dtype)
    (_, (k, W)), _ = jax.lax.scan(stage, (first, first), coefficients)
    k, W = k / 6, W / 6
    return Belief(x + dt * jnp.concatenate([k, steady]), _rows(lambda r: grown(W, r, dt), n))


def _expected(h: Callable, belief: Belief):
    """h(x), the map H and the matrix H P, (k, n, ...)."""
    expected, H = jax.linearize(_stacked(h, belief.mean.shape[1:]), belief.mean)
    return expected, H, jax.vmap(H, 1, 1)(belief.cov)


def _innovation(h: Callable, belief: Belief, value, R, period):
    expected, H, HP = _expected(h, belief)
    return _residual(value, expected, period), _rows(lambda i: H(HP[i])[i], value.shape[0]) + R


def _update(h: Callable, belief: Belief, reading: Reading, R, period, triangle=True) -> tuple[Belief, Innovation]:
    """Cholesky's S = L L' row by row: D = L^-1 H P, whence P+ = P - D' D is symmetric by construction.

    e = L^-1 (y - h(x)) and E = L', each row as soon as the rows before it are known: those that are not used stay zero.
    triangle: go over the rows before it only, which reverse mode cannot, instead of over all, the later ones being zero.
    """
    x, P = belief
    n, k = x.shape[0], R.shape[0]
    expected, H, HP = _expected(h, belief)
    due = reading.valid & jnp.isfinite(reading.value) & ~jnp.isposinf(R)
    value = jnp.where(due, _residual(jnp.where(due, reading.value, 0), expected, period), 0)
    # not ~(R >= 0): of R = s * s the compiler takes that for False, NaN or not
    impossible = jnp.any(due & ((R < 0) | jnp.isnan(R)), axis=0) | ~jnp.all(_rows(lambda i: P[i, i], n) >= 0, axis=0)
    noise = jnp.where(due & (R >= 0), R, 1)
    number = jnp.finfo(x.dtype)
    rounding = 16 * number.eps * (jnp.abs(jnp.where(due, reading.value, 0)) + jnp.abs(expected))

    def one(i, carry):
        D, E, e, *_ = carry

        def less(j, gr):
            return gr[0] - E[j, i] * D[j], gr[1] - E[j, i] * e[j]

        g, r = jax.lax.fori_loop(0, i if triangle else k, less, (jnp.where(impossible, 0, HP[i]), value[i]))
        Hg = H(g)
        s = Hg[i] + noise[i]
        whole = s + jnp.sum(E[:, i] ** 2, axis=0)  # S[i, i]
        least = jnp.maximum(8 * number.eps * jnp.abs(whole), number.tiny ** (2 / 3))  # its root differentiates
        new = due[i] & ~(s <= least)
        root = jax.lax.rsqrt(jnp.maximum(s, least))
        scale = jnp.where(new & ~impossible, root, 0)
        # where the measurements before it determine this one, its residual contradicts them beyond rounding or is none
        e_i = jnp.where(due[i] & (new | (jnp.abs(r) > rounding[i])), r * root, 0)
        rows = scale * g, scale * Hg, e_i, jnp.where(new, s, 1), new
        return tuple(a.at[i].set(row) for a, row in zip(carry, rows))

    zeros = jnp.zeros_like(value)
    start = jnp.zeros_like(HP), jnp.zeros((k, *zeros.shape), x.dtype), zeros, zeros, jnp.zeros_like(due)
    D, E, e, S, used = jax.lax.fori_loop(0, k, one, start)
    mean = jax.lax.fori_loop(0, k, lambda j, x: x + e[j] * D[j], x)

    def remaining(r):
        row = jax.lax.fori_loop(0, k, lambda j, row: row - D[j, r] * D[j], P[r])
        return row.at[r].set(jnp.maximum(row[r], jnp.minimum(P[r, r], 0)))  # rounding makes no variance negative

    nis = jnp.sum(e * e, axis=0) + jnp.where(impossible, jnp.nan, 0).astype(x.dtype)
    rows = jnp.sum(used, axis=0, dtype=x.dtype)
    nll = 0.5 * (nis + jnp.sum(jnp.log(S), axis=0) + rows * log(2 * pi))

    def column(i, K):  # of K = D' L^-1, the last one first
        i = k - 1 - i
        d = jax.lax.fori_loop(0, k, lambda j, d: d - E[i, j] * K[j], D[i])
        return K.at[i].set(d * jax.lax.rsqrt(S[i]))

    gain = jnp.swapaxes(jax.lax.fori_loop(0, k, column, jnp.zeros_like(D)), 0, 1)
    covariance = jax.lax.map(H, HP) + jnp.where(mask(np.eye(k, dtype=bool), value[0]), R, 0)
    return Belief(mean, _rows(remaining, n)), Innovation(value, covariance, nis, rows, nll, gain)
