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

from rbjax.errors import InputError
from rbjax.joints.joint import (
    DofKind,
    DofSpec,
    Joint,
    JointMotion,
    ModalMotion,
    NodeMotion,
    Placed,
)
from rbjax.joints.modal import ModalInertia
from rbjax.lanes import Lane, Mat3, Vec3, as_arrays, is_literal, is_zero
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

    def inertia(self, q: Sequence[Lane], params: Sequence[Lane]) -> ModalInertia | None:
        """Return the inertia of a flexible link, in the joint's frame at the anchor.

        Override it for a link whose mass moves with the coordinate, such as a beam in an assumed
        mode. It is in addition to the inertia of the body. The joint must have one coordinate.
        """
        return None


class NodeDof(DofKind):
    """Dof k of a node. Dof 0 has the whole motion, and all further dofs only their axes."""

    constant_axis = False

    def __init__(self, joint: Node, k: int):
        self.joint, self.k = joint, k
        self.modal = k == 0 and type(joint).inertia is not Node.inertia

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
        lanes = at.R, at.p, axis, twist.ang, v[0], twist.lin, bias, rate
        return ModalMotion(*lanes, *_modal(joint, q, params)) if self.modal else NodeMotion(*lanes)


def _modal(
    joint: Node, q: Sequence[Lane], params: Sequence[Lane]
) -> tuple[ModalInertia, ModalInertia]:
    """Compute the modal inertia in the body's frame, and its derivative by the coordinate."""
    qs, shape = _arrays(q), {}

    def lanes(*q: Lane) -> list[jax.Array]:
        given = joint.inertia(q, params)
        assert given is not None  # `register` checks it
        moved = given.at_frame(joint.pose(q, params), joint.axis(q, params, 0))
        shape["leaves"], shape["tree"] = jax.tree.flatten(moved)
        return as_arrays([x for x in shape["leaves"] if not is_literal(x)], qs[0])

    found = jax.jvp(lanes, tuple(qs), tuple(jnp.ones_like(x) for x in qs))

    def with_literals(arrays: Sequence[jax.Array], keep: float) -> ModalInertia:
        rest = iter(arrays)
        out = [x * keep if is_literal(x) else next(rest) for x in shape["leaves"]]
        return jax.tree.unflatten(shape["tree"], out)

    return with_literals(found[0], 1.0), with_literals(found[1], 0.0)


def check_modal(joint: Node) -> None:
    """Check the modal inertia of a kind, if it has one, at two values of its coordinate."""
    if type(joint).inertia is Node.inertia:
        return
    name = type(joint).__name__
    if joint.coordinates != 1:
        raise InputError(
            f"register: {name} has a modal inertia and {joint.coordinates} coordinates, expected "
            "1; give each mode a link of its own, in series"
        )
    for q in (0.0, 0.3):

        def moments(q: jax.Array) -> list[jax.Array]:
            found = joint.inertia([q], joint.defaults)
            if not isinstance(found, ModalInertia):
                raise InputError(
                    f"register: {name}.inertia returned {type(found).__name__}, expected "
                    "rbjax.joints.ModalInertia(rigid, coupling, mass)"
                )
            return as_arrays([*found.rigid.h, *found.coupling.lin, found.rigid.m], q)

        value, rate = jax.jvp(moments, (jnp.asarray(q),), (jnp.asarray(1.0),))
        h_rate, lin = jnp.stack(rate[:3]), jnp.stack(value[3:6])
        scale = jnp.abs(jnp.stack([*value, *rate])).max() * 1e4 * jnp.finfo(lin.dtype).eps
        if not bool((jnp.abs(h_rate - lin) <= scale).all()) or bool(rate[6] != 0):
            raise InputError(
                f"register: {name}.inertia at q = {q}: the linear part of the coupling is "
                f"{[round(float(x), 6) for x in lin]}, and the mass has the derivative "
                f"{float(rate[6]):.3g}, expected a constant mass and the derivative of the first "
                f"moment, {[round(float(x), 6) for x in h_rate]}"
            )


def _arrays(q: Sequence[Lane]) -> list[jax.Array]:
    like = next((x for x in q if hasattr(x, "dtype")), jnp.zeros(()))
    return [jnp.broadcast_to(jnp.asarray(x, like.dtype), jnp.shape(like)) for x in q]
