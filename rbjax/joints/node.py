"""Node: a joint with any pose T(q) of k coordinates, and axes S(q) that depend on q.

    twist = S(q) qd,   bias = S'(q, qd) qd,   S_i = [vee(R^T dR/dq_i); R^T dr/dq_i]

in the body's axes. Only `pose` is required: by default JAX differentiates it for the axes and their
rates. Use nodes for joints on curves and surfaces, rolling contacts, linkages in closed form, and
frames on flexible bodies.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from rbjax.joints.joint import (
    DofKind,
    DofSpec,
    Joint,
    JointMotion,
    NodeMotion,
    Placed,
)
from rbjax.lanes import Lane, Mat3, Vec3, as_arrays, is_zero
from rbjax.spatial import Motion, Transform


class Node(Joint):
    """A joint of k coordinates. Subclasses define `name`, `coordinates` and `pose`.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.lanes import Mat3, Vec3
        >>> from rbjax.spatial import Transform
        >>> class OnParabola(rb.joints.Node):
        ...     name, coordinates = "on_parabola", 1
        ...     def pose(self, q, params):
        ...         return Transform(Mat3.identity(), Vec3(q[0], 0.0, q[0] * q[0]))
        >>> rb.joints.register(OnParabola())
        >>> model = rb.load("pendulum").with_joint("hinge", "on_parabola")
        >>> rb.mass_matrix(model, jnp.array([0.5])).shape
        (1, 1)
    """

    coordinates: int

    def __init__(self) -> None:
        every = range(self.coordinates)
        self.dofs = tuple(
            DofSpec(NodeDof(self, k), every, every, node=every, from_reference=False) for k in every
        )

    def pose(self, q: Sequence[Lane], params: Sequence[Lane]) -> Transform:
        """Return the pose of the body's frame in the joint's frame, both at the anchor."""
        raise NotImplementedError(f"{type(self).__name__} needs a pose(q, params)")

    def axis(self, q: Sequence[Lane], params: Sequence[Lane], k: int) -> Motion:
        """Return the axis S_k of dof k in the body's axes."""
        qs = _arrays(q)

        def lanes(*q: Lane) -> list[jax.Array]:
            T = self.pose(q, params)
            return as_arrays([*T.R, *T.p], qs[0])

        unit = [jnp.ones_like(x) if i == k else jnp.zeros_like(x) for i, x in enumerate(qs)]
        value, rate = jax.jvp(lanes, tuple(qs), tuple(unit))
        E, dR = Mat3(*value[:9]).T, Mat3(*rate[:9])
        W = E @ dR
        return Motion(Vec3(W[7], W[2], W[3]), E @ Vec3(*rate[9:]))

    def axis_rate(
        self, q: Sequence[Lane], v: Sequence[Lane], params: Sequence[Lane], k: int
    ) -> Motion:
        """Return the time derivative of the axis S_k in the body's axes."""
        qs = _arrays(q)

        def lanes(*q: Lane) -> list[jax.Array]:
            return as_arrays([*self.axis(q, params, k)], qs[0])

        vs = [jnp.broadcast_to(jnp.asarray(x, qs[0].dtype), qs[0].shape) for x in v]
        return Motion.from_lanes(jax.jvp(lanes, tuple(qs), tuple(vs))[1])


class NodeDof(DofKind):
    """Dof k of a node. Dof 0 has the whole motion, and all further dofs only their axes."""

    constant_axis = False

    def __init__(self, joint: Node, k: int):
        self.joint, self.k = joint, k

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], dof: Placed) -> JointMotion:
        joint, params, zero = self.joint, dof.params, Motion.zero()
        moves = not all(map(is_zero, v))

        def own(k: int) -> tuple[Motion, Motion]:
            rate = joint.axis_rate(q, v, params, k) if moves else zero
            return joint.axis(q, params, k), rate

        if self.k > 0:
            axis, rate = own(self.k)
            one, none = Mat3.identity(), Vec3.zero()
            return NodeMotion(one, none, axis, none, v[self.k], none, zero, rate)
        at, twist, bias = joint.pose(q, params), zero, zero
        every = [own(k) for k in range(joint.coordinates)]
        for (axis, rate), speed in zip(every, v, strict=True):
            twist, bias = twist + axis * speed, bias + rate * speed
        # add omega x v: the bias is relative to the parent, whose axes do not rotate with the body
        bias = Motion(bias.ang, bias.lin + twist.ang.cross(twist.lin))
        axis, rate = every[0]
        return NodeMotion(at.R, at.p, axis, twist.ang, v[0], twist.lin, bias, rate)


def _arrays(q: Sequence[Lane]) -> list[jax.Array]:
    like = next((x for x in q if hasattr(x, "dtype")), jnp.zeros(()))
    return [jnp.broadcast_to(jnp.asarray(x, like.dtype), jnp.shape(like)) for x in q]
