"""Rows of the limits of joints and of the friction loss of dofs.

    hinge, slide    lower limit   d = q - lower,   row  1     upper limit   d = upper - q,   row -1
    ball            d = upper - angle,             row -axis
    friction loss                                  row  1
(MuJoCo, *Computation*, constraint model.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.contact.rows.options import Options
from rbjax.contact.rows.scalar_row import ScalarRow, Softness, entry
from rbjax.lanes import Lane, Vec3, neg
from rbjax.model import Model
from rbjax.model.leaves import numbers, table


def limit_rows(
    model: Model, q: jax.Array, v: jax.Array, weights: Any, options: Options, joints: Sequence[int]
) -> list[ScalarRow]:
    """Return the rows of the limits of joints. weights: (nv,) inverse inertias of the dofs."""
    return [row for j in joints for row in _limits(model, q, v, weights, options, j)]


def friction_rows(
    model: Model, q: jax.Array, v: jax.Array, weights: Any, options: Options
) -> list[ScalarRow]:
    """Return the rows of the friction loss of dofs. weights: (nv,) inverse inertias of the dofs."""
    own, dtype, rows = model.solver, q.dtype, []
    assert own is not None
    for i in own.rubbing:
        tables = own.friction_solref, own.friction_solimp
        softness = Softness.of(entry(weights, i, dtype), *tables, i, dtype)
        floss = entry(own.frictionloss, i, dtype)
        rows.append(ScalarRow.friction({i: 1.0}, floss, v, softness, options, ("dof", i)))
    return rows


def _limits(
    model: Model, q: jax.Array, v: jax.Array, weights: Any, options: Options, j: int
) -> list[ScalarRow]:
    """Return the rows of the limits of a joint."""
    own, dtype = model.solver, q.dtype
    assert own is not None
    margin, i = entry(own.limit_margin, j, dtype), model.topology.joint_v[j]
    tables = own.limit_solref, own.limit_solimp
    softness = Softness.of(entry(weights, i, dtype), *tables, j, dtype)
    given = margin, v, softness, options, ("joint", j)
    return [ScalarRow.limit(J, d, *given) for d, J in joint_limits(model, q, j)]


def joint_limits(model: Model, q: jax.Array, j: int) -> list[tuple[Lane, dict[int, Lane]]]:
    """Compute the distance of a joint to each of its limits, and the gradient of the distance."""
    top = model.topology
    low, high = numbers(table(model.joints.range, q.dtype)[j], q.dtype)
    i, k = top.joint_v[j], top.joint_q[j]
    if top.joints[j].quaternion:
        angle, axis = _angle_and_axis(*(q[k + n] for n in range(4)))
        return [(high - angle, {i + n: neg(x) for n, x in enumerate(axis)})]
    return [(q[k] - low, {i: 1.0}), (high - q[k], {i: -1.0})]


def _angle_and_axis(w: Lane, x: Lane, y: Lane, z: Lane) -> tuple[Lane, Vec3]:
    """Compute the angle in [0, pi] and the axis of a unit quaternion."""
    sign = jnp.where(w < 0, -1.0, 1.0)
    u = Vec3(x, y, z) * sign
    square = u.dot(u)
    small = square < 1e-24
    s = jnp.sqrt(jnp.where(small, 1.0, square))
    axis = [jnp.where(small, e, a / s) for a, e in zip(u, (1.0, 0.0, 0.0), strict=True)]
    return jnp.where(small, 0.0, 2.0 * jnp.arctan2(s, w * sign)), Vec3(*axis)
