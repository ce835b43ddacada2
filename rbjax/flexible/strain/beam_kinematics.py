"""Positions, columns and accelerations at the frames of a beam, on lanes.

    r_g = sum_h A_gh t_h,                              t_h = L R_h Gamma_h
    dr_g/dq_j = sum_h A_gh (L W_hj x t_h + L R_h B_hj)
    r_g' = sum_h A_gh (w_h x t_h + u_h),               u_h = L R_h Gamma_h'
    r_g'' = sum_h A_gh (alpha_h x t_h + w_h x (w_h x t_h + 2 u_h))        at q'' = 0

h is a Gauss point, A the integration matrix (`basis.integration_matrix`), Gamma the strain along
the beam with the value 1 of the unstrained beam, B_hj = dGamma_h/dq_j, and W_j, w and alpha belong
to the sections (`section_rotations`). The columns are the exact derivatives of these sums, and the
accelerations their exact second derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rbjax.flexible.strain.basis import ShapeValue
from rbjax.flexible.strain.section_rotations import Coefficients, Orientation
from rbjax.lanes import Lane, Vec3, add, fusion_barrier, inner, is_literal
from rbjax.spatial import Motion, Transform

Rows = Sequence[Sequence[float]]


class Stretched(NamedTuple):
    """The tangents of a beam at its Gauss points, in base axes, times the length.

    Fields:
        t: L R Gamma.
        u: L R Gamma'.
        sections: the sections at the Gauss points.
    """

    t: list[Vec3]
    u: list[Vec3]
    sections: Sequence[Orientation]


def stretch(
    sections: Sequence[Orientation],
    values: Rows,
    strain: Coefficients,
    rate: Coefficients | None,
    length: Lane,
) -> Stretched:
    """Compute the tangents at the Gauss points.

    Args:
        sections: the sections at the Gauss points.
        values: P_j at the Gauss points.
        strain: coefficients of Gamma - (1, 0, 0).
        rate: their time derivatives; None if the velocities are not needed.
        length: the length of the beam, m.
    """

    t = tangents(sections, values, strain, length, Vec3(1.0, 0.0, 0.0))
    if rate is None:
        return Stretched(fusion_barrier(t), [Vec3.zero()] * len(t), sections)
    t, u = fusion_barrier((t, tangents(sections, values, rate, length)))
    return Stretched(t, u, sections)


def tangents(
    sections: Sequence[Orientation],
    values: Rows,
    coefficients: Coefficients,
    length: Lane,
    constant: Vec3 | None = None,
) -> list[Vec3]:
    """Compute L R (constant + sum_j P_j c_j) at the Gauss points, without a constant by default."""
    out = []
    for x, P in zip(sections, values, strict=True):
        y = Vec3(*(inner(P[: len(c)], c) for c in coefficients))
        out.append((x.R @ (y if constant is None else constant + y)) * length)
    return out


def position(weights: Sequence[float], s: Stretched) -> Vec3:
    """Compute r of a frame in the base frame, from its row A of weights."""
    return weighted_sum(weights, s.t)


def columns(
    rows: Rows,
    shapes: Sequence[Sequence[ShapeValue]],
    s: Stretched,
    sections: Sequence[Orientation],
    length: Lane,
) -> list[list[Motion]]:
    """Compute [L W_j; dr/dq_j] of each frame and coordinate, in the frame's axes.

    Args:
        rows: rows A of weights of the frames.
        shapes: the values of the shape functions at the Gauss points.
        s: the tangents at the Gauss points.
        sections: the sections of the frames.
        length: the length of the beam; a coordinate turns by W_j times the length.
    """
    out: list[list[Motion]] = [[] for _ in rows]
    t = fusion_barrier([x * length for x in s.t])
    about = [[Vec3(*(float(i == k) for i in range(3))).cross(x) for x in t] for k in range(3)]
    active = sorted({k for at in shapes for shape in at for k in shape if k >= 3})
    axes = {k: [x.R.columns[k - 3] * length for x in s.sections] for k in active}
    for j, strains in enumerate(shapes[0]):
        turns = [x.turn[j] for x in s.sections]
        constant = all(is_literal(x) for turn in turns for x in turn)
        arms = []
        if not constant or len(strains) > 1:
            arms = [w.cross(x) for w, x in zip(turns, t, strict=True)]
            for k in (k for k in axes if k in strains):
                parts = zip(arms, shapes, axes[k], strict=True)
                arms = [arm + x * at[j][k] for arm, at, x in parts]
        for columns, row, section in zip(out, rows, sections, strict=True):
            lin = weighted_sum(row, arms) if arms else Vec3.zero()
            if not arms:  # one strain and constant directions: products of constants are constants
                for k, arm in enumerate(about):
                    weights = [a * w[k] for a, w in zip(row, turns, strict=True)]
                    lin = lin + weighted_sum(weights, arm)
                for k in (k for k in axes if k in strains):
                    weights = [a * at[j][k] for a, at in zip(row, shapes, strict=True)]
                    lin = lin + weighted_sum(weights, axes[k])
            E = section.R.T
            columns.append(Motion((E @ section.turn[j]) * length, E @ lin))
    return out


def velocities(
    rows: Rows, s: Stretched, sections: Sequence[Orientation]
) -> list[tuple[Motion, Motion]]:
    """Compute the twist and the acceleration [w'; r''] of each frame, in the frame's axes."""
    moved = [x.w.cross(t) for x, t in zip(s.sections, s.t, strict=True)]
    v = [m + u for m, u in zip(moved, s.u, strict=True)]
    a = [
        x.alpha.cross(t) + x.w.cross(m + u * 2.0)
        for x, t, m, u in zip(s.sections, s.t, moved, s.u, strict=True)
    ]
    v, a = fusion_barrier((v, a))
    out = []
    for row, section in zip(rows, sections, strict=True):
        E = section.R.T
        twist = Motion(E @ section.w, E @ weighted_sum(row, v))
        out.append((twist, Motion(E @ section.alpha, E @ weighted_sum(row, a))))
    return out


def pose(weights: Sequence[float], s: Stretched, section: Orientation) -> Transform:
    """Return the pose of a frame in the base frame."""
    return Transform(section.R, position(weights, s))


def weighted_sum(weights: Sequence[float], vectors: Sequence[Vec3]) -> Vec3:
    """Compute the sum of vectors times weights."""
    out = Vec3.zero()
    for a, x in zip(weights, vectors, strict=True):
        out = out + x * a
    return out


def added(a: Sequence[Lane], b: Sequence[Lane]) -> list[Lane]:
    """Add two lists of coefficients of different lengths."""
    n = max(len(a), len(b))
    x, y = ([*c, *[0.0] * (n - len(c))] for c in (a, b))
    return [add(i, j) for i, j in zip(x, y, strict=True)]
