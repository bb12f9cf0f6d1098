"""Three-vectors, 3x3 matrices and quaternions, held by components.

Every component is a number of its own, so that the compiler sees nothing but element-wise arithmetic, which it fuses and
vectorises: in a batch several times faster than arrays of shape (3,) and (3, 3).

May import: nothing of ours.
"""

from __future__ import annotations

from typing import Any, NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import numpy as np


def _undefined(a, operator: str, b, instead: str) -> NoReturn:
    names = [type(v).__name__ if isinstance(v, tuple) else "number" if not jnp.ndim(v) else "array" for v in (a, b)]
    raise TypeError(f"`{names[0]} {operator} {names[1]}` is not defined: {instead}.")


def _same(a, operator: str, b) -> None:
    if type(a) is not type(b):
        _undefined(a, operator, b, f"`{operator}` takes two operands of one type")


def _number(a, operator: str, s, instead: str) -> None:
    if isinstance(s, (tuple, list)):
        _undefined(a, operator, s, instead)


class Vec3(NamedTuple):
    """A vector, components of one shape: ``+ -`` with vectors, ``* /`` with numbers, ``@`` is the dot product."""

    x: Any
    y: Any
    z: Any

    __array_ufunc__ = None  # a NumPy scalar on the left must defer to us instead of making an array

    @classmethod
    def of(cls, a) -> Vec3:
        """The vector of an array-like with three rows."""
        x, y, z = a
        return cls(x, y, z)

    def __add__(self, v):
        _same(self, "+", v)
        return Vec3(self.x + v.x, self.y + v.y, self.z + v.z)

    def __sub__(self, v):
        _same(self, "-", v)
        return Vec3(self.x - v.x, self.y - v.y, self.z - v.z)

    def __neg__(self):
        return Vec3(-self.x, -self.y, -self.z)

    def __mul__(self, s):
        _number(self, "*", s, "`a @ b` is the dot product, `cross(a, b)` the vector product, `m @ v` turns a vector")
        return Vec3(self.x * s, self.y * s, self.z * s)

    def __rmul__(self, s):
        return self * s

    def __truediv__(self, s):
        _number(self, "/", s, "a vector is divided by numbers only")
        return self * (1 / s)

    def __matmul__(self, v):
        _same(self, "@", v)
        return self.x * v.x + self.y * v.y + self.z * v.z


class Mat3(NamedTuple):
    """A matrix by rows, three `Vec3` of one shape: ``@`` with `Mat3` and `Vec3`, ``+ -`` with `Mat3`, ``* /`` with numbers."""

    x: Vec3
    y: Vec3
    z: Vec3

    __array_ufunc__ = None

    @classmethod
    def of(cls, a) -> Mat3:
        """The matrix of an array-like (3, 3)."""
        return cls(*(Vec3.of(row) for row in a))

    def __add__(self, m):
        _same(self, "+", m)
        return Mat3(self.x + m.x, self.y + m.y, self.z + m.z)

    def __sub__(self, m):
        _same(self, "-", m)
        return Mat3(self.x - m.x, self.y - m.y, self.z - m.z)

    def __neg__(self):
        return Mat3(-self.x, -self.y, -self.z)

    def __mul__(self, s):
        _number(self, "*", s, "`m @ v` and `m @ m` are the products of matrices")
        return Mat3(self.x * s, self.y * s, self.z * s)

    def __rmul__(self, s):
        return self * s

    def __truediv__(self, s):
        _number(self, "/", s, "`inverse(m)` is the inverse; a matrix is divided by numbers only")
        return self * (1 / s)

    def __matmul__(self, other) -> Any:
        if isinstance(other, Mat3):
            columns = other.T
            return Mat3(*(Vec3(row @ columns.x, row @ columns.y, row @ columns.z) for row in self))
        if not isinstance(other, Vec3):
            _undefined(self, "@", other, "a matrix multiplies a Vec3 or a Mat3")
        return Vec3(self.x @ other, self.y @ other, self.z @ other)

    @property
    def T(self):
        """The transpose."""
        return Mat3(*(Vec3(*column) for column in zip(*self)))


