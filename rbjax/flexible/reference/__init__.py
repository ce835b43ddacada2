"""Beams of the literature, as references for the strain-coordinate beam.

lumped_chain.py: rigid links with springs in the joints between them.
piecewise_constant_strain.py: segments of constant curvature, with masses lumped at their ends.
"""

from rbjax.flexible.reference.lumped_chain import lumped_beam
from rbjax.flexible.reference.piecewise_constant_strain import (
    StrainSprings,
    constant_strain_beam,
)

__all__ = ["StrainSprings", "lumped_beam", "constant_strain_beam"]
