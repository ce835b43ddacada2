"""Inverse kinematics for goals of bodies and sites, on position level and on velocity level.

`inverse_kinematics` searches for a configuration from many starts (`position_level`, `restarts`).
`differential_inverse_kinematics` solves one quadratic program per control step (`velocity_level`).
"""

from rbjax.kinematics.goals import Goal
from rbjax.kinematics.position_level import inverse_kinematics
from rbjax.kinematics.restarts import InverseKinematics
from rbjax.kinematics.velocity_level import (
    DifferentialInverseKinematics,
    differential_inverse_kinematics,
)

__all__ = [
    "DifferentialInverseKinematics",
    "Goal",
    "InverseKinematics",
    "differential_inverse_kinematics",
    "inverse_kinematics",
]

__dir__ = __all__.copy
