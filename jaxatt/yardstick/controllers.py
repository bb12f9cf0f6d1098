"""The baselines among the controllers: two that know of no fault, two that adapt, one that estimates.

Each is the PD law of `leo4` with something added. e = 2 vec(q_e) is the turn from the aim to the MEKF's attitude, w_e the
rate less the commanded one, J the believed inertia, W the wheels' axes in columns.

May import: leo4, control, attitude, check, faults, filters, vec.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxatt import filters
from jaxatt.attitude import quat_conjugate
from jaxatt.check import not_negative, positive
from jaxatt.faults import Reading as Measured
from jaxatt.filters import Belief
from jaxatt.vec import Mat3, Quat, Vec3, array, cross, inverse, scaled_identity
from jaxatt.yardstick import leo4
from jaxatt.yardstick.control import Controller
from jaxatt.yardstick.leo4 import DT, Reading


def nothing(params: Any) -> tuple:
    """z of a law without memory."""
    return ()


def errors(reading: Reading) -> tuple[Vec3, Vec3]:
    """e [rad] and w_e [rad/s]."""
    turn = leo4.vector_part(quat_conjugate(Quat.of(reading.aim)) * Quat.of(reading.attitude))
    return turn, Vec3.of(reading.rate) - Vec3.of(reading.aim_rate)


# PID


class Pid(NamedTuple):
    """Gains of the PID law."""

    law: leo4.Params = leo4.params
    ki: Annotated[Any, "1/s^3", not_negative] = 2e-4  # integral gain over inertia
    most: Annotated[Any, "rad s", positive] = 3.0  # the integral's limit about each axis; a bias of 10 mN m needs 1.9


def pid_init(params: Pid):
    """The integral (3,) [rad s]."""
    return jnp.zeros(3)


def pid_step(params: Pid, integral, reading: Reading):
    """u = u_pd - ki J (integral of e), the integral limited."""
    e, _ = errors(reading)
    integral = jnp.clip(integral + DT * array(e), -params.most, params.most)
    u = leo4.demanded(params.law, reading) - params.ki * (params.law.J @ Vec3.of(integral))
    return integral, leo4.shared_out(u)


# adaptive


class Adaptive(NamedTuple):
    """Rates of the adaptive law."""

    law: leo4.Params = leo4.params
    gain_rate: Annotated[Any, "1/(N m rad)", not_negative] = 1e4  # gamma_rho
    bias_rate: Annotated[Any, "N m/rad", not_negative] = 1.5  # gamma_eta
    low: Annotated[Any, "1", positive] = 0.2  # where rho is kept
    high: Annotated[Any, "1", positive] = 10.0


class Adapted(NamedTuple):
    """What the adaptive law has learned."""

    rho: Any  # (3,) gains
    eta: Any  # (3,) [N m]


def adaptive_init(params: Adaptive) -> Adapted:
    """The PD law."""
    return Adapted(jnp.ones(3), jnp.zeros(3))


def adaptive_step(params: Adaptive, z: Adapted, reading: Reading):
    """u = diag(rho) u_pd + eta; rho' = -gamma_rho s u_pd within its limits, eta' = -gamma_eta s, s = w_e + (kp/kd) e.

    A direct adaptive law: it needs no estimate of the fault, but the sign of each axis.
    """
    s, u = _sliding(params.law, reading)
    u = array(u)
    rho = jnp.clip(z.rho - DT * params.gain_rate * s * u, params.low, params.high)
    eta = z.eta - DT * params.bias_rate * s
    return Adapted(rho, eta), leo4.shared_out(Vec3.of(rho * u + eta))


def _sliding(law: leo4.Params, reading: Reading):
    """s = w_e + (kp/kd) e, (3,) [rad/s], and u_pd [N m]."""
    e, w = errors(reading)
    return array(w + (law.kp / law.kd) * e), leo4.demanded(law, reading)


# unknown signs


class Nussbaum(NamedTuple):
    """Rate of the Nussbaum law."""

    law: leo4.Params = leo4.params
    rate: Annotated[Any, "1/(N m rad)", not_negative] = 300.0
    start: Annotated[Any, "1", positive] = 1.88  # k, where -k^2 cos k is 1.08


def nussbaum_init(params: Nussbaum):
    """k (3,)."""
    return jnp.full(3, params.start)


def nussbaum_step(params: Nussbaum, k, reading: Reading):
    """u = -k^2 cos k u_pd, k' = -rate s u_pd for each axis: a gain that tries both signs (Nussbaum, 1983)."""
    s, u = _sliding(params.law, reading)
    u = array(u)
    k = k - DT * params.rate * s * u
    return k, leo4.shared_out(Vec3.of(-k * k * jnp.cos(k) * u))


