"""Inverse kinematics: configurations (`position_level`) and velocities (`velocity_level`) for goals
of bodies and sites.

`inverse_kinematics` searches from many starts, one search a thread (`restarts`,
`damped_least_squares`); `differential_inverse_kinematics` solves one quadratic program a tick.
"""

from rbjax.kinematics.goals import Goal
from rbjax.kinematics.position_level import InverseKinematics, inverse_kinematics
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
