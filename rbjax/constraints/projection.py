"""A state put back on its constraints: the least change, in the norm of the mass matrix.

    min |dq|_M:  g(t, q + dq) = 0          dq = -M^-1 G^T A^-1 g, again with what is left
    min |dv|_M:  G v + g_t = 0             dv = -M^-1 G^T A^-1 (G v + g_t)
G, M and A are those of the state as it came, so they are factored once; after a step, whose error
is small, each iteration takes the residual down by about the relative size of the correction.

A is damped more than in the law (`DAMPING`), and that is taken back once: what a row of the
singular value sigma is off by is divided by sigma, times 1 - (eps / (sigma^2 + eps))^2. So near a
singular position rounding u moves a state by about u / eps^(1/2) at most, and not by u / sigma;
what is left is of second order there, and goes when sigma grows again. A velocity across a row is
scaled by a factor between 0 and 1, so kinetic energy does not rise but by rounding.
(Blajer 2002; Bayo & Ledesma, *Augmented Lagrangian and mass-orthogonal projection methods for
constrained multibody dynamics*, 1996; Masarati, ch. 8)
"""

from __future__ import annotations

from typing import Any

import jax

from rbjax.constraints.system import response, rows_of
from rbjax.dynamics.aba import factorize
from rbjax.dynamics.drivers import Driver, driver
from rbjax.dynamics.manifold import moved
from rbjax.dynamics.tracing import with_values
from rbjax.forces.instant import Instant
from rbjax.lanes import Lane, neg
from rbjax.model import Model, State

#: by bytes of a number
ITERATIONS = {4: 1, 8: 2}
#: eps and e of `system`, by bytes of a number
DAMPING = {4: 1e-3, 8: 1e-6}


def projected(
    model: Model, t: Any, state: State, iterations: int | None = None, positions: bool = True
) -> State:
    """The state on its constraints. iterations None: as many as bring the error of a step down to
    rounding. `positions`: not only its velocity."""
    iterations = ITERATIONS[state.q.dtype.itemsize] if iterations is None else iterations

    def run(given: Any, q: jax.Array, v: jax.Array, values: bool) -> tuple[jax.Array, jax.Array]:
        model, t = given
        d = driver(model, q.dtype, values=values)
        return _least_changes(d, model, t, q, v, iterations, positions)

    q, v = with_values(run, (model, t), state.q, state.v)
    return State(q, v, state.x)


def _least_changes(
    d: Driver, model: Model, t: Any, q: jax.Array, v: jax.Array, iterations: int, positions: bool
) -> tuple[jax.Array, jax.Array]:
    def seen(q: jax.Array, v: jax.Array) -> Instant:
        return Instant.of(model, t, State(q, v), None, d=d)

    now = seen(q, v)
    rows = rows_of(model, now)
    answer = response(d, factorize(d, now.links.joints), now, rows, DAMPING[q.dtype.itemsize])

    def least(off: list[Lane]) -> jax.Array:
        return answer.solved(None, [neg(x) for x in off])[0]

    if positions and any(row.holonomic for row in rows):
        for _ in range(iterations):
            dq = least([row.residual for row in rows])
            q = moved(model, q, dq)
            rows = rows_of(model, seen(q, v))
    for k in range(iterations):
        if k:
            rows = rows_of(model, seen(q, v))
        v = v + least([row.rate for row in rows])
    return q, v
