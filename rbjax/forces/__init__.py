"""What acts on a robot: its springs, dampers and actuators, and force elements of any kind."""

from rbjax.forces.acting import applied_forces, elastic_energy
from rbjax.forces.element import Element, Loads
from rbjax.forces.fluid_box import InertiaBoxFluid
from rbjax.forces.fluid_ellipsoid import EllipsoidFluid
from rbjax.forces.instant import Frame, Instant, Joint
from rbjax.forces.many import on_each

__all__ = [
    "Element",
    "EllipsoidFluid",
    "Frame",
    "InertiaBoxFluid",
    "Instant",
    "Joint",
    "Loads",
    "applied_forces",
    "elastic_energy",
    "on_each",
]
