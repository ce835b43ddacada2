"""Descriptions of the features of a compiled MuJoCo model that rbjax does not support."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from rbjax.errors import listed
from rbjax.loading.mjcf.constraints import equalities_are_on, is_loaded
from rbjax.loading.mjcf.fields import Off, is_at_joint, is_at_tendon, is_on, reason_left_out
from rbjax.loading.mjcf.sensors import read_sensors
from rbjax.loading.mjcf.tendons import limited_tendons, rubbing_tendons, tendon_armature

#: prefix of entries about inverted limits
INVERTED = "joint limits whose lower end is above the upper one"
#: prefix of entries about the root of a URDF
FIXED = "fixed root link"
#: prefixes of entries about contacts
CONTACTS, COLLISION = "contacts (", "collision shapes"
#: prefix of the entry about collision shapes of a URDF that are not read as geoms
MESHES = "collision meshes"
#: prefix of an entry -> how to keep the feature
_CURES = {
    INVERTED: "swap them in the file",
    "joint limits": "load(contacts=True) or load(limits=True) takes them",
    "joint friction loss": "load(contacts=True) or load(friction=True) takes it",
    "tendon limits": "load(contacts=True) takes them",
    "tendon friction loss": "load(contacts=True) takes it",
    "tendon armature": "load(contacts=True) takes it",
    "equality constraints (": "load(constraints=True) loads them",
    "mimic joints": "load(constraints=True) loads them if they are hinges or slides",
    "contacts": "load(contacts=True) takes them; for wheels on the ground use rbjax.wheeled",
    "collision shapes": "load(contacts=True) takes them; for wheels on the ground use "
    "rbjax.wheeled",
    FIXED: "load(floating_base=True) frees it; floating_base=False fixes it without a warning",
    "sensors of the kind user": "rbjax.sensors.CustomSensor measures a function",
}


def _named(what: str, m: mujoco.MjModel, kind: mujoco.mjtObj, which: Any) -> str:
    """Return an entry of `Model.dropped`: `what`, and the names of the elements at the indices
    `which`."""
    names = [mujoco.mj_id2name(m, kind, int(i)) or f"#{i}" for i in which]
    return f"{what} ({listed(names)})"


def dropped_features(
    m: mujoco.MjModel,
    *,
    limits: bool = False,
    friction: bool = False,
    constraints: bool = False,
    contacts: bool = False,
) -> tuple[str, ...]:
    """Return an entry of `Model.dropped` for each unsupported feature that changes the motion.

    With `contacts`, limits and friction loss of joints and tendons and armature of tendons are
    supported, and
    `contacts_left_out` lists pairs."""
    obj, solved = mujoco.mjtObj, Off.mjDSBL_CONSTRAINT
    out: list[str] = []

    def note(what: str, mask: Any, kind: mujoco.mjtObj) -> None:
        which = np.flatnonzero(mask)
        if len(which):
            out.append(_named(what, m, kind, which))

    if is_on(m, solved, Off.mjDSBL_CONTACT) and not contacts and _may_collide(m):
        out.append(f"{CONTACTS}{m.ngeom} geoms)")
    inverted = inverted_limits(m)
    if is_on(m, solved, Off.mjDSBL_LIMIT) and not (limits or contacts):
        note("joint limits", m.jnt_limited & ~inverted, obj.mjOBJ_JOINT)
    note(INVERTED, inverted, obj.mjOBJ_JOINT)
    if is_on(m, solved, Off.mjDSBL_FRICTIONLOSS) and not (friction or contacts):
        rubs = np.isin(np.arange(m.njnt), m.dof_jntid[m.dof_frictionloss > 0])
        note("joint friction loss", rubs, obj.mjOBJ_JOINT)
    for why, which in _equalities_left_out(m, constraints=constraints).items():
        note(why, which, obj.mjOBJ_EQUALITY)
    tendon = obj.mjOBJ_TENDON
    if not contacts:
        note("tendon limits", limited_tendons(m), tendon)
        note("tendon friction loss", rubbing_tendons(m), tendon)
        note("tendon armature", tendon_armature(m) != 0, tendon)
    note("deformable bodies", np.ones(m.nflex), obj.mjOBJ_FLEX)
    note("poses of mocap bodies in keyframes", _keyframes_of_mocap(m), obj.mjOBJ_KEY)
    if hasattr(m, "jnt_plasticadr"):  # MuJoCo 3 has no plasticity
        note("plastic joint springs", m.jnt_plasticadr >= 0, obj.mjOBJ_JOINT)
        note("plastic tendon springs", m.tendon_plasticadr >= 0, tendon)
    left_out = [reason_left_out(m, i) for i in range(m.nactuator)]
    for why in dict.fromkeys(filter(None, left_out)):
        note(f"actuators: {why}", [why == reason for reason in left_out], obj.mjOBJ_ACTUATOR)
    extra = (m.actuator_damping != 0) | m.actuator_dampingpoly.any(-1) | (m.actuator_armature != 0)
    at = [is_at_joint(m, i) or is_at_tendon(m, i) for i in range(m.nactuator)]
    elsewhere = ~np.array(at, bool)
    note("damping and armature of actuators at sites", extra & elsewhere, obj.mjOBJ_ACTUATOR)
    return (*out, *["plugins"] * bool(m.nplugin))


def _keyframes_of_mocap(m: mujoco.MjModel) -> np.ndarray:
    """Return the mask (nkey,) of keyframes with another pose of a mocap body than the file's."""
    bodies = np.argsort(m.body_mocapid)[m.nbody - m.nmocap :]
    keys = (m.key_mpos, m.body_pos), (m.key_mquat, m.body_quat)
    return np.any([(key != file[bodies].ravel()).any(1) for key, file in keys], 0)


