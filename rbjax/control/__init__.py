"""Trajectories and controllers, designed by gradients.

A `Problem` (`problem`) says what is to be found: a system (`system`), costs and constraints of
terms (`terms`, `residuals`), bounds, and what of start, time and model is free. `solve`
(`front_door`) finds it by any of `methods`: `ddp` (expanded by `expansion`, `backward_pass`,
`forward_pass`).

`inverse_kinematics` finds configurations in which frames meet `Goal`s, one search a thread
(`restarts`, `damped_least_squares`); `differential_inverse_kinematics` velocities. A feedback `Law`
is a policy (t, state) -> ctrl: `computed_torque`, `operational_space`, `cartesian_impedance`,
`joint_impedance`, `gravity_compensation`; `allocate` turns forces into controls (`actuation`).
"""

from rbjax.control.actuation import Allocation, allocate
from rbjax.control.computed_torque import ComputedTorque, computed_torque
from rbjax.control.differential_inverse_kinematics import (
    DifferentialInverseKinematics,
    differential_inverse_kinematics,
)
from rbjax.control.front_door import solve
from rbjax.control.goals import Goal
from rbjax.control.gravity_compensation import GravityCompensation, gravity_compensation
from rbjax.control.impedance import (
    CartesianImpedance,
    JointImpedance,
    cartesian_impedance,
    joint_impedance,
)
from rbjax.control.inverse_kinematics import InverseKinematics, inverse_kinematics
from rbjax.control.law import Law
from rbjax.control.methods import Method, methods
from rbjax.control.operational_space import OperationalSpace, operational_space
from rbjax.control.problem import Design, Problem
from rbjax.control.residuals import (
    Acceleration,
    CenterOfMass,
    Configuration,
    Control,
    Effort,
    FrameVelocity,
    Jerk,
    Point,
    Pose,
    StateError,
    Velocity,
)
from rbjax.control.solution import Solution
from rbjax.control.system import Equations, System
from rbjax.control.terms import Constraint, Cost, Term

__all__ = [
    "Problem",
    "Design",
    "solve",
    "Solution",
    "methods",
    "Method",
    "System",
    "Equations",
    # costs and constraints
    "Cost",
    "Constraint",
    "Term",
    "StateError",
    "Velocity",
    "Configuration",
    "Control",
    "Effort",
    "Acceleration",
    "Jerk",
    "CenterOfMass",
    "Pose",
    "Point",
    "FrameVelocity",
    # inverse kinematics
    "Goal",
    "inverse_kinematics",
    "InverseKinematics",
    "differential_inverse_kinematics",
    "DifferentialInverseKinematics",
    # feedback laws
    "Law",
    "computed_torque",
    "ComputedTorque",
    "operational_space",
    "OperationalSpace",
    "cartesian_impedance",
    "CartesianImpedance",
    "joint_impedance",
    "JointImpedance",
    "gravity_compensation",
    "GravityCompensation",
    "allocate",
    "Allocation",
]
