"""Elastic bodies by modes in a floating frame.

body                  the record of a modal body: inertia, stiffness, frames
invariants            inertia invariants from points or a mass matrix
link                  the modal body as a flexible link
finite_elements       mass and stiffness matrices of a structure
beam_elements         frames of Euler-Bernoulli or Timoshenko elements
tetrahedra            solids of linear or quadratic tetrahedra
interfaces            node sets whose averaged motion is the motion of a frame
reduction             Craig-Bampton reduction of finite elements to a modal body
stiffening            geometric stiffening, elastic forces, check of fast rotation
"""

from rbjax.flexible.modal.beam_elements import BeamSection, beam_mesh
from rbjax.flexible.modal.body import ModalBody
from rbjax.flexible.modal.finite_elements import FiniteElements
from rbjax.flexible.modal.interfaces import Interface
from rbjax.flexible.modal.invariants import InertiaInvariants, from_points, inertia_invariants
from rbjax.flexible.modal.link import ModalLayout, ModalLink
from rbjax.flexible.modal.reduction import craig_bampton
from rbjax.flexible.modal.stiffening import (
    FastRotation,
    elastic_force,
    fast_rotation,
    stiffness_in_motion,
)
from rbjax.flexible.modal.tetrahedra import box_mesh, tetrahedral_mesh, with_middle_nodes

__all__ = [
    "BeamSection",
    "FastRotation",
    "FiniteElements",
    "InertiaInvariants",
    "Interface",
    "ModalBody",
    "ModalLayout",
    "ModalLink",
    "beam_mesh",
    "box_mesh",
    "craig_bampton",
    "elastic_force",
    "fast_rotation",
    "from_points",
    "inertia_invariants",
    "stiffness_in_motion",
    "tetrahedral_mesh",
    "with_middle_nodes",
]