def unread_features(m: mujoco.MjModel) -> tuple[str, ...]:
    """Return the entries of `Model.dropped` about sensors that are not read.

    Cameras, lights and materials have no effect but on pictures, and are no entries. A sensor of a
    camera is read."""
    kinds = read_sensors(m)[1]
    return tuple(
        _named(what, m, mujoco.mjtObj.mjOBJ_SENSOR, which) for what, which in kinds.items()
    )


def inverted_limits(m: mujoco.MjModel) -> np.ndarray:
    """Return the mask (nj,) of joints whose lower limit is above the upper one."""
    return m.jnt_limited.astype(bool) & (m.jnt_range[:, 0] > m.jnt_range[:, 1])


def active_numbers(m: mujoco.MjModel) -> tuple[str, ...]:
    """Return an entry of `Model.dropped` for each passive property with a negative value."""
    joint, tendon, dofs = mujoco.mjtObj.mjOBJ_JOINT, mujoco.mjtObj.mjOBJ_TENDON, m.dof_jntid
    fields = [
        ("damping", m.dof_damping, joint, dofs),
        ("armature", m.dof_armature, joint, dofs),
        ("friction loss", m.dof_frictionloss, joint, dofs),
        ("stiffness", m.jnt_stiffness, joint, np.arange(m.njnt)),
        ("tendon damping", m.tendon_damping, tendon, np.arange(m.ntendon)),
        ("tendon stiffness", m.tendon_stiffness, tendon, np.arange(m.ntendon)),
    ]
    below = ((what, kind, owners[values < 0]) for what, values, kind, owners in fields)
    return tuple(
        _named(f"negative {what}", m, kind, dict.fromkeys(which.tolist()))
        for what, kind, which in below
        if len(which)
    )


def with_cure(entry: str) -> str:
    """Append to an entry of `Model.dropped` the option that keeps the feature, if there is one."""
    return next((f"{entry}: {cure}" for start, cure in _CURES.items() if entry.startswith(start)),
                entry)  # fmt: skip


def _equalities_left_out(m: mujoco.MjModel, *, constraints: bool) -> dict[str, np.ndarray]:
    """Return the masks of equalities that are not loaded, by reason."""
    if not equalities_are_on(m):
        return {}
    active = m.eq_active0.astype(bool)
    if not constraints:
        return {"equality constraints": active}
    loaded = np.array([is_loaded(m, i) for i in range(m.neq)], bool)
    return {
        "equality constraints of flexes": active & ~loaded,
        "equality constraints that are not active": ~active,
    }


def _may_collide(m: mujoco.MjModel) -> bool:
    """Check whether any two geoms of different bodies could collide by their collision masks."""
    if m.npair:
        return True
    types, affinities = set(), set()
    columns = (m.geom_contype.tolist(), m.geom_conaffinity.tolist(), m.geom_bodyid.tolist())
    masks = set(zip(*columns, strict=True))
    for contype, conaffinity, body in masks:
        types.add((contype, body))
        affinities.add((conaffinity, body))
    return any(a & b and i != j for a, i in types for b, j in affinities)
