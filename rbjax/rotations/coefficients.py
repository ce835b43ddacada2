"""Scalar functions and Jacobians that the formulas of rotation share.

Stumpff's functions c_k(x) = sum_j (-x)^j / (2 j + k)! are entire in x = t^2:

    c_0 = cos t,  c_1 = sin t / t,  c_2 = (1 - cos t) / t^2,  c_3 = (t - sin t) / t^3,  ...
    c_{k+2} = (1/k! - c_k) / x,    dc_k/dx = (k c_{k+2} - c_{k+1}) / 2

Formulas of SO(3) and SE(3) in terms of c_k have no removable singularity. Near zero a series
replaces the closed form. At the switch, values and first and second derivatives of both are
accurate to the last digits. Both branches are evaluated and one is selected. The argument of the
other branch is replaced by a regular value, so that no derivative of any order is nan.

The Jacobians satisfy exp(phi + d) = exp(J_l d) exp(phi) = exp(phi) exp(J_r d) to first order, and
omega_space = J_l phi', omega_body = J_r phi' (Sola, arXiv:1812.01537, eqs. 143-146):

    J_l = 1 + c_2 [phi] + c_3 [phi]^2,    J_l^-1 = 1 - [phi]/2 + e [phi]^2,    J_r(phi) = J_l(-phi)

The inverses have a pole at |phi| = 2 pi and its multiples.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.lanes import horner, sincos
from rbjax.rotations.arguments import entries, stacked, takes


def where(condition: jax.Array, a: Any, b: Any) -> jax.Array:
    """Select as `jnp.where`, but without its nested jit, which is slow to trace."""
    like = a if isinstance(a, jax.Array) else b
    shape = condition.shape
    a, b = (jnp.broadcast_to(jnp.asarray(x, like.dtype), shape) for x in (a, b))
    return jax.lax.select(condition, a, b)


def stumpff(x: jax.Array, *orders: int) -> list[jax.Array]:
    """Compute Stumpff's functions c_k(x), x >= 0, for each order k <= 5."""
    x = jnp.asarray(x)
    return [where(x < _switch(k), _series(x, k), _closed(x, k)) for k in orders]


def inverse_jacobian_coefficient(x: jax.Array) -> jax.Array:
    """Compute the coefficient e of J_l^-1 = 1 - [phi]/2 + e [phi]^2, from x = t^2 = |phi|^2.

    e = (1 - (t/2) cot(t/2)) / t^2 = (c_2 - c_3)(x/4) / (4 c_1(x/4)): 1/12 at 0, a pole at 2 pi.

    >>> float(inverse_jacobian_coefficient(0.0) * 12)
    1.0
    """
    c1, c2, c3 = stumpff(jnp.asarray(x) / 4, 1, 2, 3)
    return (c2 - c3) / (4 * c1)


def arctan_over(w: jax.Array, square: jax.Array) -> jax.Array:
    """Compute atan2(n, w) / n for n^2 = `square` and w >= 0, not both zero. It is smooth.

    Each of three steps w <- w + |(n, w)| halves the angle, to at most pi/16. Then the series of the
    arctangent converges fast.
    """
    for _ in range(3):
        w = w + jnp.sqrt(w * w + square)
    return _arctan_series(square / (w * w)) * 8 / w


def angle(y: jax.Array, x: jax.Array) -> jax.Array:
    """Compute atan2(y, x) for numbers whose squares do not underflow, faster than XLA on a CPU.

    If both are zero it is 0, with finite derivatives. The angle is halved as in `arctan_over`.
    """
    w = where((x == 0) & (y == 0), 1.0, jnp.abs(x))
    t = y / (w + jnp.sqrt(w * w + y * y))
    for _ in range(2):
        t = t / (1 + jnp.sqrt(1 + t * t))
    right = 8 * t * _arctan_series(t * t)
    half_turn = where(y < 0, -jnp.pi * jnp.ones_like(y), jnp.pi)
    return where(x < 0, half_turn - right, right)


def away_from_zero(x: jax.Array) -> jax.Array:
    """Return x, or a tiny number of the same sign if |x| is smaller, as a divisor.

    The square of the inverse of the tiny number does not overflow.
    """
    least = 1e-150 if x.dtype == jnp.float64 else 1e-18
    return where(jnp.abs(x) < least, where(x < 0, -least * jnp.ones_like(x), least), x)


