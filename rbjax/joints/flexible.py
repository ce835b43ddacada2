"""Flexible links: links with n coordinates of their own, and the frames that they carry.

A flexible link has a base frame, which is fixed to the parent of its joint, and frames at which
children, sites and forces act. Relative to the base frame, frame k has

    pose T_k(q),   twist S_k(q) q',   acceleration S_k q'' + bias_k,   S_k = [S_k1 ... S_kn]

The kinetic energy of a link is a function of the twist V of its base and of q':

    T = sum_k (X_k V + S_k q').I_k (X_k V + S_k q') / 2 + V.I V / 2 + V.C q' + q'.m q' / 2

The first term are rigid inertias I_k at frames, such as the sections of a beam. The others are the
`LinkInertia` of a body whose deformation is a sum of modes (Jain & Rodriguez, JGCD 15(6), 1992).
In the tree a flexible link is a chain of n dofs at the base frame, each with S = 0. The frames are
children of the last dof, and have no velocity coordinate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.joints.frame_motion import FrameMotion, VirtualFrame
from rbjax.joints.joint import Block, DofKind, DofSpec, Joint, JointMotion, Placed
from rbjax.lanes import Lane, Mat3, Vec3, add, as_arrays, inner, is_zero
from rbjax.spatial import Force, Motion, RigidInertia, Transform


class LinkInertia(NamedTuple):
    """The inertia of a flexible link over the twist of its base and its coordinates.

    Fields:
        rigid: inertia I of the deformed link about its base frame.
        coupling: C, the momentum [angular; linear] for a unit rate of each coordinate.
        mass: m, rows of the modal mass matrix (n, n).
        force: inertial force on the base that depends on velocities, in base axes, without
            [w x J w; w x (w x h)] of `rigid` (on the left side of I a + C q'' + force = f).
        forces: inertial generalized forces that depend on velocities, one for each coordinate.
    """

    rigid: RigidInertia
    coupling: tuple[Force, ...]
    mass: tuple[tuple[Lane, ...], ...]
    force: Force
    forces: tuple[Lane, ...]

    def bias_force(self, w: Vec3) -> Force:
        """Compute the wrench on the base of velocities. w is the angular velocity of the base."""
        return self.rigid.bias_force(w) + self.force

    def momentum(self, V: Motion, rates: Block) -> tuple[Force, Block]:
        """Compute I V + C q' and C.V + m q' from the twist V of the base and the rates q'."""
        f = self.rigid(V)
        for C, rate in zip(self.coupling, rates, strict=True):
            f = f + C * rate
        rows = zip(self.mass, self.coupling, strict=True)
        return f, tuple(add(inner(row, rates), C.dot(V)) for row, C in rows)

    def twice_kinetic_energy(self, V: Motion, rates: Block) -> Lane:
        """Compute V.I V + 2 V.C q' + q'.m q'."""
        f, p = self.momentum(V, rates)
        return add(V.dot(f), inner(p, rates))

    def inertial_forces(self, w: Vec3, a: Motion, rates: Block) -> tuple[Force, Block]:
        """Compute the wrench on the base and the generalized forces of an acceleration.

        a: classical acceleration of the base. rates: accelerations of the coordinates.
        """
        f, forces = self.momentum(a, rates)
        return f + self.bias_force(w), tuple(map(add, forces, self.forces))


