"""Motions, forces, Plücker transforms and inertias on lanes (Featherstone, 2 and 7.1).

A motion [omega; v] and a force [n; f], angular part first, are dual: their product is a power. Both
refer to the origin of the frame in which they are expressed. `Transform(R, p)` is the pose of a
child frame C in its parent P. R = R_PC maps C-coordinates to P-coordinates, and p is the origin of
C in P.

    rigid         I = [J, [h]; [h]^T, m 1],  h = m c, J about the frame's origin: 10 numbers
    articulated   I = [J, H; H^T, M],  J and M symmetric, H general: 21 numbers
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax

from rbjax.lanes import Lane, Mat3, Sym3, Vec3, add, is_literal, is_zero, mul, neg


class _Pair:
    """A pair of an angular and a linear Vec3."""

    __slots__ = ("ang", "lin")

    def __init__(self, ang: Vec3, lin: Vec3):
        self.ang, self.lin = ang, lin

    def __init_subclass__(cls) -> None:
        jax.tree_util.register_pytree_node(
            cls, lambda m: ((m.ang, m.lin), None), lambda _, c: cls(*c)
        )

    @classmethod
    def zero(cls):
        return cls(Vec3.zero(), Vec3.zero())

    @classmethod
    def from_lanes(cls, lanes):
        """Make a pair from six lanes, angular part first."""
        x = tuple(lanes)
        return cls(Vec3(*x[:3]), Vec3(*x[3:]))

    def __iter__(self):
        yield from self.ang
        yield from self.lin

    def __add__(self, other):
        return type(self)(self.ang + other.ang, self.lin + other.lin)

    def __sub__(self, other):
        return type(self)(self.ang - other.ang, self.lin - other.lin)

    def __neg__(self):
        return type(self)(-self.ang, -self.lin)

    def __mul__(self, scalar: Lane):
        return type(self)(self.ang * scalar, self.lin * scalar)

    __rmul__ = __mul__

    def dot(self, other: _Pair) -> Lane:
        """Compute the scalar product of a motion and a force."""
        return add(self.ang.dot(other.ang), self.lin.dot(other.lin))

    def __repr__(self) -> str:
        return f"{type(self).__name__}(ang={self.ang}, lin={self.lin})"


class Motion(_Pair):
    """A twist or a spatial acceleration [omega; v]."""

    __slots__ = ()

    def cross(self, other: Motion) -> Motion:
        """Compute v x m, the rate of a motion m that is fixed in a frame with twist v."""
        return Motion(
            self.ang.cross(other.ang), self.ang.cross(other.lin) + self.lin.cross(other.ang)
        )

    def cross_force(self, f: Force) -> Force:
        """Compute v x* f, the rate of a force f that is fixed in a frame with twist v."""
        return Force(self.ang.cross(f.ang) + self.lin.cross(f.lin), self.ang.cross(f.lin))


class Force(_Pair):
    """A wrench or a spatial momentum [n; f]."""

    __slots__ = ()


@jax.tree_util.register_dataclass
@dataclass(eq=False, slots=True)
class RigidInertia:
    """Mass m, first moment h = m c, rotational inertia J about the frame's origin."""

    m: Lane
    h: Vec3
    J: Sym3

    @classmethod
    def zero(cls) -> RigidInertia:
        return cls(0.0, Vec3.zero(), Sym3.zero())

    def __add__(self, other: RigidInertia) -> RigidInertia:
        return RigidInertia(add(self.m, other.m), self.h + other.h, self.J + other.J)

    def __call__(self, v: Motion) -> Force:
        """Compute I v: momentum from velocity, or force from acceleration."""
        return Force(self.J @ v.ang + self.h.cross(v.lin), v.lin * self.m - self.h.cross(v.ang))

    def bias_force(self, w: Vec3) -> Force:
        """Compute [w x J w; w x (w x h)], the force for rotation at constant w."""
        return Force(w.cross(self.J @ w), w.cross(w.cross(self.h)))

    def rotated(self, R: Mat3) -> RigidInertia:
        """Return the inertia in new axes, with R from the current to the new axes."""
        return RigidInertia(self.m, R @ self.h, self.J.rotated(R))

    def shifted(self, p: Vec3) -> RigidInertia:
        """Return the inertia about an origin at -p (Steiner).

        h' = h + m p,  J' = J - [p][h] - [h][p] - m [p][p]
        """
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
        """Convert the inertia to an `ArticulatedInertia`."""
        M = Sym3(self.m, self.m, self.m, 0.0, 0.0, 0.0)
        return ArticulatedInertia(self.J, Mat3.skew(self.h), M)


