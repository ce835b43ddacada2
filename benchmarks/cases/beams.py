"""Robots of beams for the benchmarks."""

from __future__ import annotations

import math
from typing import Any

import rbjax as rb

STIFFNESS = [1.0, 2.0, 2.0, 3e2, 1e2, 1e2]


def chain(count: int, degrees: dict[str, int], points: int | None = None) -> rb.Model:
    """Beams in series, the first clamped to the world."""
    model, parent = rb.load("<mujoco/>"), "world"
    one = rb.flexible.beam(
        1.0 / count, STIFFNESS, degrees, mass=0.5, inertia=(2e-4, 1e-4, 1e-4), points=points
    )
    for k in range(count):
        model = model.with_beam(f"beam{k}", one, parent)
        parent = f"beam{k}"
    return model


def cable(length: float = 2.0, count: int = 10, dtype: Any = None) -> rb.Model:
    """A rubber cable of 10 mm, clamped, straight along x."""
    rubber = rb.flexible.circle(0.005, E=5e7, nu=0.45, density=1200.0)
    model, parent = rb.load("<mujoco/>"), "world"
    part = rb.flexible.beam(length / count, rubber, {"k_y": 1, "k_z": 1}, damping=2e-3, points=3)
    for k in range(count):
        model = model.with_beam(f"cable{k}", part, parent)
        parent = f"cable{k}"
    return model if dtype is None else model.astype(dtype)


def flying_beam(EI: float, count: int, degrees: dict[str, int]) -> rb.Model:
    """The flying beam of Simo and Vu-Quoc: from (0, 8) m to its loaded end at (6, 0) m, free in the
    plane, as beams in series. It has a length of 10 m, and 1 kg/m."""
    beam = rb.flexible.beam(
        10.0 / count, [0, 0, EI, 1e4, 1e4, 0], degrees, mass=1.0, inertia=[10.0, 0, 10.0]
    )
    model = rb.load('<mujoco><option gravity="0 0 0"/></mujoco>')
    model = model.with_link("base", rb.joints.kind("planar"), position=[0, 8.0, 0])
    half = math.atan2(-8.0, 6.0) / 2
    parent, turn = "base", [math.cos(half), 0, 0, math.sin(half)]
    for i in range(count):
        model = model.with_beam(f"rod{i}", beam, parent, orientation=turn)
        parent, turn = f"rod{i}", [1.0, 0, 0, 0]
    return model


#: the moment of -80 N m about z and the force of 8 N along x at the end of `flying_beam`, for 2.5 s
FLYING_LOAD = (0.0, 0.0, -80.0, 8.0, 0.0, 0.0)


#: name -> robot, of 8 coordinates in one beam and of 52 in 13 beams or more
CASES = {
    "planar 8": lambda: chain(1, {"k_z": 7}),
    "spatial 8": lambda: chain(1, {"k_y": 3, "k_z": 3}),
    "spatial 8, 5 points": lambda: chain(1, {"k_y": 3, "k_z": 3}, 5),
    "13 x 4": lambda: chain(13, {"k_y": 1, "k_z": 1}, 2),
    "13 x 4, 3 points": lambda: chain(13, {"k_y": 1, "k_z": 1}, 3),
    "planar 26 x 2": lambda: chain(26, {"k_z": 1}, 3),
}
