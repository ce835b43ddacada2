"""Joints that close kinematic loops: lower pairs, and other joints made of the same primitive rows.

a and b are frames on the two bodies, and their z axes are the joint's axis. Parallel axes may point
in opposite directions. Prismatic joints and welds use the sine of an angle, which is also zero
at half a turn. `assemble` uses the sine of half the angle (`HalfAngle`) instead.

Source: Masarati, *Multibody System Dynamics*, ch. 6; Haug, *Computer-Aided Kinematics and
Dynamics*, 9.4.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike
from rbjax.constraints.rows.geometry import (
    AXES,
    End,
    X,
    Y,
    Z,
    along,
    cosine,
    displacement,
    distance,
    origin,
    places,
    turn,
)
from rbjax.constraints.rows.row import Constraint, Row, angle
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError
from rbjax.forces.context import Context, FrameState
from rbjax.forces.place import Place, as_place, check_places
from rbjax.model import Frame, Model
from rbjax.model.leaves import scalar
from rbjax.model.record import check_number, floats

Primitive = Callable[[FrameState, FrameState], list[Row]]
#: below this value of 1 + trace of a rotation matrix (near half a turn), it is mostly rounding
NEAR = 1e-5


class Pair(Constraint):
    """Base class of joints between two frames that close a kinematic loop.

    Origin and axes of the frame on body a are p_a, x_a and z_a, of the frame on b p_b, x_b, z_b.

    Fields:
        a, b: frames on the two bodies: `Place`s, or `rb.Frame`s, whose z axis is that of the body
            or site.

    Class fields:
        primitives: functions (A, B) -> rows of two frames. The joint has the rows of all of them.
        turns: slice of the rows that are the sine of an angle (`turn`), or None.
    """

    a: Place = eqx.field(converter=as_place)
    b: Place = eqx.field(converter=as_place)
    primitives: ClassVar[Sequence[Primitive]] = ()
    turns: ClassVar[slice | None] = None

    def __check_init__(self) -> None:
        check_places(self)

    @classmethod
    def between(
        cls,
        model: Model,
        a: End,
        b: End,
        *,
        point: Any = None,
        axis: Any = (0.0, 0.0, 1.0),
        q: ArrayLike | None = None,
        **numbers: Any,
    ) -> Any:
        """Make the joint from a point and an axis in the world, for one configuration.

        Args:
            model: the robot.
            a, b: names or indices of bodies, or `rb.Frame`s; None is the world.
            point: (3,) m in world axes. None: the origin of a if it is an `rb.Frame`, else the
                origin of the world.
            axis: (3,) direction of the joint's axis in world axes, of any length.
            q: (nq,) configuration; None for the model's default state.
            numbers: the other fields of the joint.
        """
        ends = places(model, a, b, point=point, axis=axis, q=q)
        try:
            return cls(*ends, **numbers)
        except TypeError as error:
            fields = [f.name for f in dataclasses.fields(cls)][2:]
            raise InputError(
                f"{cls.__name__}.between: got the numbers {sorted(numbers)}, expected {fields}"
            ) from error

    def rows(self, context: Context) -> Sequence[Row]:
        return self.between_frames(self.a.frame(context), self.b.frame(context), context)

    def between_frames(self, A: FrameState, B: FrameState, context: Context) -> Sequence[Row]:
        """Build the rows of the joint between two frames."""
        return [row for primitive in self.primitives for row in primitive(A, B)]


class HalfAngle(Constraint):
    """The rows of a pair, with 2 sin(x / 2) n instead of sin(x) n for the relative rotation.

    x is the angle between the frames and n the axis. The rows are zero only if the frames are
    aligned, and NaN within 0.2 degrees of half a turn.

    Fields:
        of: a `Pair` with `turns`.
    """

    of: Pair

    @property
    def size(self) -> int:
        return self.of.size

    def rows(self, context: Context) -> Sequence[Row]:
        A, B = self.of.a.frame(context), self.of.b.frame(context)
        rows = list(self.of.between_frames(A, B, context))
        # 2 sin(x / 2) = sin(x) / cos(x / 2), with 1 + trace = 4 cos(x / 2)^2
        scale = trace(A, B).apply(lambda c: 2 / jnp.sqrt(jnp.where(c > NEAR - 1, 1 + c, jnp.nan)))
        turns = range(*self.of.turns.indices(len(rows))) if self.of.turns else ()
        return [row * scale if r in turns else row for r, row in enumerate(rows)]


def trace(A: FrameState, B: FrameState) -> Row:
    """Return the row of the trace of the relative rotation: 1 + 2 cos(x) for the angle x."""
    x, y, z = (cosine(A, e, B, e) for e in AXES)
    return x + y + z


def parallel(A: FrameState, B: FrameState) -> list[Row]:
    """Return two rows that are zero if the z axes of two frames are parallel."""
    return [cosine(A, X, B, Z), cosine(A, Y, B, Z)]


def orthogonal(A: FrameState, B: FrameState) -> list[Row]:
    """Return the row that is zero if the z axis of B is orthogonal to the x axis of A."""
    return [cosine(A, X, B, Z)]


def on_axis(A: FrameState, B: FrameState) -> list[Row]:
    """Return two rows that are zero if the origin of B is on the z axis of A."""
    return [along(A, X, B), along(A, Y, B)]


def in_plane(A: FrameState, B: FrameState) -> list[Row]:
    """Return the row that is zero if the origin of B is in the x-y plane of A."""
    return [along(A, Z, B)]


class Spherical(Pair):
    """A ball joint, MuJoCo's `connect`: p_b = p_a, three rows in world axes."""

    size = 3
    primitives = (displacement,)


