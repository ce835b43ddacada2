"""The joint motions of many links at once, in the forms that the drivers need.

`rbjax.joints` has the motion of each kind of joint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.drivers.contract import Driver
from rbjax.joints import HINGE, SLIDE, DofKind, JointMotion, NodeMotion, hinge_motion
from rbjax.lanes import Lane, Vec3, is_literal, rotation_z, sincos
from rbjax.model import Dof, LinkConstants, Prepared, Topology
from rbjax.model.cells import stacked
from rbjax.spatial import Motion


def joint_lanes(
    link: Dof, constants: LinkConstants, q: Sequence[Lane], v: Sequence[Lane]
) -> JointMotion:
    """The motion of one link, from the coordinates of all links."""
    return link.kind.motion([q[k] for k in link.q], [v[k] for k in link.v], constants)


def joint_columns(
    top: Topology, prepared: Prepared, q: jax.Array, v: jax.Array | None, start: int = 0
) -> tuple[Callable[..., JointMotion], list[Lane]]:
    """The motions of the links from `start` on, for the rolled driver: a function and its columns.

    The function makes a `JointMotion` from the columns (nv - start, ...) or from one link's lanes.
    """
    links = top.dofs[start:]
    batch = (1,) * (q.ndim - 1)

    def mask(flags):
        return np.array(list(flags), bool).reshape(-1, *batch)

    hinge = mask(link.kind is HINGE for link in links)
    slide = mask(link.kind is SLIDE for link in links)
    places = np.array([link.q[0] if len(link.q) else 0 for link in links])
    reference = prepared.columns.reference[start:].reshape(-1, *batch)
    at = q[places] - stacked(reference, q.dtype)
    v = None if v is None else v[start:]
    qd = 0.0 if v is None else v
    if hinge.all():
        return hinge_motion, [*sincos(at), qd]
    J = rotation_z(*sincos(jnp.where(hinge, at, 0.0)))
    rate = Vec3.zero() if v is None else Vec3(0.0, 0.0, jnp.where(hinge, v, 0.0))
    S = HINGE.axis(())
    moves: Lane = 0.0
    if slide.any():
        turns = jnp.asarray(~slide, q.dtype)
        S = Motion(Vec3(0.0, 0.0, turns), Vec3(0.0, 0.0, 1 - turns))
        moves = jnp.where(slide, at, 0.0)
    motion = JointMotion(J, Vec3(0.0, 0.0, moves), S, rate, qd)
    bent = not all(link.kind.constant_axis for link in links)
    motion = NodeMotion.of(motion) if bent else motion

    def with_kind(motion: JointMotion, kind: DofKind, rows: np.ndarray) -> JointMotion:
        """The motion whose rows of a kind are its own."""
        some = [links[i] for i in rows]
        qs = [q[np.array(of)] for of in zip(*(link.q for link in some), strict=True)]
        vs = [
            0.0 if v is None else v[np.array(of) - start]
            for of in zip(*(link.v for link in some), strict=True)
        ]
        constants = jax.tree.map(
            lambda x: stacked(x[rows + start].reshape(-1, *batch), q.dtype), prepared.columns
        )
        own = kind.motion(qs, vs, constants)
        own = NodeMotion.of(own) if bent else own
        return jax.tree.map(lambda column, x: _insert(column, rows, x, at), motion, own)

    # what else there is, kind by kind; what stands still is as above
    others: dict[DofKind, list[int]] = {}
    for i, link in enumerate(links):
        if link.kind not in (HINGE, SLIDE) and not link.kind.rigid_to_previous:
            others.setdefault(link.kind, []).append(i)
    for kind, rows in others.items():
        motion = with_kind(motion, kind, np.array(rows))
    leaves, treedef = jax.tree.flatten(motion)
    return lambda *lanes: jax.tree.unflatten(treedef, lanes), leaves


def _insert(column: Lane, rows: np.ndarray, values: Lane, like: jax.Array) -> Lane:
    if is_literal(column) and is_literal(values) and column == values:
        return column
    wide = jnp.broadcast_to(jnp.asarray(column, like.dtype), like.shape)
    return wide.at[rows].set(values)


def axes(d: Driver, joints: Any) -> tuple[Any, Any]:
    """S and S' of each link in its own axes, per link."""

    def step(joint: JointMotion, _: tuple) -> tuple[tuple, tuple[Motion, Motion]]:
        return (), (joint.S, joint.S_rate)

    S, S_rate = d.unzip(d.outward(step, (), joints), 2)
    return S, S_rate


def own_axes(d: Driver, joints: Any) -> Any:
    """S of each link in its own axes, in the form of `Driver.whole`."""
    kinds = [link.kind for link in d.topology.dofs]
    if not all(kind.constant_axis and kind.shared_axis for kind in kinds):
        return d.whole(axes(d, joints)[0])

    def axis(turns: Lane, slides: Lane) -> Motion:
        return Motion(Vec3(0.0, 0.0, turns), Vec3(0.0, 0.0, slides))

    turns, slides = d.known([k.angular for k in kinds]), d.known([k.linear for k in kinds])
    return d.each(axis, turns, slides)
