"""How rigid spacecraft move, and the torque of gravity on them.

May import: vec, compiling.
"""

from __future__ import annotations

from jaxatt.compiling import shared
from jaxatt.vec import Mat3, Vec3, cross, inverse


def body_acceleration(w: Vec3, u: Vec3, J: Mat3, h: Vec3 | None = None) -> Vec3:
    """dw/dt [rad/s^2] of a rigid body under torque u [N m]: J w' = u - w x (J w + h), Euler's equation.

    h: momentum stored in wheels, in body axes [N m s]; u then contains the reaction -dh/dt. None without wheels.
    """

    def torque(w, u):
        momentum = J @ w if h is None else J @ w + h
        return u - cross(w, momentum)

    return inverse(J) @ shared(torque, w, u)


def gravity_gradient(down: Vec3, J: Mat3, orbit_rate) -> Vec3:
    """Gravity-gradient torque 3 wo^2 z x J z [N m]; down: nadir z in body axes, a unit vector; orbit_rate [rad/s]."""
    return 3 * orbit_rate * orbit_rate * cross(down, J @ down)
