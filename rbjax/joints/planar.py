"""Planar joint: two shifts in a plane and a turn about its normal."""

from rbjax.joints.hinge import HINGE
from rbjax.joints.joint import Chain
from rbjax.joints.slide import SLIDE


class Planar(Chain):
    """q = [x, y, m; turn about the normal, rad]. The axis is the normal.

    The directions of x and y are the body's x and y axes after the shortest rotation that takes z
    to the normal. If the normal is z, they are the body's own axes. If it is -z, the rotation is a
    half turn about x.
    """

    name = "planar"
    shortest_turn = True

    def __init__(self) -> None:
        super().__init__((SLIDE, 0), (SLIDE, 1), (HINGE, 2))
