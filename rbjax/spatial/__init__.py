"""Spatial vectors and inertia (Featherstone, ch. 2).

Twists, wrenches and inertias are arrays, angular part first, with leading axes as a batch. `shapes`
computes mass properties of solids. Motion, Force, Transform and RigidInertia are on lanes, for the
algorithms.
"""

from rbjax.spatial import operators, shapes
from rbjax.spatial.mass import (
    MassProperties,
    PrincipalAxes,
    kinetic_energy,
    mass_properties,
    momentum,
    parallel_axes,
    principal_axes,
    rotate_inertia,
    spatial_inertia,
    transform_inertia,
    transform_properties,
)
from rbjax.spatial.mass_conditions import (
    Consistency,
    check_mass_properties,
    consistency,
    ellipsoid_margin,
    from_pseudo_inertia,
    pseudo_inertia,
)
from rbjax.spatial.plucker import (
    extended_cross,
    extended_rotation,
    extended_translation,
    force_cross,
    force_cross_matrix,
    force_transform,
    motion_cross,
    motion_cross_matrix,
    motion_transform,
    transform_force,
    transform_motion,
)
from rbjax.spatial.vectors import ArticulatedInertia, Force, Motion, RigidInertia, Transform
from rbjax.spatial.wrenches import (
    central_axis,
    force_at,
    merge_wrenches,
    power,
    twist_at,
    wrench_at,
)

__all__ = [
    "ArticulatedInertia",
    "Consistency",
    "Force",
    "MassProperties",
    "Motion",
    "PrincipalAxes",
    "RigidInertia",
    "Transform",
    "central_axis",
    "check_mass_properties",
    "consistency",
    "ellipsoid_margin",
    "extended_cross",
    "extended_rotation",
    "extended_translation",
    "force_at",
    "force_cross",
    "force_cross_matrix",
    "force_transform",
    "from_pseudo_inertia",
    "kinetic_energy",
    "mass_properties",
    "merge_wrenches",
    "momentum",
    "motion_cross",
    "motion_cross_matrix",
    "motion_transform",
    "transform_properties",
    "operators",
    "parallel_axes",
    "power",
    "principal_axes",
    "pseudo_inertia",
    "rotate_inertia",
    "shapes",
    "spatial_inertia",
    "transform_force",
    "transform_inertia",
    "transform_motion",
    "twist_at",
    "wrench_at",
]

__dir__ = __all__.copy
