"""Optimal control: problems, the methods of `solve`, derivatives of solutions, predictive control.

A `Problem` (`problem`) contains a system (`system`), terms of costs and constraints (`terms`,
`clearances`), bounds, and free parts of the start, the time and the model. `objective` evaluates
its cost and constraints. `solve` (`solver`) runs one of the methods (`registry`) of `shooting` or
`collocation`. `derivatives` differentiates solutions. `mpc` (`receding_horizon`) computes a plan at
every tick. `RealTime` does the same in real time.
"""

from rbjax.control.optimal.clearances import Capsule, Clearance, HalfSpace, Sphere
from rbjax.control.optimal.problem import Design, Problem
from rbjax.control.optimal.real_time import RealTime
from rbjax.control.optimal.receding_horizon import mpc
from rbjax.control.optimal.registry import Method, methods
from rbjax.control.optimal.shooting.sampling import Sampling
from rbjax.control.optimal.solution import Solution
from rbjax.control.optimal.solver import solve
from rbjax.control.optimal.system import Equations, System
from rbjax.control.optimal.terms import (
    Acceleration,
    CenterOfMass,
    Configuration,
    Constraint,
    Control,
    Cost,
    Effort,
    FrameVelocity,
    Jerk,
    Point,
    Pose,
    StateError,
    Term,
    Velocity,
)
from rbjax.control.optimal.ticks import TickStatus
from rbjax.status import Status

__all__ = [
    "Acceleration", "Capsule", "CenterOfMass", "Clearance", "Configuration", "Constraint",
    "Control", "Cost", "Design", "Effort", "Equations", "FrameVelocity", "HalfSpace", "Jerk",
    "Method", "Point", "Pose", "Problem", "RealTime", "Sampling", "Solution", "Sphere",
    "StateError", "Status", "System", "Term", "TickStatus", "Velocity", "methods", "mpc", "solve",
]  # fmt: skip

__dir__ = __all__.copy
