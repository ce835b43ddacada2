"""Impulses p of contacts that satisfy Signorini's and Coulomb's conditions together.

    w = u + D p,   0 <= p_n  _|_  w_n - b >= 0,   |p_t| <= mu p_n + c,   p_t against w_t if w_t != 0
D is the Delassus matrix, u the relative velocity without impulses, b the least normal velocity
afterwards. mu = 0 is frictionless; mu = inf sticks. c is dry friction without a normal impulse.

Sweeps of projected Gauss-Seidel visit the contacts one by one, the normal impulse first. The
residual is the natural map, in m/s: the change of w that a projection step would make. Its Newton
step removes the error of the sweeps, and gives the derivatives by the implicit function theorem.

Source: Moreau, *Unilateral contact and dry friction in finite freedom dynamics*, 1988; Acary &
Brogliato, *Numerical Methods for Nonsmooth Dynamical Systems*, ch. 13; Jourdan, Alart & Jean 1998.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.contact.solver.solution import with_rule_of
from rbjax.lanes.arrays import matmat, matrix_transpose, matvec


class ImpulseProblem(NamedTuple):
    """The data of the conditions for n contacts.

    Fields:
        J: (n, 3, nv) Jacobian of the relative velocities, in contact axes.
        Y: (nv, 3 n) W J^T, changes of the velocity of the robot by unit impulses.
        u: (n, 3) relative velocities without impulses.
        b: (n,) least normal velocities afterwards.
        mu: (n,) friction coefficients.
        active: (n,) contacts that may have an impulse.
        dry: (n,) or (), c.
    """

    J: jax.Array
    Y: jax.Array
    u: jax.Array
    b: jax.Array
    mu: jax.Array
    active: jax.Array
    dry: Any = 0.0

    @property
    def D(self) -> jax.Array:
        """The Delassus matrix J W J^T (n, 3, n, 3) in contact axes."""
        n, _, nv = self.J.shape
        return matmat(self.J.reshape(3 * n, nv), self.Y).reshape(n, 3, n, 3)

    @property
    def blocks(self) -> jax.Array:
        """The blocks (n, 3, 3) on the diagonal of the Delassus matrix."""
        return (self.J[:, :, None] * self.columns[:, None]).sum(-1)

    @property
    def columns(self) -> jax.Array:
        """W J^T by contact, (n, 3, nv)."""
        return matrix_transpose(self.Y).reshape(self.J.shape)

    def relative_velocity(self, p: jax.Array) -> jax.Array:
        """Compute the relative velocities (n, 3) under impulses p (n, 3)."""
        n, _, nv = self.J.shape
        return self.u + matvec(self.J.reshape(3 * n, nv), self.change(p)).reshape(n, 3)

    def change(self, p: jax.Array) -> jax.Array:
        """Compute the change of the velocity of the robot (nv,) by impulses p (n, 3)."""
        return matvec(self.Y, p.reshape(-1))

    def friction(self, normal: jax.Array) -> jax.Array:
        """Compute the largest friction impulses (n,) at normal impulses (n,). An infinite
        coefficient counts as 0."""
        return jnp.where(jnp.isinf(self.mu), 0, self.mu) * normal + self.dry


def sweep_impulses(problem: ImpulseProblem, p: jax.Array, sweeps: int) -> jax.Array:
    """Return the impulses (n, 3) after sweeps of projected Gauss-Seidel that start at p.

    The sweeps keep the change y = W J^T p of the velocity, so a visit of a contact costs 6 nv
    products. They visit only contacts that may have an impulse; inactive ones start at zero. Their
    derivative is the one of sweeps over all contacts, in both modes.
    """
    if not len(p):
        return p
    problem = jax.tree.map(jnp.asarray, problem)
    sweep = functools.partial(_sweeps, count=sweeps)
    return with_rule_of(functools.partial(sweep, some=True), sweep)(problem, p)


def _sweeps(problem: ImpulseProblem, p: jax.Array, *, count: int, some: bool = False) -> jax.Array:
    """Return the impulses after sweeps. some: whether to visit only contacts with impulses, which
    has no reverse derivative."""
    n = len(p)
    J, u, b, mu, active, columns = problem.J, problem.u, *problem[3:6], problem.columns
    blocks, (own, tangential) = problem.blocks, _scales(problem)
    share = jnp.where(jnp.isinf(mu), 0, mu)
    dry = jnp.broadcast_to(problem.dry, b.shape).astype(p.dtype)

    def contact(i: Any, now: tuple) -> tuple:
        p, y = now
        w = u[i] + (J[i] * y).sum(-1)
        normal = jnp.maximum(p[i, 0] - (w[0] - b[i]) / own[i], 0)
        normal = jnp.where(active[i], normal, 0)
        w = w[1:] + blocks[i, 1:, 0] * (normal - p[i, 0])
        moved = p[i, 1:] - w / tangential[i]
        disc = _on_disc(moved, share[i] * normal + dry[i])
        stuck = jnp.isinf(mu[i]) & active[i]
        new = jnp.concatenate([normal[None], jnp.where(stuck, moved, disc)])
        return p.at[i].set(new), y + (columns[i] * (new - p[i])[:, None]).sum(0)

    def sweep(now: tuple, _: Any) -> tuple[tuple, None]:
        for i in range(n) if n <= 2 else ():
            now = contact(i, now)
        if order is not None:
            now = jax.lax.fori_loop(0, length, lambda k, x: contact(order[k], x), now)
        elif n > 2:
            now = jax.lax.fori_loop(0, n, contact, now)
        return now, None

    order, length = _in_order(active | (dry > 0)) if some and n > 2 else (None, n)
    return jax.lax.scan(sweep, (p, problem.change(p)), None, length=count)[0][0]


def _in_order(chosen: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the indices of the chosen entries (n,), followed by others, and their number."""

    def store(i: Any, now: tuple) -> tuple:
        order, k = now
        return order.at[k].set(jnp.asarray(i, jnp.int32)), k + chosen[i].astype(jnp.int32)

    none = jnp.zeros(len(chosen), jnp.int32), jnp.int32(0)
    return jax.lax.fori_loop(0, len(chosen), store, none)


