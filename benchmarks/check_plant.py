"""The plant of `benchmarks.check_cases` from jaxatt's parts, the same by SciPy on equations of its own, and how they differ."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.check_references import (
    BRICK_J,
    BRICK_W,
    DEG,
    MU,
    Case,
)
from jaxatt import System, check, simulate
from jaxatt.attitude import (
    mrp_from_quat,
    mrp_inner,
    mrp_rate,
    quat_from_mrp,
    quat_normalised,
    quat_rate,
    quat_rotate,
    quat_to_body,
)
from jaxatt.bodies import body_acceleration, gravity_gradient
from jaxatt.vec import Mat3, Quat, Vec3, norm, where, zeros

LIMITS = {"attitude": 1e-9, "rate": 1e-14, "position": 1e-3}  # [deg], [rad/s], [m] of the orbital cases
BRICK_LIMITS = {"attitude": 1e-8, "rate": 1e-9 * DEG}  # printed to 1e-8 deg and 1e-12 deg/s


# the plant: one System for every case


class Scenario(NamedTuple):
    """Start, body and what acts on it."""

    r: Annotated[Vec3, "m", check.finite]
    v: Annotated[Vec3, "m/s", check.finite]
    q: Annotated[Quat, "1", check.unit]  # body to inertial
    w: Annotated[Vec3, "rad/s", check.finite]
    J: Annotated[Mat3, "kg m^2", check.inertia]
    mu: Annotated[Any, "m^3/s^2", check.not_negative]
    gradient: Annotated[Any, "1", check.flag]  # whether gravity turns the body
    torque: Annotated[Vec3, "N m", check.finite]  # in body axes, from 1000 s to 2000 s
    push: Annotated[Vec3, "m/s^2", check.finite]  # acceleration, the same


class X(NamedTuple):
    """Continuous state; a log is of the same shape, with a quaternion."""

    r: Vec3
    v: Vec3
    q: Any  # `Quat`, or `Vec3` of MRP, body to inertial
    w: Vec3


class Z(NamedTuple):
    """Held between ticks."""

    torque: Vec3
    push: Vec3


def init(params, s: Scenario, *, mrp: bool):
    """x, z at the start."""
    return X(s.r, s.v, mrp_from_quat(s.q) if mrp else s.q, s.w), Z(zeros(), zeros())


def tick(params, s: Scenario, now, x: X, z: Z, noise, *, mrp: bool):
    """Thrusters switch, the attitude is brought back to its set, the truth is logged."""
    on = (now.t >= 1000) & (now.t < 2000)
    x = x._replace(q=mrp_inner(x.q) if mrp else quat_normalised(x.q))
    log = x._replace(q=quat_from_mrp(x.q)) if mrp else x
    return x, Z(where(on, s.torque, zeros()), where(on, s.push, zeros())), log


def flow(params, s: Scenario, t, x: X, z: Z, *, mrp: bool) -> X:
    """dx/dt."""
    q, r = quat_from_mrp(x.q) if mrp else x.q, norm(x.r)
    down = quat_to_body(q, x.r / -r)
    u = z.torque + s.gradient * gravity_gradient(down, s.J, jnp.sqrt(s.mu / r**3))
    a = x.r * (-s.mu / r**3) + quat_rotate(q, z.push)
    return X(x.v, a, mrp_rate(x.q, x.w) if mrp else quat_rate(x.q, x.w), body_acceleration(x.w, u, s.J))


def system_of(dt: float = 1.0, mrp: bool = False) -> System:
    """The plant with an RK4 step of dt [s] a tick; mrp: attitude by MRP in place of a quaternion."""
    return System(partial(init, mrp=mrp), partial(tick, mrp=mrp), partial(flow, mrp=mrp), dt=dt)


QUATERNION, MRP = system_of(), system_of(mrp=True)
BRICKS = system_of(0.005), system_of(0.005, mrp=True)


# starts


AXES = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}


def turn(axis: str, deg: float) -> np.ndarray:
    """The matrix (3, 3) to the components along axes that are turned about one of them."""
    i, j = AXES[axis]
    m, c, s = np.eye(3), np.cos(deg * DEG), np.sin(deg * DEG)
    m[i, i], m[i, j], m[j, i], m[j, j] = c, s, -s, c
    return m


def lvlh(r, v):
    """Rows of the local vertical, local horizontal frame (3, 3), z down and y against the orbit's normal, and its rate."""
    h = np.cross(r, v)
    z, y = -r / np.linalg.norm(r), -h / np.linalg.norm(h)
    return np.stack([np.cross(y, z), y, z]), np.array([0, -np.linalg.norm(h) / (r @ r), 0])


