"""What motion returns: states at times, and how it ended."""

from __future__ import annotations

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.model import State


class Trajectory(eqx.Module):
    """States along time.

    Fields: ts (T,) s; q (T, nq) or (B, T, nq); v (T, nv) or (B, T, nv); ok (), or (B,) for a batch,
    whether every value is finite; result, what the solver says (None for `rollout`); stats; x
    (T, nx) or (B, T, nx), the states of force elements, None where none has one.
    """

    ts: jax.Array
    q: jax.Array
    v: jax.Array
    ok: jax.Array
    result: Any = None
    stats: Any = None
    x: jax.Array | None = None

    def state(self, i: int) -> State:
        """The state at ts[i] (of each sample of a batch)."""
        x = None if self.x is None else self.x[..., i, :]
        return State(self.q[..., i, :], self.v[..., i, :], x)

    def __len__(self) -> int:
        return self.ts.shape[0]


def all_finite(states: State) -> jax.Array:
    """Whether all of a trajectory is finite, per sample."""
    finite = [jnp.isfinite(x).all((-2, -1)) for x in jax.tree.leaves(states)]
    return functools.reduce(jnp.logical_and, finite)
