"""Faster than the path allows: controls and durations changed by gradients through the dynamics.

From the fastest motion along a path (`time_scaling`), which a search on a map found, to one that
leaves the path where that saves time. Unknown are the controls and the duration of each interval
(`shooting`). With T their sum, e what must vanish and b what must not exceed zero,

    min   T / T_0 + p (|e|_1 + |max(b, 0)|_1)        controls and durations in their ranges

Each turn linearises e and b, solves the program of the step in a box, the trust region
(`elastic_program`), and corrects its end by e at the new controls (a correction of second order).
It takes the step if the sum falls, and widens or narrows the box by how well it was foreseen.

Source: Fletcher, *Practical Methods of Optimization*, 14.4 (the Sl1QP method); Nocedal & Wright,
*Numerical Optimization*, 18.5, 18.8.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.planning import elastic_program
from rbjax.planning.shooting import Shooting

PRICE = 30.0  # p
SHORTEST, LONGEST = 0.05, 4.0  # durations, of the first one
INNER = 20  # iterations of a program
PROXIMAL = 1e-3


class Iterate(NamedTuple):
    w: jax.Array
    radius: jax.Array
    turns: jax.Array
    taken: jax.Array


def optimised(s: Shooting, w: jax.Array, iterations: int) -> Iterate:
    """The best controls w (n, nu + 1) that so many turns find."""
    n = len(w)
    one = jnp.ones_like(w)
    lowest = (-one).at[:, -1].set(SHORTEST)
    highest = one.at[:, -1].set(LONGEST)
    H = PROXIMAL / n * jnp.eye(w.size, dtype=w.dtype)
    cost = jnp.zeros_like(w).at[:, -1].set(1 / n)

    def penalty(equal, below):
        return PRICE * (jnp.abs(equal).sum() + jnp.maximum(below, 0.0).sum())

    def turn(now: Iterate) -> Iterate:
        w = now.w
        (e, E), (b, B) = s.linear(w)
        low = jnp.maximum(lowest - w, -now.radius).ravel()
        high = jnp.minimum(highest - w, now.radius).ravel()
        G, g = jnp.concatenate([E, -E, B]), jnp.concatenate([-e, e, -b])
        d, _ = elastic_program.solve(
            H, cost.ravel(), G, g, jnp.full_like(g, PRICE), low, high, INNER
        )
        merit = (cost * w).sum() + penalty(e, b)
        end = e + E @ d
        foreseen = (cost.ravel() * (w.ravel() + d)).sum() + penalty(end, b + B @ d)
        W = E * jnp.minimum(d - low, high - d)
        S = W @ E.T
        S = S + jnp.eye(len(e), dtype=w.dtype) * (1e-12 * jnp.trace(S) + jnp.finfo(w.dtype).tiny)

        def corrected(d, _):
            """A step, its merit, and the next: with the end that this one should have had."""
            new = jnp.clip(w + d.reshape(w.shape), lowest, highest)
            equal, below = s.rows(new)
            value = (cost * new).sum() + penalty(equal, below)
            after = jnp.clip(d - W.T @ jnp.linalg.solve(S, equal - end), low, high)
            return after, (new, value)

        _, (steps, merits) = jax.lax.scan(corrected, d, length=2)
        k = jnp.nanargmin(merits)
        share = (merit - merits[k]) / jnp.maximum(merit - foreseen, jnp.finfo(w.dtype).tiny)
        good = merits[k] < merit
        radius = jnp.where(share > 0.75, 2 * now.radius, now.radius)
        radius = jnp.where(good & (share > 0.25), radius, now.radius / 3)
        return Iterate(
            jnp.where(good, steps[k], w), jnp.minimum(radius, 1.0), now.turns + 1, now.taken + good
        )

    def goes_on(now: Iterate):
        return (now.turns < iterations) & (now.radius > 1e-6)

    zero = jnp.zeros((), int)
    w = jnp.clip(w, lowest, highest)
    begin = Iterate(w, jnp.full((), 0.3, w.dtype), zero, zero)
    return jax.lax.while_loop(goes_on, turn, begin)
