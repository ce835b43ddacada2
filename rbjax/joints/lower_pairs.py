"""The lower pairs, and the free and the universal joint (Featherstone, 4.4-4.5).

The z axis of the frame of each dof is the axis of the dof.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

from rbjax.joints.joint import DofKind, DofSpec, Joint, JointMotion, Placed, chain
from rbjax.lanes import Lane, Mat3, Vec3, mul, quaternion_matrix, rotation_z, sincos, sub
from rbjax.spatial import Motion

TURN = Motion(Vec3(0.0, 0.0, 1.0), Vec3.zero())
SHIFT = Motion(Vec3.zero(), Vec3(0.0, 0.0, 1.0))
_CYCLE = Mat3(0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0)  # z to x, x to y, y to z


def hinge_motion(c: Lane, s: Lane, qd: Lane) -> JointMotion:
    """Return the motion of a hinge from the cosine and sine of its angle and its speed.

    Args:
        c: cosine of the angle.
        s: sine of the angle.
        qd: speed, rad/s.

    Returns:
        A `JointMotion`.

    Example:
        >>> from rbjax.joints import hinge_motion
        >>> hinge_motion(1.0, 0.0, 2.0).qd
        2.0
    """
    return JointMotion(rotation_z(c, s), Vec3.zero(), TURN, Vec3(0.0, 0.0, qd), qd)


class HingeDof(DofKind):
    """Rotation about z by q."""

    angular = 1.0

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], dof: Placed) -> JointMotion:
        return hinge_motion(*sincos(sub(q[0], dof.reference)), v[0])


class SlideDof(DofKind):
    """Translation along z by q."""

    linear = 1.0

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], dof: Placed) -> JointMotion:
        at = Vec3(0.0, 0.0, sub(q[0], dof.reference))
        return JointMotion(Mat3.identity(), at, SHIFT, Vec3.zero(), v[0])


class ScrewDof(DofKind):
    """Rotation about z by q, with a translation along z of `params[0]` metres per radian."""

    shared_axis = False

    def axis(self, params: Sequence[Lane]) -> Motion:
        return Motion(Vec3(0.0, 0.0, 1.0), Vec3(0.0, 0.0, params[0]))

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], dof: Placed) -> JointMotion:
        angle = sub(q[0], dof.reference)
        at = Vec3(0.0, 0.0, mul(dof.params[0], angle))
        J, rate = rotation_z(*sincos(angle)), Vec3(0.0, 0.0, v[0])
        return JointMotion(J, at, self.axis(dof.params), rate, v[0])


class BallFirstDof(DofKind):
    """The first dof of a ball, with its whole rotation and velocity. The axis is x of the body."""

    angular = 1.0

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], dof: Placed) -> JointMotion:
        J = quaternion_matrix(*q) @ _CYCLE
        return JointMotion(J, Vec3.zero(), TURN, Vec3(v[1], v[2], v[0]), v[0])


class BallAxisDof(DofKind):
    """The second or third dof of a ball. It adds the axis y or z of the body but no motion."""

    angular, rigid_to_previous = 1.0, True

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], dof: Placed) -> JointMotion:
        return JointMotion(Mat3.identity(), Vec3.zero(), TURN, Vec3.zero(), v[0])


HINGE, SLIDE = HingeDof(), SlideDof()
_BALL_FIRST, _BALL_AXIS = BallFirstDof(), BallAxisDof()


def ball_dofs(q: int, v: int) -> tuple[DofSpec, ...]:
    """Return the dofs of an attitude whose coordinates start at index q of q and index v of v.

    The axes are fixed in the body. The bias acceleration of all three dofs is therefore w x S qd,
    with w the angular velocity of the body (Featherstone, 4.5).
    """
    node = range(v, v + 3)
    first = DofSpec(
        _BALL_FIRST, range(q, q + 4), node, 0, node=node, from_reference=False, turns_body=True
    )
    others = (
        DofSpec(_BALL_AXIS, range(0), range(v + k, v + k + 1), k, node=node, from_reference=False)
        for k in (1, 2)
    )
    return (first, *others)


class Hinge(Joint):
    """Hinge (revolute joint): rotation about the axis, q in rad."""

    name = "hinge"
    dofs = chain((HINGE, 2))


class Slide(Joint):
    """Slide (prismatic joint): translation along the axis, q in m."""

    name = "slide"
    dofs = chain((SLIDE, 2))


class Ball(Joint):
    """Ball (spherical joint): q is a unit quaternion (4,).
    v is the angular velocity (3,) in body axes, rad/s."""

    name = "ball"
    dofs, quaternion, aligned = ball_dofs(0, 0), True, False


class Free(Joint):
    """Free joint: three slides, then a ball.

    q: [position in the world, m; unit quaternion].
    v: [linear velocity in world axes, m/s; angular velocity in body axes, rad/s].
    """

    name = "free"
    dofs = (
        *(
            DofSpec(SLIDE, one, one, k, node=one, from_reference=False)
            for k, one in enumerate((range(1), range(1, 2), range(2, 3)))
        ),
        *ball_dofs(3, 3),
    )
    quaternion, aligned, on_world = True, False, True


class Screw(Joint):
    """Screw (helical joint): rotation about the axis, q in rad, with a translation along it.
    The parameter `pitch` is the translation per angle, m/rad."""

    name = "screw"
    params = MappingProxyType({"pitch": 0.0})
    dofs = chain((ScrewDof(), 2))


class Cylindrical(Joint):
    """Cylindrical joint: q = [translation along the axis, m; rotation about it, rad]."""

    name = "cylindrical"
    dofs = chain((SLIDE, 2), (HINGE, 2))


class Planar(Joint):
    """Planar joint: q = [x, y, m; rotation about the normal, rad]. The axis is the normal.

    The directions of x and y are the body's x and y axes after the shortest rotation that maps z to
    the normal. If the normal is z, they are the body's own axes. If it is -z, the rotation is a
    half turn about x.
    """

    name = "planar"
    shortest_turn = True
    dofs = chain((SLIDE, 0), (SLIDE, 1), (HINGE, 2))


class Universal(Joint):
    """Universal joint (Cardan, Hooke): q = [rotation about the axis, about the second axis], rad.

    The parameter `second_axis` (3,) is in the body's frame, like the axis, and rotates about the
    axis. Any angle between the two axes is allowed.
    """

    name = "universal"
    params = MappingProxyType({"second_axis": (0.0, 1.0, 0.0)})
    dofs = (
        DofSpec(HINGE, range(1), range(1)),
        DofSpec(HINGE, range(1, 2), range(1, 2), own_axis=0, node=range(1, 2)),
    )
