"""What motion returns: states at times, and how it ended."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.model import State


class Trajectory(eqx.Module):
    """States along time.

    Fields: ts (T,) s; q (T, nq) or (B, T, nq); v (T, nv) or (B, T, nv); ok (), or (B,) for a batch,
    whether every value is finite; result, what the solver says (None for `rollout`); stats.
    """

    ts: jax.Array
    q: jax.Array
    v: jax.Array
    ok: jax.Array
    result: Any = None
    stats: Any = None

    def state(self, i: int) -> State:
        """The state at ts[i] (of each sample of a batch)."""
        return State(self.q[..., i, :], self.v[..., i, :])

    def __len__(self) -> int:
        return self.ts.shape[0]


def all_finite(q: jax.Array, v: jax.Array) -> jax.Array:
    """Whether all of a trajectory is finite, per sample."""
    return jnp.isfinite(q).all((-2, -1)) & jnp.isfinite(v).all((-2, -1))
