"""A state put back on its constraints: the least change, in the norm of the mass matrix.

    min |dq|_M:  g(t, q + dq) = 0          dq = -M^-1 G^T A^-1 g, again with what is left
    min |dv|_M:  G v + g_t = 0             dv = -M^-1 G^T A^-1 (G v + g_t)
G, M and A are those of the state as it came, so they are factored once; after a step, whose error
is small, each iteration takes the residual down by about the relative size of the correction. The
equations of the derivative (`least_change`) are solved by the same iterations.

A is damped more than in the law (`DAMPING`), and that is taken back once: what a row of the
singular value sigma is off by is divided by sigma, times 1 - (eps / (sigma^2 + eps))^2. So near a
singular position rounding u moves a state by about u / eps^(1/2) at most, and not by u / sigma;
what is left is of second order there, and goes when sigma grows again. A velocity across a row is
scaled by a factor between 0 and 1, so kinetic energy does not rise but by rounding.
(Blajer 2002; Bayo & Ledesma, *Augmented Lagrangian and mass-orthogonal projection methods for
constrained multibody dynamics*, 1996; Masarati, ch. 8)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.constraints.equations.least_change import (
    Changes,
    Solve,
    least_changes,
    leveled,
    off,
    off_of,
)
from rbjax.constraints.equations.system import response, rows_of
from rbjax.dynamics.algorithms.aba import factorize
from rbjax.dynamics.algorithms.manifold import retract
from rbjax.dynamics.drivers.choice import Driver
from rbjax.forces.context import Context
from rbjax.model import Model, State

#: x (nv,) -> what rows are off by (rows,)
Residual = Callable[[jax.Array], jax.Array]
#: by bytes of a number
ITERATIONS = {4: 1, 8: 2}
#: eps and e of `system`, by bytes of a number
DAMPING = {4: 1e-3, 8: 1e-6}


def projected(
    model: Model, t: Any, state: State, iterations: int | None = None, positions: bool = True
) -> State:
    """The state on its constraints. iterations None: as many as bring the error of a step down to
    rounding. `positions`: not only its velocity."""
    q, v = state.q, state.v
    many = ITERATIONS[q.dtype.itemsize] if iterations is None else iterations

    def method(d: Driver, model: Model, _: Any, t: Any, q: jax.Array, u: Any, v: Any) -> Changes:
        return _projection(d, model, t, q, v, many, positions)

    dq, dv = least_changes(method, model, t, t, q, jnp.zeros_like(v), v)
    return State(retract(model, q, dq) if positions else q, v + dv, state.x)


def _projection(
    d: Driver, model: Model, t: Any, q: jax.Array, v: jax.Array, many: int, positions: bool
) -> Changes:
    now = Context.of(model, t, State(q, v), None, d=d)
    rows = rows_of(model, now)
    answer = response(d, factorize(d, now.links.joints), now, rows, DAMPING[q.dtype.itemsize])

    def iterated(f: Residual, begun: jax.Array, force: Any = None) -> tuple[jax.Array, jax.Array]:
        """x and l of M x = force + G^T l and f(x) = 0, from x = 0, where f is `begun`."""
        x, l = answer.solved(force, list(-begun))
        for _ in range(many - 1):
            more = answer.solved(None, list(-f(x)))
            x, l = x + more[0], l + more[1]
        return x, l

    def linear(f: Residual, x: jax.Array) -> Solve:
        def left(dx: jax.Array, c: jax.Array) -> jax.Array:
            return jax.jvp(f, (x,), (dx,))[1] - c

        return lambda force, c: iterated(lambda dx: left(dx, c), -c, force)

    def level(dq: jax.Array) -> jax.Array:
        return leveled(now, rows, off(d, model, t, q, dq, v)[0], dq)

    def rate(dv: jax.Array) -> jax.Array:
        return off(d, model, t, q, dq, v + dv)[1]

    dq, l = jnp.zeros_like(v), jnp.zeros(len(rows), v.dtype)
    begun = off_of(rows, v)
    of_positions: Solve = _unmoved
    if positions and any(row.holonomic for row in rows):
        dq, l = iterated(level, begun[0])
        begun, of_positions = off(d, model, t, q, dq, v), linear(level, dq)
    dv, m = iterated(rate, begun[1])
    return Changes(dq, l, dv, m, of_positions, linear(rate, dv))


def _unmoved(force: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jnp.zeros_like(force), jnp.zeros_like(c)
