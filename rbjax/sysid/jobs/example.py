"""A complete example of a job: a robot, recordings with known parameters, and the configuration."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from rbjax.loading import load
from rbjax.model import State
from rbjax.motion.rollout import rollout

ROBOT = """<mujoco model="arm">
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.05"/>
      <inertial pos="0 0 -0.2" mass="1.0" diaginertia="0.014 0.014 0.001"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03"/>
      <body name="fore" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" damping="0.05"/>
        <inertial pos="0 0 -0.15" mass="0.5" diaginertia="0.004 0.004 0.0004"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.025"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator>
</mujoco>
"""
#: the unknowns of the example, and their true values
TRUTH = {"fore mass": 0.62, "damping[0]": 0.12, "damping[1]": 0.08}
CONFIGURATION = """# rbjax identify identify.toml
model = "arm.xml"                  # MJCF, URDF, or a bundled scene's name

[recordings]
fit = ["run1.csv", "run2.csv"]     # csv or npz
held_out = ["run3.csv"]            # not fitted, for the verdict
time = "t"
time_unit = "s"

[columns]                          # name in the files -> sensor, joint and unit
"shoulder angle" = { sensor = "q", joint = "shoulder", unit = "deg" }
"elbow angle" = { sensor = "q", joint = "elbow", unit = "deg", sign = -1 }
"shoulder torque" = { sensor = "ctrl", joint = "shoulder", unit = "N m" }
"elbow torque" = { sensor = "ctrl", joint = "elbow", unit = "N m" }

[unknowns]                         # name -> entries of a leaf; or inertia = "fore"
"fore mass" = { leaf = "bodies.mass", index = "fore", positive = true }
damping = { leaf = "joints.damping", positive = true }

[options]
estimate_initial_state = true      # the first samples are noisy

[output]
folder = "found"
"""
STEP, COUNT, NOISE = 0.01, 200, 2e-3  # s, samples, rad


def write_example(folder: str | Path) -> Path:
    """Write an example job into a folder, and return the path of its identify.toml."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.xml").write_text(ROBOT)
    model = load(ROBOT)
    mass, *damping = TRUTH.values()
    true = model.replace(
        bodies=model.bodies.replace(mass=model.bodies.mass.at[1].set(mass)),
        joints=model.joints.replace(damping=jnp.array(damping)),
    )
    t = np.arange(COUNT + 1) * STEP
    head = "t,shoulder angle,elbow angle,shoulder torque,elbow torque"
    for k in range(3):
        rng = np.random.default_rng(k)
        rate = 2 * np.pi * np.array([0.7 + 0.2 * k, 1.1 + 0.1 * k])
        torque = np.array([1.5, 0.5]) * np.sin(rate * t[:, None] + k)
        start = State(jnp.array([0.3 - 0.2 * k, 0.4]), jnp.zeros(2))
        path = rollout(true, start, jnp.asarray(torque[:-1]), STEP, integrator="rk4")
        seen = np.degrees(np.asarray(path.q) + NOISE * rng.normal(size=path.q.shape))
        table = np.column_stack([t, seen[:, 0], -seen[:, 1], torque])
        np.savetxt(
            folder / f"run{k + 1}.csv", table, "%.9g", delimiter=",", header=head, comments=""
        )
    written = folder / "identify.toml"
    written.write_text(CONFIGURATION)
    return written
