"""Planar kinematics on lanes: twists, directions, and dual numbers.

A twist is (x, y, w): the velocity of a body's origin in m/s along its own axes, and its turning
rate in rad/s. A point and a direction are pairs of lanes in the body's axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from rbjax.lanes import Lane, Lanes, add, is_literal, mul, neg, sincos, sub

Pair = tuple[Lane, Lane]
#: cosines and sines of constant angles below this are rounded to zero
SNAP = 1e-15


class Twist(Lanes):
    """A planar twist (x, y, w)."""

    __slots__ = ()

    def at(self, p: Pair) -> Pair:
        """Compute the velocity of the body's point p."""
        x, y, w = self
        return sub(x, mul(w, p[1])), add(y, mul(w, p[0]))


def dot(a: Pair, b: Pair) -> Lane:
    """Compute a . b."""
    return add(mul(a[0], b[0]), mul(a[1], b[1]))


def cross(a: Pair, b: Pair) -> Lane:
    """Compute a x b, along the vertical."""
    return sub(mul(a[0], b[1]), mul(a[1], b[0]))


def left(e: Pair) -> Pair:
    """Rotate a direction to the left by a right angle."""
    return neg(e[1]), e[0]


def rotate(a: Pair, e: Pair) -> Pair:
    """Rotate a vector by the angle of the direction e."""
    return sub(mul(a[0], e[0]), mul(a[1], e[1])), add(mul(a[0], e[1]), mul(a[1], e[0]))


def rotate_back(a: Pair, e: Pair) -> Pair:
    """Express a vector in axes rotated by the angle of the direction e."""
    return rotate(a, (e[0], neg(e[1])))


class Dual:
    """A dual number: a lane with its rate of change. A plain lane is constant. Structural zeros of
    rates are kept. Value and rate may be `Dual` themselves, for second rates."""

    __slots__ = ("rate", "value")
    __array_ufunc__ = None  # numpy's scalars leave operations to this class

    def __init__(self, value: Lane, rate: Lane):
        self.value, self.rate = value, rate

    def __add__(self, other: Any) -> Dual:
        return Dual(add(self.value, value_of(other)), add(self.rate, rate_of(other)))

    __radd__ = __add__

    def __neg__(self) -> Dual:
        return Dual(neg(self.value), neg(self.rate))

    def __sub__(self, other: Any) -> Dual:
        return self + neg(other)

    def __rsub__(self, other: Any) -> Dual:
        return -self + other

    def __mul__(self, other: Any) -> Dual:
        a, b = self.value, value_of(other)
        return Dual(mul(a, b), add(mul(self.rate, b), mul(a, rate_of(other))))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Dual:
        return self * inverse(other)

    def __rtruediv__(self, other: Any) -> Dual:
        return inverse(self) * other


def duals(values: Sequence[Lane], rates: Sequence[Lane]) -> list[Dual]:
    """Make dual numbers of lanes and their rates."""
    return [Dual(a, b) for a, b in zip(values, rates, strict=True)]


def value_of(a: Lane) -> Lane:
    """Return the value of a dual number or lane."""
    return a.value if isinstance(a, Dual) else a


def rate_of(a: Lane) -> Lane:
    """Return the rate of a dual number, or a structural zero for a lane."""
    return a.rate if isinstance(a, Dual) else 0.0


def inverse(a: Lane) -> Lane:
    """Compute 1 / a."""
    if isinstance(a, Dual):
        b = inverse(a.value)
        return Dual(b, neg(mul(mul(b, b), a.rate)))
    return 1.0 / a


def inverse_root(a: Lane) -> Lane:
    """Compute 1 / sqrt(a)."""
    if isinstance(a, Dual):
        b = inverse_root(a.value)
        return Dual(b, mul(mul(mul(b, mul(b, b)), a.rate), -0.5))
    return a**-0.5 if is_literal(a) else 1.0 / jnp.sqrt(a)


def direction(angle: Lane) -> Pair:
    """Compute the cosine and sine of an angle."""
    if isinstance(angle, Dual):
        return with_rate(direction(angle.value), angle.rate)
    if is_literal(angle):
        c, s = math.cos(angle), math.sin(angle)
        return c if abs(c) > SNAP else 0.0, s if abs(s) > SNAP else 0.0
    return sincos(angle)


def with_rate(e: Pair, rate: Lane) -> Pair:
    """Make the dual direction of an angle with a given rate."""
    return Dual(e[0], neg(mul(e[1], rate))), Dual(e[1], mul(e[0], rate))
