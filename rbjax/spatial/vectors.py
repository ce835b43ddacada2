"""Motion and force vectors, angular part first.

(Featherstone, *Rigid Body Dynamics Algorithms*, 2.2.)
A motion [omega; v] and a force [n; f] are dual: their product is a power. Both are at the origin of
the frame in which they are expressed.
"""

from __future__ import annotations

import jax

from rbjax.lanes import Lane, Vec3, add


class _Pair:
    """An angular and a linear Vec3."""

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
        """From six lanes, angular first."""
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
        """The scalar product of a motion and a force."""
        return add(self.ang.dot(other.ang), self.lin.dot(other.lin))

    def __repr__(self) -> str:
        return f"{type(self).__name__}(ang={self.ang}, lin={self.lin})"


class Motion(_Pair):
    """Twist or spatial acceleration [omega; v]."""

    __slots__ = ()

    def cross(self, other: Motion) -> Motion:
        """v x m, the rate of a motion carried along by v."""
        return Motion(
            self.ang.cross(other.ang), self.ang.cross(other.lin) + self.lin.cross(other.ang)
        )

    def cross_force(self, f: Force) -> Force:
        """v x* f, the rate of a force carried along by v."""
        return Force(self.ang.cross(f.ang) + self.lin.cross(f.lin), self.ang.cross(f.lin))


class Force(_Pair):
    """Wrench or spatial momentum [n; f]."""

    __slots__ = ()
