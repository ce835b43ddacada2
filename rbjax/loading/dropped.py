"""What a compiled MuJoCo model holds that rbjax leaves out, in words."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from rbjax.errors import listed

_SHOWN = 4  # names listed before "and N more"
_LAST_GROUP = 30  # of those that a file can disable
_KINDS: dict[str, Any] = {
    "joint": int(mujoco.mjtTrn.mjTRN_JOINT),
    "site": int(mujoco.mjtTrn.mjTRN_SITE),
    "gains": (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)),
    "biases": (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)),
}


def dropped_features(
    m: mujoco.MjModel, *, limits: bool = False, friction: bool = False
) -> tuple[str, ...]:
    """One entry for each feature that changes the motion and is not modelled."""
    off, bit, obj = m.opt.disableflags, mujoco.mjtDisableBit, mujoco.mjtObj

    def enabled(flag) -> bool:
        return not off & int(flag)

    def names(kind, mask) -> str:
        found = [mujoco.mj_id2name(m, kind, int(i)) or f"#{i}" for i in np.flatnonzero(mask)]
        return listed(found, _SHOWN)

    out: list[str] = []

    def note(what: str, mask, kind=None) -> None:
        mask = np.atleast_1d(np.asarray(mask)).astype(bool)
        if mask.any():
            out.append(f"{what} ({names(kind, mask)})" if kind is not None else what)

    joints_of_dofs = np.zeros(m.njnt, bool)
    if m.nv:
        joints_of_dofs[m.dof_jntid[m.dof_frictionloss > 0]] = True
    constraints = enabled(bit.mjDSBL_CONSTRAINT)
    if constraints and enabled(bit.mjDSBL_CONTACT) and _may_collide(m):
        out.append(f"contacts ({m.ngeom} geoms)")
    if constraints and enabled(bit.mjDSBL_LIMIT) and not limits:
        note("joint limits", m.jnt_limited, obj.mjOBJ_JOINT)
    if constraints and enabled(bit.mjDSBL_FRICTIONLOSS) and not friction:
        note("joint friction loss", joints_of_dofs, obj.mjOBJ_JOINT)
    if constraints and enabled(bit.mjDSBL_EQUALITY):
        note("equality constraints", m.eq_active0, obj.mjOBJ_EQUALITY)
    note("tendons", [not tendon_is_supported(m, i) for i in range(m.ntendon)], obj.mjOBJ_TENDON)
    if m.nflex:
        note("deformable bodies", np.ones(m.nflex), obj.mjOBJ_FLEX)
    note("mocap bodies, held where the file puts them", m.body_mocapid >= 0, obj.mjOBJ_BODY)
    note("plastic joint springs", m.jnt_plasticadr >= 0, obj.mjOBJ_JOINT)
    supported = [actuator_is_off(m, i) or actuator_is_supported(m, i) for i in range(m.nactuator)]
    note("actuators that drive no joint or site directly, or have a state, delay or muscle",
         [not s for s in supported], obj.mjOBJ_ACTUATOR)  # fmt: skip
    extra = (m.actuator_damping != 0) | m.actuator_dampingpoly.any(-1) | (m.actuator_armature != 0)
    note("damping and armature of actuators", extra, obj.mjOBJ_ACTUATOR)
    note("plugins", m.nplugin)
    return tuple(out)


def actuator_is_off(m: mujoco.MjModel, i: int) -> bool:
    """Whether the file switches actuator i off: all of them, or its group."""
    group = int(m.actuator_group[i])
    all_off = m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    return bool(all_off or (0 <= group <= _LAST_GROUP and m.opt.disableactuator >> group & 1))


def actuator_is_supported(m: mujoco.MjModel, i: int) -> bool:
    """Whether actuator i is an affine force on a joint, or a wrench at a site."""
    kinds = _KINDS
    transmission = int(m.actuator_trntype[i])
    frame_at_site = transmission == kinds["site"] and m.actuator_trnid[i, 1] == -1
    return bool(
        (transmission == kinds["joint"] or frame_at_site)
        and m.actuator_ctrlnum[i] == 1
        and m.actuator_dyntype[i] == int(mujoco.mjtDyn.mjDYN_NONE)
        and int(m.actuator_gaintype[i]) in kinds["gains"]
        and int(m.actuator_biastype[i]) in kinds["biases"]
        and not m.actuator_delay[i]
    )


def tendon_is_supported(m: mujoco.MjModel, i: int) -> bool:
    """Whether tendon i is nothing but a spring and a damper between two sites."""
    start, count = m.tendon_adr[i], m.tendon_num[i]
    off, bit = m.opt.disableflags, mujoco.mjtDisableBit
    constraints = not off & int(bit.mjDSBL_CONSTRAINT)
    limited = m.tendon_limited[i] and constraints and not off & int(bit.mjDSBL_LIMIT)
    rubs = constraints and not off & int(bit.mjDSBL_FRICTIONLOSS) and m.tendon_frictionloss[i]
    pulls = m.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
    return bool(
        count == 2
        and (m.wrap_type[start : start + count] == int(mujoco.mjtWrap.mjWRAP_SITE)).all()
        and not (limited or rubs or m.tendon_armature[i])
        and not (pulls & (m.actuator_trnid[:, 0] == i)).any()
    )


def _may_collide(m: mujoco.MjModel) -> bool:
    """Whether any two geoms of different bodies could touch by their collision masks."""
    if m.npair:
        return True
    types, affinities = set(), set()
    columns = (m.geom_contype.tolist(), m.geom_conaffinity.tolist(), m.geom_bodyid.tolist())
    masks = set(zip(*columns, strict=True))
    for contype, conaffinity, body in masks:
        types.add((contype, body))
        affinities.add((conaffinity, body))
    return any(a & b and i != j for a, i in types for b, j in affinities)
