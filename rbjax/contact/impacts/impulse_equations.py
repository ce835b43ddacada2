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

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes.arrays import matvec


class ImpulseProblem(NamedTuple):
    """The data of the conditions for n contacts.

    Fields:
        D: (n, 3, n, 3) Delassus matrix in contact axes.
        u: (n, 3) relative velocities without impulses.
        b: (n,) least normal velocities afterwards.
        mu: (n,) friction coefficients.
        active: (n,) contacts that may have an impulse.
        dry: (n,) or (), c.
    """

    D: jax.Array
    u: jax.Array
    b: jax.Array
    mu: jax.Array
    active: jax.Array
    dry: Any = 0.0

    def friction(self, normal: jax.Array) -> jax.Array:
        """Compute the largest friction impulses (n,) at normal impulses (n,). An infinite
        coefficient counts as 0."""
        return jnp.where(jnp.isinf(self.mu), 0, self.mu) * normal + self.dry


def sweep_impulses(problem: ImpulseProblem, p: jax.Array, sweeps: int) -> jax.Array:
    """Return the impulses (n, 3) after sweeps of projected Gauss-Seidel that start at p."""
    n = len(p)
    if not n:
        return p
    D, u, b, mu, active, _ = problem
    own, tangential = _scales(problem)
    share = jnp.where(jnp.isinf(mu), 0, mu)
    dry = jnp.broadcast_to(jnp.asarray(problem.dry, p.dtype), b.shape)

    def contact(i: Any, p: jax.Array) -> jax.Array:
        row = D[i]
        w = u[i] + (row * p).sum((-2, -1))
        normal = jnp.maximum(p[i, 0] - (w[0] - b[i]) / own[i], 0)
        normal = jnp.where(active[i], normal, 0)
        w = w[1:] + row[1:, i, 0] * (normal - p[i, 0])
        moved = p[i, 1:] - w / tangential[i]
        disc = _on_disc(moved, share[i] * normal + dry[i])
        stuck = jnp.isinf(mu[i]) & active[i]
        return p.at[i].set(jnp.concatenate([normal[None], jnp.where(stuck, moved, disc)]))

    def sweep(p: jax.Array, _: Any) -> tuple[jax.Array, None]:
        for i in range(n) if n <= 2 else ():
            p = contact(i, p)
        return (p if n <= 2 else jax.lax.fori_loop(0, n, contact, p)), None

    return jax.lax.scan(sweep, p, None, length=sweeps)[0]


def natural_map(problem: ImpulseProblem, p: jax.Array) -> jax.Array:
    """Return the residual (n, 3) in m/s, zero at a solution."""
    D, u, b, mu, active, _ = problem
    own, tangential = _scales(problem)
    w = u + (D * p).sum((-2, -1))
    normal = jnp.where(active, jnp.maximum(p[:, 0] - (w[:, 0] - b) / own, 0), 0)
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
    n = len(problem.b)
    block = (problem.D * jnp.eye(n, dtype=problem.D.dtype)[:, None, :, None]).sum(2)
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
