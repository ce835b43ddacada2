"""The equations of constrained motion, solved for accelerations and multipliers.

    M a + b = tau + sum of J_i^T f_i + G^T l
    G a + (G' v + ...) = -2 alpha (G v + g_t) - beta^2 g

They are linear in a and l. A method provides accelerations a_0 and solves for the difference:

    M da - G^T dl = tau + sum of J_i^T f_i - b - M a_0,     G da = c - (G a_0 + G' v + ...)

Derivatives use the implicit function theorem: one tangent of RNEA and of the rows, and one solution
by the same method.

The Delassus matrix A = G M^-1 G^T is the response of the rows to multipliers. With the factors of
the articulated-body algorithm (ABA), a sweep along the ancestors of a row's links gives a force u_i
at each joint, and A_rs = sum of u_r,i u_s,i / D_i over the joints that both rows reach.

A is singular if rows are redundant or if one vanishes, as at the flat positions of a parallelogram.
It is regularized by eps diag(A) + e B, and refinement removes the effect. B is the diagonal of A
for free bodies, which does not vanish with the row (`rbjax.lanes.factorization`). l is then the
solution of least norm. At a singular value sigma below sqrt(e) the acceleration along the vanishing
row is damped. Without B, a rounding error u of a row would grow to an acceleration v^2 u / sigma^3.

Source: Masarati, *Multibody System Dynamics*, 8.3 and 8.4; Baumgarte 1972; Featherstone, *Rigid
Body Dynamics Algorithms*, ch. 8; Carpentier, Budhiraja & Mansard, *Proximal and sparse resolution
of constrained dynamics*, 2021.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.constraints.equations.model_rows import (
    add_multipliers,
    gradient_matrix,
    rows_of,
    wrenches_by_link,
)
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.aba import aba, solve, solve_inward, solve_outward
from rbjax.dynamics.algorithms.factors import Factor
from rbjax.dynamics.algorithms.rnea import LinkForces, rnea
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.tracing.custom_rules import jax_arrays, split_tracers, with_implicit_jvp
from rbjax.forces.context import Context
from rbjax.forces.element import Loads
from rbjax.lanes import (
    Lane,
    Vec3,
    add,
    batch_first,
    fusion_barrier,
    is_literal,
    is_zero,
    mul,
    neg,
    sub,
    total,
)
from rbjax.lanes.arrays import matmat, matvec, pack
from rbjax.lanes.factorization import LeastNorm, diagonal_floor, regularization
from rbjax.model import WORLD, Model, State
from rbjax.spatial import Force

#: largest number of rows for which A is factored on lanes, which skip zero blocks
ROWS_ON_LANES = 24
#: (force (nv,), or None for `LinearProblem.force`; c of the rows) -> da (nv,), dl (rows,)
Solve = Callable[[jax.Array | None, Sequence[Lane]], tuple[jax.Array, jax.Array]]
#: (context, rows, l or None for zero, alpha, beta) -> residuals of the rows' equations
RightHandSide = Callable[[Context, Sequence[Row], jax.Array | None, Any, Any], Sequence[Lane]]


class LinearProblem(NamedTuple):
    """Linear equations of a method, for the difference da from accelerations a_0.

    Fields:
        start: (nv,) accelerations a_0; None for zero.
        force: (nv,) right-hand side of M da; None if `factor` includes it.
        factor: (context, rows) -> function that solves the equations.
    """

    start: jax.Array | None
    force: jax.Array | None
    factor: Callable[[Context, Sequence[Row]], Solve]


#: (driver, context, tau, f_ext) -> equations of the method
LinearMethod = Callable[[Driver, Context, jax.Array, LinkForces], LinearProblem]


def range_space_problem(
    d: Driver, context: Context, tau: jax.Array, f_ext: LinkForces
) -> LinearProblem:
    """Set up the range-space equations A l = c - G a_f of the multipliers l, for rows G a = c.
    A = G M^-1 G^T is the Delassus matrix, and a_f the acceleration without constraints."""
    qdd, factors = aba(d, context.links.joints, d.lanes(tau), d.prepared.gravity, f_ext)

    def factor(context: Context, rows: Sequence[Row]) -> Solve:
        return factor_delassus(d, factors, context, rows).solve

    return LinearProblem(d.pack(qdd, tau), None, factor)


def feedback_right_hand_side(
    context: Context, rows: Sequence[Row], l: Any, alpha: Any, beta: Any
) -> Sequence[Lane]:
    """Return the right-hand side -g'' - 2 alpha g' - beta^2 g of each row (Baumgarte feedback)."""
    del context, l
    return [baumgarte_residual(row, alpha, beta) for row in rows]


def baumgarte_residual(row: Row, alpha: Any, beta: Any) -> Lane:
    """Return -g'' - 2 alpha g' - beta^2 g of a row: the residual with Baumgarte feedback."""
    out = add(row.acceleration, mul(mul(2.0, alpha), row.rate))
    return neg(add(out, mul(mul(beta, beta), row.residual)))


