"""Projections: the least change of a state that satisfies the constraints.

    W dq = G^T l,   g(t, q_0 + u + dq) = 0
    W dv = G^T m,   G' (v + dv) + g_t = 0
G is the gradient at (t_0, q_0), and G' the gradient at t and at the solution of the first line. In
the first line a non-holonomic row is G dq = 0. Derivatives are those of these equations.

`project_state` acts after a step, with u = 0 and W = M. Everything is factored once. Each iteration
reduces the residual by about the relative size of the correction. The regularization of A is larger
than for accelerations, with one refinement: it multiplies a correction along a row of singular
value sigma by 1 - (eps / (sigma^2 + eps))^2. So near a singular position rounding changes a state
little, and kinetic energy does not increase.

`project_to_tangent_space` acts at a stage of a step from q_0, with W = M. It keeps the components
of u and v in the tangent space, Z^T M u and Z^T M v with G Z = 0. So the step integrates ordinary
differential equations of these components.

`solve_dependent` acts at a stage and changes only dependent coordinates, with W = 1 for them. So
the step integrates ordinary differential equations of the independent coordinates.

Source: Masarati, *Multibody System Dynamics*, 7.1.1, 7.1.3, 9.3.3; Wehage & Haug 1982; Mani, Haug &
Atkinson 1985; Potra & Rheinboldt 1991; Bayo & Ledesma 1996; Blajer 2002; Hairer, Lubich & Wanner,
*Geometric Numerical Integration*, IV.5.3.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints.equations.constrained_motion import (
    DelassusMatrix,
    factor_delassus,
    solve_least_norm,
)
from rbjax.constraints.equations.model_rows import add_multipliers, gradient_matrix, rows_of
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.aba import factorize
from rbjax.dynamics.algorithms.aba import solve as solve_mass
from rbjax.dynamics.algorithms.manifold import difference_lanes, retract, velocity_lanes
from rbjax.dynamics.algorithms.rnea import rnea
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.tracing.custom_rules import jax_arrays, split_tracers, with_implicit_jvp
from rbjax.forces.context import Context
from rbjax.lanes import Vec3, batch_first
from rbjax.lanes.arrays import matmat, matvec, pack
from rbjax.lanes.factorization import diagonal_floor
from rbjax.model import Model, State
from rbjax.rank_tolerances import rank_tolerance

#: (force (nv,), c (rows,)) -> x (nv,), l (rows,) of W x = force + G^T l, G' x = c
Solve = Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
#: (driver, model, t_0, t, q_0, u, v) -> changes
ProjectionMethod = Callable[..., "Changes"]
#: x (nv,) -> residuals (rows,)
Residual = Callable[[jax.Array], jax.Array]
#: number of iterations of `project_state`, by bytes of the dtype
ITERATIONS = {4: 1, 8: 2}
#: Newton iterations at a stage, by bytes of the dtype: from an error below 0.1 to rounding
STAGE_ITERATIONS = {4: 3, 8: 5}


@dataclass(frozen=True)
class Changes:
    """Result of a projection, and the linear solvers for its derivative.

    Fields:
        dq, dv: (nv,) changes of the configuration and of the velocity.
        l, m: (rows,) multipliers of dq and dv.
        of_positions, of_velocities: solvers of the linearized equations of dq and dv.
    """

    dq: jax.Array
    l: jax.Array
    dv: jax.Array
    m: jax.Array
    of_positions: Solve
    of_velocities: Solve


def least_change(
    method: ProjectionMethod, model: Model, t0: Any, t: Any, q: jax.Array, u: jax.Array,
    v: jax.Array, dependent: bool = False,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """Compute the least changes dq and dv by a method, differentiated as an implicit function.
    `dependent` selects the equations of `solve_dependent`."""
    given, rebuilt = split_tracers((model, t0, t))
    nv = model.nv

    def changes(changed, q, u, v):
        model, t0, t = rebuilt(changed)
        x = method(driver(model, q.dtype), model, t0, t, q, u, v)
        return (_join(x.dq, x.l), _join(x.dv, x.m)), x

    def plain(*at):
        return batch_first(changes(*at)[0], at)

    def solved(changed, q, u, v):
        values, x = changes(changed, q, u, v)
        solves = x.of_positions, x.of_velocities
        return values, [lambda c, by=by: _join(*by(c[:nv], c[nv:])) for by in solves]

    def at_start(changed, q, v, x, l):
        """Return driver, context and rows at q, and the residual G^T l - W x of the projection. W
        is the weight of the projection, x the change of q or v."""
        model, t0, _ = rebuilt(changed)
        d = driver(model, q.dtype)
        context = Context.of(model, t0, State(q, v), None, d=d)
        rows = rows_of(model, context)
        tau, f_ext = add_multipliers(d, rows, list(l), jnp.zeros_like(x), {})
        a = jnp.zeros_like(x) if dependent else x
        force = tau - d.pack(rnea(d, d.joints(q, None), d.lanes(a), Vec3.zero(), f_ext), tau)
        if dependent:
            force = force * _dependent(gradient_matrix(context, rows)) - x
        return d, context, rows, force

    def of_positions(changed, q, u, v, x):
        model, _, t = rebuilt(changed)
        dq = x[:nv]
        d, context, rows, force = at_start(changed, q, v, dq, x[nv:])
        value, _ = residuals_at(d, model, t, q, u + dq, v)
        return _join(force, -position_residuals(context, rows, value, dq))

    def of_velocities(changed, q, u, v, x, y):
        model, _, t = rebuilt(changed)
        dv = y[:nv]
        d, _, _, force = at_start(changed, q, v, dv, y[nv:])
        _, rate = residuals_at(d, model, t, q, u + x[:nv], v + dv)
        return _join(force, -rate)

    solution = with_implicit_jvp(plain, solved, of_positions, of_velocities)
    found = solution(*jax_arrays(given, q, u, v))
    return found[0][:nv], found[1][:nv]


def residuals_at(
    d: Driver, model: Model, t: Any, q: jax.Array, u: jax.Array, v: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Compute the residuals g and G v + g_t (rows,) at the configuration q (+) u."""
    context = Context.of(model, t, State(retract(model, q, u), v), None, d=d)
    return residuals_of(rows_of(model, context), v)


