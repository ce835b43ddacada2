"""Attitude in more than three numbers: quaternion, axis and angle, matrix, two of its columns.

Any representation with three parameters has singularities (Stuelpnagel, 1964). More parameters with
constraints can avoid them. x may violate the constraints slightly. E(x) x' ignores the part of x'
that only changes the constraints, and the inverse map E^-1 returns an x' that preserves them.
E E^-1 = 1, and E^-1 E is the projection onto the constraints.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.lanes import Mat3, Vec3, quaternion_matrix, safe_sqrt, sincos
from rbjax.rotations import quaternion
from rbjax.rotations.coefficients import (
    angle,
    arctan_over,
    away_from_zero,
    polynomial,
    where,
)


class _Global:
    """A representation without singularities."""

    singular_set = "none"

    def distance(self, x: list) -> jax.Array:
        return jnp.full_like(x[0], jnp.inf)


class UnitQuaternion(_Global):
    """Euler-Rodrigues parameters w, x, y, z, or x, y, z, w (`scalar_last`)."""

    size = 4

    def __init__(self, scalar_last: bool = False):
        self.scalar_last = scalar_last

    def to_quaternion(self, x: list) -> list:
        return [x[3], *x[:3]] if self.scalar_last else list(x)

    def from_quaternion(self, q: list) -> list:
        """Return the unit quaternion with w >= 0."""
        scale = jax.lax.rsqrt(sum(a * a for a in q))
        scale = where(q[0] < 0, -scale, scale)
        return self._ordered([scale * a for a in q])

    def body_rate(self, x: list) -> list:
        """Return E (3, 4), by rows, of omega_body = E x' = 2 (w u' - w' u - u x u')."""
        return self._rate(x, -1.0)

    def space_rate(self, x: list) -> list:
        """Return E (3, 4), by rows, of omega_space = E x' = 2 (w u' - w' u + u x u')."""
        return self._rate(x, 1.0)

    def inverse_body_rate(self, x: list) -> list:
        """Return E^-1 (4, 3), by rows: w' = -u.omega/2, u' = (w omega + u x omega)/2."""
        return self._inverse(x, 1.0)

    def inverse_space_rate(self, x: list) -> list:
        """Return E^-1 (4, 3), by rows: w' = -u.omega/2, u' = (w omega - u x omega)/2."""
        return self._inverse(x, -1.0)

    def _rate(self, x: list, side: float) -> list:
        q = self.to_quaternion(x)
        scale = 2 / sum(a * a for a in q)
        w, *u = (scale * a for a in q)
        cross = polynomial(w, side, 0.0, u)
        rows = [[-u[k], *cross[3 * k : 3 * k + 3]] for k in range(3)]
        return [a for row in rows for a in self._ordered(row)]

    def _inverse(self, x: list, side: float) -> list:
        w, *u = (a / 2 for a in self.to_quaternion(x))
        cross = polynomial(w, side, 0.0, u)
        rows = [[-a for a in u], *(cross[3 * k : 3 * k + 3] for k in range(3))]
        return [a for row in self._ordered(rows) for a in row]

    def _ordered(self, four: list) -> list:
        return [*four[1:], four[0]] if self.scalar_last else list(four)


class AxisAngle:
    """Unit axis n and angle phi: omega_space = phi' n + sin phi n' + (1 - cos phi) n x n'.

    In this formula n' is the part of n' that is orthogonal to n, -[n]^2 n'.
    """

    size = 4
    singular_set = "a multiple of a full turn: the axis is undetermined"

    def to_quaternion(self, x: list) -> list:
        *n, phi = x
        c, s = sincos(phi / 2)
        return [c * safe_sqrt(sum(a * a for a in n)), *(s * a for a in n)]

    def from_quaternion(self, q: list) -> list:
        """Return axis and angle, from 0 to pi. The axis is x if the angle is 0."""
        w, *u = q
        sign = where(w < 0, -jnp.ones_like(w), jnp.ones_like(w))
        square = sum(a * a for a in u)
        largest = jnp.maximum(jnp.abs(u[0]), jnp.maximum(jnp.abs(u[1]), jnp.abs(u[2])))
        turns = largest > 0
        # divided by its largest entry first: the square of a small axis would underflow
        u = [where(turns, a, b) for a, b in zip(u, (1.0, 0.0, 0.0), strict=True)]
        by = sign / jax.lax.stop_gradient(where(turns, largest, 1.0))
        v = [a * by for a in u]
        shrink = jax.lax.rsqrt(sum(a * a for a in v))
        return [*(a * shrink for a in v), 2 * safe_sqrt(square) * arctan_over(w * sign, square)]

    def body_rate(self, x: list) -> list:
        return self._rate(x, -1.0)

    def space_rate(self, x: list) -> list:
        return self._rate(x, 1.0)

    def inverse_body_rate(self, x: list) -> list:
        """Return the matrix (4, 3) from the body rate omega to (n', phi') at x = (n, phi), by rows.

        phi' = n.omega,    n' = (cot(phi/2) (omega - n phi') + n x omega) / 2
        """
        return self._inverse(x, 0.5)

    def inverse_space_rate(self, x: list) -> list:
        return self._inverse(x, -0.5)

    def distance(self, x: list) -> jax.Array:
        c, s = sincos(x[3] / 2)
        return 2 * angle(jnp.abs(s), jnp.abs(c))

    def _rate(self, x: list, side: float) -> list:
        *n, phi = x
        c, s = sincos(phi / 2)
        turn = polynomial(0.0, side * 2 * s * s, -2 * s * c, n)
        return [a for k in range(3) for a in (*turn[3 * k : 3 * k + 3], n[k])]

    def _inverse(self, x: list, side: float) -> list:
        *n, phi = x
        c, s = sincos(phi / 2)
        half = 0.5 * c / away_from_zero(s)
        # cot/2 (1 - n n^T) = -cot/2 [n]^2 of a unit n
        return [*polynomial(0.0, side, -half, n), *n]


class RotationMatrix(_Global):
    """The nine entries of a rotation matrix, row by row, with [omega_body] = R^T R'."""

    size = 9

    def to_quaternion(self, x: list) -> list:
        return quaternion.from_matrix_lanes(list(x))

    def from_quaternion(self, q: list) -> list:
        return list(quaternion_matrix(*q))

    def body_rate(self, x: list) -> list:
        """Return the rate matrix E (3, 9), by rows, of omega_body = E x'. Its first row is omega_1
        = (c_3.c_2' - c_2.c_3') / 2, with the columns c_i of R; the others are cyclic."""
        u, v, w = (0.5 * column for column in Mat3(*x).columns)
        o = Vec3.zero()
        rows = ((o, w, -v), (-w, o, u), (v, -u, o))
        return [a for row in rows for entry in zip(*row, strict=True) for a in entry]

    def space_rate(self, x: list) -> list:
        """Return the rate matrix E (3, 9), by rows, of omega_space = E x'. Its first row is omega_1
        = (r_2.r_3' - r_3.r_2') / 2, with the rows r_i of R; the others are cyclic."""
        u, v, w = (0.5 * row for row in Mat3(*x).rows)
        o = Vec3.zero()
        rows = ((o, -w, v), (w, o, -u), (-v, u, o))
        return [a for row in rows for entry in row for a in entry]

    def inverse_body_rate(self, x: list) -> list:
        """Return the matrix (9, 3), by rows, from omega_body to the entries of R' = R [omega]."""
        return [a for row in Mat3(*x).rows for k in range(3) for a in row.cross(_unit(k)) * -1.0]

    def inverse_space_rate(self, x: list) -> list:
        """Return the matrix (9, 3), by rows, from omega_space to the entries of R' = [omega] R."""
        columns = Mat3(*x).columns
        crossed = [[Mat3.skew(-c).rows[i] for c in columns] for i in range(3)]
        return [a for i in range(3) for row in crossed[i] for a in row]


class TwoColumns:
    """Two vectors that Gram-Schmidt converts to the first two columns of R (Zhou et al., 2019)."""

    size = 6
    singular_set = "the two columns are parallel, or one of them is zero"

    def to_quaternion(self, x: list) -> list:
        columns, _, _ = self._frame(x)
        rows = [entry for row in zip(*columns, strict=True) for entry in row]
        return quaternion.from_matrix_lanes(rows)

    def from_quaternion(self, q: list) -> list:
        first, second, _ = quaternion_matrix(*q).columns
        return [*first, *second]

    def body_rate(self, x: list) -> list:
        """Return the rate matrix (3, 6), by rows, from x' to omega_body. omega_body = (b_3.b_2',
        -b_3.b_1', b_2.b_1'), with the columns b_i of R."""
        (_, b2, b3), (n, m), along = self._frame(x)
        o = Vec3.zero()
        rows = [((-along / (n * m)) * b3, (1 / m) * b3), ((-1 / n) * b3, o), ((1 / n) * b2, o)]
        return [a for row in rows for half in row for a in half]

    def space_rate(self, x: list) -> list:
        (b1, b2, b3), _, _ = self._frame(x)
        flat = self.body_rate(x)
        rows = [flat[6 * i : 6 * i + 6] for i in range(3)]
        R = zip(b1, b2, b3, strict=True)
        return [r[0] * a + r[1] * b + r[2] * c for r in R for a, b, c in zip(*rows, strict=True)]

    def inverse_body_rate(self, x: list) -> list:
        (b1, b2, b3), _, _ = self._frame(x)
        flat = self.inverse_space_rate(x)
        rows = [Vec3(*flat[3 * i : 3 * i + 3]) for i in range(6)]
        return [row.dot(b) for row in rows for b in (b1, b2, b3)]

    def inverse_space_rate(self, x: list) -> list:
        """Return the matrix (6, 3), by rows, from omega_space to a' = omega x a of both vectors."""
        return [a for half in (x[:3], x[3:]) for a in Mat3.skew(-Vec3(*half))]

    def distance(self, x: list) -> jax.Array:
        """Return the angle between the lines of the two vectors, from 0 to pi/2."""
        a, b = Vec3(*x[:3]), Vec3(*x[3:])
        c = a.cross(b)
        return angle(safe_sqrt(c.dot(c)), jnp.abs(a.dot(b)))

    def _frame(self, x: list):
        a1, a2 = Vec3(*x[:3]), Vec3(*x[3:])
        n = away_from_zero(safe_sqrt(a1.dot(a1)))
        b1 = (1 / n) * a1
        along = b1.dot(a2)
        across = a2 - along * b1
        m = away_from_zero(safe_sqrt(across.dot(across)))
        b2 = (1 / m) * across
        return (b1, b2, b1.cross(b2)), (n, m), along


def _unit(k: int) -> Vec3:
    return Vec3(*(1.0 if i == k else 0.0 for i in range(3)))