def quaternion(m) -> np.ndarray:
    """The quaternion (4,), scalar first, of a matrix (3, 3): the eigenvector of Bar-Itzhack's symmetric one, then polished."""
    k = np.array([[m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
                  [0, m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
                  [0, 0, m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
                  [0, 0, 0, m[2, 2] - m[0, 0] - m[1, 1]]])  # fmt: skip
    return np.linalg.eigh(k, UPLO="U")[1][:, -1]


def start_of(case: Case):
    """r, v [m, m/s], the attitude (4,), body to inertial, and the rate (3,) [rad/s] of a case."""
    r, v = (np.array(a) for a in case.orbit)
    frame, rate = lvlh(r, v)
    to_body = np.eye(3)
    for axis, deg in case.turns:
        to_body = turn(axis, deg) @ to_body
    return r, v, quaternion((to_body @ frame).T), case.relative * (to_body @ rate) + case.spin


def scenario_of(case: Case) -> Scenario:
    """The scenario of a case."""
    r, v, q, w = start_of(case)
    body = Mat3.of(case.J), MU, case.gradient, Vec3.of(case.torque), Vec3.of(case.push)
    return Scenario(Vec3.of(r), Vec3.of(v), Quat.of(q), Vec3.of(w), *body)


def brick() -> Scenario:
    """NESC's brick, which nothing acts on, with the frame below it at the start for the inertial one."""
    return Scenario(Vec3(1.0, 0.0, 0.0), zeros(), Quat(1.0, 0.0, 0.0, 0.0), Vec3.of(BRICK_W * DEG), Mat3.of(BRICK_J),
                    0.0, 0.0, zeros(), zeros())  # fmt: skip


def stacked(scenarios):
    """One tree of scenarios, which lead."""
    return jax.tree.map(lambda *a: np.stack([np.asarray(b, float) for b in a]), *scenarios)


# runs


@partial(jax.jit, static_argnums=(0, 2, 3))
def _logs(system: System, scenarios, ticks: int, every: int):
    key = jax.random.key(0)  # no noise is drawn
    return jax.vmap(lambda s: simulate(system, (), s, key, ticks=ticks, every=every))(scenarios)


def logs(system: System, scenarios, seconds: float, every: float) -> dict[str, np.ndarray]:
    """r, v, q, w (n, records, components) of scenarios at 0, every, ... up to so many seconds."""
    log = _logs(system, scenarios, round(seconds / system.dt) + 1, round(every / system.dt))
    return {name: np.stack([np.asarray(a) for a in part], -1) for name, part in log._asdict().items()}


def by_scipy(s: dict, times) -> dict[str, np.ndarray]:
    """r, v, q, w (len(times), components) by DOP853 on equations written out in NumPy.

    s: r, v, q, w, J and, where they are not zero, mu, gradient, torque, push, as arrays.
    """
    from scipy.integrate import solve_ivp

    J, J_inv, mu = s["J"], np.linalg.inv(s["J"]), s.get("mu", 0.0)

    def rates(t, x, on):
        r, v, (a, b, c, d), w = x[:3], x[3:6], x[6:10], x[10:]
        A = np.array([[a*a+b*b-c*c-d*d, 2*(b*c-a*d), 2*(b*d+a*c)],
                      [2*(b*c+a*d), a*a-b*b+c*c-d*d, 2*(c*d-a*b)],
                      [2*(b*d-a*c), 2*(c*d+a*b), a*a-b*b-c*c+d*d]])  # fmt: skip
        size = np.sqrt(r @ r)
        n = A.T @ r / size
        p, q, k = w
        torque = on * np.array(s.get("torque", np.zeros(3))) - np.cross(w, J @ w)
        if s.get("gradient"):
            torque = torque + 3 * mu / size**3 * np.cross(n, J @ n)
        pull = on * (A @ s.get("push", np.zeros(3))) - mu / size**3 * r
        spin = np.array([-b*p - c*q - d*k, a*p + c*k - d*q, a*q + d*p - b*k, a*k + b*q - c*p]) / 2  # fmt: skip
        return np.concatenate([v, pull, spin, J_inv @ torque])

    times = np.asarray(times, float)
    x, now, found = np.concatenate([s["r"], s["v"], s["q"], s["w"]]), 0.0, []
    for stop, on in ((1000.0, 0.0), (2000.0, 1.0), (np.inf, 0.0)):  # a jump of the torque ends a stretch
        here = times[(times > now) & (times <= stop)] if now else times[times <= stop]
        end = min(stop, times[-1])
        if end > now:
            out = solve_ivp(rates, (now, end), x, "DOP853", np.union1d(here, [end]), args=(on,), rtol=3e-14, atol=1e-14)
            found += [out.y[:, np.searchsorted(out.t, t)] for t in here]
            x, now = out.y[:, -1], end
    y = np.array(found)
    return {
        "r": y[:, :3],
        "v": y[:, 3:6],
        "q": y[:, 6:10] / np.linalg.norm(y[:, 6:10], axis=1)[:, None],
        "w": y[:, 10:],
    }


def plain(case: Case) -> dict:
    """A case for `by_scipy`."""
    r, v, q, w = start_of(case)
    return dict(r=r, v=v, q=q, w=w, J=np.array(case.J), mu=MU, gradient=case.gradient, torque=np.array(case.torque),
                push=np.array(case.push))  # fmt: skip


def tumble() -> dict:
    """The brick for `by_scipy`."""
    return dict(r=np.array([1.0, 0, 0]), v=np.zeros(3), q=np.array([1.0, 0, 0, 0]), w=BRICK_W * DEG, J=BRICK_J)


# differences


def angle(p, q) -> np.ndarray:
    """Angle [deg] between attitudes (..., 4), whatever the signs of the quaternions."""
    p, q = np.asarray(p), np.asarray(q)
    v = p[..., :1] * q[..., 1:] - q[..., :1] * p[..., 1:] - np.cross(p[..., 1:], q[..., 1:])
    return 2 * np.arctan2(np.linalg.norm(v, axis=-1), np.abs((p * q).sum(-1))) / DEG


def far(a, b) -> float:
    """Largest distance between vectors (..., 3)."""
    return float(np.linalg.norm(np.asarray(a) - b, axis=-1).max())


def against(case: Case, found: dict, at) -> dict[str, float]:
    """Largest differences of a run from the references of a case; at: the index of a time [s] in it."""
    here = [at(row.t) for row in case.rows]
    out = {
        "attitude": float(angle(found["q"][here], [row.q for row in case.rows]).max()),
        "rate": far(found["w"][here], [row.w for row in case.rows]),
    }
    if placed := [row for row in case.rows if row.r is not None]:
        out["position"] = far(found["r"][[at(row.t) for row in placed]], [row.r for row in placed])
    return out


def within(found: dict[str, float], limits: dict[str, float]) -> bool:
    """Whether all differences keep their limits; NaN does not."""
    return all(found[name] <= limits[name] for name in found)


def euler(deg) -> np.ndarray:
    """Body to reference matrix (3, 3) of yaw, pitch, roll [deg]."""
    yaw, pitch, roll = deg
    return (turn("x", roll) @ turn("y", pitch) @ turn("z", yaw)).T