@jax.tree_util.register_dataclass
@dataclass(eq=False, slots=True)
class ArticulatedInertia:
    """Articulated-body inertia [J, H; H^T, M], with symmetric J and M and a general H."""

    J: Sym3
    H: Mat3
    M: Sym3

    @classmethod
    def zero(cls) -> ArticulatedInertia:
        return cls(Sym3.zero(), Mat3.zero(), Sym3.zero())

    @classmethod
    def from_lanes(cls, x: Sequence[Lane]) -> ArticulatedInertia:
        """Make an inertia from 21 lanes: J (6), H (9) and M (6)."""
        return cls(Sym3(*x[:6]), Mat3(*x[6:15]), Sym3(*x[15:]))

    @classmethod
    def outer(cls, U: Force, V: Force) -> ArticulatedInertia:
        """Compute U V^T (6, 6) of two forces. It is symmetric, or a term of a symmetric sum."""
        H = Mat3(*(mul(a, b) for a in U.ang for b in V.lin))
        return cls(Sym3.outer(U.ang, V.ang), H, Sym3.outer(U.lin, V.lin))

    def __add__(self, other: ArticulatedInertia) -> ArticulatedInertia:
        return ArticulatedInertia(self.J + other.J, self.H + other.H, self.M + other.M)

    def __call__(self, a: Motion) -> Force:
        """Compute I_A a, the force from an acceleration."""
        return Force(self.J @ a.ang + self.H @ a.lin, self.H.T @ a.ang + self.M @ a.lin)

    def rotated(self, R: Mat3) -> ArticulatedInertia:
        """Return the inertia in new axes, with R from the current to the new axes."""
        return ArticulatedInertia(self.J.rotated(R), R @ self.H @ R.T, self.M.rotated(R))

    def shifted(self, p: Vec3) -> ArticulatedInertia:
        """Return the inertia about an origin at -p: H' = H + [p] M, J' = J + [p] H'^T - H [p]."""
        P = Mat3.skew(p)
        H = self.H + P @ self.M
        J = self.J + _symmetric_product(P, H.T) - _symmetric_product(self.H, P)
        return ArticulatedInertia(J, H, self.M)

    def less(self, U: Force, inverse_D: Lane) -> ArticulatedInertia:
        """Compute I - U U^T / D, with `inverse_D` = 1 / D."""
        return self - ArticulatedInertia.outer(U * inverse_D, U)

    def without(self, U: Force, inverse_D: Lane, S: Motion, armature: Lane) -> ArticulatedInertia:
        """Compute I_A - U U^T / D, the inertia that remains across a joint with the free axis S.

        If the armature is a structural zero and S is a unit vector, the row and column along S are
        exactly zero. They become literal zeros, without arithmetic and rounding.
        """
        left, along = self.less(U, inverse_D), list(S)
        axis = all(map(is_literal, along)) and sorted(along) == [0.0] * 5 + [1.0]
        return left._with_zero_row(along.index(1.0)) if axis and is_zero(armature) else left

    def __sub__(self, other: ArticulatedInertia) -> ArticulatedInertia:
        return ArticulatedInertia(self.J - other.J, self.H - other.H, self.M - other.M)

    def _with_zero_row(self, k: int) -> ArticulatedInertia:
        """Return the inertia with structural zeros in row and column k of the 6 by 6 matrix."""
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
    """Compute the symmetric matrix with the upper triangle of A B."""
    r, c = A.rows, B.columns
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    return Sym3(*(r[i].dot(c[j]) for i, j in pairs))


@jax.tree_util.register_dataclass
@dataclass(eq=False, slots=True)
class Transform:
    """The Plücker transform X_CP of a child frame C with pose (R, p) in its parent P."""

    R: Mat3
    p: Vec3

    @property
    def E(self) -> Mat3:
        """The rotation R^T, which maps parent coordinates to child coordinates."""
        return self.R.T

    def __call__(self, m: Motion) -> Motion:
        """Transform a motion from parent to child coordinates: [E w; E (v + w x p)]."""
        return Motion(self.E @ m.ang, self.E @ (m.lin + m.ang.cross(self.p)))

    def T(self, f: Force) -> Force:
        """Transform a force from child to parent coordinates: [R n + p x R f; R f]."""
        lin = self.R @ f.lin
        return Force(self.R @ f.ang + self.p.cross(lin), lin)

    def motion_to_parent(self, m: Motion) -> Motion:
        """Transform a motion from child to parent coordinates: [R w; R v + p x R w]."""
        ang = self.R @ m.ang
        return Motion(ang, self.R @ m.lin + self.p.cross(ang))

    def rigid_to_parent(self, inertia: RigidInertia) -> RigidInertia:
        """Transform a rigid-body inertia from child to parent coordinates: X^T I X."""
        return inertia.rotated(self.R).shifted(self.p)

    def articulated_to_parent(self, inertia: ArticulatedInertia) -> ArticulatedInertia:
        """Transform an articulated-body inertia from child to parent coordinates: X^T I_A X."""
        return inertia.rotated(self.R).shifted(self.p)

    def then(self, child: Transform) -> Transform:
        """Compose transforms: return X_GP from X_CP (this one) and X_GC of a child G of C."""
        return Transform(self.R @ child.R, self.p + self.R @ child.p)
