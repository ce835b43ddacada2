"""Constraints by the method of multipliers.

low <= c <= high is enforced by a penalty with a shifted centre, a residual of the cost:

    L = mu/2 |s - clip(s, low, high)|^2,     s = c + lambda / mu

At the minimum of the cost with L, its gradient is that of the Lagrangian with the multipliers

    lambda <- mu (s - clip(s, low, high)),     mu <- 10 mu where the violation did not fall

Source: Hestenes 1969, Powell 1969; Bertsekas, *Constrained Optimization and Lagrange Multiplier
Methods*, 2.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

PENALTY, HARDER, PENALTY_MOST = 10.0, 10.0, 1e8
FALLS = 0.25  # a violation that does not fall to this share raises the penalty


class Multipliers(NamedTuple):
    """Of constraints: path (N, c) and end (e,), and the penalty mu ()."""

    path: jax.Array
    end: jax.Array
    penalty: jax.Array


def no_multipliers(N: int, path: int, end: int, dtype: jax.typing.DTypeLike) -> Multipliers:
    """Zero multipliers of `path` and `end` rows, and the first penalty."""
    zero = jnp.zeros((N, path), dtype), jnp.zeros(end, dtype)
    return Multipliers(*zero, jnp.asarray(PENALTY, dtype))


def shift_multipliers(multipliers: Multipliers | None, at: jax.Array) -> Multipliers | None:
    """The multipliers of a motion that begins later. at (N,): for each of its knots, the index of
    this knot in the earlier motion."""
    if multipliers is None:
        return None
    return multipliers._replace(path=multipliers.path[at])


def penalty_residuals(
    c: jax.Array, y: jax.Array, mu: jax.Array, low: jax.Array, high: jax.Array
) -> jax.Array:
    """The residuals of L: sqrt(mu) (s - clip(s))."""
    s = c + y / mu
    return jnp.sqrt(mu) * (s - jnp.clip(s, low, high))


def next_multipliers(
    c: jax.Array, y: jax.Array, mu: jax.Array, low: jax.Array, high: jax.Array
) -> jax.Array:
    """mu (s - clip(s))."""
    s = c + y / mu
    return mu * (s - jnp.clip(s, low, high))


def next_penalty(
    mu: jax.Array, violation: jax.Array, before: jax.Array, held: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The penalty after a turn of multipliers, and whether the violation did not fall as it should.
    before: the violation a turn ago; held: whether it is small enough."""
    failing = ~held & (violation > FALLS * before)
    return jnp.where(failing, jnp.minimum(HARDER * mu, PENALTY_MOST), mu), failing
