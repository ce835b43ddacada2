"""Kinds of joints.

hinge, slide, ball, free                  the joints of MuJoCo's files
screw, cylindrical, planar, universal     the other lower pairs and the Cardan joint
node                                      a user-defined pose T(q) of k coordinates
"""

from rbjax.joints.joint import (
    DofKind,
    DofSpec,
    Joint,
    JointMotion,
    ModalMotion,
    NodeMotion,
    PosedJoint,
)
from rbjax.joints.lower_pairs import HINGE, SLIDE, hinge_motion
from rbjax.joints.modal import ModalInertia
from rbjax.joints.node import Node
from rbjax.joints.registry import kind, kinds, register

__all__ = [
    "HINGE",
    "SLIDE",
    "DofKind",
    "DofSpec",
    "Joint",
    "JointMotion",
    "ModalInertia",
    "ModalMotion",
    "Node",
    "NodeMotion",
    "PosedJoint",
    "hinge_motion",
    "kind",
    "kinds",
    "register",
]