class Revolute(Pair):
    """A revolute joint (hinge): p_b = p_a and z_b parallel to z_a, five rows."""

    size = 5
    primitives = displacement, parallel


class Cylindrical(Pair):
    """A cylindrical joint: p_b on the axis z_a and z_b parallel to z_a, four rows."""

    size = 4
    primitives = on_axis, parallel


class Prismatic(Pair):
    """A prismatic joint (slide): p_b on the axis z_a and all axes parallel, five rows."""

    size = 5
    primitives = on_axis, turn
    turns = slice(2, 5)


class Screw(Pair):
    """A screw joint: a cylindrical joint with slide = pitch angle / (2 pi), five rows.

    Fields:
        pitch: (), slide per turn, m, not zero. The number of turns follows from the slide, so the
            residual must stay below half a turn.
    """

    pitch: jax.Array = eqx.field(converter=floats)
    size = 5

    def __check_init__(self) -> None:
        check_number(self, "pitch")
        if not isinstance(self.pitch, jax.core.Tracer) and not np.asarray(self.pitch):
            raise InputError(
                "Screw(pitch=...): got 0, expected a pitch in metres a turn that is not zero; "
                "without a pitch the joint is a Revolute"
            )

    def between_frames(self, A: FrameState, B: FrameState, context: Context) -> Sequence[Row]:
        lead = scalar(self.pitch, context.q.dtype) / (2 * math.pi)
        angle_ = along(A, Z, B) * (1.0 / lead)
        sine, cosine_ = cosine(A, Y, B, X), cosine(A, X, B, X)
        s, c = angle_.apply(jnp.sin), angle_.apply(jnp.cos)
        error = angle(sine * c - cosine_ * s, cosine_ * c + sine * s)
        return [*on_axis(A, B), *parallel(A, B), error * lead]


class Planar(Pair):
    """A planar joint: p_b in the plane orthogonal to z_a and z_b parallel to z_a, three rows."""

    size = 3
    primitives = in_plane, parallel


class Universal(Pair):
    """A universal (Cardan) joint: p_b = p_a and z_b orthogonal to x_a, four rows. The cross rotates
    about x_a relative to body a, and about z_b relative to body b."""

    size = 4
    primitives = displacement, orthogonal


class Weld(Pair):
    """A rigid connection: p_b = p_a and all axes parallel, six rows. The last three rows are sin(x)
    n, with the angle x and axis n of the relative rotation."""

    size = 6
    primitives = displacement, turn
    turns = slice(3, 6)