class Quat(NamedTuple):
    """A quaternion, scalar first, components of one shape: ``*`` is the Hamilton product or a factor, ``@`` the product of four components."""

    w: Any
    x: Any
    y: Any
    z: Any

    __array_ufunc__ = None

    @classmethod
    def of(cls, a) -> Quat:
        """The quaternion of an array-like with four rows, scalar first."""
        w, x, y, z = a
        return cls(w, x, y, z)

    @property
    def v(self):
        """The vector part."""
        return Vec3(self.x, self.y, self.z)

    def __add__(self, p):
        _same(self, "+", p)
        return Quat(*(a + b for a, b in zip(self, p)))

    def __sub__(self, p):
        _same(self, "-", p)
        return Quat(*(a - b for a, b in zip(self, p)))

    def __neg__(self):
        return Quat(*(-a for a in self))

    def __mul__(self, p):
        if isinstance(p, Quat):
            v = self.w * p.v + p.w * self.v + cross(self.v, p.v)
            return Quat(self.w * p.w - self.v @ p.v, *v)
        _number(self, "*", p, "`quat_rotate(q, v)` turns a vector")
        return Quat(*(a * p for a in self))

    def __rmul__(self, s):
        return self * s

    def __truediv__(self, s):
        _number(self, "/", s, "`p * quat_conjugate(q)` undoes q; a quaternion is divided by numbers only")
        return self * (1 / s)

    def __matmul__(self, p):
        _same(self, "@", p)
        return self.w * p.w + self.v @ p.v


def _refused(operator: str, instead: str):
    return lambda a, b: _undefined(b, operator, a, instead) if operator == "+" else _undefined(a, operator, b, instead)


_NOT_OF_TUPLES = [("__radd__", "+", "`+` takes two operands of one type; a sum starts as in `sum(vectors, zeros())`")]
_NOT_OF_TUPLES += [
    (name, operator, "there is no order; compare `norm(v)` or components")
    for name, operator in (("__lt__", "<"), ("__le__", "<="), ("__gt__", ">"), ("__ge__", ">="))
]
for _kind in (Vec3, Mat3, Quat):  # what a tuple does with these operators is no algebra: it puts together, and sorts
    for _name, _operator, _instead in _NOT_OF_TUPLES:
        setattr(_kind, _name, _refused(_operator, _instead))


def array(v) -> jax.Array:
    """`Vec3`, `Quat` or `Mat3` as an array of shape (3,), (4,) or (3, 3)."""
    if isinstance(v, Mat3):
        return jnp.stack([array(row) for row in v])
    return jnp.stack(jnp.broadcast_arrays(*v))


def largest(v: Vec3):
    """Largest magnitude of the three components."""
    return jnp.max(jnp.abs(array(v)), axis=0)


def zeros() -> Vec3:
    """The vector of zeros."""
    return Vec3(0.0, 0.0, 0.0)


def where(condition, a, b):
    """a where the condition holds, otherwise b: for vectors, quaternions, matrices and any other tree."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def diagonal(d) -> Mat3:
    """The diagonal matrix of three numbers or a `Vec3`."""
    x, y, z = d
    o = jnp.zeros_like(x)
    return Mat3(Vec3(x, o, o), Vec3(o, y, o), Vec3(o, o, z))


def scaled_identity(s: Any = 1.0) -> Mat3:
    """s I, the unit matrix by default."""
    return diagonal((s, s, s))


def cross(a: Vec3, b: Vec3) -> Vec3:
    """Vector product a x b."""
    return Vec3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


def skew(v: Vec3) -> Mat3:
    """The matrix [v x] of the vector product, [v x] a = v x a."""
    o = jnp.zeros_like(v.x)
    return Mat3(Vec3(o, -v.z, v.y), Vec3(v.z, o, -v.x), Vec3(-v.y, v.x, o))


def outer(a: Vec3, b: Vec3) -> Mat3:
    """The dyadic product a b'."""
    return Mat3(a.x * b, a.y * b, a.z * b)


def det(m: Mat3):
    """Determinant, as the triple product of the rows."""
    return m.x @ cross(m.y, m.z)


