"""Speed of the 17-state filter's tick (joint RK4 of mean and covariance, trigonometry, 11 rows) and of its loop."""

from __future__ import annotations

import ctypes
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxatt
from benchmarks.measure import c_library, cpu_ns
from jaxatt.engine import rk4
from jaxatt.faults import Reading
from jaxatt.kalman import Belief, ekf_predict, kalman_update
from jaxatt.mounting import along, gyro_pyramid, wheel_pyramid
from jaxatt.study import batch
from jaxatt.systems import gyro_ekf
from jaxatt.vec import array, inverse, vec3

BLOCK = 128
LANES = 1024


def start(real):
    """A filter under way for 1024 scenarios, and what it reads: mean, cov, u, y, lanes last."""
    rng = np.random.default_rng(0)
    mean = (rng.normal(size=(17, LANES)) * np.repeat([1.0, 1e-3, 1e-3, 10.0, 1e-4], [3, 3, 3, 4, 4])[:, None]).astype(
        real
    )
    cov = np.broadcast_to(np.eye(17)[..., None], (17, 17, LANES)).astype(real)
    u = rng.normal(size=(4, LANES)).astype(real)
    y = np.asarray(gyro_ekf.measured(gyro_ekf.params, jnp.asarray(mean)), real)
    return mean, cov.copy(), u, y


def jax_run(tick, ticks: int):
    """The tick in a scan, in blocks of 128 lanes as the engine runs it."""

    @jax.jit
    def run(mean, cov, u, y):
        def block(operands):
            mean, cov, u, y = operands
            step = lambda belief, _: (tick(belief, u, y), None)
            return jax.lax.scan(step, Belief(mean, cov), None, length=ticks)[0]

        split = lambda a: jnp.moveaxis(a.reshape(*a.shape[:-1], -1, BLOCK), -2, 0)
        out = jax.lax.map(block, jax.tree.map(split, (mean, cov, u, y)))
        return jax.tree.map(lambda a: jnp.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1), out)

    return run


def typed(real):
    """The paper's parameters in one floating type."""
    return jax.tree.map(lambda a: jnp.asarray(a, real), gyro_ekf.params)


def ours(params, belief, u, y):
    """The library's tick."""
    real = belief.mean.dtype
    unmoved = jnp.concatenate([u, jnp.zeros_like(u)])
    belief = ekf_predict(belief, partial(gyro_ekf.drift, params, u), unmoved, params.Q, jnp.asarray(gyro_ekf.DT, real))
    return kalman_update(belief, Reading(y, jnp.ones(y.shape, bool)), partial(gyro_ekf.measured, params), params.R)[0]


def naive(params, belief, u, y):
    """The textbook tick under vmap: jacfwd of the dynamics, dense products, Cholesky, lanes first within."""

    def one(mean, cov, u, y):
        def rate(x):
            return jnp.concatenate([gyro_ekf.drift(params, u, x), u, jnp.zeros_like(u)])

        def joint(t, belief):
            A = jax.jacfwd(rate)(belief.mean)
            return Belief(rate(belief.mean), A @ belief.cov + belief.cov @ A.T + jnp.diag(params.Q))

        x, P = rk4(joint, 0.0, Belief(mean, cov), jnp.asarray(gyro_ekf.DT, mean.dtype))
        h = partial(gyro_ekf.measured, params)
        H = jax.jacfwd(h)(x)
        S = jax.scipy.linalg.cho_factor(H @ P @ H.T + jnp.diag(params.R))
        K = jax.scipy.linalg.cho_solve(S, H @ P).T
        return Belief(x + K @ (y - h(x)), (jnp.eye(17, dtype=x.dtype) - K @ H) @ P)

    return jax.vmap(one, in_axes=-1, out_axes=-1)(belief.mean, belief.cov, u, y)


def c_run(real, ticks: int):
    """The C program: CPU ns per scenario-tick is measured on what this returns; also its final mean and cov."""
    kind = "float" if real == np.float32 else "double"
    run = c_library(Path(__file__).with_suffix(".c"), kind).run
    p = gyro_ekf.params
    axes = lambda a: np.asarray(along(a, vec3(jnp.eye(3))))  # (4, 3)
    G, W = axes(gyro_pyramid(p.alpha, p.beta)), axes(wheel_pyramid(p.gamma)).T
    J = np.array(p.J)
    model = np.concatenate([np.ravel(a) for a in (J, np.array(array(inverse(p.J))), G, W, p.Q, p.R, gyro_ekf.DT)])
    model = model.astype(real)
    width = 64 // model.itemsize
    pack = lambda a: np.ascontiguousarray(np.moveaxis(a.reshape(*a.shape[:-1], -1, width), -2, 0))
    mean, cov, u, y = map(pack, start(real))
    at = lambda a: a.ctypes.data_as(ctypes.c_void_p)

    def go():
        x, P = mean.copy(), cov.copy()
        run(at(model), LANES, ticks, at(x), at(P), at(u), at(y))
        unpack = lambda a: np.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1)
        return unpack(x), unpack(P)

    return go


