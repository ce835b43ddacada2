"""Spatial vectors on lanes: motions, forces, Plücker transforms, inertias (Featherstone, ch. 2)."""

from rbjax.spatial.inertia import ArticulatedInertia, RigidInertia
from rbjax.spatial.transform import Transform
from rbjax.spatial.vectors import Force, Motion

__all__ = ["ArticulatedInertia", "Force", "Motion", "RigidInertia", "Transform"]