def residuals_of(rows: Sequence[Row], like: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Pack the residuals g and G v + g_t of the rows into arrays (rows,)."""
    return pack([row.residual for row in rows], like), pack([row.rate for row in rows], like)


def position_residuals(
    context: Context, rows: Sequence[Row], value: jax.Array, dq: jax.Array
) -> jax.Array:
    """Return the residual g of holonomic rows, and G dq of non-holonomic rows with the gradient at
    `context`."""
    rates = np.array([r for r, row in enumerate(rows) if not row.holonomic], int)
    if not rates.size:
        return value
    G = gradient_matrix(context, [rows[r] for r in rates])
    return value.at[rates].set(matvec(G, dq))


def _join(x: jax.Array, l: jax.Array) -> jax.Array:
    return jnp.concatenate([x, l])


def project_state(
    model: Model, t: Any, state: State, iterations: int | None = None, positions: bool = True
) -> State:
    """Project a state on its constraints.
    iterations: None for as many as reduce the error of a step to rounding.
    positions: if False, project only the velocity."""
    q, v = state.q, state.v
    many = ITERATIONS[q.dtype.itemsize] if iterations is None else iterations

    def method(d: Driver, model: Model, _: Any, t: Any, q: jax.Array, u: Any, v: Any) -> Changes:
        return _project(d, model, t, q, v, many, positions)

    dq, dv = least_change(method, model, t, t, q, jnp.zeros_like(v), v)
    return State(retract(model, q, dq) if positions else q, v + dv, state.x)


def _project(
    d: Driver, model: Model, t: Any, q: jax.Array, v: jax.Array, many: int, positions: bool
) -> Changes:
    context = Context.of(model, t, State(q, v), None, d=d)
    rows = rows_of(model, context)
    damping = rank_tolerance("projection", q.dtype)
    delassus = factor_delassus(d, factorize(d, context.links.joints), context, rows, damping)

    def iterate(f: Residual, first: jax.Array, force: Any = None) -> tuple[jax.Array, jax.Array]:
        """Solve M x = force + G^T l, f(x) = 0 for x and l, from x = 0.
        first: the residual f(0)."""
        x, l = delassus.solve(force, list(-first))
        for _ in range(many - 1):
            more = delassus.solve(None, list(-f(x)))
            x, l = x + more[0], l + more[1]
        return x, l

    def linear(f: Residual, x: jax.Array) -> Solve:
        def residual(dx: jax.Array, c: jax.Array) -> jax.Array:
            return jax.jvp(f, (x,), (dx,))[1] - c

        return lambda force, c: iterate(lambda dx: residual(dx, c), -c, force)

    def value(dq: jax.Array) -> jax.Array:
        return position_residuals(context, rows, residuals_at(d, model, t, q, dq, v)[0], dq)

    def rate(dv: jax.Array) -> jax.Array:
        return residuals_at(d, model, t, q, dq, v + dv)[1]

    dq, l = jnp.zeros_like(v), jnp.zeros(len(rows), v.dtype)
    first = residuals_of(rows, v)
    of_positions: Solve = _no_change
    if positions and any(row.holonomic for row in rows):
        dq, l = iterate(value, first[0])
        first, of_positions = residuals_at(d, model, t, q, dq, v), linear(value, dq)
    dv, m = iterate(rate, first[1])
    return Changes(dq, l, dv, m, of_positions, linear(rate, dv))


def _no_change(force: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jnp.zeros_like(force), jnp.zeros_like(c)


def project_to_tangent_space(
    model: Model, t: Any, state: State, t0: Any, start: State, iterations: int | None = None
) -> State:
    """Return the consistent state with the same components in the tangent space at `start`."""
    return _project_stage(model, t, state, t0, start, iterations, False)


def solve_dependent(
    model: Model, t: Any, state: State, t0: Any, start: State, iterations: int | None = None
) -> State:
    """Solve the constraints for the coordinates and velocities that are dependent at `start`."""
    return _project_stage(model, t, state, t0, start, iterations, True)


def _project_stage(
    model: Model, t: Any, state: State, t0: Any, start: State, iterations: int | None,
    dependent: bool,
) -> State:  # fmt: skip
    q, v, top = start.q, state.v, model.topology
    many = STAGE_ITERATIONS[q.dtype.itemsize] if iterations is None else iterations
    u = pack(difference_lanes(top, list(q), list(state.q)), v)

    method = functools.partial(_newton, many=many, dependent=dependent)

    du, dv = least_change(method, model, t0, t, q, u, v, dependent)
    return State(retract(model, q, u + du), v + dv, state.x)


def _dependent(G: jax.Array) -> jax.Array:
    """Return a mask (nv,): 1 for dependent coordinates, chosen by elimination, and 0 for others."""
    G = jax.lax.stop_gradient(G)
    length = jnp.sqrt((G * G).sum(1, keepdims=True))
    chosen = eliminate(jnp.where(length > 0, G / jnp.where(length > 0, length, 1.0), 0.0))[1]
    return chosen.any(0).astype(G.dtype)


def eliminate(G: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Reduce [G 1] by Gauss-Jordan elimination with full pivoting.

    Returns:
        The reduced matrix (m, n + m), and a mask (m, n) of the pivots.
    """
    m, n = G.shape
    zero = rank_tolerance("constraint rows", G.dtype) * jnp.abs(G).max()

    def step(_: int, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        W, chosen = x
        remaining = ~chosen.any(1)[:, None] & ~chosen.any(0)
        size = jnp.where(remaining, jnp.abs(W[:, :n]), -1.0)
        i, j = jnp.unravel_index(size.argmax(), (m, n))
        found = size[i, j] > zero
        row = W[i] / jnp.where(found, W[i, j], 1.0)
        reduced = (W - W[:, j][:, None] * row).at[i].set(row)
        return jnp.where(found, reduced, W), chosen.at[i, j].set(found | chosen[i, j])

    start = jnp.concatenate([G, jnp.eye(m, dtype=G.dtype)], 1), jnp.zeros((m, n), bool)
    return jax.lax.fori_loop(0, min(m, n), step, start)


def _newton(
    d: Driver, model: Model, t0: Any, t: Any, q: jax.Array, u: jax.Array, v: jax.Array, many: int,
    dependent: bool,
) -> Changes:  # fmt: skip
    def rows_at(t: Any, u: jax.Array, v: jax.Array) -> tuple[Context, list[Row]]:
        context = Context.of(model, t, State(retract(model, q, u), v), None, d=d)
        return context, rows_of(model, context)

    first, rows = rows_at(t0, jnp.zeros_like(u), v)
    if dependent:
        G_0 = gradient_matrix(first, rows)
        Y = (G_0 * _dependent(G_0)).T
        size, free = (G_0 * Y.T).sum(1), jnp.zeros(len(rows), v.dtype)
    else:
        factors = factorize(d, first.links.joints)
        delassus = DelassusMatrix(d, factors, first, rows)
        G_0, Y = delassus.G, delassus.Y
        size, free = jnp.diagonal(delassus.A), delassus.free_diagonal
    size = size + diagonal_floor(size, free, 1.0)  # a vanishing row stays short
    r = jnp.where(size > 0, 1.0, 0.0) / jnp.sqrt(jnp.where(size > 0, size, 1.0))

    def correction(G: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Compute the correction x that solves G x = c with x = W^-1 G_0^T l, and the multipliers
        l.

        G_0 is the gradient at the start, and W the weight. If rows are redundant, l has least norm.
        """
        J = r[:, None] * matmat(G, Y) * r
        l = r * matvec(J.T, solve_least_norm(matmat(J, J.T), r * c, 1.0))
        return matvec(Y, l), l

    holonomic = np.array([row.holonomic for row in rows])

    def by_du(G: jax.Array, du: jax.Array) -> jax.Array:
        """Return the gradient of the rows with respect to du instead of the velocity. Attitudes
        rotate by J_r(u) du. Non-holonomic rows keep the gradient G_0 of the start."""
        back = list(-(u + du))
        rotated = jax.vmap(lambda row: pack(velocity_lanes(model.topology, back, list(row)), row))
        return jnp.where(holonomic[:, None], rotated(G), G_0)

    def improve_positions(_: Any, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        context, there = rows_at(t, u + x[0], v)
        residual = position_residuals(first, rows, residuals_of(there, v)[0], x[0])
        more = correction(by_du(gradient_matrix(context, there), x[0]), -residual)
        return x[0] + more[0], x[1] + more[1]

    du, l = jnp.zeros_like(u), jnp.zeros(len(rows), u.dtype)
    if holonomic.any():
        du, l = jax.lax.fori_loop(0, many, improve_positions, (du, l))
    G = gradient_matrix(*rows_at(t, u + du, v))

    def improve_velocities(_: Any, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        more = correction(G, -residuals_at(d, model, t, q, u + du, v + x[0])[1])
        return x[0] + more[0], x[1] + more[1]

    def linear(G: jax.Array) -> Solve:
        def solve(force: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
            free = force if dependent else d.pack(solve_mass(d, factors, d.lanes(force)), force)
            x, l = correction(G, c - matvec(G, free))
            return free + x, l

        return solve

    zero = jnp.zeros_like(v), jnp.zeros_like(l)
    dv, m = jax.lax.fori_loop(0, 2, improve_velocities, zero)  # linear: two are enough
    return Changes(du, l, dv, m, linear(by_du(G, du)), linear(G))
