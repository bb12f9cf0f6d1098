"""Speed of the attitude filters: ``python -m benchmarks attitude_filters``.

One tick of each, for 1024 scenarios in blocks of 128 as the engine runs them, beside a filter on arrays (6, 6) under
`jax.vmap`, as a textbook would have it.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.measure import c_library, cpu_ns
from jaxatt import mekf
from jaxatt.attitude import quat_conjugate, quat_from_vector, quat_normalised, vector_from_quat
from jaxatt.engine import over_lanes
from jaxatt.faults import Reading
from jaxatt.noise import BLOCK
from jaxatt.single_frame import davenport, triad_attitude
from jaxatt.usque import usque_step
from jaxatt.vec import Mat3, Quat, Vec3, array, diagonal, norm

LANES, TICKS = 1024, 50
A, B = slice(0, 3), slice(3, 6)  # turn and bias
ARW, RRW, DT = 4.4e-5, 2.4e-8, 0.1  # a gyro of .15 deg/sqrt(h) and .3 deg/h/sqrt(h), at 10 Hz
STAR, FIELD = Vec3(3.9e-5**2, 3.9e-5**2, 2.9e-4**2), 1e-3  # variances of a star tracker; std of a unit vector


def given(real):
    """What every tick reads, the scenarios last: rate, attitude, three vectors in body axes and in reference axes."""
    rng = np.random.default_rng(0)
    rate = Vec3(*(1e-3 * rng.normal(size=(3, LANES))))
    y = quat_normalised(Quat(np.ones(LANES), *(1e-4 * rng.normal(size=(3, LANES)))))
    unit = lambda v: v / norm(v)
    r = tuple(unit(Vec3(*rng.normal(size=(3, LANES)))) for _ in range(3))
    b = tuple(unit(v + 1e-3 * Vec3(*rng.normal(size=(3, LANES)))) for v in r)
    return jax.tree.map(lambda a: np.asarray(a, real), (rate, y, b, r))


def belief(real, clone=False):
    """Where every filter starts."""
    start = mekf.start(Quat(1.0, 0.0, 0.0, 0.0), Vec3(0.0, 0.0, 0.0), 1e-2, 1e-4)
    start = mekf.cloned(start) if clone else start
    return jax.tree.map(lambda a: jnp.broadcast_to(jnp.asarray(a, real)[..., None], (*jnp.shape(a), LANES)), start)


def blocks_of(P):
    """The rows of the blocks of P (6, 6, LANES) that the C program holds: turn, turn and bias, bias."""
    return [row for block in (P[:3, :3], P[:3, 3:], P[3:, 3:]) for row in block.reshape(9, -1)]


def runner(tick: Callable) -> Callable:
    """Fifty ticks (state, given) -> state of one scenario in a scan, in blocks of 128 scenarios."""

    @jax.jit
    def run(state, given):
        def block(operands):
            step = lambda state, _: (over_lanes(tick, BLOCK)(state, operands[1]), None)
            return jax.lax.scan(step, operands[0], None, length=TICKS)[0]

        apart = lambda a: jnp.moveaxis(a.reshape(*a.shape[:-1], -1, BLOCK), -2, 0)
        together = lambda a: jnp.moveaxis(a, 0, -2).reshape(*a.shape[1:-1], -1)
        return jax.tree.map(together, jax.lax.map(block, jax.tree.map(apart, (state, given))))

    return run


# ticks


def ahead(belief, rate):
    """The prediction that all share."""
    return mekf.predict(belief, rate, DT, ARW, RRW)


def with_attitude(belief, given, late=False):
    axes = diagonal(Vec3(1.0, 1.0, 1.0))
    return mekf.update_attitude(ahead(belief, given[0]), Reading(given[1], True), axes, STAR, late=late)[0]


def with_vector(belief, given):
    return mekf.update_vector(ahead(belief, given[0]), Reading(given[2][0], True), given[3][0], FIELD)[0]


def with_usque(belief, given):
    return usque_step(belief, given[0], DT, ARW, RRW, Reading(given[2][0], True), given[3][0], FIELD)[0]


def with_davenport(q, given):
    """The state enters, lest the compiler takes the fit out of the loop."""
    near = lambda v: v + 1e-6 * q.v
    return davenport(tuple(map(near, given[2])), given[3], (1.0, 2.0, 3.0)).q


def with_davenport_gap(q, given):
    near = lambda v: v + 1e-6 * q.v
    fit = davenport(tuple(map(near, given[2])), given[3], (1.0, 2.0, 3.0))
    return fit.q * jnp.where(fit.gap > 1e-3, 1, -1)


def with_triad(q, given):
    near = lambda v: v + 1e-6 * q.v
    return triad_attitude(near(given[2][0]), near(given[2][1]), *given[3][:2]).value


def on_arrays(state, given):
    """The same filter on arrays: P (6, 6), Phi and Q written in blocks, gain by a solver."""
    q, b, P = state
    rate, y = given[:2]
    w = array(rate) - b
    step = mekf.farrenkopf(Vec3(*w), DT, ARW, RRW)
    zero, one = jnp.zeros((3, 3), w.dtype), jnp.eye(3, dtype=w.dtype)
    full = lambda m: array(Mat3(*(Vec3(*jnp.broadcast_arrays(*row)) for row in m)))
    Phi = jnp.block([[full(step.turn), full(step.drift)], [zero, one]])
    Q = jnp.block([[full(step.aa), full(step.ab)], [full(step.ab).T, full(step.bb)]])
    P = Phi @ P @ Phi.T + Q
    q = quat_normalised(q * quat_from_vector(Vec3(*(DT * w))))
    H = jnp.concatenate([one, zero], 1)
    S = H @ P @ H.T + jnp.diag(jnp.stack([jnp.asarray(v, w.dtype) for v in STAR]))
    K = jnp.linalg.solve(S, H @ P).T
    moved = K @ array(vector_from_quat(quat_conjugate(q) * y))
    P = (jnp.eye(6, dtype=w.dtype) - K @ H) @ P
    q = quat_normalised(q * quat_from_vector(Vec3(*moved[:3])))
    return q, b + moved[3:], 0.5 * (P + P.T)


def arrays(real):
    start = belief(real)
    return start.q, array(start.b), start.P


def c_run(real):
    """The C program with the ticks of `with_attitude`: what it returns, called, is the state after fifty ticks."""
    run = c_library(Path(__file__).with_suffix(".c"), "float" if real == np.float32 else "double", "-Wno-psabi").run
    one, (rate, y, *_) = belief(real), given(real)
    width = 64 // np.dtype(real).itemsize
    # row after row of each group of scenarios that lie side by side, on the boundary of a vector register
    pack = lambda *trees: np.stack(jax.tree.leaves(trees)).reshape(-1, LANES // width, width).swapaxes(0, 1)
    state, read, R = pack(one.q, one.b, blocks_of(one.P)), pack(rate, y), np.array(STAR, real)
    number = ctypes.c_float if real == np.float32 else ctypes.c_double
    at = lambda a: a.ctypes.data_as(ctypes.c_void_p)
    read = aligned(read)

    def go():
        out = aligned(state)
        run(LANES // width, TICKS, number(DT), number(ARW), number(RRW), at(R), at(out), at(read))
        return out.swapaxes(0, 1).reshape(-1, LANES)

    return go


def aligned(a):
    """A copy that begins on a boundary of 64 bytes."""
    room = np.empty(a.nbytes + 64, np.uint8)
    skip = -room.ctypes.data % 64
    copy = room[skip : skip + a.nbytes].view(a.dtype).reshape(a.shape)
    copy[...] = a
    return copy


def state_of(belief):
    """The state as the C program holds it, (34, LANES): q, b, the rows of `blocks_of`."""
    return np.stack([np.ravel(a) for a in jax.tree.leaves((belief.q, belief.b, blocks_of(belief.P)))])


def apart(found, other) -> float:
    """Largest difference of two states: of q as it is, of b as a share of the largest, of P_ij as one of sqrt(P_ii P_jj)."""
    sigma = np.sqrt(np.concatenate([other[7:16:4], other[25:34:4]]))
    blocks = [(sigma[i, None] * sigma[None, j]).reshape(9, -1) for i, j in ((A, A), (A, B), (B, B))]
    scale = np.concatenate([np.ones_like(other[:4]), np.full_like(other[4:7], abs(other[4:7]).max()), *blocks])
    return float((abs(found - other) / scale).max())


def rows(quick: bool):
    """The table: ns per scenario and tick, CPU seconds of the first call, which compiles."""
    for real in (np.float32, np.float64):
        name, seen, one = np.dtype(real).name, given(real), belief(real)
        ticks = {
            "MEKF, predict": (lambda belief, given: ahead(belief, given[0]), one),
            "MEKF, predict + attitude": (with_attitude, one),
            "MEKF, predict + vector": (with_vector, one),
            "MEKF with a clone, predict + late attitude": (partial(with_attitude, late=True), belief(real, clone=True)),
            "MEKF on arrays (6, 6), predict + attitude": (on_arrays, arrays(real)),
            "USQUE, step with a vector": (with_usque, one),
            "Davenport, three vectors": (with_davenport, one.q),
            "Davenport with the gap, three vectors": (with_davenport_gap, one.q),
            "TRIAD": (with_triad, one.q),
        }
        c = c_run(real)
        yield {
            "name": f"C, predict + attitude, {name}",
            "value": cpu_ns(c, LANES * TICKS, 9),
            "unit": "ns per tick",
        }
        exact = state_of(runner(with_attitude)(belief(np.float64), given(np.float64)))
        pairs = {
            "MEKF from C": (state_of(runner(with_attitude)(one, seen)), c()),
            "C from float64": (c(), exact),
        }
        for what, (found, other) in pairs.items():
            yield {"name": f"largest deviation of {what}, {name}", "value": apart(found, other), "unit": ""}
        for form, (tick, state) in ticks.items():
            run = partial(runner(tick), state, seen)
            before = time.process_time()
            jax.block_until_ready(run())
            first = time.process_time() - before
            yield {
                "name": f"{form}, {name}",
                "value": cpu_ns(run, LANES * TICKS, 3 if quick else 9),
                "unit": "ns per tick",
            }
            yield {"name": f"{form}, {name}: first call, CPU", "value": first, "unit": "s"}
