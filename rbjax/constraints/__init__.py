"""Constraints on the motion of a robot: rows, and the formulations that enforce them."""

from rbjax.constraints.assembly import Assembly, Mobility, assemble, mobility
from rbjax.constraints.equations.model_rows import jacobian, residual
from rbjax.constraints.formulation import (
    Baumgarte,
    Formulation,
    IndependentCoordinates,
    Projection,
    TangentSpace,
    formulations,
    kinds,
)
from rbjax.constraints.lagrange import LagrangeSystem
from rbjax.constraints.methods.dense import (
    KKT,
    AugmentedLagrangian,
    ForceProjection,
    NullSpaceQR,
    NullSpaceSVD,
    Partitioning,
    UdwadiaKalaba,
)
from rbjax.constraints.methods.differential_algebraic import (
    GGL,
    DifferentialAlgebraic,
    Index2,
    Index3,
)
from rbjax.constraints.methods.method import Method, Multipliers, Penalty
from rbjax.constraints.methods.recursive import Recursive
from rbjax.constraints.methods.soft import Compliant
from rbjax.constraints.reactions import (
    ConstrainedMotion,
    constrained_dynamics,
    joint_wrenches,
    multipliers,
)
from rbjax.constraints.rows.couplings import Gear, JointPolynomial, Prescribed, Rack
from rbjax.constraints.rows.curve import PointOnCurve, PointOnSurface
from rbjax.constraints.rows.functions import Holonomic, Pfaffian
from rbjax.constraints.rows.geometry import (
    along,
    coordinate,
    cosine,
    displacement,
    distance,
    places,
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
    QuaternionWeld,
    Revolute,
    Screw,
    Spherical,
    Universal,
    Weld,
)
from rbjax.constraints.rows.rolling import KnifeEdge, RollingDisc, RollingSphere
from rbjax.constraints.rows.row import Constraint, Row
from rbjax.constraints.rows.soft import Soft
from rbjax.constraints.rows.tendons import TendonPolynomial
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
    "IndependentCoordinates",
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
    "TendonPolynomial",
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

__dir__ = __all__.copy
