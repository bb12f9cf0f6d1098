"""Plants: how spacecraft really move."""

from __future__ import annotations

from jaxatt.vec import Mat3, Vec3, cross, once


def body_acceleration(w: Vec3, u: Vec3, J: Mat3, J_inv: Mat3, sign=-1) -> Vec3:
    """dw/dt [rad/s^2] of a rigid body under torque u [N m]: J w' = -w x J w + u.

    sign: -1 is Euler's equation; +1 the dynamics as Yun & Kang (2020), eq. (4), print them, which do not
    conserve momentum (spec, 5.1).
    """
    return J_inv @ once(lambda w, u: sign * cross(w, J @ w) + u, w, u)
