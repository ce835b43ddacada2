"""Optimal control, feedback laws and linear regulators.

Subpackages:
    optimal: `Problem`, `solve` and its methods, derivatives of solutions, `mpc`.
    laws: controllers of robots, allocation of forces to actuators, regions of attraction.
    linear: regulators, Riccati and Lyapunov equations, controllability, margins, Kalman gains.

Policies are trained in `rbjax.envs.learning`.
Inverse kinematics is in `rbjax.kinematics`; its functions are also exported from this package.
`rbjax.recommend.control_method` compares the methods of `solve` on a problem.
"""

from rbjax.control import laws, linear, optimal
from rbjax.control.laws import (
    Controller,
    allocate,
    cartesian_impedance,
    computed_torque,
    gravity_compensation,
    joint_impedance,
    operational_space,
    region_of_attraction,
)
from rbjax.control.linear import LinearStatus, feedback, lqr, lqr_at, time_varying_lqr
from rbjax.control.optimal import (
    Acceleration,
    Capsule,
    CenterOfMass,
    Clearance,
    Configuration,
    Constraint,
    Control,
    Cost,
    Design,
    Effort,
    Equations,
    FrameVelocity,
    HalfSpace,
    Jerk,
    Method,
    Point,
    Pose,
    Problem,
    RealTime,
    Sampling,
    Solution,
    Sphere,
    StateError,
    Status,
    System,
    Term,
    TickStatus,
    Velocity,
    methods,
    mpc,
    solve,
)
from rbjax.kinematics import Goal, differential_inverse_kinematics, inverse_kinematics

__all__ = [
    # optimal control
    "Problem", "Design", "solve", "Solution", "Status", "methods", "Method", "Sampling", "System",
    "Equations",
    # model predictive control
    "mpc", "TickStatus", "RealTime",
    # costs and constraints
    "Cost", "Constraint", "Term", "StateError", "Velocity", "Configuration", "Control", "Effort",
    "Acceleration", "Jerk", "CenterOfMass", "Pose", "Point", "FrameVelocity", "Clearance", "Sphere",
    "Capsule", "HalfSpace",
    # inverse kinematics
    "Goal", "inverse_kinematics", "differential_inverse_kinematics",
    # feedback laws
    "Controller", "computed_torque", "operational_space", "cartesian_impedance", "joint_impedance",
    "gravity_compensation", "allocate", "region_of_attraction",
    # regulators
    "lqr", "lqr_at", "time_varying_lqr", "feedback", "LinearStatus",
    # subpackages
    "laws", "linear", "optimal",
]  # fmt: skip

__dir__ = __all__.copy
