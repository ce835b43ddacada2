"""Jacobians of the exponential of SO(3) and of unit quaternions, which are locally the same group.

exp(phi + d) = exp(J_l d) exp(phi) = exp(phi) exp(J_r d) to first order, so that omega_space =
J_l(phi) phi' and omega_body = J_r(phi) phi' (Sola, arXiv:1812.01537, eqs. 143-146):

    J_l = 1 + c_2 [phi] + c_3 [phi]^2,    J_l^-1 = 1 - [phi]/2 + e [phi]^2,    J_r(phi) = J_l(-phi)

They are smooth at phi = 0. The inverses have a genuine pole at |phi| = 2 pi and its multiples.
"""

from __future__ import annotations

import jax

from rbjax.rotations.arguments import entries, stacked, takes
from rbjax.rotations.coefficients import inverse_jacobian_coefficient, stumpff


def polynomial(a, b, c, p: list) -> list:
    """Lanes of a 1 + b [p] + c [p]^2, row by row."""
    x, y, z = p
    bx, by, bz = b * x, b * y, b * z
    xx, yy, zz = c * x * x, c * y * y, c * z * z
    xy, xz, yz = c * x * y, c * x * z, c * y * z
    return [
        a - (yy + zz), xy - bz, xz + by,
        xy + bz, a - (xx + zz), yz - bx,
        xz - by, yz + bx, a - (xx + yy),
    ]  # fmt: skip


def left_lanes(phi: list) -> list:
    """Lanes of J_l."""
    c2, c3 = stumpff(sum(p * p for p in phi), 2, 3)
    return polynomial(1.0, c2, c3, phi)


def inverse_left_lanes(phi: list) -> list:
    """Lanes of J_l^-1."""
    e = inverse_jacobian_coefficient(sum(p * p for p in phi))
    return polynomial(1.0, -0.5, e, phi)


@takes(phi="vector")
def left_jacobian(phi: jax.Array) -> jax.Array:
    """J_l (..., 3, 3): omega_space = J_l phi'.

    >>> left_jacobian([0.0, 0.0, 0.0]).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return stacked(left_lanes(entries(phi)), 3, 3)


@takes(phi="vector")
def right_jacobian(phi: jax.Array) -> jax.Array:
    """J_r (..., 3, 3): omega_body = J_r phi'."""
    return stacked(left_lanes([-p for p in entries(phi)]), 3, 3)


@takes(phi="vector")
def inverse_left_jacobian(phi: jax.Array) -> jax.Array:
    """J_l^-1 (..., 3, 3): phi' = J_l^-1 omega_space, for |phi| < 2 pi."""
    return stacked(inverse_left_lanes(entries(phi)), 3, 3)


@takes(phi="vector")
def inverse_right_jacobian(phi: jax.Array) -> jax.Array:
    """J_r^-1 (..., 3, 3): phi' = J_r^-1 omega_body, for |phi| < 2 pi."""
    return stacked(inverse_left_lanes([-p for p in entries(phi)]), 3, 3)
