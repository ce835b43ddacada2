"""Planar joint: two shifts in a plane and a turn about its normal."""

from rbjax.joints.hinge import HINGE
from rbjax.joints.joint import Chain
from rbjax.joints.slide import SLIDE


class Planar(Chain):
    """q = [x, y, m; turn about the normal, rad]. The axis is the normal.

    x and y are the directions that the shortest turn from z to the normal makes of x and y: those
    of the body, where the normal is its z.
    """

    name = "planar"

    def __init__(self) -> None:
        super().__init__((SLIDE, 0), (SLIDE, 1), (HINGE, 2))
