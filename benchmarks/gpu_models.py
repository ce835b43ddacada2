"""The robots of the GPU benchmarks, each as an `MjModel` for MJX and a `Model` for rbjax.

Constraints are off on every side; robots without actuators get a motor on every hinge.
"""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from rbjax.model import compile_model
from rbjax.validation.reference import smooth

NAMES = ("panda", "humanoid", "g1", "tree60")


def _package(name: str) -> Path:
    return Path(importlib.util.find_spec(name).submodule_search_locations[0])


def compiled(name: str) -> mujoco.MjModel:
    """MuJoCo's model of a robot."""
    if name == "panda":
        return _motors(compile_model(_package("frax") / "assets/franka_panda/panda.urdf"))
    if name == "g1":
        path = _package("frax") / "assets/unitree_g1/g1_29dof_rev_1_0.urdf"
        return _motors(compile_model(path, floating_base=True))
    if name == "humanoid":
        return compile_model(_package("mujoco.mjx") / "test_data/humanoid/humanoid.xml")
    if name == "tree60":
        return _motors(compile_model(tree(60)))
    raise ValueError(f"no robot {name!r}; known are {NAMES}")


def _motors(m: mujoco.MjModel) -> mujoco.MjModel:
    """The same robot, all geoms gone, with a motor on every hinge and slide."""
    spec = mujoco.MjSpec()
    _copy_bodies(m, 0, spec.worldbody)
    spec.option.timestep = m.opt.timestep
    spec.option.gravity = m.opt.gravity
    for j in range(m.njnt):
        if int(m.jnt_type[j]) >= int(mujoco.mjtJoint.mjJNT_SLIDE):
            motor = spec.add_actuator(name=f"m{j}", target=m.joint(j).name)
            motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
            motor.set_to_motor()
    return spec.compile()


def _copy_bodies(m: mujoco.MjModel, parent: int, into) -> None:
    for b in range(1, m.nbody):
        if m.body_parentid[b] != parent:
            continue
        body = into.add_body(
            name=f"b{b}", pos=m.body_pos[b], quat=m.body_quat[b], mass=max(m.body_mass[b], 1e-9),
            ipos=m.body_ipos[b], iquat=m.body_iquat[b],
            inertia=np.maximum(m.body_inertia[b], 1e-12), explicitinertial=True,
        )  # fmt: skip
        for j in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]):
            at = m.jnt_dofadr[j]
            body.add_joint(
                name=m.joint(j).name,
                type=m.jnt_type[j],
                axis=m.jnt_axis[j],
                pos=m.jnt_pos[j],
                armature=float(m.dof_armature[at]),
            )
        _copy_bodies(m, b, body)


def tree(n: int, seed: int = 0) -> str:
    """A tree of n hinges: chains that branch every few links."""
    rng = np.random.default_rng(seed)
    parents = [-1] + [i - 1 if i % 6 else int(rng.integers(0, i)) for i in range(1, n)]

    def body(i: int) -> str:
        numbers = lambda x: " ".join(f"{a:.4f}" for a in x)  # noqa: E731
        axis = rng.normal(size=3)
        inner = "".join(body(k) for k in range(i + 1, n) if parents[k] == i)
        return (
            f'<body pos="{numbers(rng.uniform(-0.2, 0.2, 3))}">'
            f'<joint name="j{i}" axis="{numbers(axis)}" armature="0.01"/>'
            f'<inertial pos="{numbers(rng.uniform(-0.1, 0.1, 3))}" mass="{rng.uniform(0.5, 2):.3f}"'
            f' diaginertia="0.02 0.025 0.03"/>{inner}</body>'
        )

    return f"<mujoco><worldbody>{body(0)}</worldbody></mujoco>"


def pair(name: str) -> tuple[mujoco.MjModel, rb.Model]:
    """The smooth `MjModel` and rbjax's model, in f32."""
    m, _ = smooth(compiled(name))
    m.opt.iterations = m.opt.ls_iterations = 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return m, rb.load(m)


def states(m: mujoco.MjModel, count: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Random q (count, nq), v (count, nv), tau (count, nv), ctrl (count, nu), exact in f32."""
    rng = np.random.default_rng(seed)
    q = m.qpos0 + rng.uniform(-1.0, 1.0, (count, m.nq))
    for kind, at in zip(m.jnt_type, m.jnt_qposadr, strict=True):
        if int(kind) <= int(mujoco.mjtJoint.mjJNT_BALL):
            start = at + 3 * int(kind == mujoco.mjtJoint.mjJNT_FREE)
            turn = rng.normal(size=(count, 4))
            q[:, start : start + 4] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    v, tau = rng.normal(size=(2, count, m.nv))
    ctrl = 0.1 * rng.uniform(-1.0, 1.0, (count, m.nu))
    return tuple(x.astype(np.float32) for x in (q, v, tau, ctrl))


def batch(m: mujoco.MjModel, size: int, *, last: bool) -> tuple[jax.Array, ...]:
    """`states` tiled to a batch on the device; batch last or first."""
    base = states(m, min(size, 4096))
    out = [jnp.tile(jnp.asarray(x), (size // len(x), 1)) for x in base]
    return tuple(jnp.asarray(x.T) if last else x for x in out)