class Flexible(Joint):
    """A flexible link of n coordinates. Subclasses define `name`, `coordinates`, `count`, `poses`.

    Only the poses of the frames are required, and inertias that move with the frames or an inertia
    of the whole link. By default JAX differentiates the poses for axes and rates. Override `frames`
    for closed forms.

    Class or instance attributes:
        coordinates: n.
        count: the number of frames.
        body_frame: the index of the frame that carries the body of the joint, the last by default.

    The base frame is at the joint's anchor, with the axes of the body at zero displacement in the
    parent; the joint's axis is not used. The body of the joint moves with the frame `body_frame`.
    Other bodies can be fixed to the other frames.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.lanes import Mat3, Sym3, Vec3
        >>> from rbjax.spatial import RigidInertia, Transform
        >>> class Stretching(rb.joints.Flexible):  # a spring with a mass at its middle
        ...     name, coordinates, count = "stretching", 1, 2
        ...     def poses(self, q, params):
        ...         at = (0.5 * (1.0 + q[0]), 1.0 + q[0])
        ...         return [Transform(Mat3.identity(), Vec3(x, 0.0, 0.0)) for x in at]
        ...     def inertias(self, params):
        ...         return [RigidInertia(2.0, Vec3.zero(), Sym3.zero()), RigidInertia.zero()]
        >>> rb.joints.register(Stretching())
        >>> model = rb.load("<mujoco/>").with_link("spring", rb.joints.kind("stretching"))
        >>> rb.mass_matrix(model, jnp.zeros(1)).tolist()
        [[0.5]]
    """

    aligned = False
    coordinates: int
    count: int

    @property
    def body_frame(self) -> int:
        return self.count - 1

    def __init__(self) -> None:
        every = range(self.coordinates)
        self.dofs = tuple(
            DofSpec(CoordinateDof(self, k), every, every, node=every, from_reference=False)
            for k in every
        )
        none = range(0)
        self.frame_specs = tuple(
            DofSpec(FrameKind(self), none, none, from_reference=False) for _ in range(self.count)
        )

    def invalid(self, q: np.ndarray, params: np.ndarray) -> str | None:
        """Return why the link cannot have the coordinates q (..., n), as a clause, or None."""
        return None

    def frames(
        self, q: Sequence[Lane], v: Sequence[Lane], params: Sequence[Lane]
    ) -> list[FrameMotion]:
        """Compute the motion of each frame, relative to the base frame.

        v is structurally zero (all literals) if the velocities are not needed.
        """
        return differentiated_frames(self, q, v, params)

    def virtual_frames(
        self,
        q: Sequence[Lane],
        v: Sequence[Lane],
        a: Sequence[Lane],
        rates: Sequence[Lane],
        params: Sequence[Lane],
    ) -> list[VirtualFrame]:
        """Compute the motion of each frame along accelerations a and virtual rates.

        Override it if this needs fewer operations than the axes of the frames.
        """
        return [VirtualFrame.along(x, a, rates) for x in self.frames(q, v, params)]

    def poses(self, q: Sequence[Lane], params: Sequence[Lane]) -> Sequence[Transform]:
        """Return the pose of each frame in the base frame."""
        raise NotImplementedError(f"{type(self).__name__} needs poses(q, params)")

    def inertias(self, params: Sequence[Lane]) -> Sequence[RigidInertia]:
        """Return the rigid inertia that moves with each frame, in its axes, about its origin."""
        return [RigidInertia.zero()] * self.count

    def inertia(
        self, q: Sequence[Lane], v: Sequence[Lane], w: Vec3, params: Sequence[Lane]
    ) -> LinkInertia | None:
        """Compute the inertia over base and coordinates, in addition to the inertias of frames.

        w is the angular velocity of the base frame in its own axes.
        """
        return None


