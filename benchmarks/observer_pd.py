"""Speed of `jaxatt.loops.observer_pd` as ratios in one run: against C, naive vmapped JAX and batched NumPy.

A scenario-step is one RK4 step of one scenario. Every loop computes the scores of a sweep, with every fault kind
live; ``shipped`` is four steps per tick, ``one-step`` one.
"""

from __future__ import annotations

import ctypes
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxatt
from benchmarks.measure import c_library, cpu_ns, seconds
from jaxatt import Fault, Vec3, sweep
from jaxatt.compiling import allowed_cores, compiled
from jaxatt.loops.observer_pd import START_UP, Params, Scenario, Scores, params, scenario, score, system
from jaxatt.tuning import value_and_gradient

TICKS = 1000
FORMS = {"shipped": system, "one-step": system._replace(substeps=1, dt=system.dt / system.substeps)}


def _quiet_tick(p, s, now, x, z, none):
    return system.tick(p, s, now, x, z, jnp.zeros(system.normals, z.k_w.dtype))


def quiet(loop):
    """The loop without noise: no numbers are drawn, the sensors get zeros."""
    return loop._replace(normals=0, tick=_quiet_tick)


def scenarios(n: int, dtype, seed: int = 0) -> Scenario:
    """n scenarios, leaves of shape (n,), with random starts and every kind of fault on every channel."""
    rng = np.random.default_rng(seed)
    normal, uniform = (lambda std: std * rng.standard_normal(n)), (lambda a, b: rng.uniform(a, b, n))

    def fault():
        onset = uniform(5, 25)
        return Fault(
            onset, onset + uniform(5, 100), normal(0.03), normal(0.03), uniform(1, 20), abs(normal(0.03)),
            1 + normal(0.1), 1 + abs(normal(1)), (uniform(0, 1) < 0.1) * 1.0,
        )  # fmt: skip

    def near(v):
        return Vec3(*(a * (1 + normal(0.2)) for a in v))

    three = lambda: Vec3(fault(), fault(), fault())
    s = scenario._replace(q=near(scenario.q), w=near(scenario.w), star=three(), gyro=three())
    s = s._replace(q_hat=s.q, w_hat=s.w)
    heavier = uniform(0.9, 1.1)
    s = s._replace(J=jax.tree.map(lambda a: a * heavier, s.J))
    return jax.tree.map(lambda a: np.broadcast_to(np.asarray(a, dtype), (n,)).copy(), s)


# C


def c_scores(
    library, p: Params, s: Scenario, *, ticks: int, dt: float, substeps: int, noise: Any = "none", seed=1
) -> Scores:
    """Scores of n scenarios by the C program; noise: "none", "drawn", or normals of shape (ticks, 6, n)."""
    run, out, n = _c_call(library, p, s, ticks, dt, substeps, noise, seed)
    run()
    return Scores(*out[:, :n])


