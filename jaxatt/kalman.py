"""A Kalman filter of many states, its prediction, update and consistency.

Components lead, lanes trail, and every loop over them is rolled: unrolled or reduced covariances are slow. Filters
of few states are written as plain rows in `lmmse`.

May import: check, vec, attitude, faults, mounting, scores.
"""

from __future__ import annotations

from collections.abc import Callable
from math import log, pi
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxatt import check
from jaxatt.check import door
from jaxatt.faults import Reading


class Belief(NamedTuple):
    """What a Kalman filter believes: a Gaussian."""

    mean: Any  # (n, *lanes)
    cov: Any  # (n, n, *lanes), symmetric to the last bit


def _arrays(belief: Belief) -> tuple[Any, Any]:
    """Mean and covariance, which fit each other before a function of the caller meets them."""
    x, P = map(jnp.asarray, belief)
    if x.ndim == 0 or P.shape != (x.shape[0], *x.shape):
        check.refuse("belief", "hold a mean (n, *lanes) and a cov (n, n, *lanes)", f"of shapes {x.shape} and {P.shape}")
    return x, P


class Evidence(NamedTuple):
    """What an update met. All of shape (*lanes)."""

    nis: Any  # [1] normalised innovation squared: chi-square with ``rows`` degrees of freedom if the filter is honest
    rows: Any  # [1] number of measurements used
    nll: Any  # [1] negative log-likelihood of the measurements used


@door
def ekf_predict(belief: Belief, f: Callable, steady, Q, dt) -> Belief:
    """The belief after dt [s] of x' = (f(x), steady), P' = A P + P A' + Q: one joint RK4 step, A at every stage.

    f: (n, *lanes) -> (m, *lanes), the rates of the first m states; steady: (n - m, *lanes), those of the others,
    which depend on no state; Q: (n,) or (n, *lanes), the diagonal spectral density of the process noise. A is
    never written down: `jax.linearize` of f takes the rows of P, which is symmetric, so A P is W' below.
    """
    x, P = _arrays(belief)
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


@door
def innovation(belief: Belief, value, h: Callable, R):
    """Residual value - h(mean) and its variance, both (k, *lanes), each measurement for itself.

    h: a linear map that takes components in the leading axis, of a mean and of a covariance alike; R: (k,) or
    (k, *lanes) variances of the measurements.
    """
    mean, cov = _arrays(belief)
    rows = h(cov)
    variance = jax.lax.map(lambda ir: h(ir[1])[ir[0]], (jnp.arange(rows.shape[0]), rows))
    return value - h(mean), variance + R.reshape(R.shape + (1,) * (variance.ndim - R.ndim))


@door
def kalman_update(belief: Belief, y: Reading, h: Callable, R) -> tuple[Belief, Evidence]:
    """The belief after the measurements that are valid and finite; the others move neither mean nor covariance.

    y: value and valid of shape (k, *lanes); h: linear map (n, ...) -> (k, ...) on the leading axis; R: (k,) or
    (k, *lanes) variances of independent noise. One scalar measurement after the other: row i of D is the gain
    of measurement i, whitened, so that P+ = P - D' D is symmetric by construction, and e the whitened innovation.
    float32 is precise while R exceeds 1e-6 of the prior variance (Table 5 of Park, 2005); below, take float64.
    """
    x, P = _arrays(belief)
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


@door
@jax.jit  # which keeps its loops compiled from call to call
def nees(belief: Belief, truth):
    """Normalised estimation error squared e' P^-1 e, shape (*lanes); chi-square with n degrees of freedom.

    truth: the state, (n, *lanes). It is the NIS of the whole state measured without noise, and needs no solver.
    """
    e = jnp.broadcast_to(truth - belief.mean, belief.mean.shape)
    at_zero = Belief(jnp.zeros_like(e), belief.cov)
    return kalman_update(at_zero, Reading(e, jnp.ones(e.shape, bool)), lambda x: x, jnp.zeros_like(e))[1].nis
