"""Constraints on the motion of a robot: rows, and the formulations that enforce them."""

from rbjax.constraints.constraint import Constraint
from rbjax.constraints.couplings import Gear, JointPolynomial, Prescribed, Rack
from rbjax.constraints.formulation import Baumgarte, Formulation, Multipliers, Projected
from rbjax.constraints.geometry import (
    along,
    coordinate,
    cosine,
    displacement,
    distance,
    time,
    turn,
)
from rbjax.constraints.pairs import (
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
from rbjax.constraints.place import Place, places
from rbjax.constraints.reactions import jacobian, joint_wrenches, multipliers, residual
from rbjax.constraints.registry import formulations
from rbjax.constraints.row import Row

__all__ = [
    "jacobian",
    "joint_wrenches",
    "multipliers",
    "residual",
    "Baumgarte",
    "Constraint",
    "Cylindrical",
    "Distance",
    "Formulation",
    "Gear",
    "Inline",
    "Inplane",
    "JointPolynomial",
    "Multipliers",
    "Orthogonal",
    "Pair",
    "Parallel",
    "Place",
    "Planar",
    "Prescribed",
    "Prismatic",
    "Projected",
    "Rack",
    "Revolute",
    "Row",
    "Screw",
    "Spherical",
    "Universal",
    "Weld",
    "along",
    "coordinate",
    "cosine",
    "displacement",
    "distance",
    "formulations",
    "places",
    "time",
    "turn",
]
