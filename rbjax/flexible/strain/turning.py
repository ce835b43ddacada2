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

import numpy as np

from rbjax.flexible.strain import rotation
from rbjax.flexible.strain.basis import cell_moments, integrals
from rbjax.lanes import Lane, Mat3, Vec3, fusion_barrier, inner, is_literal, sincos

#: coefficients of P_j, for each component of a vector
Coefficients = Sequence[Sequence[Lane]]


class Orientation(NamedTuple):
    """The orientation of a section.

    Fields:
        R: rotation from the axes of the section to those of the base.
        turn: W_j = dw/d(L q_j') of each coordinate of curvature, in base axes.
        w: angular velocity, in base axes.
        alpha: angular acceleration at q'' = 0, in base axes.
    """

    R: Mat3
    turn: tuple[Vec3, ...]
    w: Vec3
    alpha: Vec3


class Cells:
    """The sections of a beam: a start, Gauss points and further frames.

    A frame that is not a Gauss point is at the end of a cell from the node before it.

    Args:
        degree: the largest degree of a component of the curvature, or -1.
        nodes: s / L of the Gauss points, in increasing order.
        frames: s / L of the further frames.
        turning: (component, degree) of each coordinate of curvature.
        components: the components of the curvature that are not structurally zero.
    """

    def __init__(
        self,
        degree: int,
        nodes: np.ndarray,
        frames: Sequence[float],
        turning: Sequence[tuple[int, int]],
        components: Sequence[int],
    ):
        self.turning, self.components = tuple(turning), tuple(components)
        before = [int(np.searchsorted(nodes, x, side="right")) for x in frames]
        #: index of the section at which each cell starts; 0 is the base
        self.starts = (*range(len(nodes)), *before)
        places = [0.0, *nodes.tolist()]
        ends = [*nodes.tolist(), *frames]
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
        self, k: Coefficients, rate: Coefficients | None = None, *, columns: bool = True
    ) -> list[Orientation]:
        """Compute the sections at the Gauss points, then at the further frames.

        Args:
            k: coefficients of the curvature x, y, z, times the length.
            rate: their time derivatives; None if the velocities are not needed.
            columns: False if W_j are not needed.
        """
        if self.planar:
            return [self._planar(x, k, rate, columns) for x in self.integrals]
        none = Vec3.zero()
        start = tuple(none for _ in self.turning) if columns else ()
        sections = [Orientation(Mat3.identity(), start, none, none)]
        for at, moments in zip(self.starts, self.moments, strict=True):
            sections.append(self._next(sections[at], moments, k, rate))
        return sections[1:]

    def angles(self, k: Coefficients) -> list[Lane]:
        """Compute the squares of the angles by which the cells turn."""
        out = []
        for moments in self.moments:
            angle = rotation.magnus(*_vectors(moments, k)).angle
            out.append(angle.dot(angle))
        return out

    def _planar(
        self, x: list[float], k: Coefficients, rate: Coefficients | None, columns: bool
    ) -> Orientation:
        none = Vec3.zero()
        if not self.components:
            return Orientation(Mat3.identity(), (), none, none)
        (axis,) = self.components
        angle = _short_inner(x, k[axis])
        if is_literal(angle):
            c, s = math.cos(angle), math.sin(angle)
        else:
            c, s = fusion_barrier(sincos(angle))
        turn = tuple(_along(axis, x[j]) for _, j in self.turning) if columns else ()
        w = _along(axis, _short_inner(x, rate[axis])) if rate else none
        return Orientation(rotation.rotation_about(axis, angle, c, s), turn, w, none)

    def _next(
        self,
        last: Orientation,
        moments: list[list[float]],
        k: Coefficients,
        rate: Coefficients | None,
    ) -> Orientation:
        m = rotation.magnus(*_vectors(moments, k))
        c = rotation.stumpff_series(m.angle.dot(m.angle))
        R = last.R @ rotation.exponential(m.angle, c)
        turn, w, alpha = last.turn, last.w, last.alpha
        if turn:
            turn = self._turns(last, moments, m, last.R @ rotation.left_jacobian(m.angle, c))
        if rate:
            r = m.rate(_vectors(moments, rate))
            second = m.second_rate(r)
            more = last.R @ rotation.angular_velocity(m.angle, r.angle, c)
            own = last.R @ rotation.angular_acceleration(m.angle, r.angle, second, c)
            w, alpha = w + more, alpha + w.cross(more) + own
        return fusion_barrier(Orientation(R, turn, w, alpha))

    def _turns(
        self, last: Orientation, moments: list[list[float]], m: rotation.Magnus, J: Mat3
    ) -> tuple[Vec3, ...]:
        """Compute W_j at the end of a cell: dO/dq_j is linear in the moments of P_j."""
        none = Vec3.zero()
        slopes: dict[int, list[Vec3]] = {}
        for axis, degree in self.turning:
            units = slopes.setdefault(axis, [])
            e = _along(axis, 1.0)
            changes = ((e, e, none, none), (none, none, e, none), (e * (1 / 12), none, none, e))
            if len(units) <= min(degree, 2):
                units.append(J @ m.rate(changes[len(units)]).angle)
        return tuple(
            before + sum((u * w[j] for u, w in zip(slopes[axis], moments[1:], strict=False)), none)
            for before, (axis, j) in zip(last.turn, self.turning, strict=True)
        )


def _along(axis: int, x: Lane) -> Vec3:
    return Vec3(*(x if i == axis else 0.0 for i in range(3)))


def _short_inner(constants: Sequence[float], coefficients: Sequence[Lane]) -> Lane:
    return inner(constants[: len(coefficients)], coefficients)


def _vectors(moments: list[list[float]], k: Coefficients) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    b, a1, a2, a3 = (Vec3(*(_short_inner(row, x) for x in k)) for row in moments)
    return b, a1, a2, a3
