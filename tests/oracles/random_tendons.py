"""Random tendons on a random tree: through sites, pulleys, around geoms, and over joints."""

from __future__ import annotations

import mujoco
import numpy as np

from benchmarks.cases.random_trees import random_tree

COUNT = 3  # tendons of a model
GEOM = mujoco.mjtGeom


def random_tendons(seed: int, *, bodies: int = 2, inside: bool = False) -> mujoco.MjSpec:
    """A small random tree with tendons; sites and geoms are on all bodies and on the world.

    inside: side sites inside of their geoms, or on any body; else outside on the same body.
    """
    spec, rng = mujoco.MjSpec.from_string(random_tree(seed, bodies=bodies)), _rng(seed)
    sites, geoms = [], []
    for k, body in enumerate(spec.bodies):
        for end in range(2):
            sites.append(f"end{k}_{end}")
            body.add_site(name=sites[-1], pos=rng.uniform(-0.4, 0.4, 3))
        for kind in (GEOM.mjGEOM_SPHERE, GEOM.mjGEOM_CYLINDER):
            radius, name = rng.uniform(0.05, 0.2), f"geom{k}_{len(geoms)}"
            position = rng.uniform(-0.2, 0.2, 3)
            body.add_geom(
                name=name, type=kind, size=[radius, 0.3, 0], pos=position, quat=rng.normal(size=4),
                contype=0, conaffinity=0, mass=0,
            )  # fmt: skip
            away = rng.normal(size=3)
            reach = radius * (rng.uniform(0, 0.9) if inside else rng.uniform(1.1, 4))
            side = position + away * (reach / np.linalg.norm(away))
            body.add_site(name=f"by {name}", pos=side)
            geoms.append(name)
    joints = [j.name for j in spec.joints
              if j.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)]  # fmt: skip
    for n in range(COUNT):
        tendon = spec.add_tendon(name=f"tendon{n}")
        if n == 0 and joints:
            for joint in joints:
                tendon.wrap_joint(joint, rng.uniform(-2, 2))
        else:
            _path(tendon, rng, sites, geoms, inside)
    return spec


def _path(tendon: mujoco.MjsTendon, rng: np.random.Generator, sites: list, geoms: list,
          inside: bool) -> None:  # fmt: skip
    """Two branches, the second after a pulley half of the time."""
    for branch in range(1 + rng.integers(2)):
        if branch:
            tendon.wrap_pulley(rng.uniform(1, 3))
        chosen = rng.choice(sites, 3, replace=False)
        tendon.wrap_site(chosen[0])
        for site in chosen[1:]:
            if rng.random() < 0.7:
                geom = rng.choice(geoms)
                sides = [f"by {geom}", rng.choice(sites) if inside else ""]
                tendon.wrap_geom(geom, rng.choice(sides))
            tendon.wrap_site(site)


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, 77])
