"""Three-vectors, 3x3 matrices and quaternions as pytrees of components.

Components lead, lanes trail: every component is a scalar or an array of lanes, and batching is plain
broadcasting. XLA sees nothing but element-wise arithmetic, which it fuses and vectorises.

May import: check.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import Tracer

from jaxatt.check import door


class Vec3(NamedTuple):
    """A vector: components of shape (*lanes). ``+ -`` with vectors, ``* /`` with scalars, ``@`` is the dot product."""

    x: Any
    y: Any
    z: Any

    __array_ufunc__ = None  # a NumPy scalar on the left must defer to us instead of making an array

    def __add__(self, v):
        return Vec3(self.x + v.x, self.y + v.y, self.z + v.z)

    def __sub__(self, v):
        return Vec3(self.x - v.x, self.y - v.y, self.z - v.z)

    def __neg__(self):
        return Vec3(-self.x, -self.y, -self.z)

    def __mul__(self, s):
        return Vec3(self.x * s, self.y * s, self.z * s)

    def __rmul__(self, s):
        return self * s

    def __truediv__(self, s):
        return self * (1 / s)

    def __matmul__(self, v):
        return self.x * v.x + self.y * v.y + self.z * v.z


class Mat3(NamedTuple):
    """A matrix by rows, three `Vec3` of shape (*lanes): ``@`` with `Mat3` and `Vec3`, ``+ -`` with `Mat3`, ``*``."""

    x: Any
    y: Any
    z: Any

    __array_ufunc__ = None

    def __add__(self, m):
        return Mat3(self.x + m.x, self.y + m.y, self.z + m.z)

    def __sub__(self, m):
        return Mat3(self.x - m.x, self.y - m.y, self.z - m.z)

    def __neg__(self):
        return Mat3(-self.x, -self.y, -self.z)

    def __mul__(self, s):
        return Mat3(self.x * s, self.y * s, self.z * s)

    def __rmul__(self, s):
        return self * s

    def __matmul__(self, other) -> Any:
        if isinstance(other, Mat3):
            columns = other.T
            return Mat3(*(Vec3(row @ columns.x, row @ columns.y, row @ columns.z) for row in self))
        return Vec3(self.x @ other, self.y @ other, self.z @ other)

    @property
    def T(self):
        return Mat3(*(Vec3(*column) for column in zip(*self)))


class Quat(NamedTuple):
    """A quaternion, scalar first: components of shape (*lanes). ``*`` is the Hamilton product or a scalar factor."""

    w: Any
    x: Any
    y: Any
    z: Any

    __array_ufunc__ = None

    @property
    def v(self):
        """The vector part."""
        return Vec3(self.x, self.y, self.z)

    def __add__(self, p):
        return Quat(*(a + b for a, b in zip(self, p)))

    def __sub__(self, p):
        return Quat(*(a - b for a, b in zip(self, p)))

    def __neg__(self):
        return Quat(*(-a for a in self))

    def __mul__(self, p):
        if isinstance(p, Quat):
            v = self.w * p.v + p.w * self.v + cross(self.v, p.v)
            return Quat(self.w * p.w - self.v @ p.v, *v)
        return Quat(*(a * p for a in self))

    def __rmul__(self, s):
        return Quat(*(s * a for a in self))

    def __matmul__(self, p):
        return self.w * p.w + self.v @ p.v


@door
def vec3(a) -> Vec3:
    """Array-like a of shape (3, *lanes) to `Vec3`."""
    x, y, z = a
    return Vec3(x, y, z)


@door
def mat3(a) -> Mat3:
    """Array-like a of shape (3, 3, *lanes) to `Mat3`."""
    return Mat3(*(vec3(row) for row in a))


@door
def quat(a) -> Quat:
    """Array-like of shape (4, *lanes), scalar first, to `Quat`."""
    w, x, y, z = a
    return Quat(w, x, y, z)


@door
def array(v) -> jax.Array:
    """`Vec3`, `Quat` or `Mat3` to an array of shape (3, *lanes), (4, *lanes) or (3, 3, *lanes)."""
    if isinstance(v, Mat3):
        return jnp.stack([array(row) for row in v])
    return jnp.stack(jnp.broadcast_arrays(*v))


@door
def diagonal(d) -> Mat3:
    """The diagonal matrix of three numbers or a `Vec3`."""
    x, y, z = d
    o = jnp.zeros_like(x)
    return Mat3(Vec3(x, o, o), Vec3(o, y, o), Vec3(o, o, z))


@door
def cross(a: Vec3, b: Vec3) -> Vec3:
    """Vector product a x b."""
    return Vec3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


@door
def det(m: Mat3):
    """Determinant, as the triple product of the rows."""
    return m.x @ cross(m.y, m.z)


@door
def inverse(m: Mat3) -> Mat3:
    """Inverse in closed form (adjugate over determinant); infinities for a singular matrix."""
    columns = Mat3(cross(m.y, m.z), cross(m.z, m.x), cross(m.x, m.y))
    return columns.T * (1 / jnp.asarray(m.x @ columns.x))  # a Python zero would raise


@door
def norm(v):
    """Euclidean length of a `Vec3` or `Quat`, shape (*lanes); its gradient at zero is zero, not NaN."""
    return safe_sqrt(v @ v)


@door
def safe_sqrt(a):
    """Square root of a >= 0 whose gradient at zero is zero, not infinite."""
    positive = a > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, a, 1)), a)


def once(f, *operands):
    """f(*operands), computed once and kept.

    XLA's CPU compiler repeats shared subexpressions in every consumer, each output of a fusion on its own, unless
    a control-flow boundary holds them. This one is always taken, but the compiler does not know.
    """
    traced = [leaf for leaf in jax.tree.leaves(operands) if isinstance(leaf, Tracer)]
    if not traced:
        return f(*operands)
    f = jax.jit(f, inline=True)  # traced once for its shapes and its values
    shapes = jax.eval_shape(f, *operands)
    # tied to an operand, lest reverse mode on JAX 0.10 takes the branch apart before the operand is known
    always, _ = jax.lax.optimization_barrier((jnp.asarray(True), jax.lax.stop_gradient(traced[0])))
    return jax.lax.cond(always, f, lambda *_: jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes), *operands)
