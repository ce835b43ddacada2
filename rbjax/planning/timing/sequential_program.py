"""The shortest time by steps of linearised programs: the Sl1QP method.

Unknown are the controls and the duration of each interval (`shooting`). With T their sum, e what
must vanish and b what must not exceed zero,

    min   T / T_0 + p (|e|_1 + |max(b, 0)|_1)        controls and durations in their ranges

Each turn linearises e and b, solves the program of the step in a box, the trust region
(`elastic_program`), and corrects its end by e at the new controls (a correction of second order).
It takes the step if the sum falls, and widens or narrows the box by how well it was foreseen. The
last turns leave T out, so what is left of e and b goes.

Source: Fletcher, *Practical Methods of Optimization*, 14.4 (the Sl1QP method); Nocedal & Wright,
*Numerical Optimization*, 18.3, 18.5.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.planning.timing import elastic_program
from rbjax.planning.timing.shooting import Shooting

PRICE = 3.0  # p
SHORTEST, LONGEST = 0.05, 4.0  # durations, of the first one
INNER = 12  # iterations of a program
CORRECTIONS = 3  # looks at a step, each corrected by the one before
PROXIMAL = 0.3
FIRST, LEAST = 0.3, 1e-6  # half a side of the trust region, of the ranges
LAST, SMALL = 6, 1e-5  # turns at the end that only lower |e| + |b|, down to this


class Iterate(NamedTuple):
    """w (n, nu + 1); radius (), of the trust region; turns and steps so far."""

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
    by_time = jnp.zeros_like(w).at[:, -1].set(1 / n)

    def penalty(equal, below):
        return PRICE * (jnp.abs(equal).sum() + jnp.maximum(below, 0.0).sum())

    def turn(now: Iterate) -> Iterate:
        w, first = now.w, now.turns < iterations
        cost = first * by_time
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

        _, (steps, merits) = jax.lax.scan(corrected, d, length=CORRECTIONS)
        k = jnp.nanargmin(merits)
        share = (merit - merits[k]) / jnp.maximum(merit - foreseen, jnp.finfo(w.dtype).tiny)
        good = (merits[k] < merit) & (first | (merit > SMALL))
        radius = jnp.where(share > 0.75, 2 * now.radius, now.radius)
        radius = jnp.where(good & (share > 0.25), radius, now.radius / 3)
        radius = jnp.minimum(radius, 1.0)
        turns = jnp.where(first & (radius < LEAST), iterations, now.turns + 1)
        radius = jnp.where(turns == iterations, FIRST, radius)
        return Iterate(jnp.where(good, steps[k], w), radius, turns, now.taken + good)

    def goes_on(now: Iterate):
        return (now.turns < iterations + LAST) & (now.radius > LEAST)

    zero = jnp.zeros((), int)
    w = jnp.clip(w, lowest, highest)
    begin = Iterate(w, jnp.full((), FIRST, w.dtype), zero, zero)
    return jax.lax.while_loop(goes_on, turn, begin)
