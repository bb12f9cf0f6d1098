"""The gradient of a cost, and whether to believe it.

May import: check, compiling, noise, scores.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxatt import check, scores
from jaxatt.compiling import jitted
from jaxatt.noise import one_key

FEW = 6  # numbers up to which forward mode is the cheaper


def value_and_gradient(cost: Callable, theta, key, *, forward: bool | None = None):
    """A cost and its gradient. Pure.

    Forward mode costs less than reverse mode for few numbers, compiles in a quarter of the time and keeps no history.
    Reverse mode keeps one state per chunk of ticks and repeats the rest. A loop with a covariance in it is the
    exception: there forward mode is the cheaper up to some 20 numbers.

    Args:
        cost: (theta, key) -> scalar.
        theta: any tree of numbers.
        key: handed on to the cost.
        forward: whether by forward mode; None: for up to `FEW` numbers.

    Returns:
        The cost, and its gradient, a tree like theta.

    Raises:
        TypeError: a cost that is no function or no scalar, a theta that holds no numbers.

    Example:
        >>> value, gradient = value_and_gradient(cost, dict(k_q=330.0, k_w0=125.0), jax.random.key(0))
    """
    check.function("cost", cost)
    theta = floats("theta", theta)
    flat, unravel = ravel_pytree(theta)
    _scalar(cost, theta, key)
    if not (flat.size <= FEW if forward is None else forward):
        return jax.value_and_grad(cost)(theta, key)
    along = lambda direction: jax.jvp(lambda a: cost(unravel(a), key), (flat,), (direction,))
    value, slopes = jax.vmap(along, out_axes=(None, 0))(jnp.eye(flat.size, dtype=flat.dtype))
    return value, unravel(slopes)


def _scalar(cost: Callable, theta, key) -> None:
    value = jax.eval_shape(cost, theta, key)
    if not hasattr(value, "shape"):
        raise TypeError(f"`cost` must be a scalar, but it is {check.short(value)}.")
    if value.shape != ():
        raise TypeError(f"`cost` must be a scalar, but its shape is {value.shape}.")


# whether to believe a gradient


def blamed(cost: Callable, theta, *keys) -> str:
    """Which parts make a cost not finite, as the end of a message; "" where none says so. One evaluation for each key.

    Parts are the terms of `soft_scores.weighted`; of a cost without it, the scores of its sweeps.
    """
    scores.told.clear()
    before = scores.listening.set(True)
    try:
        # another precision of products, which are none: what jit traced before and keeps, tells nobody
        with jax.debug_nans(False), jax.debug_infs(False), jax.default_matmul_precision("highest"):
            for key in keys:
                jax.block_until_ready(jax.jit(lambda theta, key: cost(theta, key))(theta, key))
            jax.effects_barrier()
    finally:
        scores.listening.reset(before)
    words = []
    for kind in ("term", "score"):
        found = [(name, np.asarray(a)) for of, parts in scores.told if of == kind for name, a in parts.items()]
        for name, a in {name: a for name, a in found if not np.isfinite(a).all()}.items():
            bad = ~np.isfinite(a)
            said = f"its {kind} {name} is {a[bad][0]}"
            if a.ndim:
                bad = bad.reshape(len(a), -1).any(1)
                said += f" in {bad.sum()} of {len(a)} scenarios, first in scenario {np.argmax(bad)}"
            words.append(said)
        if words:
            break
    return "".join(f"; {said}" for said in words[:3])


def floats(name: str, theta):
    """The tree theta with floating arrays for leaves; TypeError, by ``name``, for what holds no numbers."""
    if not jax.tree.leaves(check.numbers(name, theta)):
        raise TypeError(f"`{name}` must hold at least one number, but it is {check.short(theta)}.")

    def convert(a):  # by NumPy where it will do: it compiles nothing
        kind = jnp.result_type(a, float)
        return jnp.asarray(a if isinstance(a, jax.Array) else np.asarray(a, kind), kind)

    return jax.tree.map(convert, theta)


class GradientCheck(NamedTuple):
    """A gradient beside central differences."""

    gradient: Any  # (n,) by forward or reverse mode, the numbers of theta in a row
    central: Any  # (n,) central difference of fourth order
    doubt: Any  # (n,) the difference's own uncertainty: by how much it changes when its step is halved
    relative: Any  # (n,) [1] |gradient - central| over the larger of the two; 0 where both are 0


def gradient_check(cost: Callable, theta, key, *, step: float | None = None, forward: bool | None = None):
    """Compare the gradient of a cost with central differences.

    Where ``doubt`` is large beside ``central`` the cost is not smooth on that scale, and the gradient, however exact,
    says little about what a step of that size would do.

    Args:
        cost: (theta, key) -> scalar.
        theta: where, any tree of n numbers.
        key: handed on to the cost.
        step: of the differences, relative to max(1, |theta|); None: the fifth root of the rounding unit, 7e-4 in
            float64.
        forward: as of `value_and_gradient`.

    Returns:
        A `GradientCheck`, its fields of shape (n,).

    Raises:
        TypeError: a cost that is no scalar, a key that is none.
        ValueError: a step that is not positive; a cost, at theta or beside it, or a gradient that is not finite. The
            message says which term of `soft_scores.weighted`, or which score of a sweep, in which scenario.

    Example:
        >>> found = gradient_check(cost, theta, jax.random.key(0), step=0.02)
        >>> assert found.relative.max() < 0.01
    """
    check.function("cost", cost)
    one_key(key)
    if step is not None:
        check.positive("step", check.number("step", step))
    flat, unravel = ravel_pytree(floats("theta", theta))
    at = lambda flat, key: cost(unravel(flat), key)
    if flat.size <= FEW if forward is None else forward:  # one compilation, the directions one by one
        along = lambda flat, way, key: jax.jvp(lambda a: at(a, key), (flat,), (way,))
        run = jitted(along)
        _scalar(at, flat, key)
        gradient = np.array([run(flat, way, key)[1] for way in jnp.eye(flat.size, dtype=flat.dtype)])
        value = lambda flat: float(run(flat, jnp.zeros_like(flat), key)[0])
    else:
        both = jitted(lambda flat, key: value_and_gradient(at, flat, key, forward=False))
        gradient = np.asarray(both(flat, key)[1])
        value = lambda flat: float(both(flat, key)[0])
    here = value(flat)
    if not np.isfinite(here):
        check.refuse("cost", "be finite at theta", f"{here}{blamed(at, flat, key)}")
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(theta)]
    sizes = [np.size(leaf) for leaf in jax.tree.leaves(theta)]
    names = [name for name, size in zip(paths, sizes) for _ in range(size)]
    if not np.isfinite(gradient).all():
        i = int(np.argmin(np.isfinite(gradient)))
        check.refuse("cost", f"have a finite gradient at theta, along theta{names[i]} too", gradient[i])
    h = np.finfo(flat.dtype).eps ** 0.2 if step is None else step
    central, doubt = np.zeros((2, flat.size))
    for i in range(flat.size):
        size = h * max(1.0, abs(float(flat[i])))

        def d(by, i=i, size=size):
            moved = flat.at[i].add(by * size)
            beside = value(moved)
            if not np.isfinite(beside):
                must = f"be finite beside theta, for theta{names[i]} = {moved[i]:.9g} too"
                check.refuse("cost", must, f"{beside}{blamed(at, moved, key)}")
            return beside

        inner, middle, outer = d(0.5) - d(-0.5), (d(1) - d(-1)) / 2, (d(2) - d(-2)) / 4
        central[i] = (4 * inner - middle) / 3 / size
        doubt[i] = abs(central[i] - (4 * middle - outer) / 3 / size)
    larger = np.maximum(np.abs(gradient), np.abs(central))
    relative = np.abs(gradient - central) / np.where(larger > 0, larger, 1)
    return GradientCheck(gradient, central, doubt, relative)
