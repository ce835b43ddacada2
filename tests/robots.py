"""Robots of the tests: a model, the MjModel that it was read from, and states for both.

A name is a bundled scene, `tree:SEED` (a random tree), a name of MODELS
(`benchmarks.cases.models`), or `small`: every kind of thing that a model can hold on five velocity
coordinates. `NAME in water` is the same robot in water that flows, with springs and dampers by
powers of what moves them.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cache
from typing import Any

import mujoco
import numpy as np

import rbjax as rb
from benchmarks.cases.models import MODELS
from benchmarks.cases.random_trees import random_state, random_tree
from rbjax.compiling import xla_accepts
from rbjax.loading import compile_model
from rbjax.validation.mjx import fast
from rbjax.validation.reference import smooth

Array = np.ndarray

QUICK = {  # two thirds of the time to compile; what these programs are asked for is right, not fast
    "xla_backend_optimization_level": 0,
    **(fast() or {}),
}
"""Options of `jax.jit` for programs that are run once."""

AS_USERS = {"xla_backend_optimization_level": 3}
if xla_accepts("xla_cpu_use_fusion_emitters", True):
    AS_USERS["xla_cpu_use_fusion_emitters"] = True
"""XLA's defaults as options of `jax.jit`, whatever flags the tests run under (conftest.py)."""

SMALL = """
<mujoco model="small">
  <compiler angle="radian"/>
  <option timestep="0.001" gravity="0.5 -1 -9"/>
  <worldbody>
    <body name="slider" pos="0.1 0.2 0.3" quat="0.9 0.1 -0.2 0.3">
      <joint name="slide" type="slide" axis="1 2 -1" pos="0.1 0 0" ref="0.2" stiffness="5"
        springref="0.3" damping="0.4" armature="0.05"/>
      <joint name="hinge" axis="0.2 1 0.1" pos="0 0.1 0.05" damping="0.2" armature="0.1"/>
      <inertial pos="0.05 0.1 -0.03" mass="1.5" fullinertia="0.02 0.03 0.025 0.002 -0.003 0.001"/>
      <body name="swinger" pos="0.2 -0.1 0.3" quat="0.8 -0.3 0.4 0.2">
        <joint name="ball" type="ball" pos="0.02 0.05 -0.04" stiffness="2" damping="0.1"/>
        <inertial pos="0.1 -0.05 0.2" mass="0.8" fullinertia="0.012 0.01 0.009 0.001 0.002 -0.001"/>
        <body name="hand" pos="0.1 0.2 0.1" quat="0.7 0.1 0.6 -0.3">
          <inertial pos="0.02 0 0.03" mass="0.4" diaginertia="0.002 0.003 0.0025"/>
          <site name="tip" pos="0.1 0.05 0" quat="0.5 0.5 -0.6 0.2"/>
        </body>
      </body>
    </body>
    <body name="plate" pos="1 0 0"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
  </worldbody>
  <actuator>
    <motor name="push" joint="slide" gear="3" ctrllimited="true" ctrlrange="-0.5 0.5"/>
    <position name="servo" joint="hinge" kp="4" kv="0.5" gear="1.5" forcelimited="true"
      forcerange="-2 2"/>
    <motor name="twist" joint="ball" gear="1 0.5 -2"/>
    <general name="jet" site="tip" gear="1 -0.5 2 0.1 0.3 -0.2" gainprm="2"/>
    <damper name="brake" joint="slide" kv="0.7" ctrlrange="0 1"/>
  </actuator>
  <keyframe><key name="bent" qpos="0.1 0.7 0.9 0.1 -0.2 0.3" qvel="1 2 3 4 5"/></keyframe>
</mujoco>
"""

#: `small` with a tendon over joints, and one that wraps around a sphere and a cylinder
TENDONS = SMALL.replace(
    "<worldbody>",
    """<worldbody><site name="anchor" pos="0.9 0.4 0.9"/>
    <geom name="ball" size="0.15" pos="0.5 0.2 0.7" contype="0" conaffinity="0"/>
    <geom name="drum" type="cylinder" size="0.2 1" pos="0.7 0.3 0.8" contype="0" conaffinity="0"/>
    <site name="side" pos="1 0.1 0.8"/>""",
).replace(
    "<actuator>",
    """<tendon><fixed name="belt"><joint joint="slide" coef="2"/><joint joint="hinge" coef="-0.5"/>
    </fixed><spatial name="rope" stiffness="3" damping="0.1"><site site="tip"/><geom geom="ball"/>
    <site site="anchor"/><pulley divisor="2"/><site site="tip"/>
    <geom geom="drum" sidesite="side"/><site site="anchor"/></spatial></tendon><actuator>""",
)


@dataclass(frozen=True, eq=False)
class Robot:
    """A model, and its reference: an MjModel with only what the model has."""

    model: rb.Model
    reference: mujoco.MjModel

    def states(self, count: int) -> tuple[Array, Array]:
        """q (count, nq) and v (count, nv), the same on every run."""
        drawn = [random_state(self.reference, seed) for seed in range(count)]
        return np.stack([q for q, _ in drawn]), np.stack([v for _, v in drawn])

    def element_states(self, count: int) -> Array:
        """x (count, nx), activations of actuators: the same on every run."""
        return np.random.default_rng(3).uniform(0.0, 1.0, (count, self.reference.na))


def load_quietly(source: Any, **options: Any) -> rb.Model:
    """`rb.load` without warnings about features left out."""
    with warnings.catch_warnings():
        known = ".*(left out of the model|move no mass|no passive joint can have)"
        warnings.filterwarnings("ignore", message=known)
        return rb.load(source, **options)


@cache
def _load(name: str) -> Robot:
    dry = name.removesuffix(" in water")
    if dry.startswith("tree:"):
        compiled = mujoco.MjModel.from_xml_string(random_tree(int(dry.removeprefix("tree:"))))
    elif dry == "small":
        compiled = compile_model(SMALL)
    elif dry == "tendons":
        compiled = compile_model(TENDONS)
    elif dry in MODELS:
        with warnings.catch_warnings():  # MuJoCo's about old files
            warnings.simplefilter("ignore")
            compiled = MODELS[dry].load()
    else:
        compiled = compile_model(dry)
    if name != dry:
        _immerse(compiled)
    return Robot(load_quietly(compiled), smooth(compiled)[0])


def _immerse(m: mujoco.MjModel) -> None:
    rng = np.random.default_rng(7)
    m.opt.density, m.opt.viscosity, m.opt.wind = 1000.0, 0.5, rng.normal(size=3)
    for powers in (m.jnt_stiffnesspoly, m.dof_dampingpoly):
        powers[:] = rng.uniform(0.0, 0.1, powers.shape)


def robot(name: str, driver: str = "auto") -> Robot:
    """The robot of that name, whose recursions run on that driver."""
    found = _load(name)
    return Robot(found.model.replace(driver=driver), found.reference)


def at(reference: mujoco.MjModel, q: Array, v: Array) -> mujoco.MjData:
    """MuJoCo's data at a state, everything computed."""
    data = mujoco.MjData(reference)
    data.qpos, data.qvel = q, v
    mujoco.mj_forward(reference, data)
    return data


def mass_matrix(reference: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """MuJoCo's M (nv, nv)."""
    out = np.zeros((reference.nv, reference.nv))
    mujoco.mj_fullM(reference, data, out)  # MuJoCo 4's order of arguments
    return out
