"""Speed of the satellite that reconfigures itself: a tick of everything against batched NumPy, of its filter against C."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxatt
from benchmarks import attitude_filters as filters
from benchmarks.measure import cpu_ns, seconds
from jaxatt import scores
from jaxatt.loops import microsat as ms
from jaxatt.orbit import MU

N = 1024


def equal(n: int, real):
    """Params and n times the healthy day, in one floating type."""
    cast = lambda tree: jax.tree.map(lambda a: np.asarray(a, real), tree)
    return cast(ms.params), jax.tree.map(lambda a: np.repeat(a[None], n, axis=0), cast(ms.scenario))


def normals(rng, real, k):
    """The normal numbers (N, 19) of a tick."""
    return rng.normal(size=(N, ms.system.normals)).astype(real)


def rows(quick: bool):
    """CPU time per tick with all tallies, in both precisions, and of NumPy; the filter's; gradient; scenario rate."""
    ticks, key = 200 if quick else 1000, jax.random.key(0)
    for real in (np.float32,) if quick else (np.float32, np.float64):
        params, scenarios = equal(N, real)

        def run(params=params, scenarios=scenarios):
            return jaxatt.sweep(ms.system, params, scenarios, key, ticks=ticks, score=ms.score, progress=False)

        label = f"{np.dtype(real).name}, N = {N}"
        ns = cpu_ns(run, N * ticks, repeats=3 if quick else 5)
        yield {"name": f"tick, {label}", "value": ns, "unit": "CPU ns"}
        yield {"name": f"days of 500 s, {label}", "value": N * ticks / 5000 / seconds(run), "unit": "scenarios/s wall"}
        plain = cpu_ns(
            partial(batched, scenarios, 20, partial(normals, np.random.default_rng(0), real), real), N * 20, 1
        )
        yield {"name": f"NumPy / jaxatt, tick, {label}", "value": plain / ns, "unit": "x"}
        c = cpu_ns(filters.c_run(real), N * filters.TICKS, 9)
        given = filters.belief(real), filters.given(real)
        ours = cpu_ns(partial(filters.runner(filters.with_attitude), *given), N * filters.TICKS, 9)
        yield {"name": f"MEKF, predict + attitude, {label}", "value": ours, "unit": "CPU ns"}
        yield {"name": f"MEKF, share of C, {label}", "value": 100 * c / ours, "unit": "%"}
    if not quick:
        yield from gradient_rows(key)


def gradient_rows(key, n: int = 128, ticks: int = 100):
    """Cost of the gradient in two gains."""
    _, scenarios = equal(n, np.float64)
    score = lambda params, scenario, now, log: scores.mean(log.pointing**2)

    @jax.jit
    def cost(theta):
        params = ms.params._replace(kp=jnp.exp(theta[0]), kd=jnp.exp(theta[1]))
        return jnp.mean(jaxatt.sweep(ms.system, params, scenarios, key, ticks=ticks, score=score))

    gradient = jax.jit(jax.value_and_grad(cost))
    theta = jnp.log(jnp.array([0.01, 0.14]))
    alone = cpu_ns(lambda: cost(theta), n * ticks, repeats=3)
    ns = cpu_ns(lambda: gradient(theta), n * ticks, repeats=3)
    yield {"name": f"gradient in kp, kd, float64, N = {n}: tick", "value": ns, "unit": "CPU ns"}
    yield {"name": "gradient over its cost", "value": ns / alone, "unit": "1"}


# the healthy loop as one would write it for batches of arrays: scenarios first, vectors (n, 3), covariance (n, 9, 9)


def product(p, q):
    """Hamilton product, scalar first."""
    (a, u), (b, v) = ((x[:, :1], x[:, 1:]) for x in (p, q))
    return np.concatenate([a * b - (u * v).sum(1, keepdims=True), a * v + b * u + np.cross(u, v)], axis=1)


def conjugate(q):
    return q * np.array([1, -1, -1, -1], q.dtype)


