"""Beams in strain coordinates: the strains are polynomials, and the pose is their integral.

basis              Legendre polynomials, Gauss points, moments of a cell, integration matrix
rotation           rotation over a cell: Magnus expansion of order 6, exponential, derivatives
section_rotations  rotations, their columns and their rates at the nodes of a beam
beam_kinematics    positions, columns and accelerations at the frames of a beam
virtual_power      virtual power of a beam's inertial forces
shape              static configuration of a beam
beam_joint         `StrainBeam`, a flexible link
stiffness          stiffness matrix of the coordinates, elastic energy
"""

from rbjax.flexible.strain.beam_joint import (
    StrainBeam,
    largest_cell_angle,
    strain_beam,
)
from rbjax.flexible.strain.shape import STRAINS
from rbjax.flexible.strain.stiffness import elastic_energy, stiffness_matrix

__all__ = [
    "STRAINS",
    "StrainBeam",
    "elastic_energy",
    "largest_cell_angle",
    "stiffness_matrix",
    "strain_beam",
]

__dir__ = __all__.copy
