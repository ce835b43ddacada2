"""The virtual power of the inertial forces of a beam, for the derivative of inverse dynamics.

For virtual rates l of the coordinates and a virtual twist V* of the base, the inertial forces of
all sections g, of mass m_g and rotational inertia J_g, have the power

    l^T tau = sum_g m_g u_g.a_g + W*_g.(J_g W'_g + W_g x J_g W_g)

with the virtual velocity u_g = v* + w* x r_g + sum_h A_gh (w*_h x t_h + L R_h Gamma*_h). It needs
the motions along l, v and q'' only, not the columns of all coordinates. Its gradient by q and v is
the derivative of inverse dynamics (`rbjax.dynamics.algorithms.virtual_power`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rbjax.flexible.strain.beam_kinematics import Rows, Stretched, weighted_sum
from rbjax.flexible.strain.section_rotations import Orientation
from rbjax.lanes import Lane, Mat3, Vec3, add, fusion_barrier, is_zero, mul
from rbjax.spatial import Motion, RigidInertia


class SectionMotion(NamedTuple):
    """The motion of a frame of a beam relative to its base frame, in the axes of the base.

    Fields:
        R: rotation from the axes of the section to those of the base.
        r: position.
        twist: [w; r'].
        acceleration: [w'; r''].
        virtual: virtual twist.
    """

    R: Mat3
    r: Vec3
    twist: Motion
    acceleration: Motion
    virtual: Motion


def section_motions(
    rows: Rows,
    s: Stretched,
    sections: Sequence[Orientation],
    acceleration: Sequence[Vec3],
    virtual: Sequence[Vec3],
) -> list[SectionMotion]:
    """Compute the motions of all frames.

    Args:
        rows: rows A of weights of the frames.
        s: the tangents at the Gauss points.
        sections: the sections of the frames; `alpha` includes the accelerations of coordinates.
        acceleration, virtual: L R Gamma at the Gauss points, for the accelerations of the
            coordinates and for the virtual rates in place of Gamma.
    """
    at_points = s.sections
    moved = [x.w.cross(t) for x, t in zip(at_points, s.t, strict=True)]
    rate = [m + u for m, u in zip(moved, s.u, strict=True)]
    second = [
        x.alpha.cross(t) + x.w.cross(m + u * 2.0) + more
        for x, t, m, u, more in zip(at_points, s.t, moved, s.u, acceleration, strict=True)
    ]
    third = [x.virtual.cross(t) + more for x, t, more in zip(at_points, s.t, virtual, strict=True)]
    rate, second, third = fusion_barrier((rate, second, third))
    return [
        SectionMotion(
            x.R,
            weighted_sum(row, s.t),
            Motion(x.w, weighted_sum(row, rate)),
            Motion(x.alpha, weighted_sum(row, second)),
            Motion(x.virtual, weighted_sum(row, third)),
        )
        for row, x in zip(rows, sections, strict=True)
    ]


class BeamPower(NamedTuple):
    """The virtual power of a beam's inertial forces (`rbjax.joints.flexible.DistributedPower`)."""

    motions: list[SectionMotion]
    inertias: list[RigidInertia]

    def power(self, w: Vec3, a: Motion, V: Motion) -> Lane:
        """Compute the power from angular velocity, acceleration and virtual twist of the base."""
        out: Lane = 0.0
        for x, inertia in zip(self.motions, self.inertias, strict=True):
            out = add(out, _of_section(x, inertia, w, a, V))
        return out


def _of_section(x: SectionMotion, inertia: RigidInertia, w: Vec3, a: Motion, V: Motion) -> Lane:
    E = x.R.T
    carried = a.ang.cross(x.r) + w.cross(w.cross(x.r) + x.twist.lin * 2.0)
    lin = x.acceleration.lin + a.lin + carried
    u = x.virtual.lin + V.lin + V.ang.cross(x.r)
    W = E @ (x.twist.ang + w)
    turn = E @ (x.acceleration.ang + a.ang + w.cross(x.twist.ang))
    virtual = E @ (x.virtual.ang + V.ang)
    if all(is_zero(y) for y in inertia.h):
        force = inertia.J @ turn + W.cross(inertia.J @ W)
        return add(mul(inertia.m, u.dot(lin)), virtual.dot(force))
    f = inertia(Motion(turn, E @ lin)) + inertia.bias_force(W)
    return Motion(virtual, E @ u).dot(f)
