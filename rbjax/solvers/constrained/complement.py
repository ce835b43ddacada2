"""Stage equations by the Schur complement of their algebraic unknowns, in little memory.

    [A  C] [k]   [r]          F: A^-1, nearly, in blocks of one stage (`simplified`)
    [B  D] [w] = [b]          S = D - B F C,    one column after another
A is much the same all through a step, also where rows turn round between its stages. So F is that
of the start, and only S, of all w, is of the stages: its columns are derivatives of the equations
along w and along what F makes of them. No other matrix is kept. One sweep is

    k <- k - F r(k, w), twice;    w <- w - (S + E)^-1 (b(k, w) + E (w - c))
and converges as fast as F is near A^-1. E is near times the diagonal of S and what that is where no
row vanishes. (Benzi, Golub & Liesen, *Numerical solution of saddle point problems*, 2005, 8.1.)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes import inverse
from rbjax.lanes.arrays import each

#: of x (s, n + m), or of a change of it; F of (s, n)
Function = Callable[[jax.Array], jax.Array]


class Complement(NamedTuple):
    """The transpose of (S + E)^-1 (s m, s m), E (s m,), and whether it is for the transposed
    equations. (A thread would copy a matrix to transpose it.)"""

    inverse: jax.Array
    E: jax.Array
    transposed: bool = False

    def swept(self, off: Function, free: Function, x: jax.Array, c: jax.Array) -> jax.Array:
        """x after one sweep of off(x) = 0, its w drawn to c."""
        m = c.shape[1]
        n = x.shape[1] - m
        x, rows = _relaxed(off, free, x, n)
        w = x[:, n:]
        due = rows.ravel() + self.E * (w - c).ravel()
        axis = 1 if self.transposed else 0
        precision = jax.lax.Precision.HIGHEST
        dw = jax.lax.dot_general(self.inverse, due, (((axis,), (0,)), ((), ())), precision)
        return jnp.concatenate([x[:, :n], w - dw.reshape(w.shape)], 1)


def complement(
    push: Function, free: Function, usual: jax.Array, s: int, n: int, near: float
) -> Complement:
    """push: the derivative of the equations of s stages along a change of x; usual (m,): the
    diagonal of S, of a stage, where no row vanishes."""
    m = len(usual)

    def column(j: jax.Array) -> tuple:
        one = (jnp.arange(s * m) == j).astype(usual.dtype)
        d = jnp.concatenate([jnp.zeros((s, n), usual.dtype), one.reshape(s, m)], 1)
        S = _relaxed(push, free, d, n)[1].ravel()
        E = near * (jnp.abs(one * S).sum() + usual[j % m])
        E = jnp.where(E > 0, E, 1.0)
        return S + E * one, E

    S, E = each(column, jnp.arange(s * m))
    return Complement(inverse(S)[0], E)


def _relaxed(off: Function, free: Function, x: jax.Array, n: int) -> tuple[jax.Array, jax.Array]:
    """x with other rates, and the rows before the last change of these."""

    def turn(x: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        r = off(x)
        return jnp.concatenate([x[:, :n] - free(r[:, :n]), x[:, n:]], 1), r[:, n:]

    found, rows = jax.lax.scan(turn, x, None, length=2)
    return found, rows[-1]
