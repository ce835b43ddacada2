"""The real Go2 in the air: its recording in halves, and models of it of growing detail.

The base is held, so that no leg feels another: each is a robot of three joints of its own. The
computer sends angles, and the joints' controllers are springs and dampers (20 N m/rad, 1.5 N m s)
that pull towards the last one.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from rbjax.sysid import Channel, Grid, Recording, Setup, Shared, Unknown
from rbjax.sysid.simulation.runs import make_run
from rbjax.sysid.simulation.setup import simulate_motion

DATA = Path(__file__).parents[3] / "shared" / "data" / "go2_in_air"
LEGS = ("FL", "FR", "RL", "RR")
RATE, KP, KD = 200, 20.0, 1.5
#: the samples to fit models, to choose one, and to judge it
FITTED, HALF, END = 1570, 2349, 4698
GRID = Grid(1 / RATE, 2, "rk4", 4)
#: numbers that the source of the data assumes for each joint
NOMINAL = {"armature": 0.01, "viscous": 0.6, "coulomb": 0.2, "smoothing": 0.02}
#: coefficients of torque and friction by position
TERMS = (12, 8)


def robot(*legs: str) -> rb.Model:
    """The robot with these legs, a position servo on each joint."""
    spec = mujoco.MjSpec.from_file(str(DATA / "go2_in_air.xml"))
    spec.delete(spec.keys[0])
    for actuator in list(spec.actuators):
        if actuator.name.startswith(legs):
            actuator.set_to_position(kp=KP, kv=KD)
        else:
            spec.delete(actuator)
    for leg in set(LEGS) - set(legs):
        spec.delete(spec.body(f"{leg}_hip"))
    with warnings.catch_warnings(action="ignore"):  # joint limits are far away
        model = rb.load(spec.compile(), contacts=False)
    ones = np.ones(model.nv)
    return model.replace(joints=model.joints.replace(armature=0.01 * ones, damping=0.1 * ones))


def recording(model: rb.Model, first: int = 0, last: int = HALF) -> Recording:
    """Samples of the joints of a model, their commands, and an error to weigh them by."""
    data = np.load(DATA / "traj_0.npz")
    at = [list(data["joint_names"]).index(name) for name in model.joint_names]
    t = np.arange(first, last) / RATE
    q, asked = (np.array(data[k], float)[first:last, at] for k in ("position_rad", "command_rad"))
    noise = np.full(len(at), 1e-3)
    return Recording(f"{model.joint_names[0]} from {first}", {
        "q": Channel(t, q, model.joint_names, noise=noise), "ctrl": Channel(t, asked),
    })  # fmt: skip


def free_run(setup: Setup, run: Recording) -> np.ndarray:
    """Simulated less recorded angles (T, n), from the first sample and under the commands."""
    given = make_run(setup, run, GRID)
    path = jax.jit(
        lambda r: simulate_motion(lambda p: setup, jnp.zeros(1), r.start, r.commands, GRID)
    )
    return np.asarray(path(given).q - given.values["q"])[: len(run["q"].t)]


def nominal(model: rb.Model) -> Setup:
    """The numbers of the source."""
    n, given = np.ones(model.nv), dict(NOMINAL)
    joints = {"armature": given.pop("armature") * n, "damping": given.pop("viscous") * n}
    dry = rb.forces.JointFriction.of(model, model.joint_names, **given)
    model = model.replace(joints=model.joints.replace(**joints))
    return Setup.of(model.with_forces(dry))


def joint_dynamics(model: rb.Model) -> tuple[Setup, dict[str, Any]]:
    """Armature, viscous and Coulomb friction and a bias for each joint, and a delay, in the box of
    the source. The controllers read the biased angle too, which is a torque kp bias."""
    dry = rb.forces.JointFriction.of(model, model.joint_names, 0.3, smoothing=0.03)
    bias = [Unknown("sensors.q.bias", bounds=(-0.1, 0.1)), Unknown("actuators.bias", (..., 0))]
    return Setup.of(model.with_forces(dry), delay=0.005), {
        "armature": Unknown("joints.armature", bounds=(1e-5, 1.0)),
        "viscous": Unknown("joints.damping", bounds=(0.0, 7.0)),
        "coulomb": Unknown("forces.0.coulomb", bounds=(0.0, 2.0)),
        "bias": Shared(tuple(bias), (1.0, -KP)),
        "delay": Unknown("delay", bounds=(0.0, 0.02)),
    }


def by_position(model: rb.Model, terms: tuple[int, int] = TERMS) -> tuple[Setup, dict[str, Any]]:
    """Torque and dry friction that depend on the angle, series with so many terms; of all legs the
    same armature and viscous friction; no delay."""
    q, n = recording(model)["q"].values, model.nv
    ends = np.stack([q.min(0) - 0.005, q.max(0) + 0.005], 1)  # of the half that may be seen
    torque, coulomb = (np.zeros((n, k)) for k in terms)
    coulomb[:, 0] = 0.3
    curves = rb.forces.JointCurves.of(
        model, model.joint_names, ends, torque=torque, coulomb=coulomb, smoothing=0.03
    )
    return Setup.of(model.with_forces(curves)), {
        "armature": alike("joints.armature", n),
        "viscous": alike("joints.damping", n),
        "torque": Unknown("forces.0.torque"),
        "coulomb": Unknown("forces.0.coulomb"),
    }


def alike(leaf: str, n: int) -> Shared:
    """Hip, thigh and calf of all legs have the same drives."""
    return Shared(tuple(Unknown(leaf, slice(k, k + 3), positive=True) for k in range(0, n, 3)))
