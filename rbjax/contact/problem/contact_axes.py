"""The point and the axes of a contact, which map between twists and the velocities of its rows.

For the axes e_1 to e_3 of a contact at p about an origin, and the twist (w, v) of a link there, the
velocities of its rows are

    e_k . (v + w x p)  along axis k,    e_k . w  about axis k.

The rows of a contact with dim rows are along the axes, up to three, and then about them.

Source: Featherstone, *Rigid Body Dynamics Algorithms*, 2.2; MuJoCo, *Computation*, contacts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rbjax.lanes import Lane, Vec3
from rbjax.spatial import ArticulatedInertia, Force, Motion


class ContactAxes(NamedTuple):
    """The point and the axes of a contact, in the axes of a link or of the world.

    Fields:
        point: the contact, from the origin of the twists, m.
        axes: unit vectors: of dim 1 the normal, else also the two tangents.
        dim: the number of rows, 1, 3, 4 or 6.
    """

    point: Vec3
    axes: Sequence[Vec3]
    dim: int

    @staticmethod
    def size(dim: int) -> int:
        """Return the number of lanes of a contact with `dim` rows."""
        return 3 + 3 * min(dim, 3)

    @classmethod
    def from_lanes(cls, x: Sequence[Lane], dim: int) -> ContactAxes:
        """Return the point and the axes with these lanes (`lanes`)."""
        point, *axes = (Vec3(*x[i : i + 3]) for i in range(0, len(x), 3))
        return cls(point, axes, dim)

    @property
    def lanes(self) -> list[Lane]:
        """The point and the axes, `size` lanes."""
        return [x for vector in (self.point, *self.axes) for x in vector]

    def row(self, k: int) -> Motion:
        """Return the unit motion b_k of a row, whose velocity at a twist y is b_k . y."""
        if k < 3:
            return Motion(self.point.cross(self.axes[k]), self.axes[k])
        return Motion(self.axes[k - 3], Vec3.zero())

    def rates(self, y: Motion) -> list[Lane]:
        """Compute the velocity of each row at a twist y of the link."""
        at_point = y.lin + y.ang.cross(self.point)
        about = self.axes[: max(self.dim - 3, 0)]
        return [e.dot(at_point) for e in self.axes] + [e.dot(y.ang) for e in about]

    def wrench(self, f: Sequence[Lane]) -> Force:
        """Compute the wrench on the link of the forces f along the rows, the sum of b_k f_k."""
        force, torque = self._sum(f[:3]), self._sum(f[3:])
        return Force(self.point.cross(force) + torque, force)

    def stiffness(self, H: Sequence[Sequence[Lane]]) -> ArticulatedInertia:
        """Compute the 6 by 6 stiffness of the contact, the sum of b_k H_kl b_l^T over its rows.

        H: lower triangle of the Hessian in the rows.
        """
        out, n = ArticulatedInertia.zero(), range(self.dim)
        centred = self._replace(point=Vec3.zero())
        for k in n:
            b, h = centred.row(k), [H[max(k, j)][min(k, j)] for j in n]
            f = Force(self._sum(h[3:]), self._sum(h[:3]))
            out = out + ArticulatedInertia.outer(Force(b.ang, b.lin), f)
        return out.shifted(self.point)

    def _sum(self, f: Sequence[Lane]) -> Vec3:
        """Compute the sum of f_k e_k over the given f_k."""
        return sum((e * x for e, x in zip(self.axes, f, strict=False)), Vec3.zero())
