"""Fields of a compiled MuJoCo model: names, flags, error messages, and types of actuators."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import mujoco
import numpy as np

from rbjax.errors import ModelError
from rbjax.model.solver_parameters import SOLREF

#: flags by which a file disables features
Off = mujoco.mjtDisableBit
#: quaternion of no rotation
ALIGNED = np.array([1.0, 0.0, 0.0, 0.0])


def matrix_of(quat: Any) -> np.ndarray:
    """Return the rotation matrix of a quaternion."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, np.asarray(quat, np.float64))
    return flat.reshape(3, 3)


def quaternion_of(R: Any) -> np.ndarray:
    """Return the quaternion of a rotation matrix."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.asarray(R, np.float64).ravel())
    return quat


def members(enum: Any) -> SimpleNamespace:
    """Return the members of an enumeration as integers, without their prefix."""
    return SimpleNamespace(**{n.split("_")[1]: int(x) for n, x in enum.__members__.items()})


def is_on(m: mujoco.MjModel, *flags: mujoco.mjtDisableBit) -> bool:
    """Check that the file disables none of these features."""
    return not any(m.opt.disableflags & int(flag) for flag in flags)


def names_of(m: mujoco.MjModel, kind: mujoco.mjtObj, count: int) -> tuple[str, ...]:
    """Return the names of joints, bodies, ...; type and index (joint0) if a name is missing."""
    return tuple(
        mujoco.mj_id2name(m, kind, i) or f"{kind.name[6:].lower()}{i}" for i in range(count)
    )


def leaf(x: Any) -> jax.Array:
    """Convert numbers of a file to an array of JAX's default dtype.

    It puts them on the device. `jnp.asarray` compiles a program for each shape.

    Raises:
        ModelError: a finite number is too large for the dtype.
    """
    x = np.asarray(x, np.float64)
    with np.errstate(over="ignore"):
        out = x.astype(jax.dtypes.canonicalize_dtype(x.dtype))
    lost = np.isfinite(x) & ~np.isfinite(out)
    if lost.any():
        raise ModelError(
            f"the file has the number {x[lost][0]}, which is too large for {out.dtype}; correct "
            "it, or enable float64: jax.config.update('jax_enable_x64', True)"
        )
    return jax.device_put(out)


#: part of a MuJoCo message -> the fix
_FIXES = {
    "mass and inertia of moving bodies": "give the body an <inertial> with positive mass and "
    "inertia, or weld it (no joint, URDF type='fixed')",
    "A + B >= C": "correct the inertia, or let MuJoCo balance it: "
    "<compiler balanceinertia='true'/>",
    "repeated name": "give each body, joint or other element a name of its own",
    "opening file": "put the file where the model names it, or remove the element",
    "free joint can only be used on top": "put the body into <worldbody>, or give it three slides "
    "and a ball",
    "joint found in world body": "the world cannot move: put the joint into a <body>",
    "inertia must have positive eigenvalues": "give every principal moment a positive value",
}


def message_of(error: Exception) -> str:
    """Return the message of a MuJoCo error in one line, with a fix if one is known."""
    message = " ".join(str(error).split())
    fix = next((f"; {fix}" for key, fix in _FIXES.items() if key in message), "")
    return message + fix


Trn, Dyn, Gain = map(members, (mujoco.mjtTrn, mujoco.mjtDyn, mujoco.mjtGain))
Bias, Wrap = map(members, (mujoco.mjtBias, mujoco.mjtWrap))
_LAST_GROUP = 30  # last group that a file can disable
_ACTIVATIONS = (Dyn.NONE, Dyn.INTEGRATOR, Dyn.FILTER, Dyn.FILTEREXACT, Dyn.MUSCLE)


def is_off(m: mujoco.MjModel, i: int) -> bool:
    """Check whether the file disables actuator i, by its group or with all actuators."""
    group = int(m.actuator_group[i])
    grouped = 0 <= group <= _LAST_GROUP and m.opt.disableactuator >> group & 1
    return bool(grouped or not is_on(m, Off.mjDSBL_ACTUATION))


def is_at_joint(m: mujoco.MjModel, i: int) -> bool:
    """Check whether actuator i drives a joint."""
    return m.actuator_trntype[i] in (Trn.JOINT, Trn.JOINTINPARENT)


def is_at_tendon(m: mujoco.MjModel, i: int) -> bool:
    """Check whether actuator i pulls a tendon."""
    return bool(m.actuator_trntype[i] == Trn.TENDON)


def is_circular(m: mujoco.MjModel, i: int) -> bool:
    """Check whether actuator i is a position servo on an angle with setpoints modulo full turns."""
    servo = m.actuator_gaintype[i] == Gain.PID or (
        m.actuator_gaintype[i] == Gain.FIXED
        and m.actuator_biastype[i] == Bias.AFFINE
        and m.actuator_gainprm[i, 0] == -m.actuator_biasprm[i, 1]
        and m.actuator_dyntype[i] != Dyn.MUSCLE
    )
    target, base = m.actuator_trnid[i]
    if is_at_joint(m, i):
        angle = m.jnt_type[target] == int(mujoco.mjtJoint.mjJNT_BALL)
    else:
        gear = m.actuator_gear[m.actuator_outadr[i]]
        pose = m.actuator_trntype[i] == Trn.SITE and base >= 0
        angle = pose and not gear[:3].any() and gear[3:].any()
    return bool(servo and angle)


def inertial_frame(m: mujoco.MjModel, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the inertial frame of a body; MuJoCo uses the body frame if they agree within 1e-6."""
    same, kinds = int(m.body_sameframe[b]), mujoco.mjtSameFrame
    if same == int(kinds.mjSAMEFRAME_BODY):
        return np.zeros(3), ALIGNED
    turned = same != int(kinds.mjSAMEFRAME_BODYROT)
    return m.body_ipos[b], m.body_iquat[b] if turned else ALIGNED


