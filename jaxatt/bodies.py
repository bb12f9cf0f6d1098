"""How rigid spacecraft move, and the torques of their surroundings on them.

May import: check, vec, compiling.
"""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.check import finite, not_negative, share
from jaxatt.compiling import shared
from jaxatt.vec import Mat3, Vec3, cross, inverse, norm


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


def dipole_torque(moment: Vec3, field: Vec3) -> Vec3:
    """Torque m x B [N m] on a magnetic moment [A m^2], that of torquers or a residual one; field [T] in body axes."""
    return cross(moment, field)


class Facets(NamedTuple):
    """Flat outer faces; none shades another."""

    normal: Annotated[Vec3, "1", finite, ("faces",)]  # outward unit vectors in body axes
    arm: Annotated[Vec3, "m", finite, ("faces",)]  # centres of pressure, from the centre of mass
    area: Annotated[Any, "m^2", not_negative, ("faces",)]
    drag: Annotated[Any, "1", finite, not_negative] = 2.2  # drag coefficient
    specular: Annotated[Any, "1", share] = 0.2  # share of the light that is mirrored
    diffuse: Annotated[Any, "1", share] = 0.2  # share that is scattered

    def check(self, name: str) -> None:
        """Refuse, with ValueError, normals that are no unit vectors and shares of light above one together."""
        if check.concrete((self.normal, self.specular, self.diffuse)):
            check.unit(f"{name}.normal", self.normal)
            both = np.add(self.specular, self.diffuse)
            check.each(f"{name}.specular + diffuse", "not exceed 1", both, both <= 1 + 1e-6)


def box(x, y, z, offset: Vec3, **surface) -> Facets:
    """The six faces of a box with edges x, y, z [m], its centre at offset [m] from the centre of mass.

    surface: drag, specular and diffuse of `Facets`.
    """
    side = np.array([1.0, -1.0, 0, 0, 0, 0])
    normal = Vec3(side, np.roll(side, 2), np.roll(side, 4))
    arm = Vec3(*(0.5 * edge * n + o for edge, n, o in zip((x, y, z), normal, offset)))
    return Facets(normal, arm, np.repeat([y * z, z * x, x * y], 2), **surface)


def aero_torque(facets: Facets, v: Vec3, density) -> Vec3:
    """Torque [N m] of free-molecular drag: every face takes -1/2 rho |v|^2 C_d A max(n.e, 0) e at its arm, e = v/|v|.

    v: velocity against the air in body axes [m/s]; density [kg/m^3].
    """
    speed = norm(v)
    e = v / jnp.where(speed > 0, speed, 1)
    push = -0.5 * density * speed * speed * facets.drag * facets.area * jnp.maximum(facets.normal @ e, 0)
    return _sum(cross(facets.arm, push * e))


def solar_torque(facets: Facets, sun: Vec3, lit, pressure=4.56e-6) -> Vec3:
    """Torque [N m] of sunlight: each face takes -p A c ((1 - s) sun + 2 (s c + d/3) n) at its arm, c = max(n.sun, 0).

    sun: unit vector to the Sun in body axes; lit: share of its disc that is seen; pressure p [N/m^2], at one
    astronomical unit; s, d: shares of the light that are mirrored and scattered.
    """
    c = jnp.maximum(facets.normal @ sun, 0)
    push = -pressure * lit * facets.area * c
    normal = 2 * (facets.specular * c + facets.diffuse / 3)
    return _sum(cross(facets.arm, push * ((1 - facets.specular) * sun + normal * facets.normal)))


def _sum(v: Vec3) -> Vec3:
    return Vec3(*(reduce(add, a) for a in v))  # written out: over the array's axis it is slower in a batch