def constrained_motion(
    model: Model,
    t: Any,
    state: State,
    tau: jax.Array,
    f_ext: LinkForces,
    alpha: Any = 0.0,
    beta: Any = 0.0,
    method: LinearMethod = range_space_problem,
    right_hand_side: RightHandSide = feedback_right_hand_side,
) -> tuple[jax.Array, jax.Array]:
    """Compute accelerations a (nv,) and multipliers l (rows,) of one sample, from checked arrays.
    alpha, beta: Baumgarte gains, 1/s."""
    given, rebuilt = split_tracers((model, f_ext, t, alpha, beta))
    nv = model.nv

    def solve_with_factors(changed, q, v, tau):
        model, f_ext, t, alpha, beta = rebuilt(changed)
        d = driver(model, q.dtype)
        context = Context.of(model, t, State(q, v), None, d=d)
        start, force, factor = method(d, context, tau, f_ext)
        context = context if start is None else context.accelerating(start)
        rows = rows_of(model, context)
        solve = factor(context, rows)
        da, l = solve(force, right_hand_side(context, rows, None, alpha, beta))
        a = da if start is None else start + da
        return jnp.concatenate([a, l]), solve

    def plain(*at):
        return batch_first((solve_with_factors(*at)[0],), at)

    def solved(changed, q, v, tau):
        x, solve = solve_with_factors(changed, q, v, tau)
        return (x,), [lambda change: jnp.concatenate(solve(change[:nv], list(change[nv:])))]

    def residual(changed, q, v, tau, x):
        model, f_ext, t, alpha, beta = rebuilt(changed)
        a, l = x[:nv], x[nv:]
        d = driver(model, q.dtype)
        context = Context.of(model, t, State(q, v), None, d=d).accelerating(a)
        rows = rows_of(model, context)
        joints = context.links.joints  # evaluated first, because the driver reads its lanes
        tau, f_ext = add_multipliers(d, rows, list(l), tau, f_ext)
        forces = rnea(d, joints, d.lanes(a), d.prepared.gravity, f_ext)
        remaining = pack(right_hand_side(context, rows, l, alpha, beta), a)
        return jnp.concatenate([tau - d.pack(forces, tau), remaining])

    at = jax_arrays(given, state.q, state.v, tau)
    (found,) = with_implicit_jvp(plain, solved, residual)(*at)
    return found[:nv], found[nv:]


def free_body_diagonal(d: Driver, row: Row) -> Lane:
    """Return the diagonal entry of G M^-1 G^T of a row, for links that are free bodies of isotropic
    inertia. It is the sum of f^2 / m for forces f, and of n^2 / (tr J / 3) for torques n on links
    without a force. It does not vanish with the lever arm of a force."""
    out: Lane = 0.0
    for link, load in wrenches_by_link(row.gradient).items():
        body = d.prepared.link(link).inertia
        if any(not is_zero(x) for x in load.lin):
            out = add(out, _divide(load.lin, body.m))
        else:
            xx, yy, zz, *_ = body.J
            out = add(out, _divide(load.ang, mul(1 / 3, add(add(xx, yy), zz))))
    return out


def _divide(load: Vec3, inertia: Lane) -> Lane:
    """Return |load|^2 / inertia, or zero if the inertia is zero."""
    if is_literal(inertia):
        return mul(1.0 / inertia if inertia > 0 else 0.0, load.dot(load))
    positive = inertia > 0
    return mul(load.dot(load), jnp.where(positive, 1.0 / jnp.where(positive, inertia, 1.0), 0.0))


def factor_delassus(
    d: Driver, factors: Any, context: Context, rows: Sequence[Row], damping: float | None = None
) -> Delassus:
    """Factor the Delassus matrix G M^-1 G^T, on lanes or, for many rows or a rolled tree, as an
    array.

    damping: replaces the regularization parameters and sets one refinement; None uses the values
        of the dtype.
    """
    few = d.listed and len(rows) <= ROWS_ON_LANES and not d.topology.frames
    return (DelassusOnLanes if few else DelassusMatrix)(d, factors, context, rows, damping)


def eliminate_loads(
    parents: Sequence[int],
    factors: Mapping[int, Factor],
    links: Sequence[int],
    loads: Loads,
    base: int = WORLD,
) -> tuple[dict[int, Lane], dict[int, Lane], Force]:
    """Propagate the loads of a row inward along `links`, by the factors of the mass matrix.

    Returns:
        The force u at each joint that the loads reach, u / D, and the wrench on the base.
    """
    pending, us, es = dict(wrenches_by_link(loads)), {}, {}
    for i in links:
        tau = loads.tau.get(i, 0.0)
        if i not in pending and is_zero(tau):
            continue
        f, x, parent = pending.pop(i, Force.zero()), factors[i], parents[i]
        u = add(tau, x.S.dot(f))
        e, message = mul(u, x.inverse_D), None
        if parent != WORLD:
            message = pending.get(parent, Force.zero()) + x.X.T(f - x.U * e)
        us[i], es[i], message = fusion_barrier((u, e, message), known=(tau, f, x))
        if parent != WORLD:
            pending[parent] = message
    return us, es, pending.get(base, Force.zero())


