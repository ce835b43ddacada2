"""Flexible links: beams and elastic bodies as links of a robot.

beam          `Beam`, which `Model.with_beam` adds to a robot
elasticity    elastic and viscous forces of a beam
section       cross-sections: stiffness, mass and rotary inertia per length
strain/       beams whose strains are polynomials of the arclength
"""

from rbjax.flexible.beam import Beam, beam
from rbjax.flexible.elasticity import BeamElasticity
from rbjax.flexible.section import Section, circle, ellipse, rectangle, section, tube

__all__ = [
    "Beam",
    "BeamElasticity",
    "Section",
    "beam",
    "circle",
    "ellipse",
    "rectangle",
    "section",
    "tube",
]
