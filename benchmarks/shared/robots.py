"""The robots of the figures, as every engine reads them; this file is no benchmark."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from benchmarks.cases.models import MODELS, switch_off_constraints

NAMES = {
    "panda": "frax/franka_panda/panda.urdf",
    "humanoid": "gymnasium/humanoid.xml",
    "g1": "frax/unitree_g1/g1_29dof_rev_1_0.urdf+free",
}
ALL = (*NAMES, "tree60")


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


def actuated(name: str) -> mujoco.MjModel:
    """The same without geoms, for MJX. A robot without actuators gets a motor on every joint with
    one coordinate."""
    m = compiled(name)
    if not m.nu:
        spec = mujoco.MjSpec()
        spec.option.timestep, spec.option.gravity = m.opt.timestep, m.opt.gravity
        _copy_bodies(m, 0, spec.worldbody)
        for j in range(m.njnt):
            if m.jnt_type[j] >= int(mujoco.mjtJoint.mjJNT_SLIDE):
                motor = spec.add_actuator(name=f"m{j}", target=f"j{j}")
                motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
                motor.set_to_motor()
        m = spec.compile()
        switch_off_constraints(m)
    m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)  # MJX's step, else implicit
    m.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER  # as ours; one file asks for RK4
    m.opt.iterations = m.opt.ls_iterations = 1
    return m


def _copy_bodies(m: mujoco.MjModel, parent: int, into: mujoco.MjsBody) -> None:
    for b in range(1, m.nbody):
        if m.body_parentid[b] != parent:
            continue
        body = into.add_body(
            name=f"b{b}", pos=m.body_pos[b], quat=m.body_quat[b], mass=max(m.body_mass[b], 1e-9),
            ipos=m.body_ipos[b], iquat=m.body_iquat[b],
            inertia=np.maximum(m.body_inertia[b], 1e-12), explicitinertial=True,
        )  # fmt: skip
        for j in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]):
            body.add_joint(
                name=f"j{j}", type=m.jnt_type[j], axis=m.jnt_axis[j], pos=m.jnt_pos[j],
                armature=float(m.dof_armature[m.jnt_dofadr[j]]),
            )  # fmt: skip
        _copy_bodies(m, b, body)


def ours(name: str) -> rb.Model:
    """The robot of `compiled` as a Model."""
    return as_model(compiled(name))


def as_model(m: mujoco.MjModel) -> rb.Model:
    """An MjModel as a Model, without the warning about dropped features."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return rb.load(m)


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


def batch(m: mujoco.MjModel, size: int, *, last: bool) -> tuple[jax.Array, ...]:
    """q, v, tau, ctrl in f32 on the device: 4,096 states tiled to a batch, last or first axis."""
    count = min(size, 4096)
    ctrl = 0.1 * np.random.default_rng(1).uniform(-1.0, 1.0, (count, m.nu))
    out = [jnp.tile(jnp.asarray(x, jnp.float32), (size // count, 1))
           for x in (*states(m, count), ctrl)]  # fmt: skip
    return tuple(jnp.asarray(x.T) if last else x for x in out)


def exact(m: mujoco.MjModel, count: int) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """q, v, tau in f32 and MuJoCo's accelerations in f64 under only tau and gravity; and the tau
    for an engine with springs, dampers and actuators."""
    q, v, tau = (x.astype(np.float32) for x in states(m, count, seed=1))
    data, out, applied = mujoco.MjData(m), [], []
    for i in range(count):
        data.qpos, data.qvel, data.ctrl, data.qfrc_applied = q[i], v[i], 0, 0
        mujoco.mj_forward(m, data)
        applied.append(tau[i] - data.qfrc_passive - data.qfrc_actuator)
        data.qfrc_applied = applied[-1]
        mujoco.mj_forward(m, data)
        out.append(data.qacc.copy())
    return (q, v, tau, np.array(applied, np.float32)), np.array(out)


def relative(got: np.ndarray, want: np.ndarray) -> np.ndarray:
    """For each state, the largest deviation over the largest entry."""
    return np.abs(np.asarray(got, np.float64) - want).max(-1) / np.abs(want).max(-1)
