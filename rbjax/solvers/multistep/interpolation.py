"""Interpolation through given times: the coefficients of multistep methods, for any step sizes.

    l_j(x) = prod_m (x - x_m) / (x_j - x_m)
The weights of Adams methods are the integrals of these polynomials. The weights of BDF are their
derivatives at the new time. Equal steps give the textbook's numbers.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def basis(nodes: jax.Array) -> jax.Array:
    """Row j: the coefficients of l_j (n, n), constant first, for distinct nodes (n,)."""
    n = nodes.shape[0]
    own = jnp.eye(n, dtype=bool)
    out = jnp.zeros((n, n), nodes.dtype).at[:, 0].set(1.0)
    for m in range(n):
        times_x = jnp.pad(out, ((0, 0), (1, 0)))[:, :-1]
        gap = jnp.where(own[m], 1.0, nodes - nodes[m])[:, None]
        out = jnp.where(own[m][:, None], out, (times_x - nodes[m] * out) / gap)
    return out


def integrals(nodes: jax.Array) -> jax.Array:
    """Row j: the coefficients of x, x^2, ... in int_0^x l_j (n, n)."""
    return basis(nodes) / jnp.arange(1, nodes.shape[0] + 1, dtype=nodes.dtype)


def slopes_at_one(nodes: jax.Array) -> jax.Array:
    """l_j'(1) (n,)."""
    return (basis(nodes) * jnp.arange(nodes.shape[0], dtype=nodes.dtype)).sum(1)