def natural_map(problem: ImpulseProblem, p: jax.Array) -> jax.Array:
    """Return the residual (n, 3) in m/s, zero at a solution."""
    mu, active, (own, tangential) = problem.mu, problem.active, _scales(problem)
    w = problem.relative_velocity(p)
    normal = jnp.where(active, jnp.maximum(p[:, 0] - (w[:, 0] - problem.b) / own, 0), 0)
    moved = p[:, 1:] - w[:, 1:] / tangential[:, None]
    stuck = (jnp.isinf(mu) & active)[:, None]
    tangent = jnp.where(stuck, moved, jax.vmap(_on_disc)(moved, problem.friction(normal)))
    scales = jnp.stack([own, tangential, tangential], -1)
    return scales * (p - jnp.concatenate([normal[:, None], tangent], -1))


def solve_impulses(
    problem: ImpulseProblem, sweeps: int = 100, newton_steps: int = 4
) -> tuple[jax.Array, jax.Array]:
    """Return impulses (n, 3) and the largest residual in m/s.

    The last Newton step has a constant Jacobian, so that the derivatives are those of the implicit
    function theorem. If contacts are redundant, a step is the one of least norm.
    """
    n = len(problem.b)
    if not n:
        return jnp.zeros_like(problem.u), jnp.zeros((), problem.u.dtype)
    fixed = jax.lax.stop_gradient(problem)
    p = sweep_impulses(fixed, jnp.zeros_like(problem.u), sweeps)
    size = 3 * n
    rank = jnp.finfo(p.dtype).eps * size * 10

    def step(problem: ImpulseProblem, p: jax.Array, at: jax.Array) -> jax.Array:
        K = jax.jacfwd(lambda p: natural_map(fixed, p))(at).reshape(size, size)
        F = natural_map(problem, p).reshape(size)
        return p - matvec(jax.lax.stop_gradient(jnp.linalg.pinv(K, rtol=rank)), F).reshape(n, 3)

    def error(p: jax.Array) -> jax.Array:
        return jnp.abs(natural_map(fixed, p)).max()

    def improve(p: jax.Array, _: Any) -> tuple[jax.Array, None]:
        new = step(fixed, p, p)
        return jnp.where(error(new) < error(p), new, p), None

    p = jax.lax.stop_gradient(jax.lax.scan(improve, p, None, length=newton_steps)[0])
    residual = error(p)
    return step(problem, p, p), residual


def _scales(problem: ImpulseProblem) -> tuple[jax.Array, jax.Array]:
    """Return the normal diagonal entry of D and a bound of its tangential block, per contact."""
    block = problem.blocks
    normal = block[:, 0, 0]
    tangential = jnp.maximum(block[:, 1, 1], block[:, 2, 2]) + jnp.abs(block[:, 1, 2])
    # a contact between bodies that cannot move has no impulse; any scale will do
    return jnp.where(normal > 0, normal, 1), jnp.where(tangential > 0, tangential, 1)


def _on_disc(x: jax.Array, radius: jax.Array) -> jax.Array:
    """Project x (2,) onto a disc about zero."""
    square = (x * x).sum()
    outside = square > radius * radius
    length = jnp.sqrt(jnp.where(outside, square, 1))
    return jnp.where(outside, x * (radius / length), x)
