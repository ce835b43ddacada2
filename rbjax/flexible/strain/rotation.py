"""The rotation of a section over a cell of a beam, R' = R [k] (derivative by arclength), on lanes.

    R_b = R_a exp([O]),   O = B_0 - D x E / 240                     (Magnus expansion of order 6)
    C = -a_1 x a_2,   D = C - 20 a_1 - a_3,   E = a_2 + a_1 x (2 a_3 + C) / 60

B_0, a_1, a_2, a_3 are moments of the curvature k over the cell (`basis.cell_moments`). If k has a
constant direction, O = B_0 is exact. The expansion converges if int |k| ds < pi over the cell
(Blanes, Casas, Oteo & Ros, *The Magnus expansion and some of its applications*, 2009). Here
R' = R [k] has k on the right, so that the commutator of k and l is -k x l.

The derivatives of exp([O]) are written with Stumpff's functions c_k of x = O.O:

    exp([O]) = 1 + c_1 [O] + c_2 [O]^2,   w = J O',   J = 1 + c_2 [O] + c_3 [O]^2

where w is the angular velocity in the axes of the start of the cell. c_4 and c_5 are evaluated as
series, which hold all digits for angles to 4 rad. The others follow by c_k = 1/k! - x c_{k+2}.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes import Lane, Mat3, Vec3, add, horner, is_literal, mul, sub


class Magnus(NamedTuple):
    """The Magnus expansion of a cell and its intermediate values: F = 2 a_3 + C."""

    a1: Vec3
    a2: Vec3
    D: Vec3
    E: Vec3
    F: Vec3
    angle: Vec3

    def rate(self, moments: tuple[Vec3, Vec3, Vec3, Vec3]) -> MagnusRate:
        """Compute the derivative of O along a change of the moments B_0, a_1, a_2, a_3."""
        b, d1, d2, d3 = moments
        C = self.a2.cross(d1) - self.a1.cross(d2)
        F = d3 * 2.0 + C
        D = C - d1 * 20.0 - d3
        E = d2 + (d1.cross(self.F) + self.a1.cross(F)) * (1 / 60)
        angle = b - (D.cross(self.E) + self.D.cross(E)) * (1 / 240)
        return MagnusRate(d1, d2, D, E, F, angle)

    def second_rate(self, r: MagnusRate) -> Vec3:
        """Compute the second derivative of O along a straight line of moments."""
        C = r.a1.cross(r.a2) * -2.0
        E = (r.a1.cross(r.F) * 2.0 + self.a1.cross(C)) * (1 / 60)
        return (C.cross(self.E) + r.D.cross(r.E) * 2.0 + self.D.cross(E)) * (-1 / 240)


class MagnusRate(NamedTuple):
    """The derivatives of the values of `Magnus`."""

    a1: Vec3
    a2: Vec3
    D: Vec3
    E: Vec3
    F: Vec3
    angle: Vec3


def magnus(B0: Vec3, a1: Vec3, a2: Vec3, a3: Vec3) -> Magnus:
    """Compute the rotation vector O of a cell from moments of its curvature."""
    C = a2.cross(a1)
    F = a3 * 2.0 + C
    D, E = C - a1 * 20.0 - a3, a2 + a1.cross(F) * (1 / 60)
    return Magnus(a1, a2, D, E, F, B0 - D.cross(E) * (1 / 240))


class Stumpff(NamedTuple):
    """Stumpff's functions c_1 to c_5 of the square of an angle."""

    c1: Lane
    c2: Lane
    c3: Lane
    c4: Lane
    c5: Lane


def stumpff_series(x: Lane) -> Stumpff:
    """Compute c_1 to c_5 of x = angle^2, accurate for angles to 4 rad, smooth everywhere."""
    c4, c5 = _c4_and_c5(jnp.asarray(x))
    c2, c3 = sub(0.5, mul(x, c4)), sub(1 / 6, mul(x, c5))
    return Stumpff(sub(1.0, mul(x, c3)), c2, c3, c4, c5)


def _series(k: int, x: jax.Array) -> Lane:
    terms = 14 if x.dtype == jnp.float64 else 8
    return horner([(-1) ** j / math.factorial(2 * j + k) for j in range(terms)], x)


@jax.custom_jvp
def _c4_and_c5(x: jax.Array) -> tuple[Lane, Lane]:
    return _series(4, x), _series(5, x)


@_c4_and_c5.defjvp
def _(primals: tuple, tangents: tuple) -> tuple:
    """dc_k/dx = (k c_{k+2} - c_{k+1}) / 2: no intermediate value of the series is stored."""
    (x,), (rate,) = primals, tangents
    c6, c7 = _series(6, x), _series(7, x)
    c4, c5 = 1 / 24 - x * c6, 1 / 120 - x * c7
    return (c4, c5), ((2.0 * c6 - 0.5 * c5) * rate, (2.5 * c7 - 0.5 * c6) * rate)


def exponential(angle: Vec3, c: Stumpff) -> Mat3:
    """Compute exp([O])."""
    return _polynomial(c.c1, c.c2, angle)


def left_jacobian(angle: Vec3, c: Stumpff) -> Mat3:
    """Compute J, which maps O' to the angular velocity in the axes of the start of the cell."""
    return _polynomial(c.c2, c.c3, angle)


def angular_velocity(angle: Vec3, rate: Vec3, c: Stumpff) -> Vec3:
    """Compute w = J O', in the axes of the start of the cell."""
    y = angle.cross(rate)
    return rate + y * c.c2 + angle.cross(y) * c.c3


def angular_acceleration(angle: Vec3, rate: Vec3, second: Vec3, c: Stumpff) -> Vec3:
    """Compute w', in the axes of the start of the cell, from O, O' and O''."""
    y, dy = angle.cross(rate), angle.cross(second)
    z, dz = angle.cross(y), rate.cross(y) + angle.cross(dy)
    speed = mul(2.0, angle.dot(rate))
    c2_rate = mul(speed, sub(c.c4, mul(0.5, c.c3)))
    c3_rate = mul(speed, sub(mul(1.5, c.c5), mul(0.5, c.c4)))
    return second + dy * c.c2 + dz * c.c3 + y * c2_rate + z * c3_rate


def rotation_about(axis: int, angle: Lane, c: Lane, s: Lane) -> Mat3:
    """Return the rotation about the axis x, y or z (0, 1, 2) from its cosine and sine."""
    if is_literal(angle) and angle == 0:
        return Mat3.identity()
    i, j = (axis + 1) % 3, (axis + 2) % 3
    m = [0.0] * 9
    m[4 * axis] = 1.0
    m[4 * i], m[4 * j], m[3 * i + j], m[3 * j + i] = c, c, -s, s
    return Mat3(*m)


def _polynomial(b: Lane, c: Lane, v: Vec3) -> Mat3:
    """Compute 1 + b [v] + c [v]^2."""
    x, y, z = v
    cx, cy, cz = v * c
    bx, by, bz = v * b
    xx, yy, zz = mul(cx, x), mul(cy, y), mul(cz, z)
    xy, xz, yz = mul(cx, y), mul(cx, z), mul(cy, z)
    return Mat3(
        sub(1.0, add(yy, zz)), sub(xy, bz), add(xz, by),
        add(xy, bz), sub(1.0, add(xx, zz)), sub(yz, bx),
        sub(xz, by), add(yz, bx), sub(1.0, add(xx, yy)),
    )  # fmt: skip
