"""What acts on a robot: its springs, dampers and actuators, and force elements of any kind."""

from rbjax.forces.acting import applied_forces, elastic_energy
from rbjax.forces.anchor import Anchor
from rbjax.forces.bushing import Bushing
from rbjax.forces.element import Element, Loads
from rbjax.forces.gravity_compensation import GravityCompensation
from rbjax.forces.instant import Frame, Instant, Joint
from rbjax.forces.joint_friction import JointFriction
from rbjax.forces.joint_limits import JointLimits
from rbjax.forces.joint_polynomials import JointPolynomials
from rbjax.forces.point_spring import PointSpring

__all__ = [
    "Anchor",
    "Bushing",
    "Element",
    "Frame",
    "GravityCompensation",
    "Instant",
    "Joint",
    "JointFriction",
    "JointLimits",
    "JointPolynomials",
    "Loads",
    "PointSpring",
    "applied_forces",
    "elastic_energy",
]
