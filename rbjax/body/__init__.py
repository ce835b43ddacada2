"""The motion of one rigid body in equivalent formulations, and mechanics of particles.

`formulations()` returns all formulations, with one signature. `lagrange` derives equations of
motion from energies, `particles` from ideal constraints, `relative_motion` in moving frames.
"""

from rbjax.body import lagrange, particles, relative_motion, virtual_work
from rbjax.body.attitude_lagrange import Lagrange, QuasiLagrange, hamel_acceleration
from rbjax.body.body import (
    Body,
    Situation,
    ellipsoid_added_mass,
    inertia_matrix,
    kinetic_energy,
    potential_energy,
    rigid_body,
    total_wrench,
)
from rbjax.body.forces import (
    Buoyancy,
    CentralGravity,
    Damper,
    LinearDrag,
    QuadraticDrag,
    Spring,
    UniformGravity,
)
from rbjax.body.formulation_types import (
    BodyState,
    Formulation,
    Kirchhoff,
    Momentum,
    NewtonEuler,
    Spatial,
)
from rbjax.body.registry import formulation, formulations

__all__ = [
    "Body",
    "Buoyancy",
    "CentralGravity",
    "Damper",
    "Formulation",
    "Kirchhoff",
    "Lagrange",
    "LinearDrag",
    "Momentum",
    "NewtonEuler",
    "QuadraticDrag",
    "QuasiLagrange",
    "Situation",
    "Spatial",
    "Spring",
    "BodyState",
    "UniformGravity",
    "ellipsoid_added_mass",
    "formulation",
    "formulations",
    "hamel_acceleration",
    "inertia_matrix",
    "kinetic_energy",
    "lagrange",
    "particles",
    "potential_energy",
    "relative_motion",
    "rigid_body",
    "total_wrench",
    "virtual_work",
]

__dir__ = __all__.copy
