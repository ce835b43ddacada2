"""Ball (spherical joint): a unit quaternion, with the angular velocity in body axes.

Three links in one place, whose axes are x, y, z of the body. The first carries the whole rotation
and the whole angular velocity; the other two stand still against it and only bring their axis. For
all three the joint's share of the bias acceleration is w x S qd with w the final angular velocity,
because the axes are fixed in the body (Featherstone, 4.5).
"""

from __future__ import annotations

from collections.abc import Sequence

from rbjax.joints.hinge import S
from rbjax.joints.joint import Joint, LinkForm, LinkKind
from rbjax.joints.joint_motion import JointMotion, Placed
from rbjax.lanes import Lane, Mat3, Vec3, quaternion_matrix

_CYCLE = Mat3(0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0)  # z to x, x to y, y to z


class FirstOfBall(LinkKind):
    """Carries the rotation; its axis is x of the body."""

    turns = 1.0

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], link: Placed) -> JointMotion:
        J = quaternion_matrix(*q) @ _CYCLE
        return JointMotion(J, Vec3.zero(), S, Vec3(v[1], v[2], v[0]), v[0])


class AxisOfBall(LinkKind):
    """Brings its axis, y or z of the body."""

    turns, still = 1.0, True

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], link: Placed) -> JointMotion:
        return JointMotion(Mat3.identity(), Vec3.zero(), S, Vec3.zero(), v[0])


_FIRST, _AXIS = FirstOfBall(), AxisOfBall()


def ball_links(q: int, v: int) -> tuple[LinkForm, ...]:
    """The links of an attitude whose coordinates start at q and v."""
    node, none = range(v, v + 3), range(0)
    first = LinkForm(_FIRST, range(q, q + 4), node, 0, None, node, False, True)
    others = (
        LinkForm(_AXIS, none, range(v + k, v + k + 1), k, None, node, False) for k in (1, 2)
    )
    return (first, *others)


class Ball(Joint):
    """q is a unit quaternion (4,), v the angular velocity (3,) in body axes, rad/s."""

    name = "ball"
    links, nq, quaternion, aligned = ball_links(0, 0), 4, True, False
