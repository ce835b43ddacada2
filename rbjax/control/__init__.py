"""Trajectories and controllers, designed by gradients.

A `Problem` (`problem`) says what is to be found: a system (`system`), costs and constraints of
terms (`terms`, `residuals`), bounds, and what of start, time and model is free. `solve`
(`front_door`) finds it by any of `methods`: `ddp` (expanded by `expansion`, `backward_pass`,
`forward_pass`), or samples (`sampling`). The first robots of a form are constants of its programs
(`constants`).

Policies (`networks`) are trained through the dynamics of an `environment` (`policy_gradient`);
`region_of_attraction` maps which starts come back under a feedback.

`inverse_kinematics` finds configurations in which frames meet `Goal`s, one search a thread
(`restarts`, `damped_least_squares`); `differential_inverse_kinematics` velocities. A feedback `Law`
is a policy (t, state) -> ctrl: `computed_torque`, `operational_space`, `cartesian_impedance`,
`joint_impedance`, `gravity_compensation`; `allocate` turns forces into controls (`actuation`).

A solution has derivatives (`implicit`: `optimality`, `riccati_solve`). `clearances` are distances
to obstacles. `mpc` plans again at every tick; `RealTime` does so with a clock. `recommend` tries
the methods on a problem.

Linear systems: regulators of matrices, a model, a motion (`lqr`, `lqr_at`, `time_varying_lqr`);
Riccati recursions serial and parallel in time (`riccati`, `parallel_riccati`); controllability,
observability, poles, `margins`; Kalman gains and filters for what is not measured (`observer`).
"""

from typing import Any

from rbjax.above import names_from_above
from rbjax.control.laws.allocation import Allocation, allocate
from rbjax.control.laws.attraction_map import RegionMap, region_of_attraction
from rbjax.control.laws.computed_torque_law import ComputedTorque, computed_torque
from rbjax.control.laws.controller import Law
from rbjax.control.laws.gravity_compensation_law import GravityCompensation, gravity_compensation
from rbjax.control.laws.impedance import (
    CartesianImpedance,
    JointImpedance,
    cartesian_impedance,
    joint_impedance,
)
from rbjax.control.laws.operational_space_law import OperationalSpace, operational_space
from rbjax.control.learning.environment import Environment
from rbjax.control.learning.networks import Network, network
from rbjax.control.learning.policy_gradient import Trained, actor_critic, through_time
from rbjax.control.linear.lyapunov_equation import Lyapunov, lyapunov
from rbjax.control.linear.observer import SteadyFilter, kalman_gain, observed
from rbjax.control.linear.parallel_riccati import parallel_backward, parallel_roll
from rbjax.control.linear.regulators import Regulator, feedback, lqr, lqr_at, lqr_finite
from rbjax.control.linear.riccati import (
    Gains,
    LinearQuadratic,
    Steered,
    backward,
    constant_problem,
    quadratic_cost,
    roll,
    steer,
)
from rbjax.control.linear.stability_margins import Margins, margins
from rbjax.control.linear.systems import (
    Reach,
    controllability,
    controllability_gramian,
    directions,
    discretise,
    observability,
    observability_gramian,
    poles,
)
from rbjax.control.linear.tracking import Tracking, time_varying_lqr
from rbjax.control.optimal.clearances import Capsule, Clearance, HalfSpace, Sphere
from rbjax.control.optimal.problem import Design, Problem
from rbjax.control.optimal.real_time import RealTime
from rbjax.control.optimal.receding_horizon import Controller, mpc
from rbjax.control.optimal.registry import Method, methods
from rbjax.control.optimal.residuals import (
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
from rbjax.control.optimal.shooting.sampling import SampledStart, Sampling
from rbjax.control.optimal.solution import Solution
from rbjax.control.optimal.solver import solve
from rbjax.control.optimal.system import Equations, System
from rbjax.control.optimal.terms import Constraint, Cost, Term
from rbjax.control.status import LinearStatus
from rbjax.kinematics.goals import Goal
from rbjax.kinematics.position_level import InverseKinematics, inverse_kinematics
from rbjax.kinematics.velocity_level import (
    DifferentialInverseKinematics,
    differential_inverse_kinematics,
)
from rbjax.motion.kalman import Estimate, StateSpace, kalman_predict, kalman_update

#: names offered here whose module imports this package; `rbjax` fills this table
FROM_ABOVE = names_from_above("rbjax.control")


def __getattr__(name: str) -> Any:
    """`recommend` solves problems, so its module imports this package; it is loaded on use."""
    if name in FROM_ABOVE:
        return FROM_ABOVE[name]()
    raise AttributeError(f"module 'rbjax.control' has no attribute {name!r}")


__all__ = [
    "Problem",
    "Design",
    "solve",
    "Solution",
    "methods",
    "Method",
    # the loop closed
    "mpc",
    "Controller",
    "RealTime",
    # what is controlled
    "System",
    "Equations",
    "Sampling",
    "SampledStart",
    # policies
    "Environment",
    "Network",
    "network",
    "actor_critic",
    "through_time",
    "Trained",
    "region_of_attraction",
    "RegionMap",
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
    "Clearance",
    "Sphere",
    "Capsule",
    "HalfSpace",
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
    # regulators
    "LinearStatus",
    "Regulator",
    "Tracking",
    "feedback",
    "lqr",
    "lqr_at",
    "lqr_finite",
    "time_varying_lqr",
    # linear-quadratic problems
    "Gains",
    "LinearQuadratic",
    "Steered",
    "backward",
    "constant_problem",
    "parallel_backward",
    "parallel_roll",
    "quadratic_cost",
    "roll",
    "steer",
    # linear systems
    "Lyapunov",
    "Margins",
    "Reach",
    "controllability",
    "controllability_gramian",
    "directions",
    "discretise",
    "lyapunov",
    "margins",
    "observability",
    "observability_gramian",
    "poles",
    # what is not measured
    "Estimate",
    "SteadyFilter",
    "StateSpace",
    "kalman_gain",
    "kalman_predict",
    "kalman_update",
    "observed",
]
