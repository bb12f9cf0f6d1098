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
from jaxatt.engine import over_lanes, rk4
from jaxatt.faults import Reading
from jaxatt.filters import Belief, predict, update
from jaxatt.loops import gyro_ekf
from jaxatt.noise import BLOCK
from jaxatt.sensors import gyro_pyramid
from jaxatt.vec import Vec3, array, inverse, project
from jaxatt.wheels import park_pyramid

LANES = 1024


def start(real):
    """Filters under way for 1024 scenarios, and what they read: mean, cov, u, y, the scenarios last, as in C."""
    rng = np.random.default_rng(0)
    size = np.repeat([1.0, 1e-3, 1e-3, 10.0, 1e-4], [3, 3, 3, 4, 4])
    mean = (rng.normal(size=(17, LANES)) * size[:, None]).astype(real)
    cov = np.broadcast_to(np.eye(17)[..., None], (17, 17, LANES)).astype(real)
    u = rng.normal(size=(4, LANES)).astype(real)
    y = over_lanes(expected, LANES)(jnp.asarray(mean))
    return mean, cov.copy(), u, np.asarray(y, real)


def expected(x, params=gyro_ekf.params):
    """What the sensors read of the state x (17,), in a row (11,)."""
    return jnp.concatenate([jnp.stack(list(a)) for a in gyro_ekf.measured(params, x)])


def rates(params, u, x):
    """dx/dt (17,) of the filter's state under the command u (4,)."""
    return jnp.concatenate([*map(array, gyro_ekf.drift(params, u, x)), u, jnp.zeros(4, x.dtype)])


def jax_run(tick, ticks: int):
    """The tick (belief, u, y) -> belief of one scenario in a scan, in blocks of 128 scenarios as the engine runs it."""

    @jax.jit
    def run(mean, cov, u, y):
        def block(operands):
            mean, cov, u, y = operands
            step = lambda belief, _: (over_lanes(tick, BLOCK)(belief, u, y), None)
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
    unmoved = jnp.concatenate([u, jnp.zeros_like(u)])
    prior = predict(belief, partial(gyro_ekf.drift, params, u), unmoved, params.Q, gyro_ekf.DT)
    return update(prior, Reading(y, jnp.ones(11, bool)), partial(gyro_ekf.measured, params), params.R)[0]


def naive(params, belief, u, y):
    """The textbook tick: jacfwd of the dynamics, dense products, Cholesky."""

    def joint(t, belief):
        A = jax.jacfwd(partial(rates, params, u))(belief.mean)
        return Belief(rates(params, u, belief.mean), A @ belief.cov + belief.cov @ A.T + jnp.diag(params.Q))

    x, P = rk4(joint, 0.0, belief, jnp.asarray(gyro_ekf.DT, y.dtype))
    h = partial(expected, params=params)
    H = jax.jacfwd(h)(x)
    S = jax.scipy.linalg.cho_factor(H @ P @ H.T + jnp.diag(params.R))
    K = jax.scipy.linalg.cho_solve(S, H @ P).T
    return Belief(x + K @ (y - h(x)), (jnp.eye(17, dtype=x.dtype) - K @ H) @ P)


def c_run(real, ticks: int):
    """The C program: CPU ns per scenario-tick is measured on what this returns; also its final mean and cov."""
    kind = "float" if real == np.float32 else "double"
    run = c_library(Path(__file__).with_suffix(".c"), kind).run
    p = gyro_ekf.params
    axes = lambda a: np.asarray(project(a, Vec3.of(jnp.eye(3))))  # (4, 3)
    G, W = axes(gyro_pyramid(p.alpha, p.beta)), axes(park_pyramid(p.gamma)).T
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
    dt = jnp.asarray(gyro_ekf.DT, y.dtype)
    f = partial(rates, params, u)
    _, A = jax.linearize(f, belief.mean)

    def moved(row):  # F row
        first = A(row)
        return row + dt * (first + dt / 2 * A(first))

    half = jax.lax.map(moved, belief.cov)
    column = lambda r: moved(half[:, r]) + dt * jnp.where(jnp.arange(17) == r, params.Q, 0)
    prior = Belief(rk4(lambda t, x: f(x), 0.0, belief.mean, dt), jax.lax.map(column, jnp.arange(17)))
    return update(prior, Reading(y, jnp.ones(11, bool)), partial(gyro_ekf.measured, params), params.R)[0]


def sweep_ns(loop, score, real, n: int, ticks: int) -> float:
    """CPU ns per scenario-tick of a whole closed loop in a sweep."""
    single, one = jax.tree.map(lambda a: np.asarray(a, real), (gyro_ekf.params, gyro_ekf.scenario))
    scenarios = jax.tree.map(lambda a: np.broadcast_to(a, (n, *a.shape)), one)
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
        without = sweep_ns(gyro_ekf.direct, gyro_ekf.score, real, n, length)
        yield row(f"closed loop without filter, {name}, N = {n}", without)
