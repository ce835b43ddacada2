"""rbjax: differentiable rigid-body dynamics in JAX.

A robot file goes in. Fast, accurate and differentiable motion comes out, for one sample or for a
batch of a million. Every function takes one sample and composes with jit, vmap, grad, jvp and vjp.
"""

import functools
import importlib
from typing import Any

from rbjax import (
    body,
    constraints,
    control,
    dynamics,
    forces,
    joints,
    planning,
    rotations,
    solvers,
    spatial,
    sysid,
    wheeled,
)
from rbjax.callable_modules import make_modules_callable
from rbjax.compiling import compiler_options
from rbjax.dynamics import (
    Poses,
    bias_forces,
    body_velocities,
    center_of_mass,
    centroidal_momentum,
    coriolis_matrix,
    difference,
    forward_dynamics,
    forward_dynamics_derivatives,
    forward_kinematics,
    frame_bias_acceleration,
    frame_velocity,
    gravity_forces,
    inertial_parameters,
    inertial_regressor,
    integrate,
    inverse_dynamics,
    inverse_dynamics_derivatives,
    inverse_mass_matrix,
    jacobian,
    jacobian_rate,
    kinetic_energy,
    mass_matrix,
    potential_energy,
    site_pose,
)
from rbjax.dynamics.operations import operation_count
from rbjax.errors import InputError, ModelError, RbjaxError, UnknownName, UnsupportedFeature
from rbjax.forces import applied_forces
from rbjax.loading.load import load, scenes
from rbjax.loading.write_back import write_back
from rbjax.loading.write_mjcf import write_mjcf
from rbjax.model import Model, State
from rbjax.motion.linearise import Linear, linearise, step
from rbjax.motion.rollout import rollout
from rbjax.motion.simulate import simulate
from rbjax.motion.trajectory import Trajectory
from rbjax.threads import compile, threads

__version__ = "0.1.0"


def _of(module: str, name: str) -> Any:
    """A name of a module. The module is imported on the first use."""
    return getattr(importlib.import_module(module), name)


# These rooms offer these names too, although the modules of the names import them.
for _name in ("recommend", "Recommendation"):
    wheeled.FROM_ABOVE[_name] = functools.partial(_of, "rbjax.recommend.fidelity", _name)
    solvers.FROM_ABOVE[_name] = functools.partial(_of, "rbjax.recommend.solver", _name)
    control.FROM_ABOVE[_name] = functools.partial(_of, "rbjax.recommend.control", _name)
    constraints.FROM_ABOVE[_name] = functools.partial(_of, "rbjax.recommend.formulation", _name)


def __getattr__(name: str) -> Any:
    """Subpackages that are imported on the first use, because their own imports are slow.

    `validation` imports MJX, `plotting` matplotlib, `stability` SciPy's integrators and mpmath.
    """
    if name in ("plotting", "stability", "validation"):
        return importlib.import_module(f"rbjax.{name}")
    raise AttributeError(f"module 'rbjax' has no attribute {name!r}")

__all__ = [
    "InputError",
    "Model",
    "ModelError",
    "Poses",
    "Linear",
    "RbjaxError",
    "State",
    "Trajectory",
    "UnknownName",
    "UnsupportedFeature",
    "applied_forces",
    "bias_forces",
    "body",
    "body_velocities",
    "center_of_mass",
    "centroidal_momentum",
    "compile",
    "compiler_options",
    "constraints",
    "control",
    "coriolis_matrix",
    "difference",
    "dynamics",
    "forces",
    "forward_dynamics",
    "forward_dynamics_derivatives",
    "forward_kinematics",
    "frame_bias_acceleration",
    "frame_velocity",
    "gravity_forces",
    "inertial_parameters",
    "inertial_regressor",
    "integrate",
    "inverse_dynamics",
    "inverse_dynamics_derivatives",
    "inverse_mass_matrix",
    "jacobian",
    "jacobian_rate",
    "joints",
    "kinetic_energy",
    "linearise",
    "load",
    "mass_matrix",
    "operation_count",
    "planning",
    "plotting",
    "potential_energy",
    "rollout",
    "rotations",
    "scenes",
    "simulate",
    "site_pose",
    "solvers",
    "spatial",
    "stability",
    "step",
    "sysid",
    "threads",
    "validation",
    "wheeled",
    "write_back",
    "write_mjcf",
]

make_modules_callable(__name__)
