"""The attitude of a frame as a quaternion, by a product along the tree.

    q_body = q_parent q_0 q_joint ...,      q_joint = (cos a / 2, n sin a / 2) for a hinge
The product is smooth and has MuJoCo's sign, which a quaternion computed from a matrix has not.
"""

from __future__ import annotations

import jax.numpy as jnp

from rbjax.forces.context import Context
from rbjax.lanes import Lane, Vec3, is_literal
from rbjax.model import WORLD, Frame
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.rotations import quaternion

_IDENTITY: list[Lane] = [1.0, 0.0, 0.0, 0.0]


def attitude(context: Context, frame: Frame) -> list[Lane]:
    """Return the unit quaternion (w, x, y, z) of a frame in the world, as lanes."""
    model, dtype = context.model, context.q.dtype
    turn = _IDENTITY
    if frame.site is not None:
        i = model.site(frame.site)
        body, turn = model.topology.site_bodies[i], _row(model.sites.orientation, i, dtype)
    elif frame.geom is not None:
        assert model.geoms is not None
        i = model.geom(frame.geom)
        body, turn = model.geoms.bodies[i], _row(model.geoms.orientation, i, dtype)
    elif (frame.body == "world" and frame.body not in model.body_names) or frame.body == WORLD:
        body = WORLD
    else:
        body = model.body(frame.center if frame.body is None else frame.body)
    if frame.orientation is not None:
        turn = _product(turn, list(map(float, frame.orientation)))
    return _unit(_product(_of_body(context, body), turn))


def _of_body(context: Context, body: int) -> list[Lane]:
    """Return the quaternion of a body; those of the bodies on its path are computed once."""
    found = context.once(attitude, lambda: {WORLD: _IDENTITY})
    parents, path = context.model.topology.body_parents, []
    while body not in found:
        path.append(body)
        body = parents[body]
    for b in reversed(path):
        found[b] = _child(context, b, found[parents[b]])
    return found[path[0] if path else body]


def _child(context: Context, body: int, parent: list[Lane]) -> list[Lane]:
    model, q, dtype = context.model, context.q, context.q.dtype
    top = model.topology
    turn = _product(parent, _row(model.bodies.orientation, body, dtype))
    for j, owner in enumerate(top.joint_bodies):
        kind, at = top.joint_kinds[j], top.joint_q[j]
        if owner != body or kind == "slide":
            continue
        if kind == "free":
            turn = [q[at + k] for k in range(3, 7)]
        elif kind == "ball":
            turn = _product(turn, _unit([q[at + k] for k in range(4)]))
        elif kind == "hinge":
            half = (q[at] - lane(table(model.joints.reference, dtype), at)) / 2
            axes = table(model.joints.axis, dtype)
            axis = Vec3(*(lane(axes[:, k], j) for k in range(3)))
            axis = axis * (1 / axis.norm())
            turn = _product(turn, [jnp.cos(half), *(axis * jnp.sin(half))])
        else:
            matrix = [jnp.asarray(x, dtype) for x in context.body(body).rotation]
            return _unit(quaternion.from_matrix_lanes(matrix))
    return _unit(turn)


def _row(quaternions, row: int, dtype) -> list[Lane]:
    rows = table(quaternions, dtype)
    return [lane(rows[:, k], row) for k in range(4)]


def _product(a: list[Lane], b: list[Lane]) -> list[Lane]:
    if a is _IDENTITY or b is _IDENTITY:
        return b if a is _IDENTITY else a
    return quaternion.product(a, b)


def _unit(q: list[Lane]) -> list[Lane]:
    if all(map(is_literal, q)):
        size = sum(x * x for x in q) ** 0.5
        return q if size == 1.0 else [x / size for x in q]
    scale = 1 / jnp.sqrt(sum(x * x for x in q))
    return [x * scale for x in q]