def reason_left_out(m: mujoco.MjModel, i: int) -> str:
    """Return the reason why actuator i is not supported; empty if it is supported."""
    if is_off(m, i):
        return ""
    if m.actuator_delay[i]:
        return "delays of controls"
    if m.actuator_plugin[i] >= 0 or not _law_is_known(m, i):
        return "laws of a plugin or callback"
    if m.actuator_trntype[i] == Trn.BODY:
        return "adhesion, which needs contacts"
    return ""


def reflected(m: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the armature and linear damping (nv,) of actuators at their joints, and their damping
    by higher powers of the velocity (nv, n)."""
    armature, damping = np.zeros(m.nv), np.zeros(m.nv)
    polynomial = np.zeros_like(m.dof_dampingpoly)
    for i in range(m.nactuator):
        if is_at_joint(m, i):
            square = m.actuator_gear[m.actuator_outadr[i], 0] ** 2
            dofs = m.dof_jntid == m.actuator_trnid[i, 0]
            armature[dofs] += m.actuator_armature[i] * square
            damping[dofs] += m.actuator_damping[i] * square
            polynomial[dofs] += m.actuator_dampingpoly[i] * square
    return armature, damping, polynomial


def _law_is_known(m: mujoco.MjModel, i: int) -> bool:
    dyn, gain, bias = m.actuator_dyntype[i], m.actuator_gaintype[i], m.actuator_biastype[i]
    if gain == Gain.PID:
        return dyn in (Dyn.NONE, Dyn.PID) and bias == Bias.AFFINE
    if gain == Gain.DCMOTOR:
        return dyn == Dyn.DCMOTOR and bias == Bias.DCMOTOR
    if gain == Gain.SO3:
        return dyn in _ACTIVATIONS and bias == Bias.SO3
    return (
        dyn in _ACTIVATIONS
        and gain in (Gain.FIXED, Gain.AFFINE, Gain.MUSCLE)
        and bias in (Bias.NONE, Bias.AFFINE, Bias.MUSCLE)
    )


def safe_solref(m: mujoco.MjModel, solref: np.ndarray) -> np.ndarray:
    """Return solref with a time constant of two time steps or more, unless refsafe is off or the
    integrator is `discrete`. Mixed signs stand for MuJoCo's default."""
    if (solref[0] > 0) != (solref[1] > 0):
        solref = np.array(SOLREF)
    explicit = m.opt.integrator != mujoco.mjtIntegrator.mjINT_DISCRETE
    if solref[0] > 0 and explicit and is_on(m, Off.mjDSBL_REFSAFE):
        return np.array([max(solref[0], 2 * m.opt.timestep), solref[1]])
    return solref
