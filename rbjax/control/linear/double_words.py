"""Matrices of about 1.5 times the digits: an entry is an unevaluated sum of two numbers.

A sum of two numbers is such a pair exactly, and so is a product of halves of their digits:

    s = fl(a + b),  t = s - a,  a + b = s + ((a - (s - t)) + (b - t))
    a b = a_h b_h + (a_h b_l + a_l b_h) + a_l b_l

A compiler may join a product and a sum and round once for both. Here that changes nothing, because
products of halves are exact; Dekker's product, which subtracts the rounded a b, would break.
Source: Knuth, *The Art of Computer Programming* 2, 4.2.2; Dekker, Numerische Mathematik 18, 1971;
Ogita, Rump & Oishi, SIAM J. Scientific Computing 26, 2005.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Double(NamedTuple):
    """hi + lo, of which hi is the rounded sum."""

    hi: jax.Array
    lo: jax.Array

    @classmethod
    def of(cls, x: jax.Array) -> Double:
        return cls(x, jnp.zeros_like(x))

    @property
    def T(self) -> Double:
        return Double(self.hi.T, self.lo.T)

    def __neg__(self) -> Double:
        return Double(-self.hi, -self.lo)

    def __add__(self, other: Double) -> Double:  # type: ignore[override]
        s, rest = _sum(self.hi, other.hi)
        return Double(*_sum(s, rest + (self.lo + other.lo)))

    def __sub__(self, other: Double) -> Double:
        return self + -other

    def __matmul__(self, other: Double) -> Double:
        upper, lower = _halves(self.hi), _halves(other.hi)

        def add(k: jax.Array, found: Double) -> Double:
            ah, al, a, a_lo = (x[:, k, None] for x in (*upper, *self))
            bh, bl, b, b_lo = (x[k, None] for x in (*lower, *other))
            rest = (ah * bl + al * bh) + (al * bl + (a * b_lo + a_lo * b))
            return found + Double(ah * bh, rest)

        zero = jnp.zeros((self.hi.shape[0], other.hi.shape[1]), self.hi.dtype)
        return jax.lax.fori_loop(0, self.hi.shape[1], add, Double.of(zero))


def _sum(a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


def _halves(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The upper and the lower half of the digits."""
    bits = np.dtype(f"u{a.dtype.itemsize}")
    lower = (jnp.finfo(a.dtype).nmant + 2) // 2
    mask = np.asarray(~((1 << lower) - 1) & (2 ** (8 * a.dtype.itemsize) - 1), bits)
    high = jax.lax.bitcast_convert_type(jax.lax.bitcast_convert_type(a, bits) & mask, a.dtype)
    return high, a - high
