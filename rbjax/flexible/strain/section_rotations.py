"""Rotations of the sections of a beam, from node to node, on lanes.

    R_{g+1} = R_g exp([O]),    W_{g+1,j} = W_g,j + R_g J dO/d(L q_j),    w = L sum_j W_j q_j'

O is the rotation vector of the cell between two nodes (`rotation`). All vectors are in base axes.
The coefficients of the curvature are multiplied by the length, so that lengths are in units of it.

If the curvature has only one component, its integral is the angle, exactly. Then W_j is a constant
and the planar beam has planar arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.flexible.strain import rotation
from rbjax.flexible.strain.basis import ShapeFunction, cell_moments, integrals
from rbjax.lanes import Lane, Mat3, Vec3, as_arrays, fusion_barrier, inner, is_literal, sincos
from rbjax.lanes.primitives import whole_cotangent

#: coefficients of P_j, for each component of a vector
Coefficients = Sequence[Sequence[Lane]]
#: the moments of a cell (`basis.cell_moments`), row by row
Rows = Sequence[Sequence[Lane]]


class Orientation(NamedTuple):
    """The orientation of a section.

    Fields:
        R: rotation from the axes of the section to those of the base.
        turn: W_j = dw/d(L q_j') of each coordinate, in base axes.
        w: angular velocity, in base axes.
        alpha: angular acceleration, in base axes; at q'' = 0 unless accelerations are given.
        virtual: virtual angular velocity, in base axes.
    """

    R: Mat3
    turn: tuple[Vec3, ...]
    w: Vec3
    alpha: Vec3
    virtual: Vec3


class Cells:
    """The sections of a beam: a start, Gauss points and further frames.

    A frame that is not a Gauss point is at the end of a cell from the node before it.

    Args:
        degree: the largest degree of a component of the curvature, or -1.
        nodes: s / L of the Gauss points, in increasing order.
        frames: s / L of the further frames.
        shapes: the shape functions of the coordinates.
        components: the components of the curvature that are not structurally zero.
    """

    def __init__(
        self,
        degree: int,
        nodes: np.ndarray,
        frames: Sequence[float],
        shapes: Sequence[ShapeFunction],
        components: Sequence[int],
    ):
        self.shapes, self.components = tuple(shapes), tuple(components)
        #: the largest degree of the shape functions by component
        self.degrees = {
            k: max(len(shape.get(k, ())) for shape in shapes) - 1
            for k in sorted({k for shape in shapes for k in shape if k < 3})
        }
        before = [int(np.searchsorted(nodes, x, side="right")) for x in frames]
        #: index of the section at which each cell starts; 0 is the base
        self.starts = (*range(len(nodes)), *before)
        places = [0.0, *nodes.tolist()]
        ends = [*nodes.tolist(), *frames]
        #: the number of first cells that each start at the end of the cell before
        self.in_series = next((i for i, x in enumerate(self.starts) if x != i), len(self.starts))
        degree = max(degree, 0)
        self.integrals = [integrals(degree, x).tolist() for x in ends]
        self.moments = [
            cell_moments(degree, places[k], x).tolist()
            for k, x in zip(self.starts, ends, strict=True)
        ]

    @property
    def planar(self) -> bool:
        """True if the curvature has at most one component."""
        return len(self.components) < 2

    def sections(
        self,
        k: Coefficients,
        rate: Coefficients | None = None,
        *,
        along: Sequence[Coefficients] = (),
        columns: bool = True,
    ) -> list[Orientation]:
        """Compute the sections at the Gauss points, then at the further frames.

        Args:
            k: coefficients of the curvature x, y, z, times the length.
            rate: their time derivatives; None if the velocities are not needed.
            along: accelerations and virtual rates of the coefficients, with a rate.
            columns: False if W_j are not needed.
        """
        if self.planar:
            return [self._planar(x, k, rate, along, columns) for x in self.integrals]
        if along and rate:
            return self._looped(k, rate, along)
        none = Vec3.zero()
        start = tuple(none for _ in self.shapes) if columns else ()
        sections = [Orientation(Mat3.identity(), start, none, none, none)]
        for at, moments in zip(self.starts, self.moments, strict=True):
            sections.append(self._next(sections[at], moments, k, rate, along))
        return sections[1:]

    def _looped(
        self, k: Coefficients, rate: Coefficients, along: Sequence[Coefficients]
    ) -> list[Orientation]:
        """Compute the sections without columns, by a loop over the cells in series.

        The derivative of the loop computes the values of one cell at a time again, so that they fit
        into registers.
        """
        like = next(x for row in (*k, *rate) for x in row if hasattr(x, "dtype"))
        none = Vec3.zero()
        start = as_arrays(Orientation(Mat3.identity(), (), none, none, none), like)
        table = np.array(self.moments[: self.in_series])
        used = np.any(table, 0)

        def cell(last: Orientation, row: jax.Array) -> tuple[Orientation, Orientation]:
            entries = iter([row[i] for i in range(row.shape[0])])
            moments = [[next(entries) if x else 0.0 for x in line] for line in used]
            new = as_arrays(self._next(last, moments, k, rate, along), like)
            return new, new

        rows = jnp.asarray(table[:, used], like.dtype)
        _, ys = jax.lax.scan(jax.checkpoint(cell, prevent_cse=False), start, rows)
        ys = jax.tree.map(whole_cotangent, ys)
        sections = [start, *(jax.tree.map(lambda y, i=i: y[i], ys) for i in range(self.in_series))]
        further = zip(self.starts[self.in_series :], self.moments[self.in_series :], strict=True)
        sections += [self._next(sections[i], m, k, rate, along) for i, m in further]
        return sections[1:]

    def angles(self, k: Coefficients) -> list[Lane]:
        """Compute the squares of the angles by which the cells turn."""
        out = []
        for moments in self.moments:
            angle = rotation.magnus(*_vectors(moments, k)).angle
            out.append(angle.dot(angle))
        return out

    def _planar(
        self,
        x: list[float],
        k: Coefficients,
        rate: Coefficients | None,
        along: Sequence[Coefficients],
        columns: bool,
    ) -> Orientation:
        none = Vec3.zero()
        if not self.components:
            start = tuple(none for _ in self.shapes) if columns else ()
            return Orientation(Mat3.identity(), start, none, none, none)
        (axis,) = self.components
        angle = _short_inner(x, k[axis])
        if is_literal(angle):
            c, s = math.cos(angle), math.sin(angle)
        else:
            c, s = fusion_barrier(sincos(angle))
        shapes = [shape.get(axis, ()) for shape in self.shapes] if columns else []
        turn = tuple(_along(axis, _short_inner(x, shape)) for shape in shapes)
        rates = (rate, *(along or (None, None)))
        w, alpha, virtual = (_along(axis, _short_inner(x, y[axis])) if y else none for y in rates)
        return Orientation(rotation.rotation_about(axis, angle, c, s), turn, w, alpha, virtual)

    def _next(
        self,
        last: Orientation,
        moments: Rows,
        k: Coefficients,
        rate: Coefficients | None,
        along: Sequence[Coefficients],
    ) -> Orientation:
        m = rotation.magnus(*_vectors(moments, k))
        c = rotation.stumpff_series(m.angle.dot(m.angle))
        R = last.R @ rotation.exponential(m.angle, c)
        turn, w, alpha, virtual = last.turn, last.w, last.alpha, last.virtual
        if turn:
            turn = self._next_columns(last, moments, m, last.R @ rotation.left_jacobian(m.angle, c))
        if rate:
            r = m.rate(_vectors(moments, rate))
            second = m.second_rate(r)
            if along:
                second = second + m.rate(_vectors(moments, along[0])).angle
                change = m.rate(_vectors(moments, along[1])).angle
                virtual = virtual + last.R @ rotation.angular_velocity(m.angle, change, c)
            more = last.R @ rotation.angular_velocity(m.angle, r.angle, c)
            relative = last.R @ rotation.angular_acceleration(m.angle, r.angle, second, c)
            w, alpha = w + more, alpha + w.cross(more) + relative
        return fusion_barrier(Orientation(R, turn, w, alpha, virtual))

    def _next_columns(
        self, last: Orientation, moments: Rows, m: rotation.Magnus, J: Mat3
    ) -> tuple[Vec3, ...]:
        """Compute W_j at the end of a cell: dO/dq_j is linear in the moments of the shape."""
        none = Vec3.zero()
        units: dict[int, list[Vec3]] = {}
        for axis, degree in self.degrees.items():
            e = _along(axis, 1.0)
            changes = ((e, e, none, none), (none, none, e, none), (e * (1 / 12), none, none, e))
            units[axis] = [J @ m.rate(x).angle for x in changes[: degree + 1]]
        out = []
        for turn, shape in zip(last.turn, self.shapes, strict=True):
            for axis in (k for k in units if k in shape):
                own = [_short_inner(row, shape[axis]) for row in moments[1:]]
                turn = turn + sum((u * w for u, w in zip(units[axis], own, strict=False)), none)
            out.append(turn)
        return tuple(out)


def _along(axis: int, x: Lane) -> Vec3:
    return Vec3(*(x if i == axis else 0.0 for i in range(3)))


def _short_inner(constants: Sequence[Lane], coefficients: Sequence[Lane]) -> Lane:
    return inner(constants[: len(coefficients)], coefficients)


def _vectors(moments: Rows, k: Coefficients) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    a1, a2, a3 = (Vec3(*(_short_inner(row, x) for x in k)) for row in moments[1:])
    return a1 + a3 * (1 / 12), a1, a2, a3
