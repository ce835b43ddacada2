"""Euler angles: all 24 sequences from one set of formulas (Olguin Diaz, 4.2, 4.3; Diebel, 2006).

Intrinsic i-j-k: R = R_i(a) R_j(b) R_k(c), where each rotation is about an axis of the rotated
frame. Extrinsic i-j-k, about fixed axes, is the intrinsic k-j-i with the angles in reverse order.
*Proper* sequences (k = i) are singular at sin b = 0, *Tait-Bryan* sequences (all three axes) at
cos b = 0. At a singularity the first and the third axis are the same line, and only the sum or the
difference of their angles is determined.

Angles are computed from the quaternion (after Bernardes & Viollet, PLoS ONE 17(11), 2022), as two
complex numbers whose phases are half the sum and half the difference of a and c. A rounding error
of a phase changes both angles equally, so the attitude is accurate even next to the singularity.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from rbjax.lanes import Mat3, Vec3, add, mul, neg, safe_sqrt, sincos, sub
from rbjax.rotations.arguments import stacked
from rbjax.rotations.coefficients import angle, away_from_zero, where

AXES = "xyz"
SEQUENCES = ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx", "xyx", "xzx", "yxy", "yzy", "zxz", "zyz")
UNIT = (Vec3(1.0, 0.0, 0.0), Vec3(0.0, 1.0, 0.0), Vec3(0.0, 0.0, 1.0))


@dataclass(frozen=True)
class EulerAngles:
    """A sequence of axes such as "zyx", about rotated (intrinsic) or fixed (extrinsic) axes."""

    sequence: str
    intrinsic: bool

    size = 3

    @property
    def axes(self) -> tuple[int, int, int]:
        """The axes (i, j, k) of the intrinsic sequence."""
        i, j, k = (AXES.index(a) for a in self.sequence)
        return (i, j, k) if self.intrinsic else (k, j, i)

    @property
    def proper(self) -> bool:
        """True if the first axis is also the third."""
        return self.sequence[0] == self.sequence[2]

    @property
    def singular_set(self) -> str:
        where = "a multiple of pi" if self.proper else "an odd multiple of pi/2"
        return f"the second angle is {where}: first and third axis are one line (gimbal lock)"

    def to_quaternion(self, x: list) -> list:
        a, b, c = (_turn(k, t) for k, t in zip(self.axes, self._ordered(x), strict=True))
        return _product(_product(a, b), c)

    def from_quaternion(self, q: list) -> jax.Array:
        """Return the angles as an array (..., 3).

        The second angle is from 0 to pi (proper) or from -pi/2 to pi/2, and the first and the third
        are from -pi to pi.
        """
        i, j, _ = self.axes
        l = 3 - i - j
        sign = 1.0 if (j - i) % 3 == 1 else -1.0  # e_i x e_j = sign e_l
        w, u = q[0], q[1:]
        if self.proper:
            w, x, y, z = w, u[i], u[j], sign * u[l]
        else:  # R R_j(+-pi/2) is a proper sequence i-j-i, with third angle -c
            w, x, y, z = w - sign * u[j], u[i] - u[l], sign * u[j] + w, u[l] + u[i]
        # w + i x = cos(b/2) e^(i (a + c)/2) and y + i z = sin(b/2) e^(i (a - c)/2), either of which
        # is zero at a singularity; below `least` a phase does not matter, and its squares underflow
        sum_square, difference_square = w * w + x * x, y * y + z * z
        least = 1e-280 if w.dtype == jnp.float64 else 1e-30
        sums, differs = sum_square > least, difference_square > least
        w, x = where(sums, w, 1.0), where(sums, x, 0.0)
        y, z = where(differs, y, 1.0), where(differs, z, 0.0)
        sine = [x * y + w * z, safe_sqrt(difference_square), x * y - w * z]
        cosine = [w * y - x * z, safe_sqrt(sum_square), w * y + x * z]
        factor, shift = [1.0, 2.0, 1.0], [0.0, 0.0, 0.0]
        if not self.proper:
            factor, shift[1] = [1.0, 2 * sign, -1.0], -sign * jnp.pi / 2
        out = angle(stacked(self._ordered(sine)), stacked(self._ordered(cosine)))
        factor, shift = self._ordered(factor), self._ordered(shift)
        return out * jnp.array(factor, out.dtype) + jnp.array(shift, out.dtype)

    def body_rate(self, x: list) -> list:
        return self._columns(self._body_axes(x))

    def space_rate(self, x: list) -> list:
        return self._columns(self._space_axes(x))

    def inverse_body_rate(self, x: list) -> list:
        return self._inverse(x, self._body_axes(x))

    def inverse_space_rate(self, x: list) -> list:
        return self._inverse(x, self._space_axes(x))

    def distance(self, x: list) -> jax.Array:
        """Return the angle, from 0 to pi/2, of the smallest rotation to a singular attitude."""
        cosine, sine = map(jnp.abs, sincos(x[1]))
        return jnp.arctan2(sine, cosine) if self.proper else jnp.arctan2(cosine, sine)

    # The three axes of rotation are the columns of the rate matrix. The first and the third are
    # orthogonal to the second. The triple product of all three is zero at a singularity.

    def _ordered(self, x: list) -> list:
        return list(x) if self.intrinsic else list(x)[::-1]

    def _body_axes(self, x: list) -> tuple[Vec3, Vec3, Vec3]:
        i, j, k = self.axes
        _, b, c = self._ordered(x)
        first, second = _rotation(j, b), _rotation(k, c).T
        return second @ (first.T @ UNIT[i]), second @ UNIT[j], UNIT[k]

    def _space_axes(self, x: list) -> tuple[Vec3, Vec3, Vec3]:
        i, j, k = self.axes
        a, b, _ = self._ordered(x)
        first, second = _rotation(i, a), _rotation(j, b)
        return UNIT[i], first @ UNIT[j], first @ (second @ UNIT[k])

    def _columns(self, columns: tuple[Vec3, Vec3, Vec3]) -> list:
        u, v, w = columns if self.intrinsic else columns[::-1]
        return [x for row in zip(u, v, w, strict=True) for x in row]

    def _inverse(self, x: list, columns: tuple[Vec3, Vec3, Vec3]) -> list:
        u, v, w = columns
        i, j, k = self.axes
        volume = (_rotation(j, x[1]).T @ UNIT[i]).dot(UNIT[j].cross(UNIT[k]))
        scale = 1 / away_from_zero(volume)
        rows = [scale * v.cross(w), v, scale * u.cross(v)]
        return [x for row in self._ordered(rows) for x in row]


def _turn(axis: int, angle: jax.Array) -> list:
    """Return the quaternion of a rotation about one axis, with structural zeros."""
    cosine, sine = sincos(angle / 2)
    return [cosine, *(sine if axis == k else 0.0 for k in range(3))]


def _rotation(axis: int, angle: jax.Array) -> Mat3:
    c, s = sincos(angle)
    rows: list[list] = [[1.0 if i == j == axis else 0.0 for j in range(3)] for i in range(3)]
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rows[i][i], rows[j][j], rows[i][j], rows[j][i] = c, c, neg(s), s
    return Mat3(*(x for row in rows for x in row))


def _product(p: list, q: list) -> list:
    """Compute the quaternion product p q, without the arithmetic of structural zeros."""
    a, b = Vec3(*p[1:]), Vec3(*q[1:])
    return [sub(mul(p[0], q[0]), a.dot(b)), *map(add, p[0] * b + q[0] * a, a.cross(b))]