def differentiated_frames(
    link: Flexible, q: Sequence[Lane], v: Sequence[Lane], params: Sequence[Lane]
) -> list[FrameMotion]:
    """Compute `Flexible.frames` from the poses, with derivatives by JAX.

    S_j = [vee(R^T dR/dq_j); R^T dr/dq_j]. The bias is S' q' + [0; w x v]. The second term converts
    the derivative of components in axes that rotate to the classical acceleration.
    """
    like = next((x for x in q if hasattr(x, "dtype")), jnp.zeros(()))
    qs, vs = as_arrays(list(q), like), as_arrays(list(v), like)

    def lanes(*q: Lane) -> list[list[jax.Array]]:
        return [as_arrays([*T.R, *T.p], like) for T in link.poses(q, params)]

    def along(q: Sequence[jax.Array], rates: Sequence[jax.Array]) -> list[Motion]:
        values, changes = jax.jvp(lanes, tuple(q), tuple(rates))
        out = []
        for value, change in zip(values, changes, strict=True):
            E = Mat3(*value[:9]).T
            W = E @ Mat3(*change[:9])
            out.append(Motion(Vec3(W[7], W[2], W[3]), E @ Vec3(*change[9:])))
        return out

    units = [[jnp.ones_like(x) if i == j else jnp.zeros_like(x) for i, x in enumerate(qs)]
             for j in range(len(qs))]  # fmt: skip
    columns = [along(qs, unit) for unit in units]
    twists = biases = [Motion.zero()] * link.count
    if not all(map(is_zero, v)):
        twists, rates = jax.jvp(lambda *q: along(q, vs), tuple(qs), tuple(vs))
        biases = [
            Motion(a.ang, a.lin + V.ang.cross(V.lin)) for V, a in zip(twists, rates, strict=True)
        ]
    rest = zip(zip(*columns, strict=True), twists, biases, link.inertias(params), strict=True)
    return [FrameMotion.at_pose(T, *x) for T, x in zip(link.poses(q, params), rest, strict=True)]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CoordinateMotion(JointMotion):
    """The motion of the base frame along coordinate k of a flexible link, which is zero.

    Fields:
        joint: the flexible link.
        k: the index of the coordinate.
        q, v: all coordinates of the link and their rates.
        params: the parameters of the link.
    """

    joint: Flexible = field(metadata={"static": True})
    k: int = field(metadata={"static": True})
    q: tuple[Lane, ...]
    v: tuple[Lane, ...]
    params: tuple[Lane, ...]

    @property
    def coordinate_of(self) -> Flexible:
        return self.joint

    def own_momentum(self, V: Motion) -> tuple[RigidInertia, Force]:
        own = self.link_inertia(Vec3.zero())
        if own is None:
            return RigidInertia.zero(), Force.zero()
        return own.rigid, own.momentum(V, self.v)[0]

    def accelerate(self, qdd: Lane, block: Block) -> tuple[Motion, Block]:
        return Motion.zero(), (*block, qdd)

    def project(self, f: Force, block: Block) -> tuple[Lane, Block]:
        *rest, own = block or (0.0,) * (self.k + 1)
        return own, tuple(rest)

    def link_inertia(self, w: Vec3) -> LinkInertia | None:
        """Return the inertia of the link at its last coordinate, and None at the others."""
        last = self.k == self.joint.coordinates - 1
        return self.joint.inertia(self.q, self.v, w, self.params) if last else None


class CoordinateDof(DofKind):
    """Coordinate k of a flexible link. It does not move the base frame."""

    def __init__(self, joint: Flexible, k: int):
        self.joint, self.k = joint, k

    def axis(self, params: Sequence[Lane]) -> Motion:
        return Motion.zero()

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], dof: Placed) -> JointMotion:
        none, params = Vec3.zero(), tuple(dof.params[: len(self.joint.defaults)])
        at = Mat3.identity(), none, Motion.zero(), none, v[self.k]
        return CoordinateMotion(*at, self.joint, self.k, tuple(q), tuple(v), params)


class FrameKind(DofKind):
    """A frame of a flexible link, without a coordinate. `Flexible.frames` computes its motion."""

    constant_axis = False

    def __init__(self, joint: Flexible):
        self.joint = joint

    def motions(
        self, q: Sequence[Lane], v: Sequence[Lane], dof: Placed, *along: Sequence[Lane]
    ) -> Sequence[FrameMotion]:
        """Compute the motions of all frames of the link, from its coordinates and their rates.

        along: nothing, or accelerations and virtual rates for `virtual_frames`.
        """
        params = dof.params[: len(self.joint.defaults)]
        if along:
            a, rates = along
            return self.joint.virtual_frames(q, v, a, rates, params)
        return self.joint.frames(q, v, params)

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], dof: Placed) -> JointMotion:
        raise NotImplementedError("Flexible.frames computes the motions of all frames of a link")
