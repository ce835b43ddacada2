"""The robots of the figures, as every engine reads them; this file is no benchmark."""

from __future__ import annotations

import warnings

import mujoco
import numpy as np

import rbjax as rb
from tests.oracles.models import MODELS, switch_off_constraints

NAMES = {
    "panda": "frax/franka_panda/panda.urdf",
    "humanoid": "gymnasium/humanoid.xml",
    "g1": "frax/unitree_g1/g1_29dof_rev_1_0.urdf+free",
}


def tree_60() -> str:
    """A 60-joint tree: four chains of 15 hinges on one base, axes turning from link to link."""

    def chain(k: int, depth: int) -> str:
        if depth == 15:
            return ""
        axis = ("1 0 0", "0 1 0", "0 0 1")[(depth + k) % 3]
        return (
            f'<body pos="0.05 0 -0.1"><joint axis="{axis}"/>'
            '<geom type="capsule" size="0.02" fromto="0 0 0 0.05 0 -0.1"/>'
            f"{chain(k, depth + 1)}</body>"
        )

    limbs = "".join(f'<body pos="{k} 0 1">{chain(k, 0)}</body>' for k in range(4))
    return f"<mujoco><worldbody>{limbs}</worldbody></mujoco>"


def compiled(name: str) -> mujoco.MjModel:
    """The MuJoCo model of a robot, with contacts, limits, friction loss and the rest off."""
    m = (
        mujoco.MjModel.from_xml_string(tree_60())
        if name == "tree60"
        else MODELS[NAMES[name]].load()
    )
    switch_off_constraints(m)
    return m


def ours(name: str) -> rb.Model:
    """The same robot as a Model."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return rb.load(compiled(name))


def states(
    model: mujoco.MjModel, count: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random q, v, tau with unit quaternions."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1, 1, (count, model.nq))
    for kind, at in zip(model.jnt_type, model.jnt_qposadr, strict=True):
        if kind in (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)):
            start = at + (3 if kind == int(mujoco.mjtJoint.mjJNT_FREE) else 0)
            turn = rng.normal(size=(count, 4))
            q[:, start : start + 4] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    return q, rng.normal(size=(count, model.nv)), rng.normal(size=(count, model.nv))
