"""The smallest and the largest entry of an array, with a derivative that is always finite.

The derivative of `jnp.min` divides by the number of entries that are equal to the minimum. XLA may
compute the entries a second time for this comparison, and round them in another way. If none is
equal, the derivative is 0 / 0. Here it is that of one entry, chosen by its index.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

Pair = tuple[jax.Array, jax.Array]


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def smallest(x: jax.Array, axis: int = -1) -> jax.Array:
    """The minimum along an axis that is not empty."""
    return x.min(axis)


@smallest.defjvp
def _(axis: int, primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> Pair:
    return _picked(jnp.argmin(*primals, axis, keepdims=True), axis, *primals, *tangents)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def largest(x: jax.Array, axis: int = -1) -> jax.Array:
    """The maximum along an axis that is not empty."""
    return x.max(axis)


@largest.defjvp
def _(axis: int, primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> Pair:
    return _picked(jnp.argmax(*primals, axis, keepdims=True), axis, *primals, *tangents)


def _picked(index: jax.Array, axis: int, x: jax.Array, dx: jax.Array) -> Pair:
    one, other = (jnp.take_along_axis(y, index, axis).squeeze(axis) for y in (x, dx))
    return one, other