def _c_call(library, p, s, ticks, dt, substeps, noise="drawn", seed=1):
    leaves = jax.tree.leaves(s)
    dtype, n = leaves[0].dtype, leaves[0].shape[-1]
    wide = -(-n // library.lanes()) * library.lanes()
    last = np.minimum(np.arange(wide), n - 1)
    rows = np.ascontiguousarray(np.stack(leaves)[:, last])
    moments = np.linalg.eigvalsh(np.array(p.J, float))
    numbers = np.array([*map(float, jax.tree.leaves(p)), moments[-1]], dtype)
    given = np.ascontiguousarray(np.asarray(noise, dtype)[..., last]) if not isinstance(noise, str) else None
    mode = 2 if given is not None else ("none", "drawn").index(noise)
    out = np.zeros((len(Scores._fields), wide), dtype)
    pointer = lambda a: None if a is None else a.ctypes.data_as(ctypes.c_void_p)

    def run():
        library.observer_pd(
            pointer(numbers), pointer(rows), pointer(given), ctypes.c_int(mode), ctypes.c_uint64(seed),
            ctypes.c_long(wide), ctypes.c_long(ticks), ctypes.c_int(substeps), ctypes.c_double(dt), pointer(out),
        )  # fmt: skip

    return run, out, n


# the same loop as one would write it on plain arrays, for naive JAX and for NumPy


class Plain(NamedTuple):
    """Params and scenario of one scenario, or of n in the last axis, as plain arrays."""

    q: Any  # (3,)
    w: Any  # (3,)
    q_hat: Any  # (3,)
    w_hat: Any  # (3,)
    J: Any  # (3, 3)
    J_inv: Any  # (3, 3)
    std: Any  # (6,)
    fault: Any  # Fault of (6,)


def plain_of(s: Scenario) -> Plain:
    """The scenarios, leaves of shape (n,), as plain arrays with n last."""
    J = np.array(s.J)
    inv = np.moveaxis(np.linalg.inv(np.moveaxis(J, -1, 0)), 0, -1)
    std = np.stack([s.std_q] * 3 + [s.std_w] * 3)
    fault = Fault(*(np.stack(f) for f in zip(*s.star, *s.gyro)))
    return Plain(np.stack(s.q), np.stack(s.w), np.stack(s.q_hat), np.stack(s.w_hat), J, inv, std, fault)


def plain_loop(xp, mul, p: Params, s: Plain, dt, substeps):
    """start and tick(k, state, normals) -> state on plain arrays; xp: numpy or jax.numpy, mul: matrix times vector."""
    dtype = s.q.dtype
    Jh = xp.asarray(np.array(p.J, float), dtype)
    Jh_inv = xp.asarray(np.linalg.inv(np.array(p.J, float)), dtype)
    lambda_max = float(np.linalg.eigvalsh(np.array(p.J, float))[-1])
    p = jax.tree.map(float, p)
    q_d, w_d = (xp.asarray(v, dtype).reshape((3,) + (1,) * (s.q.ndim - 1)) for v in (p.q_d, p.w_d))
    cross = partial(xp.cross, axis=0)
    dot = lambda a, b: (a * b).sum(axis=0)
    inf = np.asarray(np.inf, dtype)
    onset = s.fault.onset.min(axis=0)

    def error(q):
        pp, qq = dot(q_d, q_d), dot(q, q)
        scalar = (1 - pp) * (1 - qq) + 4 * dot(q_d, q)
        vector = -(1 - qq) * q_d + (1 - pp) * q - 2 * cross(q_d, q)
        return xp.where(scalar < 0, -2, 2) / ((1 + pp) * (1 + qq) + abs(scalar)) * vector

    def rate(q, w, sign=1):
        return ((1 - dot(q, q)) * w + 2 * sign * cross(q, w) + 2 * dot(q, w) * q) / 4

    def torque(y_q, y_w, k_w):
        return xp.clip(-p.k_q * error(y_q) - k_w * (y_w - w_d), -p.u_max, p.u_max)

    def flow(x, gain, offset, k_w):
        q, w, qh, wh = x
        y_q, y_w = gain[:3] * q + offset[:3], gain[3:] * w + offset[3:]
        u = torque(y_q, y_w, k_w)
        xi_q, xi_w = y_q - qh, y_w - wh
        dw = mul(s.J_inv, u - cross(w, mul(s.J, w)))
        dwh = mul(Jh_inv, u - cross(wh, mul(Jh, y_w)) + p.beta * xi_w + rate(y_q, xi_q, -1))
        return rate(q, w), dw, rate(y_q, wh) + p.alpha * xi_q, dwh

    def rk4(x, h, *held):
        ahead = lambda k, by: tuple(a + by * b for a, b in zip(x, k))
        k1 = flow(x, *held)
        k2 = flow(ahead(k1, h / 2), *held)
        k3 = flow(ahead(k2, h / 2), *held)
        k4 = flow(ahead(k3, h), *held)
        return tuple(a + h / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip(x, k1, k2, k3, k4))

    def tick(k, state, normals):
        (q, w, qh, wh), y, k_w, tally = state
        t = xp.asarray(k * dt, dtype)
        qq = dot(q, q)
        q = xp.where(qq > 1, -q / xp.where(qq > 1, qq, 1), q)
        f = s.fault
        on = (t >= f.onset) & (t < f.end)
        stuck = on & (f.stuck > 0)
        drift = f.drift * (1 - xp.exp(-xp.where(on, t - f.onset, 0) / f.tau))
        spread = xp.sqrt((f.growth * s.std) ** 2 + f.random**2)
        gain = xp.where(stuck, 0, xp.where(on, f.scale, 1))
        offset = xp.where(stuck, y, xp.where(on, f.bias + drift + spread * normals, s.std * normals))
        y = gain * xp.concatenate([q, w]) + offset
        shadow = -qh / xp.where(dot(qh, qh) > 0, dot(qh, qh), 1)
        qh = xp.where(dot(qh - y[:3], qh - y[:3]) <= dot(shadow - y[:3], shadow - y[:3]), qh, shadow)
        xi = xp.sqrt(dot(y[:3] - qh, y[:3] - qh) + dot(y[3:] - wh, y[3:] - wh))
        alarm = ~(xi <= p.sigma)
        e_q, e_w = error(y[:3]), y[3:] - w_d
        ee = dot(e_q, e_q)
        h = p.eps * lambda_max / 4 * (3 + 2 * xp.sqrt(ee) + 3 * ee) + 1.5
        c = p.eps * lambda_max * xp.sqrt(dot(e_w, e_w)) + 1 + ee
        elapsed = xp.where(k > 0, dt, 0.0).astype(dtype)
        k_w = xp.where(k_w > h, h + xp.sqrt(xp.maximum((k_w - h) ** 2 - c * c * elapsed / p.eps, 0)), k_w)
        u = torque(y[:3], y[3:], k_w)
        e_q, e_w = error(q), w - w_d
        qq, ww, uu = dot(e_q, e_q), dot(e_w, e_w), dot(u, u)
        faulty, before, start = on.any(axis=0), t < onset, t < START_UP
        o = tally
        tally = (
            xp.minimum(o[0], xp.where(alarm & ~before, t - onset, inf)),
            o[1] + (start & before & alarm), o[2] + (start & before),
            o[3] + (~start & before & alarm), o[4] + (~start & before),
            o[5] + (faulty & ~alarm), o[6] + faulty,
            o[7] + qq, o[8] + ww, o[9] + uu,
            o[10] + xp.where(faulty, qq, 0), o[11] + xp.where(faulty, ww, 0), o[12] + xp.where(faulty, uu, 0),
            xp.maximum(o[13], xp.where(start, -inf, xp.sqrt(qq))),
            xp.maximum(o[14], xp.where(start, -inf, xp.sqrt(ww))),
            xp.maximum(o[15], xp.sqrt(uu)),
            xp.where(before & (qq > 0.01**2), t, o[16]), xp.where(before, t, o[17]),
            o[18] & xp.isfinite(qq + ww + uu + xi + k_w + q.sum(axis=0) + w.sum(axis=0)),
        )  # fmt: skip
        x = (q, w, qh, wh)
        for _ in range(substeps) if xp is np else ():
            x = rk4(x, dt / substeps, gain, offset, k_w)
        if xp is not np:
            x = jax.lax.fori_loop(0, substeps, lambda _, x: rk4(x, dt / substeps, gain, offset, k_w), x)
        return x, y, k_w, tally

    one = xp.ones_like(onset)
    zero, never = 0 * one, -inf * one
    tally = (-never, *[zero] * 12, never, never, never, never, never, one > 0)
    start = ((s.q, s.w, s.q_hat, s.w_hat), xp.concatenate([s.q, s.w]), p.k_w0 * one, tally)
    return start, tick


def plain_values(xp, o, ticks) -> Scores:
    """Scores of the tallies of `plain_loop`."""
    share = lambda a, b: xp.where(b > 0, a / xp.where(b > 0, b, 1), np.nan)
    peak = lambda a: xp.where(a == -np.inf, np.nan, a)
    rms = lambda a, b: xp.sqrt(share(a, b))
    settled = xp.where(o[16] == o[17], np.inf, xp.maximum(o[16], 0))
    every = 0 * o[7] + ticks
    return Scores(
        o[0], share(o[1], o[2]), share(o[3], o[4]), share(o[5], o[6]), rms(o[7], every), rms(o[8], every),
        rms(o[10], o[6]), rms(o[11], o[6]), peak(o[13]), peak(o[14]), xp.where(o[17] == -np.inf, np.nan, settled),
        rms(o[9], every), rms(o[12], o[6]), peak(o[15]), o[18],
    )  # fmt: skip


def naive(loop, s: Scenario, ticks: int, noisy: bool = True):
    """() -> scores by naive JAX: plain jit(vmap(scan)), a normal draw each step."""

    def one(s, key):
        start, tick = plain_loop(jnp, jnp.matmul, params, s, loop.dt, loop.substeps)

        def step(state, k):
            n = jax.random.normal(jax.random.fold_in(key, k), (6,), s.q.dtype) if noisy else jnp.zeros(6, s.q.dtype)
            return tick(k, state, n), None

        (*_, tally), _ = jax.lax.scan(step, start, jnp.arange(ticks))
        return plain_values(jnp, tally, ticks)

    plain = jax.tree.map(lambda a: jnp.asarray(np.moveaxis(a, -1, 0)), plain_of(s))
    keys = jax.random.split(jax.random.key(1), plain.q.shape[0])
    run = jax.jit(jax.vmap(one))
    return lambda: run(plain, keys)


def numpy(loop, s: Scenario, ticks: int, noisy: bool = True):
    """() -> scores by batched NumPy."""
    plain = plain_of(s)
    mul = partial(np.einsum, "ij...,j...->i...")
    rng = np.random.default_rng(1)

    def run():
        state, tick = plain_loop(np, mul, params, plain, loop.dt, loop.substeps)
        shape, dtype = (6, plain.q.shape[-1]), plain.q.dtype
        for k in range(ticks):
            state = tick(k, state, rng.standard_normal(shape, dtype) if noisy else np.zeros(shape, dtype))
        return plain_values(np, state[3], ticks)

    return run


# rows


def rows(quick: bool):
    """The table, row by row."""
    repeats = 3 if quick else 5
    source = Path(__file__).with_suffix(".c")
    key = jax.random.key(0)
    for real, dtype in (("float32", np.float32), ("float64", np.float64)):
        # without these two passes fewer of a step's values are spilt: 4 % faster
        library = c_library(source, {"float32": "float", "float64": "double"}[real], "-fno-tree-pre", "-fno-gcse")
        p = jax.tree.map(dtype, params)
        for form, loop in FORMS.items():
            for noise, system_ in (("noise", loop), ("no noise", quiet(loop))):
                name = f"{real}, {form}, {noise}"
                for n in (1024,) if quick else (1, 64, 1024, 16384):
                    s = scenarios(n, dtype)
                    steps = n * TICKS * loop.substeps
                    mine = partial(sweep, system_, p, s, key, ticks=TICKS, score=score, progress=False)
                    if (real, form, noise) == ("float32", "shipped", "noise"):
                        first, second = seconds(mine), seconds(mine)
                        if n == 1 or quick:  # later sizes run the same program
                            yield _row("forward compile", first - second, "s")
                    limit, _, _ = _c_call(
                        library, p, s, TICKS, loop.dt, loop.substeps, "drawn" if noise == "noise" else "none"
                    )
                    c = cpu_ns(limit, steps, max(repeats, 3 * 1024 // n))
                    ours = cpu_ns(mine, steps, repeats)
                    yield _row(f"{name}, N = {n}, C", c, "ns")
                    yield _row(f"{name}, N = {n}, jaxatt", ours, "ns")
                    yield _row(f"{name}, N = {n}, share of C", 100 * c / ours, "%")
                    if n == 1024 and noise == "noise" and (form == "shipped" or not quick):
                        yield _row(
                            f"{name}, N = {n}, naive JAX / jaxatt", cpu_ns(naive(loop, s, TICKS), steps, 2) / ours, "x"
                        )
                        yield _row(
                            f"{name}, N = {n}, NumPy / jaxatt", cpu_ns(numpy(loop, s, TICKS), steps, 1) / ours, "x"
                        )
    yield from _gradient()
    if not quick:
        yield from _cores()


def _row(name, value, unit):
    return {"name": name, "value": float(value), "unit": unit}


def _gradient(n: int = 1024, ticks: int = 500):
    """Cost of the gradient with respect to four gains, as logarithms, over 2000 steps."""
    s, key = scenarios(n, np.float32), jax.random.key(0)
    p = jax.tree.map(lambda a: np.asarray(a, np.float32), params)
    names = ("alpha", "beta", "k_q", "k_w0")

    def loss(log_gains, p, s):  # p and s are arguments: as constants the compiler would fold them in
        gains = dict(zip(names, jnp.exp(log_gains)))
        out = sweep(system, p._replace(**gains), s, key, ticks=ticks, score=score)
        return jnp.mean(out.rms_q + 0.1 * out.rms_w)

    at = jnp.log(jnp.asarray([getattr(p, name) for name in names])), p, s
    forward = compiled(loss, 0).lower(*at).compile()

    def slopes(log_gains, p, s):  # as `tune` takes them
        return value_and_gradient(lambda log_gains, key: loss(log_gains, p, s), log_gains, key)

    gradient = compiled(slopes, 0).lower(*at).compile()
    steps = n * ticks * system.substeps
    f, g = cpu_ns(lambda: forward(*at), steps, 3), cpu_ns(lambda: gradient(*at), steps, 3)
    yield _row("loss of 2000 steps, N = 1024", f, "ns")
    yield _row("gradient of 2000 steps, N = 1024", g, "ns")
    yield _row("gradient of 2000 steps over its loss", g / f, "x")
    yield _row("gradient of 2000 steps, memory", gradient.memory_analysis().temp_size_in_bytes / 2**20, "MiB")


def _cores():
    """Wall time of a sweep on one core over that on all, in turns."""
    if allowed_cores() < 2:
        return
    s = scenarios(12_800, np.float32)
    p = jax.tree.map(lambda a: np.asarray(a, np.float32), params)
    run = partial(sweep, system, p, s, jax.random.key(0), ticks=TICKS, score=score, progress=False)
    run()
    ratios = []
    for _ in range(7):
        jaxatt.configure(cores=1)
        one = seconds(run)
        jaxatt.configure()
        ratios.append(one / seconds(run))
    yield _row(f"one core over {allowed_cores()}, wall time", float(np.median(ratios)), "x")
