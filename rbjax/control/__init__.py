"""Trajectories and controllers, designed by gradients.

A `Problem` (`problem`) says what is to be found: a system (`system`), costs and constraints of
terms (`terms`, `residuals`), bounds, and what of start, time and model is free. `solve`
(`front_door`) finds it by any of `methods`: `ddp` (expanded by `expansion`, `backward_pass`,
`forward_pass`).
"""

from rbjax.control.front_door import solve
from rbjax.control.methods import Method, methods
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
]
