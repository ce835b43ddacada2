"""Spatial inertia of a rigid body and of an articulated body (Featherstone, 2.13 and 7.1).

Rigid:        I = [J, [h]; [h]^T, m 1] with h = m c and J about the frame's origin: 10 numbers.
Articulated:  I = [J, H; H^T, M] with J and M symmetric and H general: 21 numbers.
"""

from __future__ import annotations

import jax

from rbjax.lanes import Lane, Mat3, Sym3, Vec3, add, is_literal, is_zero, mul, neg
from rbjax.spatial.vectors import Force, Motion


@jax.tree_util.register_pytree_node_class
class RigidInertia:
    """Mass m, first moment h = m c, rotational inertia J about the frame's origin."""

    __slots__ = ("J", "h", "m")

    def __init__(self, m: Lane, h: Vec3, J: Sym3):
        self.m, self.h, self.J = m, h, J

    def tree_flatten(self):
        return (self.m, self.h, self.J), None

    @classmethod
    def tree_unflatten(cls, _, children):
        return cls(*children)

    @property
    def massless(self) -> bool:
        """Whether all ten numbers are structural zeros."""
        return all(is_zero(x) for x in (self.m, *self.h, *self.J))

    def __add__(self, other: RigidInertia) -> RigidInertia:
        return RigidInertia(add(self.m, other.m), self.h + other.h, self.J + other.J)

    def __call__(self, v: Motion) -> Force:
        """I v: momentum from velocity, or force from acceleration."""
        return Force(self.J @ v.ang + self.h.cross(v.lin), v.lin * self.m - self.h.cross(v.ang))

    def rotated(self, R: Mat3) -> RigidInertia:
        """The same inertia in axes rotated by R."""
        return RigidInertia(self.m, R @ self.h, self.J.rotated(R))

    def shifted(self, p: Vec3) -> RigidInertia:
        """About an origin at -p (Steiner): h' = h + m p, J' = J - [p][h] - [h][p] - m [p][p]."""
        g = self.h + p * self.m
        (px, py, pz), (_, hy, hz), (gx, gy, _) = p, self.h, g
        xx, yy, zz = (mul(a, b) for a, b in zip(p, self.h + g, strict=True))
        steiner = Sym3(
            add(yy, zz), add(xx, zz), add(xx, yy),
            neg(add(mul(px, hy), mul(gx, py))),
            neg(add(mul(px, hz), mul(gx, pz))),
            neg(add(mul(py, hz), mul(gy, pz))),
        )  # fmt: skip
        return RigidInertia(self.m, g, self.J + steiner)

    def articulated(self) -> ArticulatedInertia:
        """The same inertia with 21 numbers."""
        return ArticulatedInertia(
            self.J, Mat3.skew(self.h), Sym3(self.m, self.m, self.m, 0.0, 0.0, 0.0)
        )


@jax.tree_util.register_pytree_node_class
class ArticulatedInertia:
    """J (symmetric), H (general), M (symmetric): force of an articulated body per acceleration."""

    __slots__ = ("H", "J", "M")

    def __init__(self, J: Sym3, H: Mat3, M: Sym3):
        self.J, self.H, self.M = J, H, M

    def tree_flatten(self):
        return (self.J, self.H, self.M), None

    @classmethod
    def tree_unflatten(cls, _, children):
        return cls(*children)

    @classmethod
    def zero(cls) -> ArticulatedInertia:
        return cls(Sym3.zero(), Mat3.zero(), Sym3.zero())

    @classmethod
    def outer(cls, U: Force, V: Force) -> ArticulatedInertia:
        """U V^T, a term of a symmetric sum."""
        H = Mat3(*(mul(a, b) for a in U.ang for b in V.lin))
        return cls(Sym3.outer(U.ang, V.ang), H, Sym3.outer(U.lin, V.lin))

    def __add__(self, other: ArticulatedInertia) -> ArticulatedInertia:
        return ArticulatedInertia(self.J + other.J, self.H + other.H, self.M + other.M)

    def __call__(self, a: Motion) -> Force:
        """I_A a."""
        return Force(self.J @ a.ang + self.H @ a.lin, self.H.T @ a.ang + self.M @ a.lin)

    def rotated(self, R: Mat3) -> ArticulatedInertia:
        """The same inertia in axes rotated by R."""
        return ArticulatedInertia(self.J.rotated(R), R @ self.H @ R.T, self.M.rotated(R))

    def shifted(self, p: Vec3) -> ArticulatedInertia:
        """About an origin at -p: H' = H + [p] M, J' = J + [p] H'^T - H [p]."""
        P = Mat3.skew(p)
        H = self.H + P @ self.M
        J = self.J + _symmetric_product(P, H.T) - _symmetric_product(self.H, P)
        return ArticulatedInertia(J, H, self.M)

    def less(self, U: Force, inverse_D: Lane) -> ArticulatedInertia:
        """I - U U^T / D."""
        return self - ArticulatedInertia.outer(U * inverse_D, U)

    def without(self, U: Force, inverse_D: Lane, S: Motion, armature: Lane) -> ArticulatedInertia:
        """I_A - U U^T / D: the remaining inertia across a joint that moves freely along S.

        Along S only the armature's share remains. It is exactly zero if the armature is a
        structural zero and S is an axis. A literal zero here avoids the arithmetic and its
        rounding.
        """
        left, along = self.less(U, inverse_D), list(S)
        axis = all(map(is_literal, along)) and sorted(along) == [0.0] * 5 + [1.0]
        return left._with_zero_row(along.index(1.0)) if axis and is_zero(armature) else left

    def __sub__(self, other: ArticulatedInertia) -> ArticulatedInertia:
        return ArticulatedInertia(self.J - other.J, self.H - other.H, self.M - other.M)

    def _with_zero_row(self, k: int) -> ArticulatedInertia:
        """The same, with structural zeros in row and column k of the 6 by 6 matrix."""
        pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        J, H, M = list(self.J), list(self.H), list(self.M)
        block, axis = (J, k) if k < 3 else (M, k - 3)
        for n, pair in enumerate(pairs):
            if axis in pair:
                block[n] = 0.0
        for n in range(3):
            H[3 * axis + n if k < 3 else 3 * n + axis] = 0.0
        return ArticulatedInertia(Sym3(*J), Mat3(*H), Sym3(*M))


def _symmetric_product(A: Mat3, B: Mat3) -> Sym3:
    """The upper triangle of A B."""
    r, c = A.rows, B.columns
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    return Sym3(*(r[i].dot(c[j]) for i, j in pairs))
