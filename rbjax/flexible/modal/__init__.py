"""Elastic bodies by modes in a floating frame.

body                  the record of a modal body: inertia, stiffness, frames
invariants            inertia invariants from points or a mass matrix
link                  the modal body as a flexible link
finite_elements       mass and stiffness matrices of a structure
beam_elements         frames of Euler-Bernoulli or Timoshenko elements
tetrahedra            solids of linear or quadratic tetrahedra
interfaces            node sets whose averaged motion is the motion of a frame
reduction             Craig-Bampton reduction of finite elements to a modal body
elasticity            the link and its elastic forces in a model
stiffening            geometric stiffening, elastic forces, check of fast rotation
sid                   standard input data of flexible bodies, as text or as a structure
mbdyn_modal           MBDyn's modal format
"""

from rbjax.flexible.modal.beam_elements import BeamSection, beam_mesh
from rbjax.flexible.modal.body import ModalBody
from rbjax.flexible.modal.elasticity import ModalElasticity, add_modal_body
from rbjax.flexible.modal.finite_elements import FiniteElements
from rbjax.flexible.modal.interfaces import Interface
from rbjax.flexible.modal.invariants import InertiaInvariants, from_points, inertia_invariants
from rbjax.flexible.modal.link import ModalLayout, ModalLink
from rbjax.flexible.modal.mbdyn_modal import MBDynModal, read_mbdyn_modal
from rbjax.flexible.modal.reduction import craig_bampton
from rbjax.flexible.modal.sid import from_sid, read_sid, write_sid
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
    "MBDynModal",
    "ModalBody",
    "ModalElasticity",
    "ModalLayout",
    "ModalLink",
    "add_modal_body",
    "beam_mesh",
    "box_mesh",
    "craig_bampton",
    "elastic_force",
    "fast_rotation",
    "from_points",
    "from_sid",
    "inertia_invariants",
    "read_mbdyn_modal",
    "read_sid",
    "stiffness_in_motion",
    "tetrahedral_mesh",
    "with_middle_nodes",
    "write_sid",
]

__dir__ = __all__.copy