def inverse(m: Mat3) -> Mat3:
    """Inverse in closed form, adjugate over determinant; not finite for a singular matrix."""
    columns = Mat3(cross(m.y, m.z), cross(m.z, m.x), cross(m.x, m.y))
    return columns.T / jnp.asarray(m.x @ columns.x)  # a Python zero would raise


# The largest root of a cubic with three real roots is q + 2 p cos(acos(r) / 3). With z = sqrt((1 + r) / 2) the
# cosine is cos(2/3 acos z), analytic up to z = -1, so a polynomial of degree 20 gives it to rounding on [0, 1].
_NODES = np.cos(np.pi * (np.arange(21) + 0.5) / 21)  # Chebyshev's
_THIRD = np.polynomial.chebyshev.cheb2poly(
    np.polynomial.chebyshev.chebfit(_NODES, np.cos(2 / 3 * np.arccos((_NODES + 1) / 2)), 20)
)


def _cos_third(r):
    """cos(acos(r) / 3) for r in [-1, 1]."""
    return polynomial(_THIRD, 2 * safe_sqrt((1 + r) / 2) - 1)


def largest_eigenvalue(m: Mat3):
    """Largest eigenvalue of a symmetric matrix, in closed form; the gradient is finite where eigenvalues coincide."""
    mean = (m.x.x + m.y.y + m.z.z) / 3
    a = m - scaled_identity(mean)
    p = safe_sqrt((a.x @ a.x + a.y @ a.y + a.z @ a.z) / 6)
    a = a / jnp.where(p > 0, p, 1)  # before the determinant, where p^3 would underflow in float32
    return mean + 2 * p * _cos_third(jnp.clip(det(a) / 2, -1, 1))


def largest_eigenvector(K) -> tuple[Any, Quat]:
    """Largest eigenvalue of a symmetric 4x4 matrix, and its unit eigenvector, w >= 0, which is often an attitude.

    K: four rows, each a `Quat`. Newton's method on det(K - x I) = 0 from a bound above all eigenvalues; there
    adj(K - x I) is a multiple of v v', whose longest column, multiplied by it once more, is v. Where the largest
    eigenvalue is a double one, no vector is singled out: NaN.
    """
    size = safe_sqrt(sum(row @ row for row in K))
    rows = [[a / jnp.where(size > 0, size, 1) for a in row] for row in K]
    mean = (rows[0][0] + rows[1][1] + rows[2][2] + rows[3][3]) / 4
    square = sum(a * a for row in rows for a in row) / 4
    above = mean + safe_sqrt(3 * jnp.maximum(square - mean * mean, 0))  # Wolkowicz and Styan, 1980

    def newton(_, x):
        determinant, adjugate = _adjugate(rows, x)
        slope = sum(adjugate[i][i] for i in range(4))
        return x + jnp.where(slope < 0, determinant / jnp.where(slope < 0, slope, 1), 0)

    x = jax.lax.fori_loop(0, 20, newton, jnp.asarray(above, jnp.result_type(float, above)))
    columns = _adjugate(rows, x)[1]
    longest, length = columns[0], jnp.abs(columns[0].w)
    for i in (1, 2, 3):
        longer = jnp.abs(columns[i][i]) > length
        longest, length = where(longer, columns[i], longest), jnp.where(longer, jnp.abs(columns[i][i]), length)
    longest = longest / jnp.sqrt(longest @ longest)
    v = Quat(*(column @ longest for column in columns))
    length, trace = jnp.sqrt(v @ v), sum(columns[i][i] for i in range(4))  # equal if the adjugate has rank one
    single = length > 0.75 * jnp.abs(trace)
    return size * x, v * jnp.where(single, jnp.where(v.w < 0, -1, 1) / length, jnp.nan)


