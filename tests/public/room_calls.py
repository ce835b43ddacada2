"""Valid calls of contacts, flexible links, sensors and environments, as in `tests.public.calls`."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax import contact, envs, flexible, sensors

Calls = dict[str, dict[str, Any]]

BALL = rb.load(
    """<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 0.0999"><freejoint/>
    <geom type="sphere" size="0.1" mass="1"/></body></worldbody></mujoco>""",
    contacts=True,
)
FALLING = BALL.default_state().replace(v=jnp.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0]))
CONTACT: Calls = {
    "detect": {"model": BALL, "q": np.asarray(FALLING.q), "reach": 0.1},
    "solve": {"model": BALL, "state": FALLING, "t": 0.0, "contact": "mujoco", "dt": 0.01},
    "impulse": {"model": BALL, "state": FALLING, "restitution": 0.5, "friction": 0.5,
                "law": "newton", "reach": 0.1, "t": 0.0, "sweeps": 3},
    "with_geom": {"model": BALL, "name": "pad", "body": "world", "kind": "sphere", "size": 0.1,
                  "position": (0, 0, 0), "orientation": (1, 0, 0, 0)},
    "SoftContact": {"iterations": 5, "dt": 0.01},
    "CoulombContact": {"share": 0.2, "stiffness": 0.9, "rounds": 3, "iterations": 5},
    "MoreauContact.of": {"model": BALL, "restitution": 0.5, "friction": 0.5, "correction": 0.1,
                         "rest_speed": 0.01, "sweeps": 3},
    "CompliantContact.of": {"model": BALL.replace(contact=None), "stiffness": 1e4,
                            "dissipation": 0.1, "friction": 0.5, "slip_speed": 0.01,
                            "exponent": 1.5},
}  # fmt: skip

STEEL = {"E": 2.1e11, "density": 7800.0, "nu": 0.3}
ROD = flexible.beam(1.0, flexible.circle(0.01, **STEEL), {"k_y": 1, "k_z": 1})
RODS = rb.load("<mujoco/>").with_beam("rod", ROD)
ZERO = np.zeros(RODS.nv)
FLEXIBLE: Calls = {
    "circle": {"radius": 0.01, **STEEL},
    "tube": {"outer": 0.02, "inner": 0.01, **STEEL},
    "rectangle": {"width": 0.01, "height": 0.02, **STEEL},
    "ellipse": {"semi_y": 0.01, "semi_z": 0.02, **STEEL},
    "section": {"stiffness": np.ones(6), "mass": 0.5, "inertia": np.array([2.0, 1.0, 1.0]),
                "first_moment": np.zeros(2), "product": 0.0},
    "beam": {"length": 1.0, "section": flexible.circle(0.01, **STEEL), "degrees": {"k_y": 1},
             "damping": 0.01, "points": 5},
    "BeamLoad.of": {"model": RODS, "joint": "rod", "force": np.ones(3), "axes": "world"},
    "section_regressor": {"model": RODS, "q": ZERO, "v": ZERO, "a": ZERO},
    "elastic_regressor": {"model": RODS, "q": ZERO, "v": ZERO},
    "with_beam": {"name": "other", "beam": ROD, "parent": "rod", "position": np.zeros(3),
                  "orientation": np.array([1.0, 0.0, 0.0, 0.0]), "free": False},
    "modal.box_mesh": {"size": np.ones(3), "divisions": (2, 1, 1), "quadratic": False},
}  # fmt: skip

ARM = rb.load("arm7")
REST = ARM.default_state()
GYRO = sensors.NamedSensor("gyro", sensors.Gyro("tool"))
SEEN = ARM.replace(sensors=(GYRO,))


def reading(kind: Any, **fields: Any) -> Any:
    """What a sensor of these fields reads at rest."""
    return rb.sense(ARM.replace(sensors=(sensors.NamedSensor("x", kind(**fields)),)), REST)


def one_of(**fields: Any) -> Any:
    return rb.sense(ARM.replace(sensors=(sensors.NamedSensor(**fields),)), REST)


SENSORS: Calls = {
    "sense": {"model": SEEN, "state": REST, "ctrl": np.zeros(ARM.nu), "tau": np.zeros(ARM.nv),
              "t": 0.0, "dt": 0.01, "named": False},
    "NamedSensor": {"name": "a", "sensor": sensors.Gyro("tool"), "cutoff": 1.0, "noise": 0.1},
    "reading of Gyro": {"frame": "tool"},
    "reading of Position": {"frame": "tool", "reference": "link1"},
    "reading of Pose": {"frame": "tool"},
    "reading of JointPosition": {"joint": "joint1"},
    "reading of JointLimitPosition": {"joint": "joint1", "margin": 0.1},
    "reading of ActuatorForce": {"actuator": "servo1"},
    "reading of Magnetometer": {"frame": "tool", "field": (0.0, -0.5, 0.0)},
    "reading of CameraProjection": {"frame": "tool", "seen": "link1", "focal": (500.0, 500.0),
                                    "resolution": (640, 480)},
    "reading of Currents": {"constant": np.ones(ARM.nv)},
    "reading of SubtreeCenter": {"body": "link3"},
    "sensor_of": {"name": "gyro:tool"},
}  # fmt: skip

PLANE = '<geom name="floor" type="plane" size="0 0 1"/>'
FLOOR = f"<mujoco><worldbody>{PLANE}</worldbody></mujoco>"
POLE = envs.make("cart_pole_balance", kernel=False)


def mass(model: rb.Model) -> Any:
    return model.bodies.mass


ENVS: Calls = {
    "Environment": {"task": POLE.task, "kernel": False},
    "Offset": {"rest": np.zeros(1), "scale": 0.5},
    "Increment": {"scale": 0.5, "start": 0.0},
    "make": {"name": "cart_pole_balance", "kernel": False},
    "random_scale": {"name": "mass", "where": mass, "low": 0.9, "high": 1.1, "each": False},
    "random_offset": {"name": "mass", "where": mass, "low": -0.1, "high": 0.1, "each": True},
    "register": {"name": "a_task"},
    "rough_ground": {"xml": FLOOR, "height": 0.05, "side": 20.0,
                     "points": 8, "seed": 0, "friction": 1.0, "floor": "floor"},
    "control_grid": {"env": POLE},
    "log_recording": {"env": POLE, "observations": np.zeros((4, 5)), "actions": np.zeros((4, 1)),
                      "group": "policy", "name": "log"},
    "observation_sensors": {"env": POLE, "group": "policy"},
    "terms.tolerance": {"bounds": (0.0, 1.0), "margin": 0.5, "sigmoid": "gaussian",
                        "value_at_margin": 0.1},
    "terms.clipped_sum": {"low": 0.0, "high": 1.0, "times_dt": False},
    "terms.force_pushes": {"dt": 0.02, "name": "push"},
    "terms.velocity_pushes": {"dt": 0.02, "name": "push"},
    "terms.gait_clock": {"dt": 0.02, "offsets": np.zeros(2)},
    "terms.periodic_commands": {"every": 5, "name": "command"},
    "terms.switched_commands": {"dt": 0.02, "name": "command"},
    "terms.planar_start": {"model": POLE.task.model, "root": "slider"},
    "terms.joint_randomisations": {"model": ARM, "friction": (0.5, 2.0), "armature": (1.0, 1.1),
                                   "zero": 0.05},
    "terms.mass_randomisations": {"model": ARM, "body": "link1", "factor": (0.9, 1.1),
                                  "added": 1.0},
    "terms.shift_center_of_mass": {"model": ARM, "body": "link1", "most": 0.05},
    "terms.set_friction": {"name": "ground", "geoms": (0,), "low": 0.4, "high": 1.0},
    "adapters.to_gymnax": {"environment": POLE},
    "learning.settings": {"task": "cart_pole_balance", "algorithm": "ppo", "backend": "cpu"},
}  # fmt: skip

ROOMS: dict[str, tuple[Any, Calls]] = {
    "contact": (contact, CONTACT),
    "flexible": (flexible, FLEXIBLE),
    "sensors": (sensors, SENSORS),
    "envs": (envs, ENVS),
}
OTHERS: dict[str, Callable] = {
    "flexible.with_beam": RODS.with_beam,
    "sensors.NamedSensor": one_of,
    "envs.terms.tolerance": functools.partial(envs.terms.tolerance, 0.3),
} | {
    f"sensors.{name}": functools.partial(reading, getattr(sensors, name.rpartition(" ")[2]))
    for name in SENSORS
    if name.startswith("reading of ")
}
