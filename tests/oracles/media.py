"""Random trees in a fluid, as MJCF text, and MuJoCo's fluid forces on them; a seed is a model."""

from __future__ import annotations

import mujoco
import numpy as np

from benchmarks.cases.random_trees import random_state, random_tree

Array = np.ndarray
GEOMS = ("sphere", "capsule", "cylinder", "ellipsoid", "box")


def immersed_tree(seed: int, *, ellipsoids: float, bodies: int = 4) -> mujoco.MjModel:
    """A random tree in a random fluid with a random wind. Each body has up to two geoms; the share
    `ellipsoids` of these acts by the ellipsoid model."""
    rng = np.random.default_rng([1237, seed])
    spec = mujoco.MjSpec.from_string(random_tree(seed, bodies=bodies))
    spec.option.density, spec.option.viscosity = rng.uniform(1, 1000), rng.uniform(0.01, 2)
    spec.option.wind = rng.normal(size=3) * rng.choice([0, 3])
    for body in spec.bodies[1:]:
        for _ in range(rng.integers(0, 3)):
            kind = getattr(mujoco.mjtGeom, f"mjGEOM_{rng.choice(GEOMS).upper()}")
            body.add_geom(
                type=kind,
                size=rng.uniform(0.01, 0.3, 3),
                pos=rng.normal(size=3) * 0.2 * rng.choice([0, 1]),
                quat=rng.normal(size=4) if rng.random() < 0.7 else [1, 0, 0, 0],
                fluid_ellipsoid=int(rng.random() < ellipsoids),
                fluid_coefs=rng.uniform(0, 2, 5),
                contype=0,
                conaffinity=0,
            )
    return spec.compile()


def states(m: mujoco.MjModel, count: int) -> tuple[Array, Array]:
    """q (count, nq) and v (count, nv), the same on every run."""
    drawn = [random_state(m, seed) for seed in range(count)]
    return np.stack([q for q, _ in drawn]), np.stack([v for _, v in drawn])


def fluid_forces(m: mujoco.MjModel, q: Array, v: Array) -> Array:
    """MuJoCo's generalized forces of the fluid (count, nv)."""
    data, rows = mujoco.MjData(m), []
    for data.qpos[:], data.qvel[:] in zip(q, v, strict=True):
        mujoco.mj_forward(m, data)
        rows.append(data.qfrc_fluid.copy())
    return np.array(rows)