# detect and reallocate


class Structured(NamedTuple):
    """The filter of the wheels, a random walk, and the damping of the allocation."""

    law: leo4.Params = leo4.params
    R: Annotated[Any, "(N m)^2", positive] = (30 * leo4.STD_AXIS * 2**0.5 / leo4.PACKET) ** 2  # of a rate difference
    walk_gain: Annotated[Any, "1", not_negative] = 1e-5  # variance that a packet adds
    walk_torque: Annotated[Any, "(N m)^2", not_negative] = 1e-9
    gain: Annotated[Any, "1", positive] = 1.0  # variances at the start
    torque: Annotated[Any, "(N m)^2", positive] = 25e-6
    damping: Annotated[Any, "1", positive] = 0.02


class Estimated(NamedTuple):
    """What the structured law knows of the wheels, and gathers until the next packet."""

    belief: Belief  # (7,) gains of the four wheels, torque on the body [N m]
    torque: Any  # (4,) [N m] sum of the commands
    moment: Vec3  # [N m] sum of w x J w
    rate: Vec3  # [rad/s] at the packet's first tick
    seen: Any  # () [1] packets, 0 or 1


def structured_init(params: Structured) -> Estimated:
    """Healthy wheels, no torque."""
    gains, three = jnp.ones(4), jnp.zeros(3)
    cov = jnp.diag(jnp.concatenate([jnp.full(4, params.gain), jnp.full(3, params.torque)]))
    zero = Vec3.of(three)
    return Estimated(Belief(jnp.concatenate([gains, three]), cov), 0 * gains, zero, zero, jnp.zeros(()))


def wheels_seen(params: Structured, z: Estimated, rate: Vec3) -> Estimated:
    """The belief after a packet: J (w - w before) / .5 s + mean(w x J w) = W diag(mean command) g + T + noise of R."""
    mean, at = z.torque / leo4.TICKS, (params.law.J @ (rate - z.rate)) / leo4.PACKET + z.moment / leo4.TICKS
    walk = jnp.concatenate([jnp.full(4, params.walk_gain), jnp.full(3, params.walk_torque)])
    cov = z.belief.cov + jnp.diag(walk.astype(z.belief.cov.dtype))
    expected = lambda x: leo4.summed(mean * x[:4]) + Vec3.of(x[4:])
    reading = Measured(array(at), jnp.broadcast_to(z.seen > 0, 3))
    belief, _ = filters.update(Belief(z.belief.mean, cov), reading, expected, jnp.full(3, params.R))
    zero = Vec3(*(0 * a for a in rate))
    return Estimated(belief, 0 * z.torque, zero, rate, jnp.ones_like(z.seen))


def reallocated(params: Structured, gains, u: Vec3):
    """B' (B B' + damping I)^-1 u, (4,) [N m] with B = W diag(gains): torques of wheels with these gains that give u."""
    squares = gains * gains
    x, y, z = leo4.AXES
    entry = lambda a, b: sum(p * q * s for p, q, s in zip(a, b, squares))
    square = Mat3(*(Vec3(*(entry(a, b) for b in (x, y, z))) for a in (x, y, z)))
    return gains * leo4.along(inverse(square + scaled_identity(params.damping)) @ u)


def structured_step(params: Structured, z: Estimated, reading: Reading):
    """Estimate the gains of the wheels and the torque T, and let the wheels give u_pd - T."""
    rate = Vec3.of(reading.rate)
    z = z._replace(torque=z.torque + reading.torque)
    z = jax.lax.cond(reading.star_valid, lambda z: wheels_seen(params, z, rate), lambda z: z, z)
    z = z._replace(moment=z.moment + cross(rate, params.law.J @ rate))
    u = leo4.demanded(params.law, reading) - Vec3.of(z.belief.mean[4:])
    return z, reallocated(params, z.belief.mean[:4], u)


CONTROLLERS = {
    c.name: c
    for c in (
        Controller("pd", nothing, leo4.decide, leo4.params),
        Controller("pid", pid_init, pid_step, Pid()),
        Controller("adaptive", adaptive_init, adaptive_step, Adaptive(), tuned=2),
        Controller("nussbaum", nussbaum_init, nussbaum_step, Nussbaum(), tuned=1),
        Controller("structured", structured_init, structured_step, Structured()),
    )
}
