"""Checks of a compiled model: values that are not finite, and joints that move no mass.

MuJoCo accepts both. If the motions of two joints cancel, M is singular and M a = tau has no unique
solution.
"""

from __future__ import annotations

import copy

import jax
import mujoco
import numpy as np

from rbjax.errors import ModelError
from rbjax.loading.mjcf.fields import reflected
from rbjax.model.record import Record

#: leaves in which an infinite value means no limit
_LIMITS = ("range", "limits", "windup", "slew", "drive", "current_rate", "strongest")


def check_finite(record: Record) -> None:
    """Raise if a parameter of a force element is not finite."""
    for at, leaf in jax.tree_util.tree_leaves_with_path(record):
        name, values = jax.tree_util.keystr(at).lstrip("."), np.asarray(leaf)
        bad = np.isnan(values) if name.endswith(_LIMITS) else ~np.isfinite(values)
        if bad.any():
            raise ModelError(
                f"the compiled model has {type(record).__name__}.{name} = {values[bad][0]}, which "
                f"is not finite; correct that number in the file"
            )


def check_finite_fields(m: mujoco.MjModel) -> None:
    """Raise if a number of a compiled model is not finite; MuJoCo only warns."""
    fields = "qpos0 qpos_spring body_mass body_ipos body_iquat body_inertia body_pos body_quat"
    fields += (
        " geom_pos geom_quat geom_size jnt_pos jnt_axis jnt_stiffness dof_armature dof_damping"
    )
    fields += " site_pos site_quat"
    fields += " actuator_gear actuator_gainprm actuator_biasprm key_qpos key_qvel key_ctrl"
    for name in fields.split():
        values = np.asarray(getattr(m, name))
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            raise ModelError(
                f"the compiled model has {name}[{int(bad[0][0])}] = {values[bad[0][0]]}, which is "
                f"not finite; correct that number in the file"
            )
    for name in ["jnt_range", "jnt_actfrcrange", "actuator_ctrlrange", "actuator_forcerange"]:
        bad = np.argwhere(np.isnan(getattr(m, name)))
        if len(bad):
            raise ModelError(
                f"the compiled model has {name}[{int(bad[0][0])}] = {getattr(m, name)[bad[0][0]]}, "
                f"expected two numbers, which may be infinite; correct them in the file"
            )
    if not np.isfinite(m.opt.gravity).all():
        raise ModelError(f"gravity is {m.opt.gravity}, which is not finite; correct the file")


#: ratio of eigenvalues of M to the largest one below which they are rounding, per dof
_SINGULAR = 1e-15
_SMALL = 300  # number of dofs up to which the eigenvalues are cheap


def data_of(m: mujoco.MjModel) -> mujoco.MjData:
    """Make MuJoCo's data of a model."""
    try:
        return mujoco.MjData(m)
    except mujoco.FatalError as error:
        size = m.narena / 2**20
        raise ModelError(
            f"MuJoCo cannot make the data of the model, which take more than {size:.0f} MiB: "
            f"{error}; free memory, or lower <size memory=...>"
        ) from error


def mass_matrix(m: mujoco.MjModel) -> np.ndarray:
    """Compute the mass matrix M (nv, nv) at a generic configuration."""
    data = data_of(m)
    mujoco.mj_integratePos(m, data.qpos, np.cos(np.arange(1.0, m.nv + 1)), 1.0)
    m = copy.copy(m)  # do not write into the caller's model
    m.body_subtreemass[:] = m.body_mass
    for i in range(m.nbody - 1, 0, -1):
        m.body_subtreemass[m.body_parentid[i]] += m.body_subtreemass[i]
    mujoco.mj_kinematics(m, data)
    mujoco.mj_comPos(m, data)
    mujoco.mj_crb(m, data)
    M = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, data, M)
    return M + np.diag(reflected(m)[0])


def joints_that_cancel(m: mujoco.MjModel, M: np.ndarray | None = None) -> list[str]:
    """List the joints whose motions cancel, so that M is singular at a generic configuration.
    Return none for a large model, which is not checked."""
    if not 0 < m.nv <= _SMALL:
        return []
    M = mass_matrix(m) if M is None else M
    size = np.sqrt(np.abs(np.diag(M)))
    if not np.isfinite(M).all() or not size.all():
        return []
    values, motions = np.linalg.eigh(M / size / size[:, None])
    least = np.argmin(np.abs(values))
    if np.abs(values[least]) > _SINGULAR * m.nv:
        return []
    share = np.abs(motions[:, least])
    joints = dict.fromkeys(m.dof_jntid[np.flatnonzero(share > 0.1 * share.max())].tolist())
    return [m.joint(j).name or f"joint{j}" for j in joints]
