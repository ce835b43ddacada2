"""Anderson's acceleration, of depth two, of a fixed-point iteration x <- f(x).

    x_next = f - sum of s_i (f_i - f_i-1),   s minimises |r - sum of s_i (r_i - r_i-1)|

with the residuals r = f(x) - x of the last rounds. A linear map of n unknowns, also one that
diverges, is solved in n + 2 rounds for n up to two. If an accelerated round increases the error,
the next round is plain, x_next = f, and the history begins anew.

Source: Anderson, *Iterative procedures for nonlinear integral equations*, 1965; Walker & Ni,
*Anderson acceleration for fixed-point iterations*, 2011.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp


class History(NamedTuple):
    """The rounds before the next one.

    Fields:
        f, r: (n,) values and residuals of the last round.
        df, dr: (n,) their changes in the last round.
        error: () error of the last round, infinite before the first one.
        used: whether the last round used changes of rounds.
    """

    f: jax.Array
    r: jax.Array
    df: jax.Array
    dr: jax.Array
    error: jax.Array
    used: jax.Array

    @classmethod
    def start(cls, x: jax.Array) -> History:
        """Return the history before the first round, which begins at x (n,)."""
        zero, infinite = jnp.zeros_like(x), jnp.full((), jnp.inf, x.dtype)
        return cls(zero, zero, zero, zero, infinite, jnp.bool_(False))


def accelerate(
    history: History, x: jax.Array, f: jax.Array, error: jax.Array
) -> tuple[jax.Array, History]:
    """Return the next x (n,) of the iteration, and the history with this round.

    The weights s_i are constants in derivatives.

    f: (n,) value f(x). error: () error of this round, such as a norm of f - x.
    """
    r = f - x
    df, dr = f - history.f, r - history.r
    one = jnp.isfinite(history.error) & ((error < history.error) | ~history.used)
    a, b, c = (dr * dr).sum(), (dr * history.dr).sum(), (history.dr * history.dr).sum()
    y, z = (dr * r).sum(), (history.dr * r).sum()
    det = a * c - b * b
    one = one & (a > 0)
    two = one & history.used & (det > jnp.sqrt(jnp.finfo(x.dtype).eps) * a * c)
    det = jnp.where(two, det, 1.0)
    s = jnp.where(two, (c * y - b * z) / det, jnp.where(one, y / jnp.where(one, a, 1.0), 0.0))
    t = jnp.where(two, (a * z - b * y) / det, 0.0)
    s, t = jax.lax.stop_gradient((s, t))
    return f - s * df - t * history.df, History(f, r, df, dr, error, one)