class Inline(Pair):
    """A point on a line: p_b on the axis z_a, two rows."""

    size = 2
    primitives = (on_axis,)


class Inplane(Pair):
    """A point in a plane: p_b in the plane through p_a orthogonal to z_a, one row."""

    size = 1
    primitives = (in_plane,)


class Parallel(Pair):
    """Parallel axes: z_b parallel to z_a, two rows."""

    size = 2
    primitives = (parallel,)


class Orthogonal(Pair):
    """Orthogonal axes: z_b orthogonal to x_a, one row."""

    size = 1
    primitives = (orthogonal,)


class Distance(Pair):
    """A massless rod with ball joints at both ends: |p_b - p_a| = length, one row.

    Fields:
        length: (), distance of the two origins, m, above zero.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> rod = rb.constraints.Distance.between(
        ...     model, None, "lower", point=[0.3, 0.0, 0.0], other=[0.0, 0.0, 0.4]
        ... )
        >>> float(rod.length)
        0.5
    """

    length: jax.Array = eqx.field(converter=floats)
    size = 1

    @classmethod
    def between(  # type: ignore[override]
        cls,
        model: Model,
        a: End,
        b: End,
        *,
        point: Any = None,
        other: Any = None,
        length: Any = None,
        q: jax.Array | None = None,
    ) -> Distance:
        """Make a rod between two points in the world, for one configuration.

        Args:
            model: the robot.
            a, b: names or indices of bodies, or `rb.Frame`s; None is the world.
            point: (3,) end of the rod on a, m in world axes. None: the origin of a if it is an
                `rb.Frame`, else the origin of the world.
            other: (3,) end of the rod on b, m in world axes. None: the origin of the `rb.Frame` b.
            length: m; None for the distance of the two points.
            q: (nq,) configuration; None for the model's default state.

        Raises:
            InputError: `other` is missing or equal to `point`.
        """
        point = origin(model, a, q) if point is None else point
        if other is None and isinstance(b, Frame):
            other = origin(model, b, q)
        if other is None:
            raise InputError(
                "Distance.between: got one point, expected two: other=(3,) is the end on b, m in "
                "the world, or an rb.Frame as b. Distance(a, b, length) takes two Frames or Places"
            )
        point = check_array("Distance.between", "point", point, (3,))
        other = check_array("Distance.between", "other", other, (3,))
        apart = jnp.sqrt(((other - point) ** 2).sum())
        if not isinstance(apart, jax.core.Tracer) and not np.asarray(apart):
            raise InputError(
                f"Distance.between: point and other are both {np.asarray(point).tolist()}, "
                "expected two points; a Spherical holds two points together"
            )
        start, end = (places(model, a, b, point=x, q=q)[k] for k, x in enumerate((point, other)))
        return cls(start, end, apart if length is None else length)

    def __check_init__(self) -> None:
        check_number(self, "length", positive=True)

    def between_frames(self, A: FrameState, B: FrameState, context: Context) -> Sequence[Row]:
        return [distance(A, B) - scalar(self.length, context.q.dtype)]


class QuaternionWeld(Pair):
    """A rigid connection with the six rows of MuJoCo's `weld`.

    The first three rows are p_b - p_a. The last three are scale sin(x / 2) n, with the angle x and
    axis n of the relative rotation. They are not differentiable at half a turn.

    Fields:
        a, b: `Place`s on the two bodies.
        scale: (), MuJoCo's torquescale, m.
    """

    scale: jax.Array = eqx.field(converter=floats)
    size = 6

    def __check_init__(self) -> None:
        super().__check_init__()
        check_number(self, "scale")

    def between_frames(self, A: FrameState, B: FrameState, context: Context) -> Sequence[Row]:
        scale = scalar(self.scale, context.q.dtype)
        # sin(x) n / (2 cos(x / 2)), with 1 + trace = 4 cos(x / 2)^2
        half = trace(A, B).apply(lambda c: 1 / jnp.sqrt(1 + c))
        return [*displacement(A, B), *(row * half * scale for row in turn(A, B))]
