"""Kinds of joints.

hinge, slide, ball, free                  the joints of MuJoCo's files
screw, cylindrical, planar, universal     the other lower pairs and the Cardan joint
node                                      a user-defined pose T(q) of k coordinates
flexible                                  a link with n coordinates that carries frames
"""

from rbjax.joints.flexible import (
    CoordinateMotion,
    Flexible,
    FrameKind,
    LinkInertia,
)
from rbjax.joints.frame_motion import FrameMotion, VirtualFrame
from rbjax.joints.joint import (
    DofKind,
    DofSpec,
    Joint,
    JointMotion,
    NodeMotion,
    PosedJoint,
)
from rbjax.joints.lower_pairs import HINGE, SLIDE, hinge_motion
from rbjax.joints.node import Node
from rbjax.joints.registry import kind, kinds, register

__all__ = [
    "HINGE",
    "SLIDE",
    "CoordinateMotion",
    "DofKind",
    "DofSpec",
    "Flexible",
    "FrameKind",
    "FrameMotion",
    "Joint",
    "JointMotion",
    "LinkInertia",
    "Node",
    "NodeMotion",
    "PosedJoint",
    "VirtualFrame",
    "hinge_motion",
    "kind",
    "kinds",
    "register",
]

__dir__ = __all__.copy
