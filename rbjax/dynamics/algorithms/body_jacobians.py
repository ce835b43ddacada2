"""Jacobians of links in their own axes, by one outward recursion over the columns.

    J_C = X J_P, plus the axis S in the column of the dof of the link

A frame of a flexible link adds its axis S_j to the column of each coordinate j of the link. These
are body Jacobians (Lynch & Park, 5.1.2). Use them for trees with flexible links.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.lanes import Mat3, Vec3, as_arrays, is_zero
from rbjax.model import WORLD, Model, Topology, prepare
from rbjax.spatial import Motion, Transform

#: dof -> column
Columns = dict[int, Motion]


def ancestor_mask(top: Topology, link: int) -> np.ndarray:
    """Return the mask (nv,) of the dofs that move a link."""
    mask = np.zeros(top.nv, bool)
    if link != WORLD:
        mask[[i for i in top.ancestors[link] if i < top.nv]] = True
    return mask


def _columns(model: Model, q: jax.Array) -> list[tuple[Columns, Mat3]]:
    """Compute the columns of each link in its own axes, and its rotation to world axes."""
    d = Unrolled(model, prepare(model, q.dtype))
    top = d.topology

    def outward(x: Any, parent: tuple[Columns, Mat3]) -> tuple[Any, Any]:
        link, joint, i = x
        X = joint.transform(link)
        out = {k: X(S) for k, S in parent[0].items()}
        if joint.frame_axes is not None:
            for k, S in zip(top.links[i].v, joint.frame_axes, strict=True):
                out[k] = out[k] + S if k in out else S
        elif any(not is_zero(x) for x in joint.S):
            out[i] = joint.S
        here = out, parent[1] @ X.R
        return here, here

    numbered = d.zip(d.constants, d.joints(q, None), list(range(len(top.links))))
    return d.outward(outward, ({}, Mat3.identity()), numbered)


def _array(columns: Columns, model: Model, like: jax.Array) -> jax.Array:
    """Convert columns to an array (6, nv)."""
    zero, like = Motion.zero(), jnp.zeros((), like.dtype)
    rows = [as_arrays([*columns.get(k, zero)], like) for k in range(model.nv)]
    return jnp.stack([jnp.stack(S) for S in rows], -1)


def body_jacobians(model: Model, q: jax.Array) -> jax.Array:
    """Compute the Jacobian (links, 6, nv) of each link in its own axes, at its origin."""
    return jnp.stack([_array(J, model, q) for J, _ in _columns(model, q)])


def point_jacobian(model: Model, q: jax.Array, link: int, r: Vec3) -> jax.Array:
    """Compute the Jacobian (6, nv), in world axes, of the point r in the axes of a link."""
    if link == WORLD:
        return jnp.zeros((6, model.nv), q.dtype)
    columns, R = _columns(model, q)[link]
    to_point, turn = Transform(Mat3.identity(), r), Transform(R.T, Vec3.zero())
    return _array({k: turn(to_point(S)) for k, S in columns.items()}, model, q)
