"""Planar joint: two shifts in a plane and a turn about its normal."""

from rbjax.joints.hinge import HINGE
from rbjax.joints.joint import Chain
from rbjax.joints.slide import SLIDE


class Planar(Chain):
    """q = [x, y, m; turn about the normal, rad]. The axis is the normal.

    The shortest turn that takes z to the normal takes the body's x and y to the directions of x and
    y. Where the normal is the body's z, these are the body's own.
    """

    name = "planar"

    def __init__(self) -> None:
        super().__init__((SLIDE, 0), (SLIDE, 1), (HINGE, 2))
