"""An arm of two links with dry friction, as a new user would identify it: recorded in MuJoCo C with
2 mrad of noise at 100 Hz, masses 10 to 60 % off, all else off too.

MuJoCo regularises friction: over `solreffriction` the joint's force follows v + a / b, not v, with
b = 2 / solreffriction; at its default of 20 ms that is another law than Coulomb's. Here it is
0.2 ms, so that the recorded motion has Coulomb's friction, and steps of 0.1 ms.
"""

from __future__ import annotations

import warnings
from typing import Any

import mujoco
import numpy as np

import rbjax as rb
from rbjax.sysid import Channel, Recording, Unknown

ROBOT = """<mujoco model="arm">
  <option timestep="1e-4" integrator="RK4"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="{d[0]}" frictionloss="{c[0]}"
             solreffriction="{soft} 1"/>
      <inertial pos="0 0 {z[0]}" mass="{m[0]}" diaginertia="0.014 0.014 0.001"/>
      <body name="fore" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" damping="{d[1]}" frictionloss="{c[1]}"
               solreffriction="{soft} 1"/>
        <inertial pos="0 0 {z[1]}" mass="{m[1]}" diaginertia="0.004 0.004 0.0004"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator>
</mujoco>
"""
TRUTH = np.array([1.2, 0.7, -0.2, -0.15, 0.12, 0.08, 0.3, 0.15])
NOISE, STEP, SECONDS = 2e-3, 0.01, 4.0  # rad, s, s
SOFT, SMOOTHING = 2e-4, 3e-3  # s, rad/s
UNKNOWNS: dict[str, Any] = {
    "mass": Unknown("bodies.mass", positive=True),
    "lever": Unknown("bodies.com", (slice(None), 2), scale=0.1),
    "damping": Unknown("joints.damping", positive=True),
    "coulomb": Unknown("forces.0.coulomb", positive=True),
}  # fmt: skip


def text(numbers: np.ndarray, soft: float = SOFT) -> str:
    """The robot's file with masses, levers, damping and friction loss of both joints."""
    m, z, d, c = np.reshape(numbers, (4, 2)).tolist()
    return ROBOT.format(m=m, z=z, d=d, c=c, soft=soft)


def recorded(seed: int, *, held_out: bool = False, soft: float = SOFT) -> Recording:
    """What MuJoCo C records under waves of torque, from rest anywhere."""
    rng = np.random.default_rng(seed + 1000 * held_out)
    model = mujoco.MjModel.from_xml_string(text(TRUTH, soft))
    data = mujoco.MjData(model)
    data.qpos[:] = rng.uniform(-0.6, 0.6, 2)
    t = np.arange(round(SECONDS / STEP) + 1) * STEP
    rate, phase = 2 * np.pi * rng.uniform([0.5, 0.8], [1.0, 1.6]), rng.uniform(0, 6, 2)
    ctrl = np.array([2.0, 0.6]) * np.sin(rate * t[:-1, None] + phase)
    q = [data.qpos.copy()]
    for u in ctrl:
        data.ctrl[:] = u
        mujoco.mj_step(model, data, nstep=round(STEP / model.opt.timestep))
        q.append(data.qpos.copy())
    q = np.array(q) + NOISE * rng.normal(size=(len(q), 2))
    name = f"run {seed}{' held out' if held_out else ''}"
    return Recording(name, {"q": Channel(t, q), "ctrl": Channel(t[:-1], ctrl)})


def guess(seed: int) -> rb.Model:
    """The robot as its user knows it: masses off by 10 to 60 %, levers by 20 %, friction by 2."""
    rng = np.random.default_rng(100 + seed)
    p = TRUTH.copy()
    p[:2] *= 1 + rng.choice([-1, 1], 2) * rng.uniform(0.1, 0.6, 2)
    p[2:4] *= 1 + rng.uniform(-0.2, 0.2, 2)
    p[4:] *= np.exp(rng.uniform(-0.7, 0.7, 4))
    with warnings.catch_warnings(action="ignore"):  # the file's friction loss is replaced below
        model = rb.load(text(p), contacts=False)
    dry = rb.forces.JointFriction.of(model, model.joint_names, coulomb=p[6:], smoothing=SMOOTHING)
    return model.with_forces(dry)