def discrete(params, belief, u, y):
    """An option beside the library's tick: F P F' + Q dt with F = I + A dt + (A dt)^2 / 2, the mean by RK4."""
    dt = jnp.asarray(gyro_ekf.DT, belief.mean.dtype)
    f = partial(gyro_ekf.drift, params, u)
    rates = lambda t, x: jnp.concatenate([f(x), u, jnp.zeros_like(u)])
    _, A = jax.linearize(f, belief.mean)

    def moved(row):  # F row
        first = A(row)
        ahead = jnp.pad(first, [(0, 8)] + [(0, 0)] * (first.ndim - 1))
        return row.at[:9].add(dt * (first + dt / 2 * A(ahead)))

    half = jax.lax.map(moved, belief.cov)
    index = jnp.arange(17)
    column = lambda r: moved(half[:, r]) + dt * jnp.where((index == r)[:, None], params.Q[:, None], 0)
    prior = Belief(rk4(rates, 0.0, belief.mean, dt), jax.lax.map(column, index))
    return kalman_update(prior, Reading(y, jnp.ones(y.shape, bool)), partial(gyro_ekf.measured, params), params.R)[0]


def sweep_ns(loop, score, real, n: int, ticks: int) -> float:
    """CPU ns per scenario-tick of a whole closed loop in a sweep."""
    single, one = jax.tree.map(lambda a: np.asarray(a, real), (gyro_ekf.params, gyro_ekf.scenario))
    scenarios = batch(one, n)
    key = jax.random.key(0)
    run = lambda: jaxatt.sweep(loop, single, scenarios, key, ticks=ticks, score=score, progress=False)
    return cpu_ns(run, n * ticks, 3)


def row(name: str, value: float, unit: str = "ns per tick") -> dict:
    """One line of the table."""
    return {"name": name, "value": float(value), "unit": unit}


def rows(quick: bool):
    """The table: C, the library, the textbook form and a discrete one, then closed loops."""
    ticks = 50
    for real in (np.float32,) if quick else (np.float32, np.float64):
        name, operands, c = np.dtype(real).name, start(real), c_run(real, ticks)
        reference = cpu_ns(c, LANES * ticks, 9)
        yield row(f"filter tick, C, {name}", reference)
        forms = {"library": ours, "vmapped jacfwd + Cholesky": naive, "F P F' (option)": discrete}
        spent, means = {}, {}
        for form, tick in forms.items():
            few = 4 if form.startswith("vmapped") else ticks
            run = jax_run(partial(tick, typed(real)), few)
            spent[form] = cpu_ns(lambda run=run, operands=operands: run(*operands), LANES * few, 3 if quick else 7)
            yield row(f"filter tick, {form}, {name}, N = {LANES}", spent[form])
            means[form] = np.asarray(jax_run(partial(tick, typed(real)), 4)(*operands).mean)
        yield row(f"speed of C reached, {name}", 100 * reference / spent["library"], "%")
        yield row(
            f"times faster than vmapped jacfwd + Cholesky, {name}",
            spent["vmapped jacfwd + Cholesky"] / spent["library"],
            "",
        )
        got, want = np.asarray(jax_run(partial(ours, typed(real)), ticks)(*operands).mean), c()[0]
        yield row(f"largest deviation of the mean from C after {ticks} ticks, {name}", np.abs(got - want).max(), "")
        for form in list(forms)[1:]:
            yield row(
                f"largest deviation of {form} after 4 ticks, {name}", np.abs(means[form] - means["library"]).max(), ""
            )
        n, length = (256, 200) if quick else (1024, 800)
        with_filter = sweep_ns(gyro_ekf.system, gyro_ekf.score, real, n, length)
        yield row(f"closed loop with filter, noise and tallies, {name}, N = {n}", with_filter)
        without = sweep_ns(gyro_ekf.direct, gyro_ekf.score_loop, real, n, length)
        yield row(f"closed loop without filter, {name}, N = {n}", without)
