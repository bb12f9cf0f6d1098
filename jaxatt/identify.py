"""What is my spacecraft really: numbers of the on-board model from recorded flights, by the likelihood of its innovations.

A Kalman filter on board states, at every tick, how far it expects each measurement to lie off: nu ~ N(0, S). The density of all
innovations of a flight is the likelihood of the filter's numbers (Schweppe, 1965). `fit` takes the ``decide`` that closes the loop,
runs it over the recorded readings and finds the numbers theta that make the innovations most likely::

    model = identify.Model(loop.decide, lambda log: log[0], loop.DT)        # of the log, the filter's innovation
    build = lambda theta: identify.put(loop.params, {"R": jnp.exp(theta["log_R"]), "alpha": theta["alpha"]})
    found = identify.fit(model, build, start, flights, spread=spread)
    print(identify.report(found))

theta is any tree of numbers that may take any value: the logarithm of what is positive, `jaxatt.tuning.bounded` for other bounds.
``spread`` says by how much each of them may differ from its start, one standard deviation: a Gaussian prior, which is forgotten where
the data tell more, and the scale on which they can be said to tell nothing. Everything is computed in float64.

May import: check, compiling, fields, innovations, noise, sweeping.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxatt import check, fields
from jaxatt.compiling import compiled
from jaxatt.innovations import Flights, Model, likelihood, put, surprise
from jaxatt.noise import one_key
from jaxatt.sweeping import progress_bar

__all__ = [
    "Difference", "Fit", "Flights", "Model", "Posterior", "compare", "fit", "held_out", "likelihood", "posterior", "put", "report", "surprise",
]  # fmt: skip
ENOUGH = 1e-6  # [nats] that a step of the search is expected to gain, at which it ends
ROUND = 12  # steps after which the search takes a new Hessian
SETTLED = 1e-3  # [nats] that a Newton step may still gain of a fit that counts as converged: .04 standard deviations
WIDEST = 3.0  # spreads that a step may move any number
STEP = 1e-3  # deviations to either side in the differences of the Hessian
LEVEL = 1.959963985  # standard deviations to either side of a 95 % interval
SMALL = 0.1  # share of a direction's largest number below which a number is left out of the words


class Fit(NamedTuple):
    """What flights tell of p numbers, theta. With ``each=True`` every leaf has another axis in front, the flights.

    theta, std, low, high and robust are trees of the shape of the start.
    """

    theta: Any  # the most likely
    std: Any  # standard deviation of each number; NaN where the search did not end at a minimum
    low: Any  # 95 % interval
    high: Any
    covariance: Any  # (p, p) of all numbers of theta in a row: inverse of the Hessian
    robust: Any  # std by the sandwich: holds where the innovations are white, but not as the model says
    nll: Any  # [nats] negative log-likelihood of the innovations, prior left out
    gap: Any  # [nats] that a Newton step would still gain
    converged: Any  # bool, whether the Hessian is positive definite and the gap small
    blind: tuple  # sentences that name what the data cannot tell; with ``each`` a tuple of them for every flight
    directions: Any  # tuple of (k, p): those directions, in units of theta; with ``each`` one for every flight


# the likelihood of many flights


class _Case(NamedTuple):
    """What is static of a likelihood: hashable, so that another call with the same functions compiles nothing."""

    model: Model
    build: Callable
    structure: Any  # of theta
    shapes: tuple

    def tree(self, flat):
        """theta of its numbers in a row, the last axis."""
        ends = np.cumsum([0, *(int(np.prod(shape)) for shape in self.shapes)])
        parts = [flat[..., a:b].reshape((*flat.shape[:-1], *shape)) for a, b, shape in zip(ends, ends[1:], self.shapes)]
        return jax.tree.unflatten(self.structure, parts)


# Everything below works in u = (theta - start) / spread, (n, p) for n flights, with the prior N(0, I).


def _nll(case: _Case, u, start, spread, flights: Flights):
    """nll and number of measurements (n, T) of n flights, u (n, p)."""
    one = lambda u, computer, readings: likelihood(
        case.model, case.build(case.tree(start + spread * u)), computer, readings
    )
    return jax.vmap(one)(u, *flights)


def _ways(u):
    """The p directions of u (n, p), each for all flights."""
    return jnp.broadcast_to(jnp.eye(u.shape[1])[:, None], (u.shape[1], *u.shape))


def _slopes(case: _Case, u, *data):
    """nll (n,), its gradient (n, p), the sum over ticks of the products of their gradients (n, p, p), measurements (n,)."""
    along = lambda way: jax.jvp(lambda u: _nll(case, u, *data), (u,), (way,), has_aux=True)
    value, slopes, rows = jax.vmap(along, out_axes=(None, 0, None))(_ways(u))
    products = jnp.einsum("int,jnt->nij", slopes, slopes)
    return jnp.sum(value, 1), jnp.sum(slopes, 2).T, products, jnp.sum(rows, 1)


class _Problem(NamedTuple):
    """A likelihood with its data, checked."""

    case: _Case
    start: Any  # (p,)
    spread: Any  # (p,)
    flights: Flights
    n: int
    names: tuple[str, ...]  # of the numbers of theta

    def call(self, f: Callable, u):
        """f, `_nll` or `_slopes`, at u (n, p), or (1, p) for all flights, as NumPy arrays."""
        u = np.broadcast_to(u, (self.n, u.shape[1]))
        operands = u, self.start, self.spread, self.flights
        return jax.tree.map(np.asarray, compiled(f, 1, *operands)(self.case, *operands))

    def summed(self, f: Callable, u):
        """`call`, summed over the flights where u (1, p) belongs to all."""
        out = self.call(f, u)
        return jax.tree.map(lambda a: a.sum(0, keepdims=True), out) if len(u) < self.n else out


def _problem(model, build, start, flights, spread) -> _Problem:
    """What the verbs are handed, checked by one evaluation at the start."""
    check.kind("model", model, Model)
    check.function("model.decide", model.decide)
    check.function("model.innovations", model.innovations)
    model = model._replace(dt=check.number("model.dt", model.dt))  # hashable
    check.positive("model.dt", model.dt)
    check.function("build", build)
    check.kind("flights", flights, Flights)
    for name, tree in zip(("flights.computer", "flights.readings"), flights):
        check.numbers(name, tree)
    n = check.batch_size("flights.readings", flights.readings)
    if jax.tree.leaves(flights.computer) and check.batch_size("flights.computer", flights.computer) != n:
        check.refuse(
            "flights.computer",
            f"lead with the {n} flights of the readings",
            f"with {check.batch_size('', flights.computer)}",
        )
    shapes = {
        jax.tree_util.keystr(path): np.shape(leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(flights.readings)
    }
    ticks = max(shape[1] if len(shape) > 1 else 0 for shape in shapes.values())
    for path, shape in shapes.items():
        if len(shape) < 2 or shape[1] != ticks or not ticks:
            must = f"have shape ({n}, {ticks or 'T'}, ...), flights of one length (fill up with readings that are not valid)"
            check.refuse(f"flights.readings{path}", must, shape)
    if not jax.tree.leaves(check.numbers("start", start)):
        raise TypeError(f"`start` must hold at least one number, but it is {check.short(start)}.")
    check.finite("start", start)
    check.finite("spread", check.numbers("spread", spread))
    leaves, structure = jax.tree.flatten(start)
    if np.ndim(spread) == 0 and check.is_number(spread):
        spread = jax.tree.map(lambda _: spread, start)
    if jax.tree.structure(spread) != structure:
        known = [list(fields.named(tree, "theta")) for tree in (start, spread)]
        check.refuse("spread", f"be one number, or hold those of start ({', '.join(known[0])})", ", ".join(known[1]))
    wide = []
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(spread), leaves):
        check.positive(f"spread{jax.tree_util.keystr(path)}", a)
        check.fits(f"spread{jax.tree_util.keystr(path)}", a, "start", b)
        wide.append(np.broadcast_to(np.asarray(a, float), np.shape(b)).ravel())
    row = lambda leaves: np.concatenate([np.ravel(np.asarray(a, float)) for a in leaves])
    names = []
    for name, leaf in fields.named(start, "theta").items():
        names += [f"{name}.{i}" for i in range(np.size(leaf))] if np.ndim(leaf) else [name]
    exact = lambda a: np.asarray(a, float if np.asarray(a).dtype.kind == "f" or isinstance(a, float) else None)
    case = _Case(model, build, structure, tuple(np.shape(a) for a in leaves))
    start = row(leaves)
    fields.validate("build(start)", build(case.tree(start)))
    problem = _Problem(case, start, row(wide), jax.tree.map(exact, flights), n, tuple(names))
    nll, slope, products, rows = problem.call(_slopes, np.zeros((1, len(start))))
    empty, bad = rows <= 0, ~(np.isfinite(nll) & np.isfinite(slope).all(1) & np.isfinite(products).all((1, 2)))
    if empty.any():
        check.refuse("flights", "hold a finite innovation in every flight", f"without one in flight {np.argmax(empty)}")
    if bad.any():
        check.refuse(
            "start",
            "have a finite likelihood and gradient in every flight",
            f"{nll[bad][0]:g} in flight {np.argmax(bad)}",
        )
    return problem


# the fit


def fit(
    model: Model, build: Callable, start, flights: Flights, *, spread, each: bool = False, steps: int = 60,
    progress: bool | None = None,
) -> Fit:  # fmt: skip
    """The numbers theta that make the innovations of recorded flights most likely, and what is known of them.

    The search is L-BFGS, preconditioned by the Hessian at its start and after every `ROUND` steps. Intervals are Laplace's, by
    the Hessian at the end; ``robust`` ones by the sandwich of it and the products of the gradients of the ticks (White, 1982).
    Directions in which the data tell less than the spread are named.

    Args:
        model: on-board code and its innovations.
        build: theta -> params, what ``decide`` takes; pure JAX, for any real numbers.
        start: theta, any tree of numbers, such as a dict by name.
        flights: recordings.
        spread: by how much each number may differ from its start, one standard deviation; a tree like it, or one number.
        each: False: one theta of all flights. True: one for each flight, all at once.
        steps: of the search, at most.
        progress: show a bar; None shows it on terminals and in notebooks, after two seconds.

    Returns:
        A `Fit` of NumPy arrays.

    Raises:
        ValueError: a likelihood that is not finite at the start, flights without a finite innovation, of different lengths or
            numbers; params of the start outside the domain that their fields state; a spread that is not positive or names others.
        TypeError: what is no model, no function, no number; innovations that are none.

    Example:
        >>> found = fit(model, build, {"log_R": 0.0, "alpha": 0.95}, flights, spread={"log_R": 3.0, "alpha": 0.01})
    """
    steps = check.whole("steps", steps)
    with jax.enable_x64(True):
        problem = _problem(model, build, start, flights, spread)
        u = np.zeros((problem.n if each else 1, len(problem.start)))
        hessian = _hessian(problem, u, problem.summed(_slopes, u)[2])
        with progress_bar(progress, steps, " steps") as bar:
            while True:
                u, (value, slope, products), used = _search(problem, u, _axes(hessian), min(steps, ROUND), bar)
                steps -= used
                hessian = _hessian(problem, u, products)
                gap = 0.5 * np.sum(np.einsum("nij,ni->nj", _axes(hessian), slope) ** 2, 1)
                sound = (np.linalg.eigvalsh(hessian)[:, 0] > 0) & (gap < SETTLED)
                if sound.all() or steps <= 0 or not used:
                    break
        return _told(problem, u, value, products, hessian, gap, sound, each)


def _axes(matrix):
    """Columns A (g, p, p) with A' M A = I, the eigenvalues of M (g, p, p) made positive and at least the prior's, 1."""
    sizes, ways = np.linalg.eigh(matrix)
    return ways / np.sqrt(np.maximum(np.abs(sizes), 1))[:, None]


def _hessian(problem: _Problem, u, products):
    """The Hessian of nll and prior (g, p, p): central differences of the exact gradient along axes of one deviation each.

    A second derivative of a filter takes the compiler as long as all else; these differences, a thousandth of a deviation wide,
    are off by some 1e-6 of it. Minus one where the likelihood is not finite so near by.
    """
    p, axes = u.shape[1], _axes(products + np.eye(u.shape[1]))
    columns = []
    for i in range(p):
        ahead, behind = (problem.summed(_slopes, u + sign * STEP * axes[:, :, i])[1] for sign in (1, -1))
        columns.append((ahead - behind) / (2 * STEP))
    hessian = np.stack(columns, 2) @ np.linalg.inv(axes)
    finite = np.isfinite(hessian).all((1, 2), keepdims=True)
    return np.where(finite, 0.5 * (hessian + np.swapaxes(hessian, 1, 2)) + np.eye(p), -np.eye(p))


def _search(problem: _Problem, u, axes, steps: int, bar):
    """L-BFGS with backtracking from u (g, p), each row for itself, in the coordinates w of u + axes w.

    Returns u, the value, gradient and products there, and how many steps were taken.
    """

    def evaluate(u):
        value, slope, products, _ = problem.summed(_slopes, u)
        return value + 0.5 * np.sum(u * u, 1), slope + u, products

    begin, w, found = u, np.zeros_like(u), evaluate(u)
    at = lambda w: np.einsum("nij,nj->ni", axes, w)
    state = jax.tree.map(np.asarray, jax.vmap(_LBFGS.init)(w))
    length, way, fresh, taken = np.ones(len(u)), np.zeros_like(u), np.ones(len(u), bool), 0
    for taken in range(steps + 1):
        slope = np.einsum("nij,ni->nj", axes, found[1])
        against, ahead = jax.tree.map(np.asarray, compiled(_turned, 0, slope)(slope, state, w))
        state, way = _chosen(fresh, (ahead, -against), (state, way))
        way = _chosen(fresh & ~(np.sum(slope * way, 1) < 0), -slope, way)  # uphill
        gain = -np.sum(slope * way, 1)
        widest = np.maximum(np.abs(at(way)).max(1), np.finfo(float).tiny)
        length = np.where(fresh, np.minimum(1, WIDEST / widest), length)
        busy = (gain > 2 * ENOUGH) & (length > 1e-8)
        if taken == steps or not busy.any():
            break
        trial = _chosen(busy, w + length[:, None] * way, w)
        there = evaluate(begin + at(trial))
        good = np.isfinite(there[0]) & np.isfinite(there[1]).all(1) & np.isfinite(there[2]).all((1, 2))
        with np.errstate(invalid="ignore"):
            fresh = busy & good & (there[0] <= found[0] - 1e-4 * length * gain)
        w, found = _chosen(fresh, (trial, there), (w, found))
        length = np.where(busy & ~fresh, 0.3 * length, length)
        bar.set_postfix_str(f"{busy.sum()} of {len(u)} to go, nll {found[0].sum():.6g}")
        bar.update()
    return begin + at(w), found, taken


_LBFGS = optax.scale_by_lbfgs(scale_init_precond=False)  # the first step is Newton's


def _turned(slope, state, w):
    """The direction of L-BFGS and its next state, row by row."""
    return jax.vmap(_LBFGS.update)(slope, state, w)


def _chosen(which, a, b):
    """Rows of the trees a where ``which``, of b elsewhere."""
    return jax.tree.map(lambda a, b: np.where(which.reshape(-1, *(1,) * (np.ndim(a) - 1)), a, b), a, b)


def _told(problem: _Problem, u, value, products, hessian, gap, sound, each: bool) -> Fit:
    """The `Fit` of rows u (g, p)."""
    p, spread = u.shape[1], problem.spread
    sizes = np.linalg.eigvalsh(hessian)
    inverse = np.linalg.inv(np.where((sizes[:, 0] > 0)[:, None, None], hessian, np.nan * np.eye(p)))
    middle = inverse @ (products + np.eye(p)) @ inverse
    row, (std, robust) = problem.start + spread * u, (_deviations(a) * spread for a in (inverse, middle))
    blind = [
        _blind(a - np.eye(p) if ok else np.full((p, p), np.inf), problem.names, spread) for a, ok in zip(hessian, sound)
    ]
    theta, std, low, high, robust = map(problem.case.tree, (row, std, row - LEVEL * std, row + LEVEL * std, robust))
    words, ways = tuple(words for words, _ in blind), tuple(ways for _, ways in blind)
    found = Fit(
        theta,
        std,
        low,
        high,
        inverse * np.outer(spread, spread),
        robust,
        value - 0.5 * np.sum(u * u, 1),
        gap,
        sound,
        (),
        (),
    )
    one = found if each else jax.tree.map(lambda a: a[0], found)
    return one._replace(blind=words if each else words[0], directions=ways if each else ways[0])


def _deviations(covariance):
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


def _blind(hessian, names, spread) -> tuple[tuple[str, ...], np.ndarray]:
    """Sentences on the directions in which the likelihood's Hessian, in units of the spread, is below 1; they, in theta's units."""
    if not np.isfinite(hessian).all():  # of a search that did not end
        return (), np.zeros((0, len(names)))
    sizes, ways = np.linalg.eigh(hessian)
    basis = _plain(ways[:, sizes < 1].T)
    return tuple(_sentence(way, names, spread) for way in basis), basis * spread


def _plain(basis):
    """Vectors that span the same space with as many zeros as they can have: Gauss-Jordan with the largest pivots."""
    basis = np.array(basis)
    left = list(range(len(basis)))
    while left:
        sub = np.abs(basis[left])
        i, j = np.unravel_index(np.argmax(sub), sub.shape)
        i = left.pop(i)
        basis[i] /= basis[i, j]
        for other in range(len(basis)):
            if other != i:
                basis[other] -= basis[other, j] * basis[i]
    return basis


def _sentence(way, names, spread) -> str:
    members = [i for i in np.argsort(-np.abs(way), kind="stable") if np.abs(way[i]) >= SMALL * np.abs(way).max()]
    first, *others = members
    move = way * spread / (way[first] * spread[first])
    if not others:
        return f"the data cannot tell {names[first]}: it may lie anywhere within its spread of {spread[first]:.3g}"
    listed = ", ".join(names[i] for i in members[:-1]) + f" and {names[members[-1]]}"
    if len(others) == 1:
        by = 1 / move[others[0]]
        alone = f"only {names[first]} {'-' if by > 0 else '+'} {abs(by):.3g} {names[others[0]]} counts"
        return f"the data cannot tell {listed} apart: {alone}"
    moves = ", ".join(f"{names[i]} by {move[i]:.3g}" for i in members)
    return f"the data cannot tell {listed} apart: moving {moves} together changes nothing that they show"


def report(found: Fit) -> str:
    """A fit in words: a line for each number, then what the data cannot tell.

    Raises:
        TypeError: what is no `Fit`, or one of each flight for itself.

    Example:
        >>> print(report(fit(model, build, start, flights, spread=spread)))
    """
    check.kind("found", found, Fit)
    trees = found.theta, found.std, found.robust, found.low, found.high
    parts = [fields.named(check.numbers("found", tree), "theta") for tree in trees]
    shapes = {tuple((name, np.shape(a)) for name, a in part.items()) for part in parts}
    words = isinstance(found.blind, tuple) and all(isinstance(said, str) for said in found.blind)
    if len(shapes) > 1 or not words or np.ndim(found.nll) or np.ndim(found.converged):
        raise TypeError(
            "`found` must be a fit of all flights together, but it is one of each flight: take one of them."
        )
    lines = [f"{'number':24} {'estimate':>12} {'std':>10} {'robust':>10}  95 % interval"]
    for name in parts[0]:
        for i, row in enumerate(zip(*(np.ravel(part[name]) for part in parts))):
            value, std, robust, low, high = row
            label = f"{name}.{i}" if np.ndim(parts[0][name]) else name
            lines.append(f"{label:24} {value:12.6g} {std:10.3g} {robust:10.3g}  {low:.6g} to {high:.6g}")
    if not found.converged:
        lines.append(
            f"not converged: a step would still gain {check.number('found.gap', found.gap):.3g} nats, or the end is no minimum"
        )
    return "\n".join(lines + [f"{said[0].upper()}{said[1:]}." for said in found.blind])


# comparison


def held_out(model: Model, build: Callable, theta, flights: Flights) -> np.ndarray:
    """Negative log-likelihood [nats] (n,) of the innovations of each flight at one theta: judge on flights that `fit` never saw.

    Args:
        model, build, flights: as of `fit`.
        theta: as `fit` found it.

    Raises:
        ValueError, TypeError: as `fit`.

    Example:
        >>> compare(held_out(model, simple, a.theta, fresh), held_out(model, rich, b.theta, fresh))
    """
    with jax.enable_x64(True):
        problem = _problem(model, build, theta, flights, 1.0)
        return problem.call(_nll, np.zeros((1, len(problem.start))))[0].sum(1)


class Difference(NamedTuple):
    """How much better the second of two models foretells the innovations of a flight."""

    value: Any  # [nats] mean over the flights of nll of the first less nll of the second
    error: Any  # [nats] its standard error; inf of one flight
    n: int  # flights


def compare(first, second) -> Difference:
    """The difference of two models on the same flights that neither was fitted to.

    Args:
        first, second: nll (n,) by `held_out`.

    Returns:
        A `Difference`; the second model is better where ``value`` exceeds some two of its errors.

    Raises:
        ValueError: other than numbers of the same flights, all finite.

    Example:
        >>> gain = compare(held_out(model, simple, a.theta, fresh), held_out(model, rich, b.theta, fresh))
        >>> print(f"{gain.value:.1f} +- {gain.error:.1f} nats a flight")
    """
    a, b = (np.asarray(check.real(name, value), float) for name, value in (("first", first), ("second", second)))
    if a.ndim != 1 or a.shape != b.shape or not a.size:
        check.refuse("second", f"be of shape (n,) with n >= 1, as the first of shape {a.shape}", b.shape)
    check.finite("first", a)
    check.finite("second", b)
    d = a - b
    return Difference(d.mean(), d.std(ddof=1) / np.sqrt(d.size) if d.size > 1 else np.inf, d.size)


# the posterior


class Posterior(NamedTuple):
    """Draws of theta given the flights and the prior of the spread."""

    theta: Any  # (draws, ...) a tree like the start
    divergent: Any  # [1] share of draws whose trajectory diverged: above a percent, do not trust them
    effective: Any  # (p,) effective sample size of each number


def posterior(
    model: Model, build: Callable, start, flights: Flights, key, *, spread, draws: int = 1000, warmup: int = 300,
    progress: bool | None = None,
) -> Posterior:  # fmt: skip
    """Draws of theta by the No-U-Turn sampler of blackjax, from the fit on and on its scale; needs the extra `posterior`.

    Args:
        model, build, start, flights, spread: as of `fit`, which is run first.
        key: of the draws.
        draws: how many are kept.
        warmup: draws in which the step size is found.
        progress: as of `fit`.

    Returns:
        A `Posterior` of NumPy arrays.

    Raises:
        ImportError: blackjax is not installed.
        ValueError, TypeError: as `fit`; a fit that did not converge.

    Example:
        >>> draws = posterior(model, build, start, flights, jax.random.key(0), spread=spread)
        >>> np.std(draws.theta["alpha"])
    """
    draws, warmup, key = check.whole("draws", draws), check.whole("warmup", warmup), one_key(key)
    try:
        import blackjax  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError("`posterior` needs blackjax: pip install 'jaxatt[posterior]'") from error
    found = fit(model, build, start, flights, spread=spread, progress=progress)
    if not found.converged:
        check.refuse("start", "lead to a fit that converges", f"one that may still gain {found.gap:.3g} nats")
    with jax.enable_x64(True):
        problem = _problem(model, build, start, flights, spread)
        row = lambda theta: np.concatenate([np.ravel(a) for a in jax.tree.leaves(theta)])
        at = (row(found.theta) - problem.start) / problem.spread
        root = np.linalg.cholesky(found.covariance / np.outer(problem.spread, problem.spread))
        data = problem.start, problem.spread, problem.flights

        def slopes(x, data):
            u = at + root @ x
            value, slope, *_ = _slopes(problem.case, jnp.broadcast_to(u, (problem.n, *u.shape)), *data)
            return -jnp.sum(value) - 0.5 * u @ u, -root.T @ (jnp.sum(slope, 0) + u)

        def density(data):
            f = jax.custom_vjp(lambda x: slopes(x, data)[0])  # forward mode: few numbers, many ticks
            f.defvjp(lambda x: slopes(x, data), lambda slope, seed: (seed * slope,))
            return f

        sampler: Any = blackjax.nuts

        def warmed(key, data):
            adaptation: Any = blackjax.window_adaptation(sampler, density(data))
            (state, numbers), _ = adaptation.run(key, jnp.zeros_like(at), warmup)
            return state, numbers

        def drawn(keys, state, numbers, data):
            step = sampler(density(data), **numbers).step

            def one(state, key):
                state, info = step(key, state)
                return state, (state.position, info.is_divergent)

            return jax.lax.scan(one, state, keys)

        first, *keys = jax.random.split(key, 1 + draws)
        state, numbers = jax.jit(warmed)(first, data)
        more, parts = jax.jit(drawn), []
        with progress_bar(progress, draws, " draws") as bar:
            for chunk in np.array_split(np.arange(draws), max(1, draws // 100)):
                state, part = more(jnp.stack([keys[i] for i in chunk]), state, numbers, data)
                parts.append(part)
                bar.update(len(chunk))
        x, divergent = (np.concatenate([np.asarray(part[i]) for part in parts]) for i in (0, 1))
        theta = problem.start + problem.spread * (at + x @ root.T)
        effective = np.asarray(blackjax.diagnostics.effective_sample_size(theta[None]))
        return Posterior(problem.case.tree(theta), divergent.mean(), effective)
