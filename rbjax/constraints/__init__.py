"""Constraints on the motion of a robot: rows, and the formulations that enforce them."""

from rbjax.constraints.constraint import Constraint
from rbjax.constraints.curve import PointOnCurve, PointOnSurface
from rbjax.constraints.functions import Holonomic, Pfaffian
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
from rbjax.constraints.rolling import KnifeEdge, RollingDisc, RollingSphere
from rbjax.constraints.row import Row

__all__ = [
    "Constraint",
    "Cylindrical",
    "Distance",
    "Holonomic",
    "Inline",
    "Inplane",
    "KnifeEdge",
    "Orthogonal",
    "Pair",
    "Parallel",
    "Pfaffian",
    "Place",
    "Planar",
    "PointOnCurve",
    "PointOnSurface",
    "Prismatic",
    "Revolute",
    "RollingDisc",
    "RollingSphere",
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
    "places",
    "time",
    "turn",
]
