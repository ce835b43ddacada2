"""Plücker transforms (Featherstone, 2.8).

`Transform(R, p)` is the pose of a child frame C in its parent frame P: R = R_PC maps C-coordinates
to P-coordinates, p is C's origin in P. The operator X = X_CP maps motions from parent to child
coordinates, outward along a tree. Its transpose maps forces inward.
"""

from __future__ import annotations

import jax

from rbjax.lanes import Mat3, Vec3
from rbjax.spatial.inertia import ArticulatedInertia, RigidInertia
from rbjax.spatial.vectors import Force, Motion


@jax.tree_util.register_pytree_node_class
class Transform:
    """X_CP of a child frame with pose (R, p) in its parent."""

    __slots__ = ("R", "p")

    def __init__(self, R: Mat3, p: Vec3):
        self.R, self.p = R, p

    @property
    def E(self) -> Mat3:
        """R^T, which maps parent coordinates to child coordinates."""
        return self.R.T

    def tree_flatten(self):
        return (self.R, self.p), None

    @classmethod
    def tree_unflatten(cls, _, children):
        return cls(*children)

    def __call__(self, m: Motion) -> Motion:
        """The motion in child coordinates: [E w; E (v + w x p)]."""
        return Motion(self.E @ m.ang, self.E @ (m.lin + m.ang.cross(self.p)))

    def T(self, f: Force) -> Force:
        """The child's force in parent coordinates: [R n + p x R f; R f]."""
        lin = self.R @ f.lin
        return Force(self.R @ f.ang + self.p.cross(lin), lin)

    def motion_to_parent(self, m: Motion) -> Motion:
        """The child's motion in parent coordinates: [R w; R v + p x R w]."""
        ang = self.R @ m.ang
        return Motion(ang, self.R @ m.lin + self.p.cross(ang))

    def rigid_to_parent(self, inertia: RigidInertia) -> RigidInertia:
        """X^T I X of a rigid body."""
        return inertia.rotated(self.R).shifted(self.p)

    def articulated_to_parent(self, inertia: ArticulatedInertia) -> ArticulatedInertia:
        """X^T I_A X of an articulated body."""
        return inertia.rotated(self.R).shifted(self.p)

    def then(self, child: Transform) -> Transform:
        """The pose of the child's child in this transform's parent."""
        return Transform(self.R @ child.R, self.p + self.R @ child.p)
