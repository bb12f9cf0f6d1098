"""Linear analysis of closed loops: the sampled loop's matrix, its growth rates, observability. Never in a scan.

May import: check, vec, engine.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxatt import check
from jaxatt.check import door
from jaxatt.engine import System, _start, _step, admit


def sampled(system: System, params, scenario, *, ticks: int, states: tuple[str, ...] | None = None, start=None):
    """Jacobian of the state after ``ticks`` ticks by the state at tick 0, without noise; shape (n, n).

    The loop as it runs is differentiated, hold, delays and RK4 included. states: names of the fields of x that
    make up the state, None for all; leave out what drifts by itself, and take ticks as the loop's longest
    period, at whose start nothing that is held matters. start: x at tick 0; None for the scenario's. Pure: vmap
    it over scenarios.

    Raises ValueError on ticks < 1 and for a state that x does not have.
    """
    ticks = check.whole("ticks", ticks)
    params, scenario = admit(system, params, scenario, ())
    x0, z0 = _start(system, params, scenario, 0)
    x0 = x0 if start is None else start
    names = x0._fields if states is None else states
    if not isinstance(names, tuple) or not names or not set(names) <= set(x0._fields):
        check.refuse("states", f"be a tuple of {x0._fields}", check.short(names))
    flat, unravel = ravel_pytree({name: getattr(x0, name) for name in names})
    noise = jnp.zeros(system.normals, flat.dtype)

    def run(part):
        step = lambda state, k: (_step(system, params, scenario, k, state, noise)[1], None)
        (x, _), _ = jax.lax.scan(step, (x0._replace(**unravel(part)), z0), jnp.arange(ticks))
        return ravel_pytree({name: getattr(x, name) for name in names})[0]

    return jax.jacfwd(run)(flat)


@door
def growth_rates(matrix, period: float) -> np.ndarray:
    """Growth rates log|z| / period [1/s] of a sampled loop's modes, largest first, shape (..., n); matrix (..., n, n).

    All negative: the loop converges, the slowest mode with the time constant -1 / rate.
    """
    size = np.abs(np.linalg.eigvals(np.asarray(matrix)))
    with np.errstate(divide="ignore"):
        return -np.sort(-np.log(size) / period, axis=-1)


@door
def observability_rank(A, H, scale, *, duration: float, samples: int = 50, tol: float = 1e-8) -> int:
    """How many directions of the state of x' = A x, A (n, n), the readings y = H x, H (m, n), tell apart.

    Rank of H exp(A t) at ``samples`` instants over ``duration`` [s], its columns multiplied by ``scale`` (n,), the
    size that a component of the state typically has: singular values above tol times the largest count.
    """
    step = _exponential(np.asarray(A, float) * (duration / samples))
    rows = [np.asarray(H, float)]
    for _ in range(samples):
        rows.append(rows[-1] @ step)
    values = np.linalg.svd(np.concatenate(rows) * np.asarray(scale), compute_uv=False)
    return int(np.sum(values > tol * values[0]))


def _exponential(A) -> np.ndarray:
    """exp(A) by its series, of a matrix halved until its norm is below 1/2, and squaring."""
    halvings = max(0, int(np.ceil(np.log2(max(np.linalg.norm(A, 1), 1e-300)))) + 1)
    term = total = np.eye(len(A))
    for k in range(1, 16):
        term = term @ A / (2**halvings * k)
        total = total + term
    return np.linalg.matrix_power(total, 2**halvings)
