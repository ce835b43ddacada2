"""Beams of the literature, as references for the strain-coordinate beam.

Beams as ordinary models of rbjax:
uniform_beam.py: UniformBeam, the properties of these beams.
lumped_chain.py: rigid links with springs in the joints between them.
piecewise_constant_strain.py: segments of constant curvature, with masses lumped at their ends.

Nodal elements, written for clarity and comparison, not for speed: dense tangents, one beam, f64:
mesh.py: Formulation, the protocol of an element, and Mesh, its nodes and elements.
quaternions.py: unit quaternions, in a form that compiles fast.
rotation_nodes.py: nodes with a position and a unit quaternion.
reissner.py: Reissner, the two-node element of Simo and Reissner, full and reduced quadrature.
finite_volume.py: FiniteVolume, the three-node element of Ghiringhelli, Masarati and Mantegazza.
absolute_nodal.py: AbsoluteNodal, the planar cable element of Shabana and Gerstmayr.
assembly.py: residual and tangent of a mesh, and Newton's method.
statics.py: equilibrium along a path of loads.
dynamics.py: motion by a midpoint rule.
scenes.py: cantilever, flying beam and spin-up beam.
"""

from rbjax.flexible.reference.absolute_nodal import AbsoluteNodal
from rbjax.flexible.reference.dynamics import Motion, simulate
from rbjax.flexible.reference.finite_volume import FiniteVolume
from rbjax.flexible.reference.lumped_chain import lumped_beam
from rbjax.flexible.reference.mesh import Formulation, Mesh, Supports, arc, line
from rbjax.flexible.reference.piecewise_constant_strain import (
    StrainSprings,
    constant_strain_beam,
)
from rbjax.flexible.reference.reissner import Reissner
from rbjax.flexible.reference.scenes import cantilever, flying_beam, spin_up_angle, spin_up_beam
from rbjax.flexible.reference.statics import Equilibria, solve_static
from rbjax.flexible.reference.uniform_beam import UniformBeam

__all__ = [
    "UniformBeam",
    # beams as models
    "StrainSprings",
    "constant_strain_beam",
    "lumped_beam",
    # nodal elements
    "AbsoluteNodal",
    "FiniteVolume",
    "Reissner",
    # meshes
    "Formulation",
    "Mesh",
    "Supports",
    "arc",
    "line",
    # solvers
    "Equilibria",
    "Motion",
    "simulate",
    "solve_static",
    # scenes
    "cantilever",
    "flying_beam",
    "spin_up_angle",
    "spin_up_beam",
]

__dir__ = __all__.copy
