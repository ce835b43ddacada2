"""Addition of a body to a model, with its joint and further bodies at frames of the joint."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.joints import Flexible, Joint
from rbjax.model.record import array_like
from rbjax.model.topology import WORLD
from rbjax.model.with_joint import start_of


def with_link(
    model: Any,
    name: str,
    joint: Joint,
    parent: str = "world",
    *,
    position: Any = (0.0, 0.0, 0.0),
    orientation: Any = (1.0, 0.0, 0.0, 0.0),
    params: Any = None,
    frames: Mapping[str, int] | None = None,
) -> Any:
    """Add a body without mass to a model, with a joint to a parent body.

    The joint and the body have the same name. They come last in all arrays, so the indices of
    others do not change. Bodies at frames of a flexible link follow the body.

    Args:
        model: the model.
        name: name of the body and of the joint.
        joint: the kind of the joint; it need not be registered.
        parent: name of the parent body, or "world".
        position: (3,) m, in the parent, of the body's frame at zero displacement; for a flexible
            link, of its base frame.
        orientation: (4,) unit quaternion of the same frame.
        params: (n,) parameters of the joint, in the order of the kind; its default values if None.
        frames: name -> index of the frame of a flexible link, for each further body to add.

    Raises:
        UnknownName: no such parent. InputError: a name that is taken, a wrong shape, a frame that
            the joint does not have.
    """
    top, dtype = model.topology, model.bodies.mass.dtype
    frames = dict(frames or {})
    on_world = isinstance(parent, str) and parent == "world"
    over = WORLD if on_world and parent not in top.body_names else model.body(parent)
    _check(top, name, joint, frames)
    body, j, count = top.nb, len(top.joints), 1 + len(frames)
    position = array_like("with_link(position=...)", position, (3,), dtype, infinite=False)
    orientation = array_like("with_link(orientation=...)", orientation, (4,), dtype, infinite=False)
    if not isinstance(orientation, jax.core.Tracer) and not np.asarray(orientation).any():
        raise InputError(
            "with_link(orientation=...): got zero, expected a unit quaternion (w, x, y, z)"
        )
    shape = (len(joint.defaults),)
    params = np.array(joint.defaults) if params is None else params
    params = array_like("with_link(params=...)", params, shape, dtype, infinite=False)
    at_frames = tuple((body + 1 + k, j, i) for k, i in enumerate(frames.values()))
    unit = np.tile([1.0, 0.0, 0.0, 0.0], (len(frames), 1))
    start: Any = start_of(joint)
    still = np.zeros(joint.nv)
    if joint.on_world:
        start = jnp.concatenate([position, orientation])
    limits = np.array([[-np.inf, np.inf]])
    bodies, joints, keys = model.bodies, model.joints, model.keyframes
    nk = keys.q.shape[0]
    return dataclasses.replace(
        model,
        topology=dataclasses.replace(
            top,
            body_parents=(*top.body_parents, over, *[body] * len(frames)),
            joint_kinds=(*top.joint_kinds, joint.name),
            joint_bodies=(*top.joint_bodies, body),
            body_names=(*top.body_names, name, *frames),
            joint_names=(*top.joint_names, name),
            frame_bodies=(*top.frame_bodies, *at_frames),
            joints=(*top.joints, joint),
        ),
        bodies=dataclasses.replace(
            bodies,
            mass=_with(bodies.mass, np.zeros(count)),
            com=_with(bodies.com, np.zeros((count, 3))),
            inertia=_with(bodies.inertia, np.zeros((count, 3, 3))),
            position=_with(bodies.position, position[None], np.zeros((count - 1, 3))),
            orientation=_with(bodies.orientation, orientation[None], unit),
        ),
        joints=dataclasses.replace(
            joints,
            placement=_with(joints.placement, np.zeros((1, 3))),
            axis=_with(joints.axis, np.array([[0.0, 0.0, 1.0]])),
            reference=_with(joints.reference, start),
            armature=_with(joints.armature, still),
            damping=_with(joints.damping, still),
            stiffness=_with(joints.stiffness, np.zeros(1)),
            springref=_with(joints.springref, start),
            forcerange=_with(joints.forcerange, limits),
            range=_with(joints.range, limits),
            params=_with(joints.params, params),
        ),
        keyframes=dataclasses.replace(
            keys,
            q=jnp.concatenate([keys.q, jnp.tile(jnp.asarray(start, dtype), (nk, 1))], 1),
            v=jnp.concatenate([keys.v, jnp.zeros((nk, joint.nv), dtype)], 1),
        ),
        solver=None if model.solver is None else model.solver.with_link(joint.nv),
        execution=model.execution.replace(zeros=None, constants=None, weights=None),
    )


def _with(x: Any, *more: Any) -> jax.Array:
    """Append rows to an array."""
    return jnp.concatenate([x, *(jnp.asarray(y, x.dtype) for y in more)])


def _check(top: Any, name: str, joint: Joint, frames: Mapping[str, int]) -> None:
    for k, given in enumerate((name, *frames)):
        named = isinstance(given, str) and given != ""
        if not named or given in (*top.body_names, "world") or (k > 0 and given == name):
            raise InputError(
                f"with_link: got the name {given!r}, expected a new name of a body; the model has "
                f"{[*top.body_names, *([name] if k else [])]}"
            )
    if name in top.joint_names:
        raise InputError(f"with_link: the model has a joint {name!r} already; choose another name")
    flexible = isinstance(joint, Flexible)
    count = joint.count if isinstance(joint, Flexible) else 0
    own = joint.body_frame if isinstance(joint, Flexible) else None
    for given, k in frames.items():
        if not 0 <= k < count or k == own:
            more = f", and frame {own} carries its own body" if flexible else ""
            raise InputError(
                f"with_link: got frame {k} for the body {given!r}; the joint {joint.name!r} has "
                f"{count} frames{more}"
            )
