"""Universal joint (Cardan, Hooke): a turn about the axis, then one about a second axis."""

from types import MappingProxyType

from rbjax.joints.hinge import HINGE
from rbjax.joints.joint import Joint, LinkForm


class Universal(Joint):
    """q = [turn about the axis, turn about the second axis], rad.

    `second_axis` (3,) is in the body's frame, like the axis, and turns with the first. The
    two usually stand at right angles; other angles are allowed.
    """

    name = "universal"
    numbers = MappingProxyType({"second_axis": (0.0, 1.0, 0.0)})
    nq = 2
    links = (
        LinkForm(HINGE, range(1), range(1)),
        LinkForm(HINGE, range(1, 2), range(1, 2), own_axis=0, node=range(1, 2)),
    )
