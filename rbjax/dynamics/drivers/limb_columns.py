"""Columns over the limbs of a group: one entry for each limb."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import Lane, is_literal, sincos


@jax.custom_jvp
def sequential_sincos(angles: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute cosines and sines in a loop, so that their long program is compiled once."""
    return jax.lax.scan(lambda _, x: ((), sincos(x)), (), angles)[1]


@sequential_sincos.defjvp
def _sequential_sincos_jvp(primals: tuple, tangents: tuple) -> tuple:
    c, s = sequential_sincos(*primals)
    return (c, s), (-s * tangents[0], c * tangents[0])


def widen(column: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Broadcast a column, or a value that all limbs share, to (limbs, 1, ...)."""
    if column.ndim:
        column = jnp.expand_dims(column, (1, *range(column.ndim + 1, len(shape))))
    return jnp.broadcast_to(column, shape)


def rows_of(x: Any, index: Sequence[int]) -> Any:
    """Return rows of an array, by a slice if they are evenly spaced."""
    steps = {b - a for a, b in itertools.pairwise(index)}
    if len(steps) == 1 and min(steps) > 0:
        return x[index[0] : index[-1] + 1 : steps.pop()]
    return x[np.array(index, int)]


def merge(*lanes: Lane) -> Any:
    """Convert the lanes of the limbs to a column, or to a literal if they are one constant."""
    if not all(map(is_literal, lanes)):
        return jnp.stack([jnp.asarray(x) for x in lanes])
    return lanes[0] if all(x == lanes[0] for x in lanes) else np.array(lanes, float)
