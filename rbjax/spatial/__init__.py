"""Spatial vectors and inertia (Featherstone, ch. 2).

Twists, wrenches and inertias are arrays, angular part first, with leading axes as a batch. Shapes
have mass properties. The algorithms use the same on lanes: Motion, Force, Transform, RigidInertia.
"""

from rbjax.spatial import operators, shapes
from rbjax.spatial.inertia import ArticulatedInertia, RigidInertia
from rbjax.spatial.mass import (
    MassProperties,
    PrincipalAxes,
    kinetic_energy,
    mass_properties,
    momentum,
    moved,
    parallel_axes,
    principal_axes,
    rotate_inertia,
    spatial_inertia,
    transform_inertia,
)
from rbjax.spatial.physical_consistency import (
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
from rbjax.spatial.transform import Transform
from rbjax.spatial.vectors import Force, Motion
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
    "moved",
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
