"""Trajectories: states at times, and the outcome of the motion."""

from __future__ import annotations

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.model import State


class Trajectory(eqx.Module):
    """States along time.

    ts: (T,) s.
    q, v: (T, nq) and (T, nv), or (B, T, nq) and (B, T, nv) for a batch.
    ok: () or (B,), whether every value is finite.
    result: of the solver; None for `rollout`.
    stats: counts of steps.
    x: (T, nx) or (B, T, nx), the states of force elements; None if none has one.
    memory: (T, m) or (B, T, m), the memory of the dynamics; None if it has none.
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
        """The state at ts[i] (of each sample of a batch)."""
        states = State(self.q, self.v, self.x, self.memory)
        return jax.tree.map(lambda x: x[..., i, :], states)

    def __len__(self) -> int:
        return self.ts.shape[0]


def all_finite(states: State) -> jax.Array:
    """Whether all of a trajectory is finite, per sample."""
    finite = [jnp.isfinite(x).all((-2, -1)) for x in jax.tree.leaves(states)]
    return functools.reduce(jnp.logical_and, finite)
