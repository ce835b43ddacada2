"""The logarithmic barrier of a primal-dual interior point method, entry by entry.

    min f - mu sum log(v - low) - mu sum log(high - v)
    zl = mu / (v - low),  zu = mu / (high - v)   are the multipliers of the bounds, and the Newton
    step of both conditions adds  Sigma = zl / (v - low) + zu / (high - v)  to the Hessian

A step leaves at least a given fraction of each distance to a bound (Waechter & Biegler 2006,
*Ipopt*). An infinite bound has no barrier.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

PUSH = 1e-2  # distance of a first guess from its bounds, relative to their size
FAR = 1e10  # multipliers stay within this factor of mu / distance


class Duals(NamedTuple):
    """Multipliers zl and zu of the bounds, in the shape of v."""

    zl: jax.Array
    zu: jax.Array


class BoundedVariable(NamedTuple):
    """A variable v with its bounds."""

    v: jax.Array
    low: jax.Array
    high: jax.Array

    @property
    def below(self) -> jax.Array:
        """The distance v - low from the lower bound, or 1 without a bound."""
        return jnp.where(jnp.isfinite(self.low), self.v - self.low, 1.0)

    @property
    def above(self) -> jax.Array:
        """The distance high - v from the upper bound, or 1 without a bound."""
        return jnp.where(jnp.isfinite(self.high), self.high - self.v, 1.0)


def push_inside(v: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Return v, moved into the interior of the bounds."""
    width = jnp.where(jnp.isfinite(high - low), high - low, jnp.inf)
    at_low = jnp.minimum(PUSH * jnp.maximum(1.0, jnp.abs(low)), PUSH * width)
    at_high = jnp.minimum(PUSH * jnp.maximum(1.0, jnp.abs(high)), PUSH * width)
    v = jnp.where(jnp.isfinite(low), jnp.maximum(v, low + at_low), v)
    return jnp.where(jnp.isfinite(high), jnp.minimum(v, high - at_high), v)


def bound_count(x: BoundedVariable) -> jax.Array:
    """Return the number of finite bounds."""
    return jnp.isfinite(x.low).sum() + jnp.isfinite(x.high).sum()


def value(x: BoundedVariable, mu: jax.Array) -> jax.Array:
    """Return the logarithmic barrier () of the bounds; infinite outside of them."""

    def log(d: jax.Array) -> jax.Array:
        good = d > 0
        return jnp.where(good, jnp.log(jnp.where(good, d, 1.0)), -jnp.inf).sum()

    return -mu * (log(x.below) + log(x.above))


def gradient(x: BoundedVariable, mu: jax.Array) -> jax.Array:
    """Return the gradient of the logarithmic barrier with respect to v."""
    low, high = jnp.isfinite(x.low), jnp.isfinite(x.high)
    return jnp.where(high, mu / x.above, 0.0) - jnp.where(low, mu / x.below, 0.0)


def hessian(x: BoundedVariable, z: Duals) -> jax.Array:
    """Return Sigma, the diagonal that the barrier adds to the Hessian."""
    return z.zl / x.below + z.zu / x.above


def first_duals(x: BoundedVariable, mu: jax.Array) -> Duals:
    """Return the first multipliers of the bounds: mu over the distances to them."""
    low, high = jnp.isfinite(x.low), jnp.isfinite(x.high)
    return Duals(jnp.where(low, mu / x.below, 0.0), jnp.where(high, mu / x.above, 0.0))


def step_to_boundary(x: BoundedVariable, dv: jax.Array, tau: jax.Array) -> jax.Array:
    """Return the longest fraction () of a step, at most 1, that leaves 1 - tau of each distance."""
    down = jnp.where(jnp.isfinite(x.low) & (dv < 0), tau * x.below / jnp.where(dv < 0, -dv, 1.0), 1)
    up = jnp.where(jnp.isfinite(x.high) & (dv > 0), tau * x.above / jnp.where(dv > 0, dv, 1.0), 1)
    return jnp.minimum(1.0, jnp.minimum(down.min(initial=1.0), up.min(initial=1.0)))


def dual_step(x: BoundedVariable, dv: jax.Array, z: Duals, mu: jax.Array) -> Duals:
    """Return the Newton step of the multipliers, for a step dv of v."""
    low, high = jnp.isfinite(x.low), jnp.isfinite(x.high)
    zl = jnp.where(low, mu / x.below - z.zl - z.zl / x.below * dv, 0.0)
    zu = jnp.where(high, mu / x.above - z.zu + z.zu / x.above * dv, 0.0)
    return Duals(zl, zu)


def dual_step_to_boundary(z: Duals, dz: Duals, tau: jax.Array) -> jax.Array:
    """Return the longest fraction () of a step of the multipliers that leaves 1 - tau of each."""
    shares = [
        jnp.where(d < 0, tau * y / jnp.where(d < 0, -d, 1.0), 1.0).min(initial=1.0)
        for y, d in zip(z, dz, strict=True)
    ]
    return jnp.minimum(1.0, jnp.minimum(*shares))


def moved_duals(x: BoundedVariable, z: Duals, dz: Duals, a: jax.Array, mu: jax.Array) -> Duals:
    """Return the multipliers z + a dz, clipped to a range about mu / (distance of v to its bound).

    x: the variable after the step of length a.
    """
    near = first_duals(x, mu)
    moved = (y + a * d for y, d in zip(z, dz, strict=True))
    return Duals(*(jnp.clip(y, n / FAR, n * FAR) for y, n in zip(moved, near, strict=True)))
