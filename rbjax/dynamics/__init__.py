"""Kinematics and dynamics of trees: one file for each algorithm, and the drivers."""

from rbjax.dynamics.algorithms.aba import forward_dynamics
from rbjax.dynamics.algorithms.coriolis import (
    LagrangeCoefficients,
    coriolis_matrix,
    lagrange_coefficients,
)
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.derivatives import (
    ForwardDynamicsDerivatives,
    InverseDynamicsDerivatives,
    forward_dynamics_derivatives,
    inverse_dynamics_derivatives,
)
from rbjax.dynamics.algorithms.energy import (
    center_of_mass,
    centroidal_momentum,
    kinetic_energy,
    potential_energy,
)
from rbjax.dynamics.algorithms.frames import (
    frame_bias_acceleration,
    frame_pose,
    frame_velocity,
    generalized_forces,
    jacobian,
    jacobian_rate,
)
from rbjax.dynamics.algorithms.inverse import inverse_mass_matrix
from rbjax.dynamics.algorithms.kinematics import Poses, body_velocities, forward_kinematics
from rbjax.dynamics.algorithms.manifold import difference, integrate
from rbjax.dynamics.algorithms.regressor import inertial_parameters, inertial_regressor
from rbjax.dynamics.algorithms.rnea import bias_forces, gravity_forces, inverse_dynamics

__all__ = [
    "ForwardDynamicsDerivatives",
    "InverseDynamicsDerivatives",
    "LagrangeCoefficients",
    "Poses",
    "bias_forces",
    "body_velocities",
    "center_of_mass",
    "centroidal_momentum",
    "coriolis_matrix",
    "difference",
    "forward_dynamics",
    "forward_dynamics_derivatives",
    "forward_kinematics",
    "frame_bias_acceleration",
    "frame_pose",
    "frame_velocity",
    "generalized_forces",
    "gravity_forces",
    "inertial_parameters",
    "inertial_regressor",
    "integrate",
    "inverse_dynamics",
    "inverse_dynamics_derivatives",
    "inverse_mass_matrix",
    "jacobian",
    "jacobian_rate",
    "kinetic_energy",
    "lagrange_coefficients",
    "mass_matrix",
    "potential_energy",
]

__dir__ = __all__.copy