def exponential(r):
    half = 0.5 * np.linalg.norm(r, axis=1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * r], axis=1)


def logarithm(q):
    s = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(s, np.abs(q[:, :1])) * np.where(q[:, :1] < 0, -1, 1)
    return np.divide(angle, s, out=2 * np.ones_like(s), where=s > 1e-12) * q[:, 1:]


def body(q, v):
    """Components in body axes of v in reference axes."""
    t = 2 * np.cross(v, q[:, 1:])
    return v + q[:, :1] * t + np.cross(t, q[:, 1:])


def normal(v):
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def skew(v):
    out = np.zeros((*v.shape, 3), v.dtype)
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - out.swapaxes(1, 2)


def nadir(r, v):
    """Quaternion and rate of the attitude that looks at the Earth."""
    z, y = -normal(r), -normal(np.cross(r, v))
    m = np.stack([np.cross(y, z), y, z], axis=2)
    trace = np.trace(m, axis1=1, axis2=2)
    axis = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], axis=1)
    candidates = [np.concatenate([(1 + trace)[:, None], axis], axis=1)]
    for i in range(3):
        e = np.eye(3, dtype=r.dtype)[i]
        rest = m[:, :, i] + m[:, i, :] + (1 - trace)[:, None] * e
        candidates.append(np.concatenate([axis[:, i : i + 1], rest], axis=1))
    rows = np.stack(candidates, axis=1)
    best = np.argmax(np.linalg.norm(rows, axis=2), axis=1)
    rate = np.linalg.norm(np.cross(r, v), axis=1) / (r * r).sum(1)
    w = np.zeros_like(r)
    w[:, 1] = -rate
    return normal(rows[np.arange(len(r)), best]), w


def surroundings(table, t):
    """Field, Sun, light, place and velocity at t (n,): Catmull-Rom, light by straight lines."""
    u = (t - table["start"]) / table["step"]
    i = np.clip(np.floor(u), 1, len(table["lit"]) - 3).astype(int)
    s = (u - i).astype(t.dtype)
    weights = -s + s * s * (2 - s), 2 - s * s * (5 - 3 * s), s + s * s * (4 - 3 * s), s * s * (s - 1)
    cubic = lambda a: 0.5 * sum(w[:, None] * a[i + k] for k, w in enumerate(weights, -1))
    line = lambda a: a[i] + s * (a[i + 1] - a[i])
    vectors = [cubic(table[name]) for name in ("field", "sun", "r", "v")]
    return vectors[0], normal(vectors[1]), line(table["lit"]), *vectors[2:], line(table["density"])


def two_sided(state, x, slack):
    up, down = np.maximum(state[0] + x - slack, 0), np.maximum(state[1] - x - slack, 0)
    return (up, down), np.maximum(up, down)


