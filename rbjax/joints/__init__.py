"""Kinds of joints: one file each, with everything about it.

    hinge, slide, ball, free                  those of MuJoCo's files
    screw, cylindrical, planar, universal     the other lower pairs, and Cardan's
    node                                      any pose T(q) of k coordinates
"""

from rbjax.joints.hinge import HINGE, turning
from rbjax.joints.joint import Chain, Joint, LinkForm, LinkKind
from rbjax.joints.joint_motion import JointMotion, NodeMotion, PosedJoint
from rbjax.joints.node import Node
from rbjax.joints.registry import kind, kinds, register
from rbjax.joints.slide import SLIDE

__all__ = [
    "HINGE",
    "SLIDE",
    "Chain",
    "Joint",
    "JointMotion",
    "LinkForm",
    "LinkKind",
    "Node",
    "NodeMotion",
    "PosedJoint",
    "kind",
    "kinds",
    "register",
    "turning",
]
