"""Robots on the floor: a bundled scene with contacts switched on, or a file, and their states."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

import rbjax as rb

SCENES = Path(rb.__file__).parent / "loading" / "scenes"
#: name -> the bundled scene and a part of the names of the geoms that touch the floor
ROBOTS = {"humanoid": ("humanoid", ""), "humanoid_feet": ("humanoid", "foot")}


def on_floor(name: str) -> mujoco.MjModel:
    """Return a robot whose geoms touch the floor, but not each other; or the model of a file."""
    if name not in ROBOTS:
        return mujoco.MjModel.from_xml_path(name)
    scene, part = ROBOTS[name]
    spec = mujoco.MjSpec.from_file(str(SCENES / f"{scene}.xml"))
    for geom in spec.geoms:
        plane = geom.type == mujoco.mjtGeom.mjGEOM_PLANE
        geom.contype, geom.conaffinity = (0, 1) if plane else (int(part in geom.name), 0)
    return spec.compile()


def settled(m: mujoco.MjModel, count: int, steps: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Return (q, v) of a robot along a fall under random controls, after `steps` steps and more."""
    data, rng = mujoco.MjData(m), np.random.default_rng(0)
    if m.nkey:
        mujoco.mj_resetDataKeyframe(m, data, 0)
    qs, vs = [], []
    for k in range(steps + 10 * min(count, 64)):
        if k % 20 == 0:
            data.ctrl[:] = random_controls(m, rng, 1)[0]
        mujoco.mj_step(m, data)
        if k >= steps and (k - steps) % 10 == 0:
            qs.append(data.qpos.copy())
            vs.append(data.qvel.copy())
    return np.resize(qs, (count, m.nq)), np.resize(vs, (count, m.nv))


def random_controls(m: mujoco.MjModel, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return controls within their ranges, as a policy at the start of its training gives them."""
    low, high = m.actuator_ctrlrange.T if m.nu else np.zeros((2, 0))
    limited = m.actuator_ctrllimited.astype(bool)
    low, high = np.where(limited, low, -1.0), np.where(limited, high, 1.0)
    middle, half = (low + high) / 2, (high - low) / 2
    if m.nkey and m.nu:
        middle = np.clip(m.key_ctrl[0], low, high)
    return middle + 0.3 * half * rng.uniform(-1, 1, (count, m.nu))