def batched(day: ms.Scenario, ticks: int, noise, real: Any = np.float64):
    """The healthy loop over n days, leaves (n, ...): pointing, knowledge, rate error and NIS, (ticks, 4, n).

    noise(k): the normals (n, 19) of tick k. All detectors run; the filters that go on without star tracker or gyro, and
    the three wheels that go on without a fourth, are left out, for no healthy day needs them.
    """
    number = lambda a: np.asarray(a, real)
    p = jax.tree.map(lambda a: number(a)[()], ms.params)
    n, three = len(day.t0), lambda v: number(np.stack(v, axis=-1))
    J, W = number(np.stack(p.J)), number(np.stack(p.axes))
    Jinv, W_plus, dt = np.linalg.inv(J), np.linalg.pinv(W), real(ms.DT)
    sky = p.table
    table = dict(
        start=float(sky.start), step=float(sky.step), lit=number(sky.lit), density=number(sky.density),
        field=three(sky.field), sun=three(sky.sun), r=three(sky.r), v=three(sky.v),
    )  # fmt: skip
    box = ms.scenario.facets
    normals, arm = (three(np.broadcast_arrays(*a)) for a in (box.normal, box.arm))
    area, drag, specular, diffuse = (number(a) for a in (box.area, box.drag, box.specular, box.diffuse))
    C = number([[0, 1, 0], [0, 0, 1], [1, 0, 0]])  # columns z, x, y
    std_star = number([p.star.cross, p.star.cross, p.star.roll])
    arw, rrw, null, friction = p.gyro.arw, p.gyro.rrw, number(ms.NULL), p.wheel.friction
    t0, dipole = np.asarray(day.t0, float), number(ms.scenario.dipole)
    q, w = nadir(*surroundings(table, number(t0))[3:5])
    h, wear = number(day.h), number(day.friction)
    theta, last_theta, bias = np.zeros_like(w), np.zeros_like(w), three(day.bias)
    qh = product(q, exponential(-three(day.turn)))
    bh, qc, wm = np.zeros_like(w), qh.copy(), w.copy()
    P = np.tile(number(np.diag(np.repeat([p.sigma_turn, p.sigma_bias, p.sigma_turn], 3) ** 2)), (n, 1, 1))
    P[:, :3, 6:] = P[:, 6:, :3] = P[:, :3, :3]
    tacho_last, reference, torque, moment = h.copy(), h.copy(), np.zeros_like(h), np.zeros_like(w)
    wheel, gyro = (np.zeros_like(h),) * 2, (np.zeros_like(w),) * 2
    nis_ring, cross_ring, dof_ring = np.full((n, 20), 3, real), np.zeros((n, 4), real), np.full((n, 4), 6, real)
    rejected, in_use, line, held_field = np.zeros(n), np.ones((n, 4), bool), [], np.zeros((n, 3))
    worst = np.zeros((4, n))

    def tick(k, state):
        """One tick of everything, apart from the loop, which type checkers would go round for minutes."""
        (
            bias, theta, last_theta, q, w, h, qh, bh, qc, wm, P, tacho_last, reference, torque, moment, wheel, gyro, rejected,
            in_use, line, held_field,
        ) = state  # fmt: skip
        field, sun, lit, r, v, rho = surroundings(table, number(t0 + k * ms.DT))
        drawn = noise(k)
        # sensors
        if k == 0:
            rate = w + bias
        else:
            walked = bias + rrw * np.sqrt(dt) * drawn[:, 3:6]
            white = np.sqrt(arw**2 / dt + rrw**2 * dt / 12) * drawn[:, :3]
            rate, bias = (theta - last_theta) / dt + (bias + walked) / 2 + white, walked
        last_theta = theta
        fB, fS = body(q, field), body(q, sun)
        sun_read, field_read = fS + p.std_sun * drawn[:, 9:12], fB + p.std_field * drawn[:, 12:15]
        tacho = h - p.wheel.J * (w @ W) + p.std_tacho * drawn[:, 15:]
        exposed = (2 * (k % 5)) % 5 < 2
        star = product(q, exponential((std_star * drawn[:, 6:9]) @ C.T)) if exposed else None
        line = [(star, sun_read, field_read, sun, field, lit), *line[:2]]
        # rate by the wheels' momentum, and the gyro against it
        if k:
            gyroscopic = np.cross(moment, held_field) - np.cross(wm, wm @ J.T + tacho @ W.T)
            wm = wm + (dt * gyroscopic - (tacho - tacho_last) @ W.T) @ Jinv.T
        apart = rate - bh - wm
        gyro, statistic = two_sided(gyro, apart / (arw / np.sqrt(dt)), p.limits.gyro_slack)
        worst[1] = np.maximum(worst[1], statistic.max(1))
        wm = wm + p.pull * apart
        # prediction
        if k:
            turn = dt * (rate - bh)
            S, x = skew(turn), np.linalg.norm(turn, axis=1)[:, None, None]
            one = np.eye(3, dtype=real)
            cosine = 0.5 * np.sinc(x / (2 * np.pi)) ** 2
            Phi = np.tile(np.eye(9, dtype=real), (n, 1, 1))
            Phi[:, :3, :3] = one - np.sinc(x / np.pi) * S + cosine * S @ S
            Phi[:, :3, 3:6] = -dt * (one - cosine * S + S @ S / 6)
            Q = np.zeros((9, 9), real)
            Q[:3, :3], Q[3:6, 3:6] = (arw**2 * dt + rrw**2 * dt**3 / 3) * one, rrw**2 * dt * one
            Q[:3, 3:6] = Q[3:6, :3] = -(rrw**2) * dt**2 / 2 * one
            P = Phi @ P @ Phi.swapaxes(1, 2) + Q
            qh = normal(product(qh, exponential(turn)))
        # star sample
        nis = np.zeros(n)
        if len(line) == 3 and line[2][0] is not None:
            y, sun_then, field_then, s, B, lit_then = line[2]
            residual = logarithm(product(conjugate(qc), y)) @ C
            H = np.zeros((3, 9), real)
            H[:, 6:] = C.T
            innovation = H @ P @ H.T + np.diag(std_star**2)
            K = np.linalg.solve(innovation, H @ P).swapaxes(1, 2)
            nis = (residual * np.linalg.solve(innovation, residual[..., None])[..., 0]).sum(1)
            use = nis <= p.limits.gate
            move = np.where(use[:, None], (K @ residual[..., None])[..., 0], 0)
            after = P - K @ (H @ P)
            P = np.where(use[:, None, None], (after + after.swapaxes(1, 2)) / 2, P)
            qh, bh, qc = (
                normal(product(qh, exponential(move[:, :3]))),
                bh + move[:, 3:6],
                normal(product(qc, exponential(move[:, 6:]))),
            )
            rejected = np.maximum(rejected + np.where(use, -1, 1), 0)
            seen = lit_then > ms.SEEN
            off = [
                ((a - body(y, b)) ** 2).sum(1) / std**2
                for a, b, std in ((sun_then, s, p.std_sun), (field_then, B, p.std_field))
            ]
            for ring, new in (
                (nis_ring, np.minimum(nis, p.limits.gate)),
                (cross_ring, np.where(seen, off[0], 0) + off[1]),
                (dof_ring, np.where(seen, 6, 3)),
            ):
                ring[:, 1:], ring[:, 0] = ring[:, :-1].copy(), new
        limit = ms.CROSS[(dof_ring.sum(1) / 3 - 1).astype(int)]
        worst[2] = np.maximum(worst[2], nis_ring.sum(1))
        worst[3] = np.maximum(worst[3], cross_ring.sum(1) / limit)
        if exposed:
            qc = qh.copy()
            P[:, 6:, :], P[:, :, 6:] = P[:, :3, :].copy(), P[:, :, :3].copy()
            P[:, 6:, 6:] = P[:, :3, :3]
        # wheels
        speed = tacho_last / p.wheel.J
        expected = torque - np.sign(speed) * friction.coulomb - friction.viscous * speed
        residual = (tacho - tacho_last - dt * expected) / (np.sqrt(2) * p.std_tacho)
        wheel, statistic = two_sided(
            wheel, np.where((abs(speed) >= p.limits.least_speed) & (k > 0), residual, 0), p.limits.slack
        )
        worst[0] = np.maximum(worst[0], statistic.max(1))
        in_use &= (statistic <= p.limits.wheel) | (k < ms.MASKED)
        if k % ms.SECOND == 0:
            held_field = field_read
        # law
        wanted_q, wanted_w = nadir(r, v)
        west = rate - bh
        e = product(conjugate(wanted_q), qh)
        wanted = body(e, wanted_w)
        turn = 2 * np.where(e[:, :1] < 0, -1, 1) * e[:, 1:]
        turn = turn * np.minimum(1, p.turn_max / np.maximum(np.linalg.norm(turn, axis=1, keepdims=True), p.turn_max))
        momentum = tacho @ W.T
        u = (-np.cross(west, wanted) - p.kp * turn - p.kd * (west - wanted)) @ J.T + np.cross(
            west, west @ J.T + momentum
        )
        demand = -u @ W_plus.T - (p.k_idle * (tacho @ null - p.idle))[:, None] * null
        reference = np.clip(reference + dt * demand, tacho - p.windup, tacho + p.windup)
        torque = np.clip(demand + p.k_wheel * (reference - tacho), -p.wheel.torque_max, p.wheel.torque_max)
        moment = np.clip(
            p.k_unload * np.cross(momentum, held_field) / (held_field**2).sum(1, keepdims=True),
            -p.moment_max,
            p.moment_max,
        )
        # tallies
        true_e = product(conjugate(wanted_q), q)
        pointing, rate_error = (
            np.linalg.norm(logarithm(true_e), axis=1),
            np.linalg.norm(w - body(true_e, wanted_w), axis=1),
        )
        knowledge = np.linalg.norm(logarithm(product(conjugate(qh), q)), axis=1)
        # the truth ahead
        speed = h / p.wheel.J - w @ W
        outward = np.sign(torque) * speed
        room = np.clip((p.wheel.speed_max - outward) / (p.wheel.speed_max - p.wheel.knee), 0, 1)
        motor = np.clip(torque, -p.wheel.torque_max * room, p.wheel.torque_max * room)
        level = wear * (
            friction.coulomb + (friction.stiction - friction.coulomb) * np.exp(-((speed / friction.stribeck) ** 2))
        )
        free = speed + dt * motor / p.wheel.J
        ahead = (
            np.sign(free)
            * np.maximum(abs(free) - dt * level / p.wheel.J, 0)
            / (1 + dt * wear * friction.viscous / p.wheel.J)
        )
        given = p.wheel.J * (ahead - speed) / dt
        down, distance = -body(q, normal(r)), np.linalg.norm(r, axis=1, keepdims=True)
        wind = body(q, v)
        ahead_wind = np.maximum(normal(wind) @ normals.T, 0)
        press = -0.5 * rho[:, None] * (wind**2).sum(1, keepdims=True) * drag * area * ahead_wind
        outer = np.cross(arm, press[..., None] * normal(wind)[:, None]).sum(1)
        shone = np.maximum(fS @ normals.T, 0)
        light = (1 - specular)[..., None] * fS[:, None] + 2 * (specular * shone + diffuse / 3)[..., None] * normals
        outer += np.cross(arm, -4.56e-6 * (lit[:, None] * area * shone)[..., None] * light).sum(1)
        outer += 3 * MU / distance**3 * np.cross(down, down @ J.T) + np.cross(moment + dipole, fB)
        outer = (outer - given @ W.T).astype(real)

        def rates(q, w, h):
            spin = np.concatenate([np.zeros((n, 1), real), w], axis=1)
            return 0.5 * product(q, spin), (outer - np.cross(w, w @ J.T + h @ W.T)) @ Jinv.T, given, w

        truth, slopes = (q, w, h, theta), []
        at = truth
        for by in (0.5, 0.5, 1, 0):
            slopes.append(rates(*at[:3]))
            at = [a + by * dt * s for a, s in zip(truth, slopes[-1])]
        q, w, h, theta = (a + dt * (k1 + 2 * k2 + 2 * k3 + k4) / 6 for a, k1, k2, k3, k4 in zip(truth, *slopes))
        ahead = (
            bias, theta, last_theta, normal(q), w, h, qh, bh, qc, wm, P, tacho, reference, torque, moment, wheel, gyro, rejected,
            in_use, line, held_field,
        )  # fmt: skip
        return ahead, (pointing, knowledge, rate_error, nis)

    state = (
        bias, theta, last_theta, q, w, h, qh, bh, qc, wm, P, tacho_last, reference, torque, moment, wheel, gyro, rejected,
        in_use, line, held_field,
    )  # fmt: skip
    told = np.zeros((ticks, 4, n), real)
    for k in range(ticks):
        state, told[k] = tick(k, state)
    return told
