"""Small convex quadratic programs in a box, by Newton steps projected onto it.

    min  d'H d/2 + g.d,      low <= d <= high

Each iteration fixes the entries whose descent leaves the box, takes Newton's step in the others,
and halves it until the cost falls (Bertsekas 1982). The free entries and the factor of
their part of H give the feedback of a bounded control (Tassa, Mansard & Todorov 2014).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes.arrays import matvec

TURNS = 20  # at most; a program of m entries seldom takes more than m + 2
HALVINGS = np.array([0.5**k for k in range(8)])


class BoxSolution(NamedTuple):
    """d (m,); free (m,), 1 where an entry is within the box; factor (m, m), lower, of H in the free
    entries and of one in the others; ok, whether that is positive definite."""

    d: jax.Array
    free: jax.Array
    factor: jax.Array
    ok: jax.Array


def box_qp(H: jax.Array, g: jax.Array, low: jax.Array, high: jax.Array) -> BoxSolution:
    """The minimum in the box. low < high; H (m, m) positive definite in the free entries."""
    L = factor_of(H)
    d = -solved(L, g)  # most often within the box
    return jax.lax.cond(
        ((d >= low) & (d <= high)).all(),
        lambda: BoxSolution(d, jnp.ones_like(g), L, is_factor(L)),
        lambda: _projected(H, g, low, high),
    )


def box_gains(
    H: jax.Array, g: jax.Array, G: jax.Array, low: jax.Array, high: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """d of `box_qp` and K = -H^-1 G (m, n) in its free entries, 0 in the others; and its ok."""
    both, ok = gains(H, g, G)
    d = both[:, -1]
    inside = ((d >= low) & (d <= high)).all()

    def held(_: tuple) -> tuple:
        box = _projected(H, g, low, high)
        free = box.free[:, None]
        K = -free * solved(box.factor, free * G)
        return jnp.concatenate([K, box.d[:, None]], 1), box.ok, jnp.asarray(True)

    # once at most; the results of two branches would be copied in both
    both, ok, _ = jax.lax.while_loop(lambda now: ~now[2], held, (both, ok, inside))
    return both[:, -1], both[:, :-1], ok


def gains(H: jax.Array, g: jax.Array, G: jax.Array) -> tuple[jax.Array, jax.Array]:
    """-H^-1 (G, g) without a box, and whether H is positive definite."""
    L = factor_of(H)
    return solved(L, -jnp.concatenate([G, g[:, None]], 1)), is_factor(L)


def _projected(H: jax.Array, g: jax.Array, low: jax.Array, high: jax.Array) -> BoxSolution:
    dtype = g.dtype
    eye = jnp.eye(len(g), dtype=dtype)
    halvings = jnp.asarray(HALVINGS, dtype)

    def cost(d: jax.Array) -> jax.Array:
        return (d * (g + 0.5 * matvec(H, d))).sum(-1)

    def free_of(d: jax.Array) -> jax.Array:
        slope = g + matvec(H, d)
        held = ((d <= low) & (slope > 0)) | ((d >= high) & (slope < 0))
        return jnp.where(held, 0.0, 1.0).astype(dtype)

    def turn(now: tuple) -> tuple:
        d, _, _, turns, _ = now
        free = free_of(d)
        L = factor_of(H * free[:, None] * free + eye * (1 - free))
        step = -free * solved(L, free * (g + matvec(H, d)))
        tries = jnp.clip(d + halvings[:, None] * step, low, high)
        costs = jax.vmap(cost)(tries)
        best = jnp.argmin(costs)
        better = costs[best] < cost(d)
        new = jnp.where(better, tries[best], d)
        # a full step that meets no bound is the minimum in the free entries
        done = ~better | ((best == 0) & (free_of(new) == free).all())
        return new, free, L, turns + 1, done

    d = jnp.clip(jnp.zeros_like(g), low, high)
    begin = (d, jnp.ones_like(g), eye, 0, jnp.asarray(False))
    d, free, L, *_ = jax.lax.while_loop(lambda now: (now[3] < TURNS) & ~now[4], turn, begin)
    return BoxSolution(d, free, L, is_factor(L))


def factor_of(H: jax.Array) -> jax.Array:
    """L of H = L L', of which the lower half is read."""
    return jax.lax.linalg.cholesky(H, symmetrize_input=False)


def is_factor(L: jax.Array) -> jax.Array:
    """Whether there was a factor: all of it is nan else."""
    return jnp.isfinite(jnp.diagonal(L)).all()


def solved(L: jax.Array, b: jax.Array) -> jax.Array:
    """(L L')^-1 b, of a vector or the columns of a matrix."""
    return jax.scipy.linalg.cho_solve((L, True), b)