def _adjugate(rows, x):
    """Determinant and adjugate, four `Quat`, of K - x I for a symmetric K, by the minors of its upper and lower half."""
    (a, b, c, d), (_, e, f, g), (_, _, h, i), (_, _, _, j) = rows
    a, e, h, j = a - x, e - x, h - x, j - x
    s0, s1, s2, s3, s4, s5 = a * e - b * b, a * f - b * c, a * g - b * d, b * f - e * c, b * g - e * d, c * g - f * d
    t0, t1, t2, t3, t4, t5 = c * g - d * f, c * i - d * h, c * j - d * i, f * i - g * h, f * j - g * i, h * j - i * i
    upper = {
        (0, 0): e * t5 - f * t4 + g * t3, (0, 1): -b * t5 + c * t4 - d * t3, (0, 2): g * s5 - i * s4 + j * s3,
        (0, 3): -f * s5 + h * s4 - i * s3, (1, 1): a * t5 - c * t2 + d * t1, (1, 2): -d * s5 + i * s2 - j * s1,
        (1, 3): c * s5 - h * s2 + i * s1, (2, 2): d * s4 - g * s2 + j * s0, (2, 3): -c * s4 + f * s2 - i * s0,
        (3, 3): c * s3 - f * s1 + h * s0,
    }  # fmt: skip
    entry = lambda m, n: upper[min(m, n), max(m, n)]
    determinant = s0 * t5 - s1 * t4 + s2 * t3 + s3 * t2 - s4 * t1 + s5 * t0
    return determinant, [Quat(*(entry(m, n) for n in range(4))) for m in range(4)]


def norm(v):
    """Euclidean length of a `Vec3` or `Quat`; its gradient at zero is zero, not NaN."""
    return safe_sqrt(v @ v)


def safe_sqrt(a):
    """Square root of a >= 0 whose gradient at zero is one, not infinite, so that the one of sqrt(v @ v) is zero.

    The compiler may work a out twice, in one place a rounding above zero: whichever branches it takes, nothing large comes
    of it. Below the least normal number the root is a itself.
    """
    least = jnp.finfo(jnp.result_type(float, a)).tiny
    return jnp.where(a > least, jnp.sqrt(jnp.maximum(a, least)), a)


def polynomial(coefficients, x):
    """Sum of coefficients[k] x^k, by Horner's scheme in the type of x."""
    value = float(coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * x + float(c)
    return value


def columns(axes) -> list[Vec3]:
    """The n axes, `Vec3`, of a tuple or list of them, of one `Vec3` of shape (n,) or of an array (3, n).

    Raises TypeError or ValueError for anything else, a `Mat3` included, whose rows nobody could tell from its columns.
    """
    if isinstance(axes, Vec3):
        if min(map(jnp.ndim, axes)) > 0:
            return [Vec3(*axis) for axis in zip(*axes, strict=True)]
    elif isinstance(axes, (tuple, list)) and not isinstance(axes, Mat3):
        if axes and all(isinstance(a, Vec3) for a in axes):
            return list(axes)
    elif not isinstance(axes, tuple) and hasattr(axes, "shape"):
        if axes.ndim != 2 or axes.shape[0] != 3 or not axes.shape[1]:
            raise ValueError(f"`axes` must have shape (3, n), but it is of shape {axes.shape}.")
        return [Vec3(*axis) for axis in axes.T]
    raise TypeError(f"`axes` must be Vec3, one for each axis, or an array (3, n), but it is {type(axes).__name__}.")


def project(axes, v: Vec3):
    """Components of v along n axes, an array (n,): G w for gyros, W' v for wheels.

    axes: a tuple of `Vec3`, a `Vec3` of shape (n,) or an array (3, n). Raises ValueError or TypeError for anything else.
    """
    return jnp.stack([a @ v for a in columns(axes)])


def resultant(axes, s) -> Vec3:
    """Sum of s[i] along n axes, s of shape (n,): W h for wheels.

    axes: a tuple of `Vec3`, a `Vec3` of shape (n,) or an array (3, n). Raises ValueError or TypeError for anything else,
    and where s has not as many numbers as there are axes.
    """
    vectors = columns(axes)
    if jnp.ndim(s) == 0 or len(s) != len(vectors):
        held = len(s) if jnp.ndim(s) else "one"
        raise ValueError(f"`s` must hold a number for each of the {len(vectors)} axes, but it holds {held}.")
    x, y, z = (sum(a[j] * s[i] for i, a in enumerate(vectors)) for j in range(3))
    return Vec3(x, y, z)
