"""Kinematics and dynamics of trees: one file for each algorithm, and the drivers."""

from rbjax.dynamics.bodywise import coriolis_matrix, inertial_parameters, inertial_regressor
from rbjax.dynamics.crba import mass_matrix
from rbjax.dynamics.derivatives import (
    ForwardDynamicsDerivatives,
    InverseDynamicsDerivatives,
    forward_dynamics_derivatives,
    inverse_dynamics_derivatives,
)
from rbjax.dynamics.energy import (
    center_of_mass,
    centroidal_momentum,
    kinetic_energy,
    potential_energy,
)
from rbjax.dynamics.forward import forward_dynamics, inverse_mass_matrix
from rbjax.dynamics.frames import frame_bias_acceleration, frame_velocity, site_pose
from rbjax.dynamics.jacobians import generalized_forces, jacobian, jacobian_rate
from rbjax.dynamics.kinematics import Poses, body_velocities, forward_kinematics
from rbjax.dynamics.manifold import difference, integrate
from rbjax.dynamics.rnea import bias_forces, gravity_forces, inverse_dynamics

__all__ = [
    "ForwardDynamicsDerivatives",
    "InverseDynamicsDerivatives",
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
    "mass_matrix",
    "potential_energy",
    "site_pose",
]
