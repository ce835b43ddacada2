"""Lanes: 3-vectors and 3 by 3 matrices as tuples of scalars.

A *lane* is one scalar of an algorithm. It is a *literal*, a Python float, if its value is a
compile-time constant (a structural zero, a one, a constant of a model that is closed over).
Otherwise it is an array of shape () or (batch,). Products with a literal 0 or 1 vanish while
tracing. The program contains no `dot`, so float32 products have full precision on every device.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

Lane = Any  # a Python float, or an array of shape () or (batch,)
Tracer = jax.core.Tracer


def is_literal(x: Lane) -> bool:
    """Return True if the lane is a literal, a compile-time constant."""
    return isinstance(x, (int, float))


def is_zero(x: Lane) -> bool:
    """Return True if the lane is a structural zero."""
    return isinstance(x, (int, float)) and x == 0


def safe_sqrt(x: Lane) -> Lane:
    """Compute sqrt(x), or 0 if x <= 0, with the derivative 0 there. A literal stays a literal."""
    if is_literal(x):
        return math.sqrt(max(x, 0.0))
    x = jnp.asarray(x)
    none = x <= 0
    root = jnp.sqrt(lax.select(none, jnp.ones_like(x), x))
    return lax.select(none, jnp.zeros_like(x), root)


def neg(a: Lane) -> Lane:
    """Compute -a. A structural zero stays one."""
    return 0.0 if is_zero(a) else -a


def _typed(a: Lane, b: Lane) -> tuple[Lane, Lane] | None:
    """Return both lanes as operands of a `lax` primitive, or None if they need promotion."""
    if isinstance(a, Tracer):
        if isinstance(b, Tracer):
            return (a, b) if a.dtype == b.dtype and a.shape == b.shape else None
        return (a, a.dtype.type(b)) if type(b) is float and _is_floating(a) else None
    if type(a) is float and isinstance(b, Tracer) and _is_floating(b):
        return b.dtype.type(a), b
    return None


def _is_floating(a: Any) -> bool:
    return a.dtype.kind == "f" and not a.weak_type


def add(a: Lane, b: Lane) -> Lane:
    """Compute a + b. Structural zeros are not added."""
    if is_zero(a):
        return b
    if is_zero(b):
        return a
    both = _typed(a, b)
    return a + b if both is None else lax.add(*both)


def sub(a: Lane, b: Lane) -> Lane:
    """Compute a - b. Structural zeros are not subtracted."""
    if is_zero(b):
        return a
    if is_zero(a):
        return neg(b)
    both = _typed(a, b)
    return a - b if both is None else lax.sub(*both)


def mul(a: Lane, b: Lane) -> Lane:
    """Compute the product a b. Products with a literal 0, 1 or -1 are not evaluated."""
    if is_literal(b) and not is_literal(a):
        a, b = b, a
    if is_literal(a):
        if a == 0:
            return 0.0
        if a == 1:
            return b
        if a == -1:
            return neg(b)
    if is_zero(b):
        return 0.0
    both = _typed(a, b)
    return a * b if both is None else lax.mul(*both)


def total(terms: Any) -> Lane:
    """Sum the lanes from left to right."""
    out: Lane = 0.0
    for term in terms:
        out = add(out, term)
    return out


def inner(a: Any, b: Any) -> Lane:
    """Compute the inner product of two sequences of lanes of equal length."""
    out: Lane = 0.0
    for x, y in zip(a, b, strict=True):
        out = add(out, mul(x, y))
    return out


class Lanes:
    """A tuple of lanes as a pytree, with entrywise + and - and multiplication by a lane."""

    __slots__ = ("_lanes",)
    _lanes: tuple[Lane, ...]

    def __init__(self, *lanes: Lane):
        self._lanes = lanes

    def __init_subclass__(cls) -> None:
        jax.tree_util.register_pytree_node(cls, lambda v: (v._lanes, None), lambda _, c: cls(*c))

    def __iter__(self):
        return iter(self._lanes)

    def __getitem__(self, i: int) -> Lane:
        return self._lanes[i]

    def __add__(self, other):
        return type(self)(*(add(a, b) for a, b in zip(self, other, strict=True)))

    def __radd__(self, other):
        return self + other if hasattr(other, "shape") else NotImplemented  # array + Lanes

    def __sub__(self, other):
        return type(self)(*(sub(a, b) for a, b in zip(self, other, strict=True)))

    def __rsub__(self, other):
        return -self + other if hasattr(other, "shape") else NotImplemented

    def __neg__(self):
        return type(self)(*map(neg, self))

    def __mul__(self, scalar: Lane):
        return type(self)(*(mul(scalar, a) for a in self))

    __rmul__ = __mul__

    def __repr__(self) -> str:
        return f"{type(self).__name__}{self._lanes}"


class Vec3(Lanes):
    """A 3-vector (x, y, z) of lanes."""

    __slots__ = ()

    @classmethod
    def zero(cls) -> Vec3:
        return cls(0.0, 0.0, 0.0)

    def dot(self, other: Vec3) -> Lane:
        return inner(self, other)

    def cross(self, other: Vec3) -> Vec3:
        (a, b, c), (x, y, z) = self, other
        return Vec3(sub(mul(b, z), mul(c, y)), sub(mul(c, x), mul(a, z)), sub(mul(a, y), mul(b, x)))

    def __mul__(self, scalar: Lane):
        known = getattr(scalar, "shape", ()) == (3,) and not isinstance(scalar, Tracer)
        if known and all(jnp.ndim(x) == 0 for x in self):  # no lane has a batch of 3
            raise TypeError("Vec3 * (3,): expected a scalar; use dot or cross for two vectors")
        return Vec3(*(mul(scalar, a) for a in self))

    __rmul__ = __mul__

    def entrywise(self, other: Iterable[Lane]) -> Vec3:
        """Compute the entrywise product with another vector."""
        return Vec3(*map(mul, self, other))

    def norm(self, least: float = 0.0) -> Lane:
        """Compute sqrt(|v|^2 + least^2), which is smooth at v = 0 if least > 0."""
        return jnp.sqrt(self.dot(self) + least * least)

    @property
    def array(self) -> jax.Array:
        """The vector as an array (3,)."""
        return jnp.stack([jnp.asarray(x) for x in self])


class Mat3(Lanes):
    """A 3 by 3 matrix of lanes, row by row."""

    __slots__ = ()

    @classmethod
    def identity(cls) -> Mat3:
        return cls(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

    @classmethod
    def zero(cls) -> Mat3:
        return cls(*(0.0,) * 9)

    @classmethod
    def skew(cls, r: Vec3) -> Mat3:
        """Return the cross-product matrix [r], with [r] a = r x a."""
        x, y, z = r
        return cls(0.0, neg(z), y, z, 0.0, neg(x), neg(y), x, 0.0)

    @property
    def rows(self) -> tuple[Vec3, Vec3, Vec3]:
        m = self._lanes
        return Vec3(*m[0:3]), Vec3(*m[3:6]), Vec3(*m[6:9])

    @property
    def columns(self) -> tuple[Vec3, Vec3, Vec3]:
        m = self._lanes
        return Vec3(*m[0::3]), Vec3(*m[1::3]), Vec3(*m[2::3])

    @property
    def T(self) -> Mat3:
        m = self._lanes
        return Mat3(*m[0::3], *m[1::3], *m[2::3])

    def __matmul__(self, other):
        if isinstance(other, Vec3):
            return Vec3(*map(inner, self.rows, (other,) * 3))
        columns = (other.dense if isinstance(other, Sym3) else other).columns
        rows = [row for row in self.rows for _ in columns]
        return Mat3(*map(inner, rows, columns * 3))


class Sym3(Lanes):
    """A symmetric 3 by 3 matrix of lanes, in the order xx, yy, zz, xy, xz, yz."""

    __slots__ = ()

    @classmethod
    def zero(cls) -> Sym3:
        return cls(*(0.0,) * 6)

    @classmethod
    def upper(cls, m: Mat3) -> Sym3:
        """Return the symmetric matrix with the same upper triangle as m."""
        return cls(m[0], m[4], m[8], m[1], m[2], m[5])

    @classmethod
    def outer(cls, a: Vec3, b: Vec3) -> Sym3:
        """Return a b^T, which must be symmetric."""
        return cls(*(mul(a[i], b[j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))))

    @property
    def isotropic(self) -> bool:
        """True if the matrix is structurally a multiple of the identity."""
        xx, yy, zz, *rest = self
        one = xx is yy and yy is zz
        one = one or (is_literal(xx) and is_literal(yy) and is_literal(zz) and xx == yy == zz)
        return one and all(is_zero(x) for x in rest)

    @property
    def dense(self) -> Mat3:
        xx, yy, zz, xy, xz, yz = self
        return Mat3(xx, xy, xz, xy, yy, yz, xz, yz, zz)

    def __matmul__(self, v: Vec3) -> Vec3:
        return self.dense @ v

    def rotated(self, R: Mat3) -> Sym3:
        """Compute R S R^T."""
        if self.isotropic:
            return self
        half = (R @ self).rows
        r = R.rows
        return Sym3(
            half[0].dot(r[0]), half[1].dot(r[1]), half[2].dot(r[2]),
            half[0].dot(r[1]), half[0].dot(r[2]), half[1].dot(r[2]),
        )  # fmt: skip


def rotation_z(c: Lane, s: Lane) -> Mat3:
    """Return the rotation about z by an angle, from its cosine and sine."""
    return Mat3(c, neg(s), 0.0, s, c, 0.0, 0.0, 0.0, 1.0)


def quaternion_matrix(w: Lane, x: Lane, y: Lane, z: Lane) -> Mat3:
    """Compute the rotation matrix of a quaternion (w, u) of any nonzero length.
    R = 1 + (2 / |q|^2) (w [u] + [u][u])"""
    s = 2.0 / (w * w + x * x + y * y + z * z)
    sx, sy, sz = s * x, s * y, s * z
    wx, wy, wz = w * sx, w * sy, w * sz
    xx, xy, xz = x * sx, x * sy, x * sz
    yy, yz, zz = y * sy, y * sz, z * sz
    return Mat3(
        1.0 - (yy + zz), xy - wz, xz + wy,
        xy + wz, 1.0 - (xx + zz), yz - wx,
        xz - wy, yz + wx, 1.0 - (xx + yy),
    )  # fmt: skip


def as_arrays(tree: Any, like: jax.Array) -> Any:
    """Convert all lanes to arrays, broadcast with the shape of `like`, for the carry of a loop."""

    def array(x: Lane) -> jax.Array:
        x = jnp.asarray(x, like.dtype)
        return jnp.broadcast_to(x, jnp.broadcast_shapes(x.shape, like.shape))

    return jax.tree.map(array, tree)
