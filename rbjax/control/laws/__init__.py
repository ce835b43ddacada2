"""Feedback laws: controllers, allocation of forces to actuators, regions of attraction."""

from rbjax.control.laws.allocation import allocate
from rbjax.control.laws.attraction_map import region_of_attraction
from rbjax.control.laws.controller import Controller
from rbjax.control.laws.frame_laws import (
    cartesian_impedance,
    operational_space,
)
from rbjax.control.laws.joint_laws import (
    computed_torque,
    gravity_compensation,
    joint_impedance,
)

__all__ = [
    "Controller", "allocate", "cartesian_impedance", "computed_torque", "gravity_compensation",
    "joint_impedance", "operational_space", "region_of_attraction",
]  # fmt: skip

__dir__ = __all__.copy
