"""Linear analysis of closed loops: the sampled loop's matrix, growth rates, margins, observability. Never in a scan.

May import: check, contract, compiling, engine.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.compiling import compiled
from jaxatt.contract import System
from jaxatt.engine import start, step, times, validated


def sampled(
    system: System, params, scenario, *, ticks: int, states: tuple[str, ...] | None = None, after: int | None = None
):
    """Matrix of a closed loop over one period: Jacobian of its state by its state ``ticks`` ticks before, without noise.

    The loop as it runs is differentiated: hold, delay lines, filters, several rates and RK4 included. Its state is every
    floating number of x and z. Switches and counters keep what the run makes of them; what a gradient does not see, such
    as the steps of a quantiser, is not in the matrix either. Pure: jit it, or vmap it over scenarios.

    Args:
        system: the loop.
        params: what the engineer ships.
        scenario: what the day brings; it decides where the loop is linearised.
        ticks: length of the period, a multiple of every interval at which the loop's code runs.
        states: paths of what makes up the state, such as ("x.theta", "z.sensors.line"), or "z" for all of z, in the
            order of the matrix; None for all. It serves to leave out what drifts by itself, such as a clock or the
            momentum in a wheel, whose growth rate of 0 would hide that of the loop. The growth rates of the rest stay
            what they are if nothing comes back through what is left out; otherwise it is refused.
        after: how many ticks the loop runs from its start before it is linearised, a multiple of ``ticks``; None for one
            period, so that nothing is special to the first tick.

    Returns:
        Array (n, n).

    Raises:
        ValueError: ticks < 1, after no multiple of it, a path that leads to no floating number, states through whose
            rest something comes back. Under jit, grad and vmap the matrix is NaN in the last case.

    Example:
        >>> matrix = sampled(loop.system, loop.params, loop.scenario, ticks=1)
        >>> growth_rates(matrix, loop.system.dt)[0] < 0
    """
    check.kind("system", system, System)
    ticks = check.whole("ticks", ticks)
    after = ticks if after is None else check.whole("after", after, 0)
    if after % ticks:
        check.refuse("after", f"be a multiple of `ticks` = {ticks}", after)
    params, scenario = validated(system, params, scenario)
    names = _names(system, params, scenario)
    kept = _kept(names, states)
    rest = tuple(i for i in range(len(names)) if i not in kept)
    matrix = compiled(_matrix, 3, params, scenario)(system, ticks, after, params, scenario)
    reduced, returning = compiled(_reduced, 2, matrix)(kept, rest, matrix)
    if check.concrete(returning) and np.any(returning):
        back = sorted({names[i] for i, comes in zip(rest, np.asarray(returning)) if comes})
        must = f"hold {', '.join(back)} too, through which what the other states do comes back"
        check.refuse("states", must, check.short(states))
    return reduced


def _floating(a) -> bool:
    return jnp.issubdtype(a.dtype, jnp.floating)


def _names(system, params, scenario) -> list[str]:
    """Path of every number of the state."""
    x, z = compiled(_first, 1, params, scenario).eval_shape(system, params, scenario)
    leaves = jax.tree_util.tree_leaves_with_path({"x": x, "z": z})
    named = [(jax.tree_util.keystr(path, simple=True, separator="."), a) for path, a in leaves if _floating(a)]
    return [name for name, a in named for _ in range(a.size)]


def _kept(names: list[str], states) -> tuple[int, ...]:
    """The numbers of the state that the paths lead to, in their order."""
    if states is None:
        return tuple(range(len(names)))
    if not isinstance(states, tuple) or not states:
        check.refuse("states", "be a tuple of paths, such as ('x.theta', 'z')", check.short(states))
    kept: list[int] = []
    for path in states:
        found = [i for i, name in enumerate(names) if f"{name}.".startswith(f"{path}.")]
        if not found:
            check.refuse("states", f"hold paths of {', '.join(dict.fromkeys(names))}", repr(path))
        kept += [i for i in found if i not in kept]
    return tuple(kept)


def _first(system, params, scenario):
    """x and z at the start, in one lane."""
    return start(system, params, _lane(scenario), 1)


def _lane(scenario):
    return jax.tree.map(lambda a: jnp.asarray(a)[..., None], scenario)


def _matrix(system, ticks, after, params, scenario):
    first, scenario = _first(system, params, scenario), _lane(scenario)
    noise = jnp.zeros((system.normals, 1), check.float_type((params, scenario)))
    one = lambda state, at: (step(system, params, scenario, 1, at, state, noise)[1], None)
    run = lambda state, first, n: jax.lax.scan(one, state, times(system, params, scenario, first + jnp.arange(n)))[0]
    leaves, tree = jax.tree.flatten(run(first, 0, after))
    moving = [i for i, a in enumerate(leaves) if _floating(a)]
    ends = np.cumsum([leaves[i].size for i in moving])[:-1]
    flat = lambda leaves: jnp.concatenate([leaves[i].ravel() for i in moving])

    def period(v):
        there = list(leaves)
        for i, part in zip(moving, jnp.split(v, ends)):
            there[i] = part.reshape(leaves[i].shape)
        return flat(jax.tree.leaves(run(jax.tree.unflatten(tree, there), after, ticks)))

    return jax.jacfwd(period)(flat(leaves))


def _reduced(kept, rest, matrix):
    """The matrix of the kept states, NaN if something comes back through the rest, and of the rest, through which.

    That is: which of the rest the kept ones move, and move the kept ones in turn, at once or by way of others.
    """
    acts = (matrix != 0).astype(matrix.dtype)
    among = lambda a, b: acts[np.ix_(np.array(a, int), np.array(b, int))]
    reach = among(rest, rest) + jnp.eye(len(rest))
    for _ in range(len(rest).bit_length()):  # paths of every length
        reach = jnp.minimum(reach @ reach, 1)
    moved, moving = reach @ among(rest, kept).sum(axis=1), among(kept, rest).sum(axis=0) @ reach
    returning = (moved > 0) & (moving > 0)
    return jnp.where(jnp.any(returning), jnp.nan, matrix[np.ix_(kept, kept)]), returning


def growth_rates(matrix, period: float) -> np.ndarray:
    """Growth rates log|z| / period [1/s] of a sampled loop's modes, largest first, shape (..., n); matrix (..., n, n).

    All negative: the loop converges, the slowest mode with the time constant -1 / rate.
    """
    size = np.abs(np.linalg.eigvals(np.asarray(matrix)))
    with np.errstate(divide="ignore"):
        return -np.sort(-np.log(size) / period, axis=-1)


class Margins(NamedTuple):
    """How much a stable loop bears, each taken alone; inf, or 0 for gain_down, where the search meets no edge."""

    gain_up: float  # [1] factor in the loop, above 1, at which it becomes unstable
    gain_down: float  # [1] the same below 1
    delay: float  # [s] more in the loop at which it becomes unstable
    phase: float  # [deg] phase that this delay takes at the crossover
    crossover: float  # [rad/s] frequency at which the loop oscillates there; NaN where there is no edge


def margins(
    matrix_of: Callable, period: float, *, most: float = 100.0, longest: float = 0.0, steps: int = 100
) -> Margins:
    """Gain, delay and phase margins of a sampled loop: where its largest growth rate crosses zero.

    The search walks a grid until the loop is unstable and closes in on the edge by bisection: an unstable range between
    two grid points that are both stable is missed. In a loop that is cut in one place the phase margin is the classical
    one, for at the delay margin the gain at the frequency of the growing mode is 1; where the gain crosses 1 several
    times, it is that of the crossing which bears the least delay. A delay line that is read between two samples
    interpolates, which is a delay only for frequencies far below that of the ticks.

    Args:
        matrix_of: (factor, delay) -> matrix (n, n) over one period, by `sampled`, with the loop's gain times ``factor`` and
            ``delay`` [s] more in it: a factor on the gains or ``Fault(scale=factor)`` on the actuators, an older reading.
        period: [s] of the matrix. Frequencies above pi / period come out too low.
        most: factors are searched from 1 / most to most.
        longest: delays are searched up to it [s]; 0 for none.
        steps: number of grid points.

    Returns:
        The `Margins`.

    Raises:
        ValueError: a loop that is unstable with factor 1 and no delay, most <= 1, longest < 0, period <= 0 or steps < 1.

    Example:
        >>> late = lambda factor, delay: sampled(
        ...     loop.system, loop.params, loop.scenario._replace(drive=Fault(scale=factor), delay=delay), ticks=1
        ... )
        >>> margins(late, loop.system.dt, longest=0.2).phase
    """
    check.positive("period", period)
    check.above("most", most, 1, "the factor of the loop as it is")
    check.not_negative("longest", longest)
    steps = check.whole("steps", steps)
    rate = lambda factor, delay: float(growth_rates(matrix_of(factor, delay), period)[0])
    if (here := rate(1.0, 0.0)) >= 0:
        check.refuse("matrix_of(1, 0)", "be of a stable loop", f"of one with the growth rate {here:.3g} 1/s")
    factors, delays = np.geomspace(1, most, steps + 1), np.linspace(0, longest, steps + 1)
    up = _edge(lambda factor: rate(factor, 0.0), factors)
    down = _edge(lambda factor: rate(factor, 0.0), 1 / factors)
    delay = _edge(lambda delay: rate(1.0, delay), delays) if longest > 0 else np.inf
    crossover = np.nan
    if np.isfinite(delay):
        z = np.linalg.eigvals(np.asarray(matrix_of(1.0, delay)))
        crossover = float(abs(np.angle(z[np.argmax(np.abs(z))])) / period)
    phase = np.degrees(crossover * delay) if np.isfinite(delay) else np.inf
    return Margins(up, down if np.isfinite(down) else 0.0, delay, float(phase), crossover)


def _edge(rate, grid) -> float:
    """Where a rate that is negative at grid[0] stops being so; inf if it is negative on all of the grid."""
    for stable, unstable in pairwise(map(float, grid)):
        if rate(unstable) >= 0:
            while abs(unstable - stable) > 1e-12 * abs(unstable):
                middle = (stable + unstable) / 2
                stable, unstable = (stable, middle) if rate(middle) >= 0 else (middle, unstable)
            return unstable
    return np.inf


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
