"""Constraints on the motion of a robot: rows, and the formulations that enforce them."""

from rbjax.constraints.analysis.assembly import Assembly, assemble
from rbjax.constraints.analysis.rank import Mobility, mobility
from rbjax.constraints.analysis.reactions import (
    ConstrainedMotion,
    constrained_dynamics,
    joint_wrenches,
    multipliers,
)
from rbjax.constraints.equations.residuals import jacobian, residual
from rbjax.constraints.formulation import Baumgarte, Formulation, Projection, TangentSpace
from rbjax.constraints.lagrange import LagrangeSystem
from rbjax.constraints.methods.compliant import Compliant
from rbjax.constraints.methods.differential_algebraic import (
    GGL,
    DifferentialAlgebraic,
    Index2,
    Index3,
)
from rbjax.constraints.methods.method import Method, Multipliers
from rbjax.constraints.methods.minimal import NullSpaceQR, NullSpaceSVD, Partitioning
from rbjax.constraints.methods.recursive import Recursive
from rbjax.constraints.methods.redundant import KKT
from rbjax.constraints.methods.soft import QuaternionWeld, Soft
from rbjax.constraints.methods.unconstrained import (
    AugmentedLagrangian,
    ForceProjection,
    Penalty,
    UdwadiaKalaba,
)
from rbjax.constraints.registry import formulations, kinds
from rbjax.constraints.rows.constraint import Constraint
from rbjax.constraints.rows.couplings import Gear, JointPolynomial, Prescribed, Rack
from rbjax.constraints.rows.curve import PointOnCurve, PointOnSurface
from rbjax.constraints.rows.functions import Holonomic, Pfaffian
from rbjax.constraints.rows.geometry import (
    along,
    coordinate,
    cosine,
    displacement,
    distance,
    time,
    turn,
)
from rbjax.constraints.rows.pairs import (
    Cylindrical,
    Distance,
    Inline,
    Inplane,
    Orthogonal,
    Pair,
    Parallel,
    Planar,
    Prismatic,
    Revolute,
    Screw,
    Spherical,
    Universal,
    Weld,
)
from rbjax.constraints.rows.place import places
from rbjax.constraints.rows.rolling import KnifeEdge, RollingDisc, RollingSphere
from rbjax.constraints.rows.row import Row
from rbjax.forces.place import Place

__all__ = [
    "Assembly",
    "AugmentedLagrangian",
    "Baumgarte",
    "Compliant",
    "ConstrainedMotion",
    "Constraint",
    "Cylindrical",
    "DifferentialAlgebraic",
    "Distance",
    "ForceProjection",
    "Formulation",
    "GGL",
    "Gear",
    "Holonomic",
    "Index2",
    "Index3",
    "Inline",
    "Inplane",
    "JointPolynomial",
    "KKT",
    "KnifeEdge",
    "LagrangeSystem",
    "Method",
    "Mobility",
    "Multipliers",
    "NullSpaceQR",
    "NullSpaceSVD",
    "Orthogonal",
    "Pair",
    "Parallel",
    "Partitioning",
    "Penalty",
    "Pfaffian",
    "Place",
    "Planar",
    "PointOnCurve",
    "PointOnSurface",
    "Prescribed",
    "Prismatic",
    "Projection",
    "QuaternionWeld",
    "Rack",
    "Recursive",
    "Revolute",
    "RollingDisc",
    "RollingSphere",
    "Row",
    "Screw",
    "Soft",
    "Spherical",
    "TangentSpace",
    "UdwadiaKalaba",
    "Universal",
    "Weld",
    "along",
    "assemble",
    "constrained_dynamics",
    "coordinate",
    "cosine",
    "displacement",
    "distance",
    "formulations",
    "jacobian",
    "joint_wrenches",
    "kinds",
    "mobility",
    "multipliers",
    "places",
    "residual",
    "time",
    "turn",
]
