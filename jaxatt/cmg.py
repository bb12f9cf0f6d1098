"""Control moment gyros (CMG): mounting, motion of a spacecraft with a cluster, torque matrix, steering laws.

The torque matrix T = [t_1 ... t_n] of n modules is a `Vec3` whose components are its rows, shape (n,), and what it can
do is told by `torque_matrix`; the cluster is singular where rank T < 3. Axes behind the modules' are grid points.
Source: Jin & Leeghim (2021); docs/loops/cmg_loss.md.

May import: check, vec, compiling, torque_matrix.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.check import not_negative, positive
from jaxatt.compiling import shared
from jaxatt.torque_matrix import dyads, gram_determinant, min_norm_solve, ordered_minors, robust_solve, times
from jaxatt.vec import Mat3, Vec3, cross, diagonal, inverse, where

# mounting


class GimbalAxes(NamedTuple):
    """How n single-gimbal control moment gyros are mounted, in body axes."""

    r: Annotated[Vec3, "1", ("n",)]  # gimbal axes
    s0: Annotated[Vec3, "1", ("n",)]  # spin axes at gimbal angle zero, at right angles to r

    def check(self, name: str) -> None:
        """Refuse, with ValueError, axes that are no unit vectors or not at right angles."""
        if check.concrete(self):
            tolerance = float(8 * np.finfo(np.float32).eps)  # they may have been float32
            for field, v in zip(self._fields, self):
                check.unit(f"{name}.{field}", v, tolerance)
            slant = sum(np.asarray(a) * np.asarray(b) for a, b in zip(self.r, self.s0))
            check.each(f"{name}.r . {name}.s0", "be 0 (right angles)", slant, np.abs(slant) <= tolerance)


class Triads(NamedTuple):
    """Where n modules point, in body axes."""

    r: Vec3  # (n,) [1] gimbal axes
    s: Vec3  # (n,) [1] spin axes
    t: Vec3  # (n,) [1] r x s = ds/dgamma, the torque matrix; the output torque is -h gamma' t


def cmg_axes(skew, azimuth) -> GimbalAxes:
    """Axes of n modules round the z axis, Jin & Leeghim (2021), eqs. (8)-(10).

    skew: angles of the gimbal axes to the z axis [rad], () or (n,): 54.7 deg makes the paper's pyramid, 90 deg its
    box-90; azimuth: of the gimbal axes in the x-y plane [rad], (n,). The spin axes at gimbal angle zero lie in the x-y
    plane. NumPy arrays unless an argument is of JAX.
    """
    m = jnp if any(isinstance(a, jax.Array) for a in (skew, azimuth)) else np  # at import nothing runs on JAX
    skew, azimuth = m.broadcast_arrays(m.asarray(skew, float), m.asarray(azimuth, float))
    sin_b, cos_b, sin_a, cos_a = m.sin(skew), m.cos(skew), m.sin(azimuth), m.cos(azimuth)
    return GimbalAxes(Vec3(sin_b * cos_a, sin_b * sin_a, cos_b), Vec3(-sin_a, cos_a, m.zeros_like(cos_a)))


def cmg_triads(axes: GimbalAxes, gamma) -> Triads:
    """The triads at gimbal angles gamma [rad], (n,)."""
    # an operand for each angle: an array of them would be transposed at the boundary, where scenarios lie last
    sin, cos = (jnp.stack(a) for a in shared(lambda *g: ([jnp.sin(a) for a in g], [jnp.cos(a) for a in g]), *gamma))
    t0 = cross(axes.r, axes.s0)
    return Triads(axes.r, cos * axes.s0 + sin * t0, cos * t0 - sin * axes.s0)


def modules(axes: GimbalAxes, which) -> GimbalAxes:
    """The axes of the modules ``which`` alone, a list of indices."""
    return jax.tree.map(lambda a: a[np.asarray(which)], axes)


def check_cluster(name: str, axes: GimbalAxes, healthy: Any = True) -> None:
    """Refuse, with ValueError, fewer than three healthy modules, and those whose gimbal axes are all parallel.

    The torques of parallel modules lie in one plane at all gimbal angles. healthy: bool, (n,). Passes tracers.
    """
    if check.concrete((axes, healthy)):
        r = np.stack([np.asarray(c, float) for c in axes.r])
        healthy = np.broadcast_to(healthy, r.shape[1:])
        count = healthy.sum(0)
        check.each(f"number of healthy modules of {name}", "be at least 3", count, count >= 3)
        second = np.linalg.eigvalsh(np.einsum("in...,jn...->...ij", r * healthy, r))[..., 1]
        must = "not all be parallel (second moment of the healthy ones > 0)"
        check.each(f"{name}.r", must, second, second > 1e-9)


# motion


class ModuleInertia(NamedTuple):
    """Moments of inertia of one module, the same for all of a cluster."""

    I_cr: Annotated[Any, "kg m^2", positive]  # of the whole module about its gimbal axis r
    I_cs: Annotated[Any, "kg m^2", positive]  # of the whole module about its spin axis s
    I_ct: Annotated[Any, "kg m^2", positive]  # of the whole module about its torque axis t
    I_ws: Annotated[Any, "kg m^2", positive]  # of the wheel about its spin axis


class CmgMotion(NamedTuple):
    """Rates of change of a spacecraft with n modules."""

    w: Vec3  # [rad/s^2] of the body rate
    rate: Any  # (n,) [rad/s^2] of the gimbal rates
    spin: Any  # (n,) [rad/s^2] of the wheel speeds


def cluster_inertia(J: Mat3, at: Triads, m: ModuleInertia) -> Mat3:
    """J_T of eq. (11) [kg m^2]: J + sum I_cr r r' + I_cs s s' + I_ct t t', using r r' + s s' + t t' = 1."""
    o = len(at.r.x) * m.I_ct
    return J + diagonal((o, o, o)) + dyads(at.r, m.I_cr - m.I_ct) + dyads(at.s, m.I_cs - m.I_ct)


def cluster_momentum(w: Vec3, rate, spin, at: Triads, J_T: Mat3, m: ModuleInertia) -> Vec3:
    """h_T of eq. (11) [N m s] at gimbal rates ``rate`` and wheel speeds ``spin``, (n,) [rad/s]."""
    return J_T @ w + times(at.r, m.I_cr * rate) + times(at.s, m.I_ws * spin)


def cmg_motion(w: Vec3, rate, spin, at: Triads, J: Mat3, m: ModuleInertia, servo, brake, free, friction) -> CmgMotion:
    """How a spacecraft with a cluster moves without outer torque, Jin & Leeghim (2021), eqs. (11)-(12), any n.

    A free gimbal obeys the balance of momentum about its own axis, in which r.w' couples back to the body; the wheel law
    leaves out the s.w' part of the wheel's acceleration, as the paper does.

    Args:
        w: body rate [rad/s].
        rate, spin: gimbal rates and wheel speeds relative to their mounting, (n,) [rad/s].
        at: where the modules point.
        J: inertia of the spacecraft without modules [kg m^2].
        m: moments of inertia of a module.
        servo: gimbal accelerations that the gimbals' drives enforce, (n,) [rad/s^2].
        brake: b_r of the wheels, (n,) [N m s], 0 where the motor holds the speed.
        free: (n,), 1 where no drive holds the gimbal and it swings against friction, servo ignored; otherwise 0.
        friction: of free gimbals, (n,) [N m s].
    """
    J_T = _once(cluster_inertia(J, at, m))
    s_w, t_w = at.s @ w, at.t @ w
    swing = ((m.I_cs - m.I_ct) * s_w * t_w + m.I_ws * spin * t_w - friction * rate) / m.I_cr  # less r.w'
    change = jnp.where(free > 0, swing, servo)
    spin_change = -brake * spin / m.I_ws
    torque = -cross(w, cluster_momentum(w, rate, spin, at, J_T, m))
    torque -= times(at.t, m.I_ws * spin * rate)  # gyroscopic, eq. (5)
    torque -= times(at.r, m.I_cr * change)
    torque -= (m.I_cs - m.I_ct) * (times(at.t, rate * s_w) + times(at.s, rate * t_w))  # J_T' w
    torque -= times(at.s, m.I_ws * spin_change)  # reaction of the brake, in eq. (12) tau_br s_4
    J_w, torque = _once((J_T - dyads(at.r, m.I_cr * free), torque))
    w_change = inverse(J_w) @ torque
    return CmgMotion(w_change, change - free * (at.r @ w_change), spin_change)


def _once(tree):
    """The tree, computed once for all that use it (see `shared`)."""
    return shared(lambda a: a, tree)


# steering


class Steering(NamedTuple):
    """A steering law as numbers: T rate = torque / h_w solved for gimbal rates."""

    rcond: Annotated[Any, "1", not_negative] = 1e-15  # singular values below rcond sigma_1 are zero, while lam0 is 0
    lam0: Annotated[Any, "1", not_negative] = 0.0  # singularity-robust inverse, lam = lam0 exp(-mu det T T'); 0: pinv
    mu: Annotated[Any, "1", not_negative] = 10.0  # how fast lam falls away from singularity
    dither: Annotated[Any, "1", not_negative] = 0.0  # off-diagonal size of E in the robust inverse
    dither_rate: Annotated[Any, "rad/s", not_negative] = np.pi / 2  # of the dither
    null: Annotated[Any, "1/s", not_negative] = 0.0  # gain of null motion up the gradient of det T T'; n > 3


def rate_pi(e: Vec3, integral: Vec3, J_T: Mat3, k_p, k_i) -> Vec3:
    """PI torque demand J_T (k_p e + k_i integral) [N m] of the rate error e [rad/s], eq. (7)."""
    return J_T @ (k_p * e + k_i * integral)


def steer(law: Steering, a: Vec3, axes: GimbalAxes, gamma, healthy, t):
    """Gimbal rates [rad/s], (n,), with T rate = a as nearly as the law allows.

    a: wanted change of the cluster's momentum over h_w [1/s]; gamma: gimbal angles, (n,) [rad]; healthy: 1 or 0, (n,):
    the columns of T that count; t: time [s], of the dither.
    """
    at = cmg_triads(axes, gamma)
    T, s = healthy * at.t, healthy * at.s
    pairs, triples = ordered_minors(T)
    turned = Vec3(*(c[:, None, None] for c in s)) @ pairs  # less the change of the minors with gamma_i, dt/dgamma = -s
    up = -law.null * jnp.sum(triples * turned, axis=(1, 2))  # law.null grad det(T T')
    to_do = a - times(T, up)  # so that up moves the gimbals, but not the momentum
    robust = law.lam0 > 0
    E = where(robust, damping(law, T, t), diagonal((1.0, 1.0, 1.0)))
    return up + jnp.where(robust, robust_solve(T, to_do, E), min_norm_solve(T, to_do, law.rcond))


def damping(law: Steering, T: Vec3, t) -> Mat3:
    """lam E of the (generalised) singularity-robust inverse at time t [s]; E = 1 without dither."""
    lam = law.lam0 * jnp.exp(-law.mu * gram_determinant(T))
    x, y, z = (law.dither * lam * jnp.sin(law.dither_rate * t + phase) for phase in (0, np.pi / 2, np.pi))
    return Mat3(Vec3(lam, z, y), Vec3(z, lam, x), Vec3(y, x, lam))
