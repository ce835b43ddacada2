"""Constraints of wheels that roll without slip, and of knife edges, on a plane.

The plane contains A's origin and its normal n is z_A. It may move with a body. The wheel's centre c
is B's origin. The contact point is p = c + r with

    sphere      r = -R n
    thin disc   r = R m,     m = -(n - (n . e) e) / sin(lean),   cos(lean) = n . e,   e its axle

The height n . (p - p_A) = 0 is a holonomic row. The slip velocity

    u = c' + w_B x r - p_A' - w_A x (p - p_A)

is zero along x_A and y_A, which are two non-holonomic rows. With the rate r' of the contact point
relative to c, which moves along the rim,

    u' = c'' + w_B' x r + w_B x r' - p_A'' - w_A' x (p - p_A) - w_A x (c' + r' - p_A')

Source: Neimark & Fufaev, *Dynamics of Nonholonomic Systems*, ch. 1; Bloch, *Nonholonomic Mechanics
and Control*, 1.4 to 1.8.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.constraints.rows.geometry import X, Y, Z, along, cosine, opposed
from rbjax.constraints.rows.row import Constraint, Row
from rbjax.forces.context import Context, FrameState
from rbjax.forces.place import Place, as_place, check_places
from rbjax.lanes import Lane, Vec3, add
from rbjax.model.leaves import scalar
from rbjax.model.record import check_number, floats

Moving = tuple[Vec3, Vec3]  # a vector in world axes, and its rate


def swept(F: FrameState, u: Vec3) -> Moving:
    """Return a direction that is fixed in a frame, and its rate, in world axes."""
    u = F.rotation @ u
    return u, F.angular_velocity.cross(u)


def slip(A: FrameState, B: FrameState, arm: Moving, directions: Sequence[Moving]) -> list[Row]:
    """Build the rows u . s, with u the slip velocity of B on A at the contact point. `arm` is the
    vector from B's origin to the contact point. `directions` are the vectors s."""
    (r, dr), a, b = arm, A.angular_velocity, B.angular_velocity
    p = B.position + r
    d, dd = p - A.position, B.velocity + dr - A.velocity
    u = B.velocity + b.cross(r) - A.velocity - a.cross(d)
    du = (
        B.acceleration + B.angular_acceleration.cross(r) + b.cross(dr)
        - A.acceleration - A.angular_acceleration.cross(d) - a.cross(dd)
    )  # fmt: skip
    return [
        Row(
            None,
            u.dot(s),
            opposed(B.push(s, at=p), A.push(-s, at=p)),
            add(du.dot(s), u.dot(ds)),
        )
        for s, ds in directions
    ]


class RollingWheel(Constraint):
    """Base class of wheels that roll on a plane: one height row and two slip rows.

    Fields:
        a: `Place` whose origin is in the plane and whose z axis is the normal towards the wheel.
        b: `Place` whose origin is the wheel's centre and whose z axis is the axle.
        radius: radius of the wheel, m, above zero.
    """

    a: Place = eqx.field(converter=as_place)
    b: Place = eqx.field(converter=as_place)
    radius: jax.Array = eqx.field(converter=floats)
    size = 3

    def __check_init__(self) -> None:
        check_places(self)
        check_number(self, "radius", positive=True)

    def rows(self, context: Context) -> Sequence[Row]:
        A, B = self.a.frame(context), self.b.frame(context)
        height, arm = self.contact(A, B, scalar(self.radius, context.q.dtype))
        return [height, *slip(A, B, arm, [swept(A, X), swept(A, Y)])]

    def contact(self, A: FrameState, B: FrameState, radius: Lane) -> tuple[Row, Moving]:
        """Return the row of the contact point's height, and the point relative to the centre."""
        raise NotImplementedError(f"{type(self).__name__} has no method contact")


class RollingSphere(RollingWheel):
    """A sphere that rolls on a plane without slip: three rows.

    It also models a round wheel whose axle stays parallel to the plane.

    Fields: a, b, radius, as in `RollingWheel`; the axes of b have no effect.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.constraints import Place, RollingSphere
        >>> ball = RollingSphere(Place.on(), Place.on(body="box"), 0.1)
        >>> rb.load("free_body").with_constraints(ball).constraints[0].size
        3
    """

    def contact(self, A: FrameState, B: FrameState, radius: Lane) -> tuple[Row, Moving]:
        n, dn = swept(A, Z)
        return along(A, Z, B) + (-radius), (n * (-radius), dn * (-radius))


class RollingDisc(RollingWheel):
    """A thin disc that rolls on a plane without slip and may lean, but not lie flat: three rows.

    Fields: a, b, radius, as in `RollingWheel`.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.constraints import Place, RollingDisc
        >>> wheel = RollingDisc(Place.on(), Place.on(body="box", axis=[0, 1, 0]), 0.3)
        >>> rb.load("free_body").with_constraints(wheel).constraints[0].size
        3
    """

    def contact(self, A: FrameState, B: FrameState, radius: Lane) -> tuple[Row, Moving]:
        lean = cosine(A, Z, B, Z)
        sine = lean.apply(lambda c: jnp.sqrt(1 - c * c))
        (n, dn), (e, de), c = swept(A, Z), swept(B, Z), lean.value
        # m sin = c e - n, with the rate m' sin + m sin'
        scale: Any = 1.0 / sine.value  # type: ignore[operator]
        m = (e * c - n) * scale
        dm = (e * lean.rate + de * c - dn - m * sine.rate) * scale
        return along(A, Z, B) - sine * radius, (m * radius, dm * radius)


class KnifeEdge(Constraint):
    """A blade on a plane that slides only along itself: one non-holonomic row.

    The row is u . (n x d) = 0, with the velocity u of the blade's point relative to the plane. It
    does not keep the point in the plane. It also models a massless wheel with an axle orthogonal to
    d.

    Fields:
        a: `Place` whose z axis is the normal n of the plane.
        b: `Place` whose origin is the blade's point and whose z axis is the blade's direction d.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.constraints import KnifeEdge, Place
        >>> skate = KnifeEdge(Place.on(), Place.on(body="box", point=[-0.3, 0, 0], axis=[1, 0, 0]))
        >>> rb.load("free_body").with_constraints(skate).constraints[0].size
        1
    """

    a: Place = eqx.field(converter=as_place)
    b: Place = eqx.field(converter=as_place)
    size = 1

    def __check_init__(self) -> None:
        check_places(self)

    def rows(self, context: Context) -> Sequence[Row]:
        A, B = self.a.frame(context), self.b.frame(context)
        (n, dn), (d, dd) = swept(A, Z), swept(B, Z)
        arm = Vec3.zero(), Vec3.zero()
        return slip(A, B, arm, [(n.cross(d), dn.cross(d) + n.cross(dd))])