def _switch(k: int) -> float:
    return 3.0 if k < 2 else 10.0


def _series(x: jax.Array, k: int) -> jax.Array:
    """Evaluate the series of c_k. Its error is below rounding, also in the second derivative."""
    double = x.dtype == jnp.float64
    terms = (13 if double else 8) if k < 2 else (16 if double else 10)
    return horner([(-1) ** j / math.factorial(2 * j + k) for j in range(terms)], x)


def _closed(x: jax.Array, k: int) -> jax.Array:
    safe = where(x < _switch(k), 20.0, x)
    if k >= 2:
        return (1 / math.factorial(k - 2) - _closed(safe, k - 2)) / safe
    root = jnp.sqrt(safe)
    cosine, sine = sincos(root)
    return sine / root if k else cosine


def _arctan_series(x: jax.Array) -> jax.Array:
    """Evaluate the series of atan(t) / t in x = t^2, for t up to tan(pi/16)."""
    terms = 13 if x.dtype == jnp.float64 else 6
    return horner([(-1) ** j / (2 * j + 1) for j in range(terms)], x)


def polynomial(a, b, c, p: list) -> list:
    """Compute the lanes of a 1 + b [p] + c [p]^2, row by row."""
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
    """Compute the lanes of the left Jacobian J_l."""
    c2, c3 = stumpff(sum(p * p for p in phi), 2, 3)
    return polynomial(1.0, c2, c3, phi)


def inverse_left_lanes(phi: list) -> list:
    """Compute the lanes of the inverse left Jacobian J_l^-1."""
    e = inverse_jacobian_coefficient(sum(p * p for p in phi))
    return polynomial(1.0, -0.5, e, phi)


@takes(phi="vector")
def left_jacobian(phi: jax.Array) -> jax.Array:
    """Compute the left Jacobian J_l (..., 3, 3) of SO(3): omega_space = J_l phi'.

    Args:
        phi: (..., 3), rotation vectors, rad.

    Returns:
        (..., 3, 3), no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.so3 import left_jacobian
        >>> left_jacobian([0.0, 0.0, 1.0])[0].round(4).tolist()
        [0.8415, -0.4597, 0.0]
    """
    return stacked(left_lanes(entries(phi)), 3, 3)


@takes(phi="vector")
def right_jacobian(phi: jax.Array) -> jax.Array:
    """Compute the right Jacobian J_r (..., 3, 3) of SO(3): omega_body = J_r phi'.

    Args:
        phi: (..., 3), rotation vectors, rad.

    Returns:
        (..., 3, 3), no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.so3 import right_jacobian
        >>> right_jacobian([0.0, 0.0, 1.0])[0].round(4).tolist()
        [0.8415, 0.4597, 0.0]
    """
    return stacked(left_lanes([-p for p in entries(phi)]), 3, 3)


@takes(phi="vector")
def inverse_left_jacobian(phi: jax.Array) -> jax.Array:
    """Compute J_l^-1 (..., 3, 3) of SO(3), with phi' = J_l^-1 omega_space, for |phi| < 2 pi.

    Args:
        phi: (..., 3), rotation vectors, rad.

    Returns:
        (..., 3, 3), no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.so3 import inverse_left_jacobian
        >>> inverse_left_jacobian([0.0, 0.0, 1.0])[0].round(4).tolist()
        [0.9152, 0.5, 0.0]
    """
    return stacked(inverse_left_lanes(entries(phi)), 3, 3)


@takes(phi="vector")
def inverse_right_jacobian(phi: jax.Array) -> jax.Array:
    """Compute J_r^-1 (..., 3, 3) of SO(3), with phi' = J_r^-1 omega_body, for |phi| < 2 pi.

    Args:
        phi: (..., 3), rotation vectors, rad.

    Returns:
        (..., 3, 3), no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.so3 import inverse_right_jacobian
        >>> inverse_right_jacobian([0.0, 0.0, 1.0])[0].round(4).tolist()
        [0.9152, -0.5, 0.0]
    """
    return stacked(inverse_left_lanes([-p for p in entries(phi)]), 3, 3)
