"""Replacement of a joint of a model by one of another kind."""

from __future__ import annotations

import dataclasses
from itertools import accumulate
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError, UnknownName
from rbjax.joints import Joint
from rbjax.joints import kind as kind_of
from rbjax.model.record import array_like
from rbjax.model.topology import WORLD


def with_joint(model: Any, name: str, kind: str, **given: Any) -> Any:
    """Replace a joint of a model by one of another kind, for `Model.with_joint`."""
    j, new, top = model.joint(name), kind_of(kind), model.topology
    old, joints, keys = top.joints[j], model.joints, model.keyframes
    solver = model.solver
    given = _numbers(given, new, kind, joints.params.dtype)
    same, single = (new.nq, new.nv) == (old.nq, old.nv), new.nv == old.nv == 1
    if not same:
        _check_forces(model, j, name, kind)
    if new.on_world:
        _check_on_world(model, j, name, kind)
    q, v = model.q_slice(name), model.v_slice(name)
    start: Any = start_of(new)
    if new.on_world:
        body, dtype = top.joint_bodies[j], joints.reference.dtype
        start = jnp.concatenate([model.bodies.position[body], model.bodies.orientation[body]])
        start = start.astype(dtype)
    before = sum(len(joint.defaults) for joint in top.joints[:j])
    own = jnp.concatenate([jnp.zeros(0), *(given[key].reshape(-1) for key in new.params)])

    def along_q(x: Any) -> Any:
        return x if same else _spliced(x, q, start)

    def along_v(x: Any) -> Any:
        return x if same else _spliced(x, v, np.zeros(new.nv))

    def row(x: Any, other: Any) -> Any:
        return x if single else x.at[j].set(jnp.asarray(other, x.dtype))

    reference = along_q(joints.reference)
    if "reference" in given:
        reference = _spliced(joints.reference, q, given["reference"])
    changed = dataclasses.replace(
        model,
        topology=dataclasses.replace(
            top,
            joint_kinds=(*top.joint_kinds[:j], kind, *top.joint_kinds[j + 1 :]),
            joints=(*top.joints[:j], new, *top.joints[j + 1 :]),
        ),
        joints=dataclasses.replace(
            joints,
            placement=joints.placement.at[j].set(0.0) if new.on_world else joints.placement,
            axis=joints.axis.at[j].set(given.get("axis", joints.axis[j])),
            reference=reference,
            armature=along_v(joints.armature),
            damping=along_v(joints.damping),
            stiffness=row(joints.stiffness, 0.0),
            springref=along_q(joints.springref),
            forcerange=row(joints.forcerange, [-np.inf, np.inf]),
            range=row(joints.range, [-np.inf, np.inf]),
            params=_spliced(joints.params, slice(before, before + len(old.defaults)), own),
        ),
        keyframes=dataclasses.replace(keys, q=along_q(keys.q), v=along_v(keys.v)),
        solver=None
        if solver is None
        else solver.with_joint(j, top.joint_bodies[j], v, new.nv, limits=single),
        execution=model.execution.replace(zeros=None, constants=None, weights=None),
    )
    return changed if model.execution.zeros is None else changed.fix_zeros()


def start_of(joint: Joint) -> np.ndarray:
    """Return the coordinates (nq,) of a joint at zero displacement."""
    out = np.zeros(joint.nq)
    if joint.quaternion:
        out[-4] = 1.0
    return out


def _spliced(x: Any, at: slice, put: Any) -> jax.Array:
    """Replace a slice of the last axis of x (..., n) by the values `put` (m,)."""
    put = jnp.broadcast_to(jnp.asarray(put, x.dtype), (*x.shape[:-1], *np.shape(put)))
    return jnp.concatenate([x[..., : at.start], put, x[..., at.stop :]], -1)


def _numbers(given: dict[str, Any], joint: Joint, kind: str, dtype: Any) -> dict[str, jax.Array]:
    """Check the given values, and add the default values of missing parameters."""
    shapes = {"axis": (3,), "reference": (joint.nq,)}
    shapes |= {key: np.shape(x) for key, x in joint.params.items()}
    for key in given:
        if key not in shapes:
            raise UnknownName(f"parameter of a {kind} joint", key, sorted(shapes))
    starts = accumulate(map(np.size, joint.params.values()), initial=0)
    named = dict(zip(starts, joint.params, strict=False))
    axes = {"axis", *(named[at] for link in joint.dofs if (at := link.own_axis) is not None)}
    out = {}
    for key, x in (dict(joint.params) | given).items():
        where = f"with_joint({key}=...)"
        out[key] = array_like(where, x, shapes[key], dtype, infinite=False)
        if key in axes:
            _check_length(where, out[key], "an axis")
        elif key == "reference" and joint.quaternion:
            _check_length(where, out[key][-4:], "a unit quaternion (w, x, y, z)")
    return out


def _check_length(where: str, x: jax.Array, what: str) -> None:
    """Raise `InputError` if an untraced vector has zero or infinite length."""
    if isinstance(x, jax.core.Tracer):
        return
    with np.errstate(over="ignore", under="ignore"):
        square = np.square(np.asarray(x)).sum()
    if not 0 < square < np.inf:
        raise InputError(f"{where}: got {x.tolist()}, of squared length {square}, expected {what}")


def _check_on_world(model: Any, joint: int, name: str, kind: str) -> None:
    """Raise `InputError` unless the parent of a joint is the world and its body has no other joint.

    A joint whose coordinates are relative to the world requires this.
    """
    top = model.topology
    body = top.joint_bodies[joint]
    parent = top.body_parents[body]
    if parent != WORLD:
        raise InputError(
            f"with_joint: {name!r} joins the body {top.body_names[body]!r} to the body "
            f"{top.body_names[parent]!r}, and the coordinates of a {kind} joint are relative to "
            "the world; expected a joint whose parent is the world, or, in the file, three slides "
            "and a ball"
        )
    others = [top.joint_names[j] for j, b in enumerate(top.joint_bodies) if b == body]
    if len(others) > 1:
        raise InputError(
            f"with_joint: the body {top.body_names[body]!r} has the joints {others}, expected "
            f"{name!r} only: a body with a {kind} joint has no other joint"
        )


def _check_forces(model: Any, joint: int, name: str, kind: str) -> None:
    for element in model.forces:
        named = getattr(element, "joints", None)
        if named is not None and (joint in named or name in named):
            raise InputError(
                f"with_joint: {type(element).__name__} has one value per coordinate of {name!r}, "
                f"and a {kind} joint has other coordinates; replace the joint first and add its "
                "forces after: model.replace(forces=()).with_joint(...).with_forces(...)"
            )
