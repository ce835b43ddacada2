"""Conversions between arrays and lanes.

An array (n, ...) becomes n lanes of shape (...), and n lanes an array.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from rbjax.lanes import Lane, fusion_barrier


def unpack(x: jax.Array) -> list[Lane]:
    """The rows of an array as lanes."""
    return [x[i] for i in range(x.shape[0])]


def pack(lanes: Sequence[Lane], like: jax.Array) -> jax.Array:
    """Lanes, materialized, as the rows of an array of the dtype and row shape of `like`."""
    if not lanes:
        return jnp.zeros((0, *like.shape[1:]), like.dtype)
    rows = [jnp.broadcast_to(jnp.asarray(x, like.dtype), like.shape[1:]) for x in lanes]
    return jnp.stack(fusion_barrier(rows))
