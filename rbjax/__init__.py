"""rbjax: differentiable rigid-body dynamics in JAX.

Load a robot file; compute fast, accurate and differentiable motion, for one sample or a batch of a
million. Every function accepts one sample and composes with jit, vmap, grad, jvp and vjp.
"""

import importlib
from typing import TYPE_CHECKING, Any

import jax

from rbjax import dynamics, joints, rotations, spatial
from rbjax.compiler import compile, threads
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
    frame_pose,
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
    lagrange_coefficients,
    mass_matrix,
    potential_energy,
)
from rbjax.dynamics.tracing.operations import operation_count
from rbjax.errors import (
    InputError,
    MissingPackage,
    ModelError,
    RbjaxError,
    UnknownName,
    UnsupportedFeature,
)
from rbjax.model import Frame, Model, State

if TYPE_CHECKING:
    from rbjax import (
        body,
        constraints,
        contact,
        control,
        envs,
        estimation,
        flexible,
        forces,
        kinematics,
        planning,
        plotting,
        recommend,
        sensors,
        solvers,
        stability,
        sysid,
        validation,
        viewer,
        wheeled,
    )
    from rbjax import loading as loading
    from rbjax import motion as motion
    from rbjax.forces import applied_forces, tendon_jacobian, tendon_lengths
    from rbjax.loading import ModelBuilder, load, write_back, write_mjcf
    from rbjax.loading.sources import scenes
    from rbjax.motion.impacts import ImpactTrajectory, simulate_impacts
    from rbjax.motion.linearise import Linear, linearise
    from rbjax.motion.rollout import rollout
    from rbjax.motion.simulate import simulate
    from rbjax.motion.step import acceleration, step
    from rbjax.motion.trajectory import Trajectory
    from rbjax.sensors import sense

__version__ = "0.1.0"

#: packages imported on first use: they import diffrax, MuJoCo and SciPy, which takes several times
#: as long as the rest of rbjax
_PACKAGES = (
    "body", "constraints", "contact", "control", "envs", "estimation", "flexible", "forces",
    "kinematics", "loading", "motion", "planning", "plotting", "recommend", "sensors", "solvers",
    "stability", "sysid", "validation", "viewer", "wheeled",
)  # fmt: skip
_MODULES = {
    "ModelBuilder": "loading",
    "Linear": "motion.linearise",
    "acceleration": "motion.step",
    "Trajectory": "motion.trajectory",
    "applied_forces": "forces",
    "linearise": "motion.linearise",
    "load": "loading",
    "rollout": "motion.rollout",
    "scenes": "loading",
    "sense": "sensors",
    "simulate": "motion.simulate",
    "ImpactTrajectory": "motion.impacts",
    "simulate_impacts": "motion.impacts",
    "step": "motion.step",
    "tendon_jacobian": "forces",
    "tendon_lengths": "forces",
    "write_back": "loading",
    "write_mjcf": "loading",
}


def _of(module: str, name: str | None = None) -> Any:
    """Import a module on first use; return it, or its attribute `name`. The first use may be inside
    a trace: `ensure_compile_time_eval` prevents tracing of the module's constants."""
    with jax.ensure_compile_time_eval():
        found = importlib.import_module(module)
    return found if name is None else getattr(found, name)


if not TYPE_CHECKING:  # with it, a type checker would accept every name

    def __getattr__(name: str) -> Any:
        """Return a package or a name that is imported on first use."""
        if name in _PACKAGES:
            return _of(f"rbjax.{name}")
        if name in _MODULES:
            globals()[name] = found = _of(f"rbjax.{_MODULES[name]}", name)
            return found
        raise AttributeError(f"module 'rbjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "loading", "motion", "__version__"]


__all__ = [
    "ImpactTrajectory",
    "InputError",
    "MissingPackage",
    "Frame",
    "Model",
    "ModelBuilder",
    "ModelError",
    "Poses",
    "Linear",
    "RbjaxError",
    "State",
    "Trajectory",
    "UnknownName",
    "UnsupportedFeature",
    "acceleration",
    "applied_forces",
    "bias_forces",
    "body",
    "body_velocities",
    "center_of_mass",
    "centroidal_momentum",
    "compile",
    "compiler_options",
    "constraints",
    "contact",
    "control",
    "coriolis_matrix",
    "difference",
    "dynamics",
    "envs",
    "estimation",
    "flexible",
    "forces",
    "forward_dynamics",
    "forward_dynamics_derivatives",
    "forward_kinematics",
    "frame_bias_acceleration",
    "frame_pose",
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
    "kinematics",
    "kinetic_energy",
    "lagrange_coefficients",
    "linearise",
    "load",
    "mass_matrix",
    "operation_count",
    "planning",
    "plotting",
    "potential_energy",
    "recommend",
    "rollout",
    "rotations",
    "scenes",
    "sense",
    "sensors",
    "simulate",
    "simulate_impacts",
    "solvers",
    "spatial",
    "stability",
    "step",
    "sysid",
    "tendon_jacobian",
    "tendon_lengths",
    "threads",
    "validation",
    "viewer",
    "wheeled",
    "write_back",
    "write_mjcf",
]
