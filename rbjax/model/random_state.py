"""Random configurations and velocities of a model."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.rotations import quaternion


def random_coordinates(model: Any, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draw q (nq,) and v (nv,) for `Model.random_state`."""
    kq, kr, kv = jax.random.split(key, 3)
    q, top, ranges = model.joints.reference, model.topology, model.joints.range
    dtype = q.dtype
    share = jax.random.uniform(kq, (model.nq,), dtype, -1.0, 1.0)
    single = np.array([j for j, joint in enumerate(top.joints) if joint.nq == 1], int)
    at = np.array(top.joint_q, int)[single]
    lower, upper = ranges[single].astype(dtype).T
    low = (q - 1).at[at].set(jnp.clip(q[at] - 1, lower, upper))
    high = (q + 1).at[at].set(jnp.clip(q[at] + 1, lower, upper))
    q = jnp.clip((low + high) / 2 + share * (high - low) / 2, low, high)
    turning = [j for j, joint in enumerate(top.joints) if joint.quaternion]
    for k, j in zip(jax.random.split(kr, max(len(turning), 1)), turning, strict=False):
        start = top.joint_q[j] + top.joints[j].nq - 4
        turn = quaternion.normalize(jax.random.normal(k, (4,), dtype))
        if top.joints[j].nq == 4:
            turn = _within_angle(turn, ranges[j, 1].astype(dtype))
        q = q.at[start : start + 4].set(turn)
    return q, jax.random.normal(kv, (model.nv,), dtype)


def _within_angle(turn: jax.Array, largest: jax.Array) -> jax.Array:
    """Multiply the angle of an attitude by largest / pi, if `largest` is below pi."""
    share = jnp.minimum(jnp.where(jnp.isfinite(largest), largest, jnp.pi) / jnp.pi, 1.0)
    return jnp.where(share < 1, quaternion.exp(share * quaternion.log(turn)), turn)