def joint_product(a: dict[int, Lane], b: dict[int, Lane]) -> Lane:
    """Return the sum of a_i b_i over the joints i that both dictionaries contain."""
    return fusion_barrier(total(mul(a[i], b[i]) for i in sorted(a.keys() & b.keys())))


def delassus_triangle(
    u: Sequence[dict[int, Lane]], e: Sequence[dict[int, Lane]]
) -> list[list[Lane]]:
    """Return the lower triangle of the Delassus matrix from joint forces u and e = u / D by row."""
    return [[joint_product(a, b) for b in e[: r + 1]] for r, a in enumerate(u)]


class Delassus:
    """Base class of the factored Delassus matrix G M^-1 G^T."""

    def __init__(
        self, d: Driver, factors: Any, context: Context, rows: Sequence[Row], damping: float | None
    ):
        self._d, self._factors, self._like, self._damping = d, factors, context.v, damping
        self._free = [free_body_diagonal(d, row) for row in rows]

    def solve(self, force: jax.Array | None, c: Sequence[Lane]) -> tuple[jax.Array, jax.Array]:
        """Solve M a = force + G^T l, G a = c for a (nv,) and l (rows,) of least norm. A force of
        None means zero."""
        raise NotImplementedError(f"{type(self).__name__} has no method solve(force, c) -> a, l")


class DelassusOnLanes(Delassus):
    """Delassus matrix on lanes, from the forces of rows at the joints that they share."""

    def __init__(
        self, d: Driver, factors: Any, context: Context, rows: Sequence[Row], damping: float | None
    ):
        super().__init__(d, factors, context, rows, damping)
        links = dict(enumerate(d.whole(factors)))
        inward = sorted(links, reverse=True)
        parents = d.topology.parents
        units = [eliminate_loads(parents, links, inward, row.gradient) for row in rows]
        self._u, self._e = [u for u, _, _ in units], [e for _, e, _ in units]

    @cached_property
    def _A(self) -> LeastNorm:
        A = delassus_triangle(self._u, self._e)
        return LeastNorm(A, self._free, self._like.dtype, self._damping)

    def solve(self, force: jax.Array | None, c: Sequence[Lane]) -> tuple[jax.Array, jax.Array]:
        d, left = self._d, {}
        if force is not None:
            ys = solve_inward(d, self._factors, d.lanes(force))
            left = dict(enumerate(d.whole(d.part(ys, 1))))
            c = [sub(x, joint_product(left, e)) for x, e in zip(c, self._e, strict=True)]
        l = self._A.solve(c)
        for own, x in zip(self._u, l, strict=True):
            for i, y in own.items():
                left[i] = add(left.get(i, 0.0), mul(x, y))
        a = solve_outward(d, d.zip(self._factors, d.scattered(left, 0.0)))
        return d.pack(a, self._like), pack(l, self._like)


class DelassusMatrix(Delassus):
    """Delassus matrix A = G Y with Y = M^-1 G^T, as an array. R (rows,) is added to its diagonal
    for compliant rows, G a + R l = c."""

    def __init__(
        self,
        d: Driver,
        factors: Any,
        context: Context,
        rows: Sequence[Row],
        damping: float | None = None,
        R: jax.Array | None = None,
    ):
        super().__init__(d, factors, context, rows, damping)
        self._R, self.free_diagonal = R, pack(self._free, context.v)
        self.G = gradient_matrix(context, rows)
        self.Y = jax.vmap(lambda row: d.pack(solve(d, factors, d.lanes(row)), row))(self.G).T

    @cached_property
    def A(self) -> jax.Array:
        A = matmat(self.G, self.Y)
        return A if self._R is None else A + jnp.diag(self._R)

    def solve(self, force: jax.Array | None, c: Sequence[Lane]) -> tuple[jax.Array, jax.Array]:
        b, free = pack(c, self._like), None
        if force is not None:
            free = self._d.pack(solve(self._d, self._factors, self._d.lanes(force)), force)
            b = b - matvec(self.G, free)
        l = solve_least_norm(self.A, b, self.free_diagonal, self._damping)
        a = matvec(self.Y, l)
        return a if free is None else free + a, l


def solve_least_norm(
    A: jax.Array, c: jax.Array, B: jax.Array | float = 0.0, damping: float | None = None
) -> jax.Array:
    """Solve A l = c, with A (rows, rows) positive semidefinite, for l of least norm.
    B: (rows,) `free_body_diagonal`; 0 if unknown. damping: as in `factor_delassus`."""
    eps, vanishing, refinements = regularization(A.dtype, damping)
    diagonal = jnp.diagonal(A)
    D = diagonal + diagonal_floor(diagonal, B, vanishing) / eps
    s = jnp.where(D > 0, 1.0, 0.0) / jnp.sqrt(jnp.where(D > 0, D, 1.0))
    scaled = s[:, None] * A * s[None]
    factors = jax.scipy.linalg.cho_factor(scaled + eps * jnp.eye(len(A), dtype=A.dtype))
    b = s * c
    l = jax.scipy.linalg.cho_solve(factors, b)
    for _ in range(refinements):
        l = l + jax.scipy.linalg.cho_solve(factors, b - matvec(scaled, l))
    return s * l
