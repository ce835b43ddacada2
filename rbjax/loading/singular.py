"""Joints whose motions cancel: together they move no mass, and M a = tau has no unique solution."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from rbjax.errors import ModelError
from rbjax.loading.mjcf.actuator_kinds import reflected

#: part of the largest below which an eigenvalue of M is rounding, for each velocity
_SINGULAR = 1e-15
_SMALL = 300  # velocities up to which eigenvalues take no time


def data_of(m: mujoco.MjModel) -> mujoco.MjData:
    """MuJoCo's data of a model."""
    try:
        return mujoco.MjData(m)
    except mujoco.FatalError as error:
        size = m.narena / 2**20
        raise ModelError(
            f"MuJoCo cannot make the data of the model, which take more than {size:.0f} MiB: "
            f"{error}; free memory, or lower <size memory=...>"
        ) from error


def mass_matrix(m: mujoco.MjModel) -> np.ndarray:
    """M (nv, nv) at a generic pose."""
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
    """The names of joints that together can move without a mass, where M is singular at a generic
    pose; none of a large model, which is not examined."""
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
