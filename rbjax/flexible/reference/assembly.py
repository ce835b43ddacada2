"""Residual and tangent of a mesh from those of its elements, and Newton's method on them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.flexible.reference.mesh import Mesh

#: a correction below this ends Newton's method: m per metre of the beam, or rad
TOLERANCE = 1e-10
#: a correction that no longer shrinks is rounding error if it is below this
ROUNDING = 1e-6
ITERATIONS = 30


class Newton(NamedTuple):
    """Result of `newton`.

    delta: the increments (nodes, d).
    iterations: their number, int.
    success: whether the corrections converged.
    """

    delta: jax.Array
    iterations: jax.Array
    success: jax.Array


def assemble(
    mesh: Mesh, element: Callable[..., jax.Array], delta: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Sum an element function and its derivative over a mesh.

    element: maps data, history, q (k, c) and increments (k, d) of one element to (k, d).
    delta: increments of the nodes, (nodes, d).
    Returns the sum (nodes, d) and its derivative (nodes, d, nodes, d).
    """
    nodes, (n, d) = mesh.connectivity, delta.shape

    def value(data: Any, history: Any, q: jax.Array, delta: jax.Array) -> tuple:
        out = element(data, history, q, delta)
        return out, out

    both = jax.vmap(jax.jacfwd(value, 3, has_aux=True))
    tangent, residual = both(mesh.data, mesh.history, mesh.q[nodes], delta[nodes])
    total = jnp.zeros((n, d)).at[nodes].add(residual)
    blocks = jnp.zeros((n, n, d, d))
    blocks = blocks.at[nodes[:, :, None], nodes[:, None, :]].add(tangent.transpose(0, 1, 3, 2, 4))
    return total, blocks.transpose(0, 2, 1, 3)


def sum_elements(mesh: Mesh, element: Callable[..., jax.Array], delta: jax.Array) -> jax.Array:
    """Sum an element function as `assemble` does, without its derivative: (nodes, d)."""
    nodes = mesh.connectivity
    out = jax.vmap(element)(mesh.data, mesh.history, mesh.q[nodes], delta[nodes])
    return jnp.zeros(delta.shape).at[nodes].add(out)


def newton(
    mesh: Mesh,
    element: Callable[..., jax.Array],
    load: Callable[..., jax.Array],
    wrenches: jax.Array,
    start: jax.Array,
    free: jax.Array,
    basis: jax.Array,
) -> Newton:
    """Find the increments of the free dofs for which the elements balance the loads.

    element: as in `assemble`, the generalised forces that an increment needs.
    load: maps q (c,), increment (d,) and wrench (6,) of a node to its generalised force (d,).
    wrenches: forces and moments on the nodes, (nodes, 6), world axes.
    start: first guess (nodes, d), with the increments of fixed dofs.
    free: indices of the free dofs among all nodes * d, (free,), node 0 in the axes `basis` (d, d).
    """
    n, d = start.shape
    size = jnp.max(jnp.linalg.norm(mesh.formulation.pose(mesh.q)[0], axis=-1)) + 1e-300
    lengths = jnp.arange(d) < (2 if mesh.formulation.c == 4 else 3)  # the rest has no unit
    scale = jnp.tile(jnp.where(lengths, size, 1.0), n)[free]
    nodes = jnp.arange(n)

    def on_nodes(q: jax.Array, delta: jax.Array, wrench: jax.Array) -> tuple:
        out = load(q, delta, wrench)
        return out, out

    def correction(delta: jax.Array) -> jax.Array:
        residual, tangent = assemble(mesh, element, delta)
        slope, loads = jax.vmap(jax.jacfwd(on_nodes, 1, has_aux=True))(mesh.q, delta, wrenches)
        residual, tangent = residual - loads, tangent.at[nodes, :, nodes, :].add(-slope)
        residual = residual.at[0].set(basis.T @ residual[0])
        tangent = tangent.at[0].set(jnp.tensordot(basis.T, tangent[0], 1))
        tangent = tangent.at[:, :, 0].set(tangent[:, :, 0] @ basis)
        K = tangent.reshape(n * d, n * d)[free[:, None], free]
        return -jnp.linalg.solve(K, residual.ravel()[free])

    def cond(carry: tuple) -> jax.Array:
        _, last, now, count = carry
        rounding = (now < ROUNDING) & (now > 0.5 * last)
        return (now > TOLERANCE) & ~rounding & (count < ITERATIONS) & jnp.isfinite(now)

    def body(carry: tuple) -> tuple:
        delta, _, last, count = carry
        change = correction(delta)
        full = jnp.zeros(n * d).at[free].set(change).reshape(n, d)
        full = full.at[0].set(basis @ full[0])
        return delta + full, last, jnp.max(jnp.abs(change) / scale), count + 1

    begin = (
        start,
        jnp.array(jnp.finfo(float).max),
        jnp.array(jnp.finfo(float).max / 4),
        jnp.array(0),
    )
    delta, last, now, count = jax.lax.while_loop(cond, body, begin)
    success = (now <= TOLERANCE) | ((now < ROUNDING) & (now > 0.5 * last))
    return Newton(delta, count, success)
