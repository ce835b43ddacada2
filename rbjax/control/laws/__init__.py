"""Feedback laws: controllers of robots, allocation of forces to actuators, attraction maps."""

from rbjax.control.laws.allocation import Allocation, allocate
from rbjax.control.laws.attraction_map import RegionMap, region_of_attraction
from rbjax.control.laws.computed_torque_law import ComputedTorque, computed_torque
from rbjax.control.laws.controller import Controller
from rbjax.control.laws.gravity_compensation_law import GravityCompensation, gravity_compensation
from rbjax.control.laws.impedance import (
    CartesianImpedance,
    JointImpedance,
    cartesian_impedance,
    joint_impedance,
)
from rbjax.control.laws.operational_space_law import OperationalSpace, operational_space

__all__ = [
    "Allocation", "CartesianImpedance", "ComputedTorque", "Controller", "GravityCompensation",
    "JointImpedance", "OperationalSpace", "RegionMap", "allocate", "cartesian_impedance",
    "computed_torque", "gravity_compensation", "joint_impedance", "operational_space",
    "region_of_attraction",
]  # fmt: skip
