"""Rows of limits and friction loss for the impulse equations, in the form of contacts.

    limit           normal row: the gradient of the distance to the limit;   no friction
    friction loss   first tangent row: the dof, or the arms of the tendon;   |p| <= h floss
The other rows of such a contact are zero. The limit is at the end of the range, as if its margin
were zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.contact.rows.dof_rows import joint_limits
from rbjax.contact.rows.scalar_row import FRICTION, LIMIT, entry
from rbjax.contact.rows.tendon_rows import tendon_limits
from rbjax.forces.context import Context
from rbjax.forces.tendons.paths import tendon_reach
from rbjax.lanes import Lane, pack
from rbjax.model import Model, State


class JointRows(NamedTuple):
    """Limits and friction loss of a model at a configuration.

    Fields:
        J: (m, 3, nv) rows.
        gap: (m,) distance to the limit; 0 for a friction loss.
        floss: (m,) friction loss; 0 for a limit.
    """

    J: jax.Array
    gap: jax.Array
    floss: jax.Array


def count_joint_rows(model: Model) -> int:
    """Return the number m of rows."""
    return len(joint_sources(model))


def joint_sources(model: Model) -> tuple[tuple[str, str, int], ...]:
    """Return (kind, part, index) of each row, the part of the model to which it belongs."""
    own, tendons, kinds = model.solver, model.tendons, model.topology.joints
    limits, dry = list[tuple[str, str, int]](), list[tuple[str, str, int]]()
    if own is not None:
        for j in own.limited:
            limits += [(LIMIT, "joint", j)] * (1 if kinds[j].quaternion else 2)
        dry += [(FRICTION, "dof", i) for i in own.rubbing]
    if tendons is not None:
        limits += [(LIMIT, "tendon", i) for i in tendons.limited for _ in range(2)]
        dry += [(FRICTION, "tendon", i) for i in tendons.rubbing]
    return (*limits, *dry)


def joint_rows(model: Model, q: jax.Array) -> JointRows:
    """Compute the rows of the limits and of the friction loss of joints and tendons."""
    v = jnp.zeros(model.nv, q.dtype)
    limits: list[tuple[Lane, Mapping[int, Lane]]] = []
    dry: list[tuple[Lane, Mapping[int, Lane]]] = []
    own: Any = model.solver
    if own is not None:
        for j in own.limited:
            limits += joint_limits(model, q, j)
        dry += [(entry(own.frictionloss, i, q.dtype), {i: 1.0}) for i in own.rubbing]
    tendons: Any = model.tendons
    if tendons is not None and (tendons.limited or tendons.rubbing):
        context = Context.of(model, 0.0, State(q, v), None)
        for i in tendons.limited:
            limits += tendon_limits(context, i)
        for i in tendons.rubbing:
            arms = tendon_reach(context, i).arms
            dry.append((entry(tendons.frictionloss, i, q.dtype), arms))
    n, m = len(limits), len(limits) + len(dry)
    if not m:
        return JointRows(jnp.zeros((0, 3, model.nv), q.dtype), *jnp.zeros((2, 0), q.dtype))
    rows = jnp.stack([pack([J.get(i, 0.0) for i in range(len(v))], v) for _, J in [*limits, *dry]])
    J = jnp.zeros((m, 3, model.nv), q.dtype).at[:n, 0].set(rows[:n]).at[n:, 1].set(rows[n:])
    like = jnp.zeros(m, q.dtype)
    gap = pack([*(d for d, _ in limits), *[0.0] * len(dry)], like)
    return JointRows(J, gap, pack([*[0.0] * n, *(f for f, _ in dry)], like))
