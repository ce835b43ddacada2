"""Another kind of joint in the place of one."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError, UnknownName
from rbjax.joints import Joint
from rbjax.joints import kind as kind_of


def with_joint(model: Any, name: str, kind: str, **given: Any) -> Any:
    """As `Model.with_joint`."""
    j, new, top = model.joint(name), kind_of(kind), model.topology
    old = top.joints[j]
    known = {"axis", "reference", *new.numbers}
    for key in given:
        if key not in known:
            raise UnknownName(f"number of a {kind} joint", key, sorted(known))
    if (new.nq, new.nv) != (old.nq, old.nv):
        _check_forces(model, j, name, kind)
    q, v = model.q_slice(name), model.v_slice(name)
    own = sum(len(joint.defaults) for joint in top.joints[:j])
    numbers = slice(own, own + len(old.defaults))
    joints, keys = model.joints, model.keyframes
    start = jnp.asarray(start_of(new), joints.reference.dtype)
    same, single = (new.nq, new.nv) == (old.nq, old.nv), new.nv == old.nv == 1

    def coordinates(x: Any, at: slice, put: Any) -> Any:
        """x (..., n) with others in the place of some, unless it may keep them."""
        if same and put is not None:
            return x
        put = jnp.zeros(new.nv, x.dtype) if put is None else put
        put = jnp.broadcast_to(put.astype(x.dtype), (*x.shape[:-1], *put.shape))
        return jnp.concatenate([x[..., : at.start], put, x[..., at.stop :]], -1)

    def speeds(x: Any) -> Any:
        return x if same else coordinates(x, v, None)

    def row(x: Any, other: Any) -> Any:
        return x if single else x.at[j].set(jnp.asarray(other, x.dtype))

    axis = joints.axis
    if "axis" in given:
        axis = axis.at[j].set(_array(given["axis"], (3,), "axis", axis.dtype))
    reference = coordinates(joints.reference, q, start)
    if "reference" in given:
        put = _array(given["reference"], (new.nq,), "reference", reference.dtype)
        reference = reference.at[q.start : q.start + new.nq].set(put)
    values = [
        np.ravel(_array(given.get(key, value), np.shape(value), key, joints.numbers.dtype))
        for key, value in new.numbers.items()
    ]
    endless = [-np.inf, np.inf]
    fields = {
        "topology": dataclasses.replace(
            top,
            joint_kinds=(*top.joint_kinds[:j], kind, *top.joint_kinds[j + 1 :]),
            joints=(*top.joints[:j], new, *top.joints[j + 1 :]),
        ),
        "joints": type(joints)(
            placement=joints.placement,
            axis=axis,
            reference=reference,
            armature=speeds(joints.armature),
            damping=speeds(joints.damping),
            stiffness=row(joints.stiffness, 0.0),
            springref=coordinates(joints.springref, q, start),
            forcerange=row(joints.forcerange, endless),
            range=row(joints.range, endless),
            numbers=jnp.concatenate(
                [joints.numbers[: numbers.start], *values, joints.numbers[numbers.stop :]]
            ),
        ),
        "keyframes": type(keys)(
            q=coordinates(keys.q, q, start), v=speeds(keys.v), ctrl=keys.ctrl, x=keys.x
        ),
        "execution": model.execution.replace(zeros=None, prepared=None),
    }
    every = {f.name: getattr(model, f.name) for f in dataclasses.fields(model)}
    changed = type(model)(**every | fields)
    return changed if model.execution.zeros is None else changed.fix_zeros()


def start_of(joint: Joint) -> np.ndarray:
    """The coordinates (nq,) of a joint that has not moved."""
    out = np.zeros(joint.nq)
    if joint.quaternion:
        out[-4] = 1.0
    return out


def _array(x: Any, shape: tuple[int, ...], name: str, dtype: Any) -> Any:
    found = jnp.asarray(x, dtype)
    if found.shape != shape:
        raise InputError(f"with_joint: {name} has shape {found.shape}, expected {shape}")
    return found


def _check_forces(model: Any, joint: int, name: str, kind: str) -> None:
    for element in model.forces:
        named = getattr(element, "joints", None)
        if named is not None and (joint in named or name in named):
            raise InputError(
                f"with_joint: {type(element).__name__} has a number for each coordinate of "
                f"{name!r}, and a {kind} joint has others; give the joint first and its forces "
                "then: model.replace(forces=()).with_joint(...).with_forces(...)"
            )
