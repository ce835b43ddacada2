"""Cylindrical joint: a shift along the axis and a turn about it."""

from rbjax.joints.hinge import HINGE
from rbjax.joints.joint import Chain
from rbjax.joints.slide import SLIDE


class Cylindrical(Chain):
    """q = [shift along the axis, m; turn about it, rad]."""

    name = "cylindrical"

    def __init__(self) -> None:
        super().__init__((SLIDE, 2), (HINGE, 2))
