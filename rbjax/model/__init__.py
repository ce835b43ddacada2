"""Models of robots: `Model` and its static part, `Topology`."""

from rbjax.model.components import Actuators, Bodies, Joints, Keyframes, Sites
from rbjax.model.frame import Frame
from rbjax.model.limbs import Group, Partition, partition
from rbjax.model.links import (
    LinkConstants,
    ModelConstants,
    prepare,
    with_constants,
    without_constants,
)
from rbjax.model.model import DRIVER_NAMES, Model
from rbjax.model.solver_parameters import SolverParameters
from rbjax.model.state import State
from rbjax.model.topology import WORLD, Dof, Topology, joint_slices

__all__ = [
    "DRIVER_NAMES",
    "WORLD",
    "Actuators",
    "Bodies",
    "Group",
    "Joints",
    "Keyframes",
    "Dof",
    "Frame",
    "LinkConstants",
    "Model",
    "Partition",
    "ModelConstants",
    "Sites",
    "SolverParameters",
    "State",
    "Topology",
    "with_constants",
    "partition",
    "prepare",
    "joint_slices",
    "without_constants",
]

__dir__ = __all__.copy
