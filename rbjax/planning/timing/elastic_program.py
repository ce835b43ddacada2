"""Quadratic programs in a box with elastic inequality constraints.

    min   1/2 d^T H d + c^T d + p^T s
    with  G d <= g + s,   s >= 0,   low <= d <= high

It has a solution for any G and g. If s = 0 is possible and the prices p exceed the multipliers, the
solution is the solution of the program without s (an exact penalty).

The method is a primal-dual interior-point method with Mehrotra's corrector. y, s and the distances
from the box are kept above zero; l and p - l are the multipliers of y = g + s - G d and of s. All
variables but d are eliminated:

    (H + Z + G^T D G) d' = ...,    D = l / (y + l s / (p - l))

Source: Nocedal & Wright, *Numerical Optimization*, 16.6, 17.2.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes.arrays import select, smallest

SHORT = 0.99  # fraction of the longest step that keeps all positive variables positive
FIRST = 0.1  # initial slack


class _Point(NamedTuple):
    """Iterate of the interior-point method."""

    d: jax.Array  # (n,), the solution
    y: jax.Array  # (m,), distance from the bound of each row
    s: jax.Array  # (m,), slack
    l: jax.Array  # (m,), multipliers of the rows
    zl: jax.Array  # (n,), multipliers of the box
    zu: jax.Array  # (n,)


def solve(
    H: jax.Array, c: jax.Array, G: jax.Array, g: jax.Array, price: jax.Array,
    low: jax.Array, high: jax.Array, iterations: int,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """Solve the elastic program. Return d (n,), within the box, and the multipliers (m,) of the
    rows. Each iteration factors one matrix (n, n).
    """
    n, m = len(c), len(g)

    def pairs(p: _Point) -> list[tuple[jax.Array, jax.Array]]:
        return [(p.y, p.l), (p.s, price - p.l), (p.d - low, p.zl), (high - p.d, p.zu)]

    def gap(p: _Point) -> jax.Array:
        return jnp.stack([(a * b).sum() for a, b in pairs(p)]).sum() / (2 * (n + m))

    def moved(p: _Point, step: _Point, a: jax.Array, b: jax.Array) -> _Point:
        d, y, s = (x + a * dx for x, dx in zip(p[:3], step[:3], strict=True))
        return _Point(d, y, s, *(x + b * dx for x, dx in zip(p[3:], step[3:], strict=True)))

    def longest(p: _Point, step: _Point) -> tuple[jax.Array, jax.Array]:
        """Compute the longest steps of (d, y, s) and of the multipliers that keep all of them
        positive."""
        rates = [
            (step.y, step.l), (step.s, -step.l), (step.d, step.zl), (-step.d, step.zu)
        ]  # fmt: skip
        out = []
        for k in (0, 1):
            ways = [
                jnp.where(r[k] < 0, -x[k] / jnp.where(r[k] < 0, r[k], 1.0), jnp.inf)
                for x, r in zip(pairs(p), rates, strict=True)
            ]
            one = jnp.ones(1, ways[0].dtype)
            out.append(smallest(jnp.concatenate([one, *map(jnp.ravel, ways)])))
        return out[0], out[1]

    def turn(p: _Point, _) -> tuple[_Point, None]:
        (y, l), (s, t), (yl, zl), (yu, zu) = pairs(p)
        w = y + l * s / t
        K = H + (G.T * (l / w)) @ G
        K = K + jnp.diag(zl / yl + zu / yu)
        factor = jax.scipy.linalg.cho_factor(K)
        off = H @ p.d + c + G.T @ l - zl + zu

        def step(mu, ry, rs, rl, ru) -> _Point:
            """Compute the Newton step for a barrier parameter mu, with second-order terms ry to ru
            of the complementarity conditions."""
            ry, rs = mu - y * l - ry, mu - s * t - rs
            rl, ru = mu - yl * zl - rl, mu - yu * zu - ru
            part = (ry - l * rs / t) / w
            d = jax.scipy.linalg.cho_solve(factor, -off + rl / yl - ru / yu - G.T @ part)
            Gd = G @ d
            dl = part + l / w * Gd
            ds = (rs + s * dl) / t
            return _Point(d, ds - Gd, ds, dl, (rl - zl * d) / yl, (ru + zu * d) / yu)

        guess = step(0.0, 0.0, 0.0, 0.0, 0.0)
        now = gap(p)
        mu = now * (gap(moved(p, guess, *longest(p, guess))) / now) ** 3
        e = guess
        full = step(mu, e.y * e.l, -e.s * e.l, e.d * e.zl, -e.d * e.zu)
        a, b = longest(p, full)
        new = moved(p, full, SHORT * a, SHORT * b)
        fine = jnp.isfinite(new.d).all() & (now > 4 * jnp.finfo(c.dtype).eps)
        return select(fine, new, p), None

    d = (low + high) / 2
    over = jnp.maximum(G @ d - g, 0.0)
    s = over + FIRST
    l = jnp.minimum(price / 2, 1.0)
    one = jnp.full_like(c, 1 / n)
    begin = _Point(d, g + s - G @ d, s, l, one, one)
    p, _ = jax.lax.scan(turn, begin, length=iterations)
    return p.d, p.l
