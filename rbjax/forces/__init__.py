"""Forces on a robot: springs, dampers, actuators, and force elements of any kind."""

from rbjax.forces.acting import applied_forces, elastic_energy
from rbjax.forces.context import Context, FrameState, on_each
from rbjax.forces.element import Element, Loads
from rbjax.forces.fluid import EllipsoidFluid, InertiaBoxFluid
from rbjax.forces.gravity_compensation import GravityCompensation
from rbjax.forces.joint_state import JointState
from rbjax.forces.joints.cable import Cable
from rbjax.forces.joints.curves import JointCurves
from rbjax.forces.joints.friction import GearLoss, JointFriction
from rbjax.forces.joints.limits import JointLimits
from rbjax.forces.joints.polynomials import JointPolynomials
from rbjax.forces.place import Place
from rbjax.forces.reach import Reach
from rbjax.forces.springs import Bushing, PointSpring
from rbjax.forces.tendons.paths import tendon_jacobian, tendon_lengths, tendon_reach

__all__ = [
    "Place",
    "Bushing",
    "Cable",
    "Element",
    "EllipsoidFluid",
    "FrameState",
    "GearLoss",
    "GravityCompensation",
    "InertiaBoxFluid",
    "Context",
    "JointState",
    "JointCurves",
    "JointFriction",
    "JointLimits",
    "JointPolynomials",
    "Loads",
    "PointSpring",
    "Reach",
    "applied_forces",
    "elastic_energy",
    "on_each",
    "tendon_jacobian",
    "tendon_lengths",
    "tendon_reach",
]

__dir__ = __all__.copy
