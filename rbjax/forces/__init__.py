"""What acts on a robot: its springs, dampers and actuators, and force elements of any kind."""

from rbjax.forces.acting import applied_forces, elastic_energy
from rbjax.forces.actuators.gear_loss import GearLoss
from rbjax.forces.bushing import Bushing
from rbjax.forces.context import Context, Frame, Joint
from rbjax.forces.element import Element, Loads
from rbjax.forces.fluid.ellipsoid import EllipsoidFluid
from rbjax.forces.fluid.inertia_box import InertiaBoxFluid
from rbjax.forces.gravity_compensation import GravityCompensation
from rbjax.forces.joints.curves import JointCurves
from rbjax.forces.joints.friction import JointFriction
from rbjax.forces.joints.limits import JointLimits
from rbjax.forces.joints.polynomials import JointPolynomials
from rbjax.forces.many import on_each
from rbjax.forces.place import Place
from rbjax.forces.point_spring import PointSpring

__all__ = [
    "Place",
    "Bushing",
    "Element",
    "EllipsoidFluid",
    "Frame",
    "GearLoss",
    "GravityCompensation",
    "InertiaBoxFluid",
    "Context",
    "Joint",
    "JointCurves",
    "JointFriction",
    "JointLimits",
    "JointPolynomials",
    "Loads",
    "PointSpring",
    "applied_forces",
    "elastic_energy",
    "on_each",
]
