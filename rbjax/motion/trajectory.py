"""Trajectories: states at times, and whether the integration succeeded."""

from __future__ import annotations

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.model import State


class Trajectory(eqx.Module):
    """States of a motion at increasing times.

    ts: (T,) times, s.
    q, v: (T, nq) and (T, nv), or (B, T, nq) and (B, T, nv) for a batch.
    ok: () or (B,), whether every value is finite.
    result: result of the diffrax solver; None for `rollout`.
    stats: counts of steps.
    x: (T, nx) or (B, T, nx), states of force elements; None if no element has a state.
    memory: (T, m) or (B, T, m), memory of the dynamics; None if it has none.
    """

    ts: jax.Array
    q: jax.Array
    v: jax.Array
    ok: jax.Array
    result: Any = None
    stats: Any = None
    x: jax.Array | None = None
    memory: jax.Array | None = None

    def state(self, i: int) -> State:
        """Return the state at ts[i], for each sample of a batch."""
        states = State(self.q, self.v, self.x, self.memory)
        return jax.tree.map(lambda x: x[..., i, :], states)

    def __len__(self) -> int:
        return self.ts.shape[0]


def all_finite(states: State) -> jax.Array:
    """Check that all values of a trajectory are finite, per sample."""
    finite = [jnp.isfinite(x).all((-2, -1)) for x in jax.tree.leaves(states)]
    return functools.reduce(jnp.logical_and, finite)
