"""Tuning: the numbers of a closed loop, found by gradient of a cost over sampled scenarios."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from jaxatt import check
from jaxatt.engine import compiled
from jaxatt.study import _bar

FEW = 6  # numbers up to which forward mode is the cheaper


def value_and_gradient(cost: Callable, theta, key):
    """cost(theta, key), a scalar, and its gradient, a tree like theta.

    Up to `FEW` numbers by forward mode: it costs less than reverse mode there, compiles in a quarter of the time
    and keeps no history. Pure.

    Raises TypeError if the cost is no scalar.
    """
    flat, unravel = ravel_pytree(theta)
    if jax.eval_shape(cost, theta, key).shape != ():
        raise TypeError(f"`cost` must be a scalar, but its shape is {jax.eval_shape(cost, theta, key).shape}.")
    if flat.size > FEW:
        return jax.value_and_grad(cost)(theta, key)
    along = lambda direction: jax.jvp(lambda a: cost(unravel(a), key), (flat,), (direction,))
    value, slopes = jax.vmap(along, out_axes=(None, 0))(jnp.eye(flat.size, dtype=flat.dtype))
    return value, unravel(slopes)


class History(NamedTuple):
    """What `tune` met, step by step; every leaf leads with the steps."""

    theta: Any  # parameters at which the step was taken
    cost: Any  # (steps,) their cost
    gradient: Any  # (steps,) norm of the gradient
    step: Any  # (steps,) [1] factor on the optimizer's update: below 1 after a step that ended in NaN


def tune(cost: Callable, theta, optimizer, steps: int, key, *, progress: bool | None = None) -> tuple[Any, History]:
    """Minimise cost(theta, key), a scalar, over a pytree theta; returns the best theta met and the `History`.

    Every step sees the same key: with common random numbers the cost is a smooth function and "best" has a
    meaning. optimizer: any of optax. A step that ends in a cost or gradient that is not finite is taken back:
    the search goes on from the best theta with updates half as long. Gains that must stay positive are tuned as
    logarithms.

    Raises ValueError if the cost is not finite at the start or steps < 1, TypeError if it is no scalar.
    """
    steps = check.whole("steps", steps)
    theta = jax.tree.map(lambda a: jnp.asarray(a, jnp.result_type(a, float)), theta)

    def step(theta, state, factor):
        value, gradient = value_and_gradient(cost, theta, key)
        size = optax.global_norm(gradient)
        more = dict(value=value, grad=gradient, value_fn=lambda theta: cost(theta, key)) if line_search else {}
        updates, state = optimizer.update(gradient, state, theta, **more)
        updates = jax.tree.map(lambda u: factor * u, updates)
        return value, size, optax.apply_updates(theta, updates), state

    line_search = isinstance(optimizer, optax.GradientTransformationExtraArgs)
    step = compiled(step, 0)
    state, factor = optimizer.init(theta), 1.0
    best = (np.inf, theta, state)
    trail = []
    with _bar(progress, steps, " steps") as bar:
        for _ in range(steps):
            value, size, ahead, ahead_state = step(theta, state, factor)
            value, size = float(value), float(size)
            trail.append((theta, value, size, factor))
            if np.isfinite(value) and np.isfinite(size):
                if value < best[0]:
                    best = (value, theta, state)
                theta, state = ahead, ahead_state
            elif np.isinf(best[0]):
                check.refuse("cost", "be finite, with a finite gradient, at the start", value)
            else:
                _, theta, state = best
                factor /= 2
            bar.set_postfix(cost=f"{value:.4g}", refresh=False)
            bar.update()
    thetas, values, sizes, factors = zip(*trail)
    stacked = jax.tree.map(lambda *a: np.stack(a), *thetas)
    return best[1], History(stacked, np.array(values), np.array(sizes), np.array(factors))
