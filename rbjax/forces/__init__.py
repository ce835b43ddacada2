"""What acts on a robot: its springs, dampers and actuators, and force elements of any kind."""

from rbjax.forces.acting import applied_forces, elastic_energy
from rbjax.forces.element import Element, Loads
from rbjax.forces.instant import Frame, Instant, Joint

__all__ = [
    "Element",
    "Frame",
    "Instant",
    "Joint",
    "Loads",
    "applied_forces",
    "elastic_energy",
]
