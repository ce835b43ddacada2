"""Factors of the mass matrix by ABA, one for each dof, and the elimination of coordinates.

A dof with the axis S is eliminated in the link that it moves (aba.py):

    U = I_A S,  D = S.U + armature,  u = tau - S.p;   I_a = I_A - U U^T / D,  p_a = p + U u / D

A coordinate j of a flexible link moves all frames f of the link, each with an axis S_fj. Its column
is a sum over the frames, plus C_j and m_ij of a `LinkInertia`, if there is one:

    C_j = sum X_f^T I_f S_fj,   m_ij = sum S_fi.I_f S_fj,   r_j = sum S_fj.p_f

p_f includes the force I_f c_f of the bias acceleration c_f. The last coordinate k is eliminated
first. The coordinates i, j < k remain:

    D = m_kk + armature,  u = tau - r_k,  I_a = I_A - C_k C_k^T / D,  p_a = p + C_k u / D,
    C_j = C_j - C_k m_kj / D,   m_ij = m_ij - m_ki m_kj / D,   r_j = r_j + m_kj u / D

All coordinates together are an L D L^T factorization of m (Jain & Rodriguez, JGCD 15(6), 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
from jax.ad_checkpoint import checkpoint_name

from rbjax.errors import ModelError
from rbjax.joints import LinkInertia
from rbjax.joints.joint import Block
from rbjax.lanes import Lane, add, inner, is_zero, mul, sub
from rbjax.spatial import ArticulatedInertia, Force, Motion, RigidInertia, Transform


class Factor(NamedTuple):
    """The factors of a joint that ABA has eliminated, which give qdd = (u - U.a) / D.

    X: pose of the link in its parent.
    S: axis of the joint in link axes.
    U: I_A S, with I_A the articulated inertia.
    inverse_D: 1 / D, with D = S.U + armature.
    """

    X: Transform
    S: Motion
    U: Force
    inverse_D: Lane

    def inward(
        self, tau: Lane, p_A: Force, block: Block, inertial: Force
    ) -> tuple[Lane, Force, Block]:
        """Compute u, the force p_a = p_A + inertial + U u / D on the parent, and the block for the
        parent.

        block: generalized forces of the coordinates of a flexible link that are not eliminated.
        inertial: I_a c.
        """
        u = sub(tau, self.S.dot(p_A))
        return u, p_A + inertial + self.U * mul(u, self.inverse_D), ()

    def outward(self, u: Lane, a: Motion, block: Block) -> tuple[Motion, Lane, Block]:
        """Compute the acceleration of the link, qdd, and the block for the children.

        a: acceleration of the link at qdd = 0.
        block: accelerations of the coordinates of a flexible link up to this dof.
        """
        qdd = mul(sub(u, self.U.dot(a)), self.inverse_D)
        return a + self.S * qdd, qdd, ()


class FrameFactor(NamedTuple):
    """The pose of a frame of a flexible link, and its axis for each coordinate of the link."""

    X: Transform
    axes: tuple[Motion, ...]

    def inward(
        self, tau: Lane, p_A: Force, block: Block, inertial: Force
    ) -> tuple[Lane, Force, Block]:
        p_a = p_A + inertial
        return 0.0, p_a, tuple(S.dot(p_a) for S in self.axes)

    def outward(self, u: Lane, a: Motion, block: Block) -> tuple[Motion, Lane, Block]:
        for S, qdd in zip(self.axes, block, strict=True):
            a = a + S * qdd
        return a, 0.0, ()


class CoordinateFactor(NamedTuple):
    """The factors of coordinate k of a flexible link: U = C_k, 1 / D, and the row m_kj of j < k."""

    X: Transform
    U: Force
    inverse_D: Lane
    row: tuple[Lane, ...]

    def inward(
        self, tau: Lane, p_A: Force, block: Block, inertial: Force
    ) -> tuple[Lane, Force, Block]:
        *rest, own = block or (0.0,) * (len(self.row) + 1)
        u = sub(tau, own)
        scaled = mul(u, self.inverse_D)
        left = tuple(add(r, mul(m, scaled)) for r, m in zip(rest, self.row, strict=True))
        return u, p_A + inertial + self.U * scaled, left

    def outward(self, u: Lane, a: Motion, block: Block) -> tuple[Motion, Lane, Block]:
        qdd = mul(sub(sub(u, self.U.dot(a)), inner(self.row, block)), self.inverse_D)
        return a, qdd, (*block, qdd)


AnyFactor = Factor | FrameFactor | CoordinateFactor


class Column(NamedTuple):
    """The inertial coupling of coordinate j of a flexible link.

    Fields:
        C: momentum of the link for a unit rate of the coordinate, about the base frame.
        m: m_ji for each i from 0 to j.
    """

    C: Force
    m: tuple[Lane, ...]


def columns_of_frame(
    axes: Sequence[Motion], X: Transform, I_A: ArticulatedInertia | RigidInertia
) -> tuple[Column, ...]:
    """Compute the columns of the inertia I_A of one frame, at the pose X, with its axes S_j."""
    momenta = [I_A(S) for S in axes]
    return tuple(
        Column(X.T(h), tuple(S.dot(h) for S in axes[: j + 1])) for j, h in enumerate(momenta)
    )


def add_columns(own: LinkInertia, columns: Sequence[Column]) -> tuple[Column, ...]:
    """Add the inertia of a flexible link to the sum of the columns of its frames."""
    of_link = tuple(
        Column(C, tuple(row[: j + 1]))
        for j, (C, row) in enumerate(zip(own.coupling, own.mass, strict=True))
    )
    if not columns:
        return of_link
    return tuple(
        Column(a.C + b.C, tuple(map(add, a.m, b.m))) for a, b in zip(of_link, columns, strict=True)
    )


def eliminate_coordinate(
    armature: Lane, X: Transform, I_A: ArticulatedInertia, columns: Sequence[Column], joint: Any
) -> tuple[ArticulatedInertia, CoordinateFactor, tuple[Column, ...]]:
    """Eliminate the last coordinate of the columns."""
    if not columns:
        raise ModelError(
            f"the flexible link {joint.name!r} has neither frames nor an inertia, so its "
            "coordinates move no mass; give it a density, or a frame with a body of mass"
        )
    *rest, (U, (*row, own)) = columns
    D = add(own, armature)
    if is_zero(D):
        raise ModelError(
            f"a coordinate of the flexible link {joint.name!r} moves no mass, so the mass matrix "
            "is singular; give the link a density, or its frames bodies of mass"
        )
    inverse_D = 1.0 / D
    left = []
    for (C, m), coupled in zip(rest, row, strict=True):
        scaled = mul(coupled, inverse_D)
        entries = tuple(sub(x, mul(scaled, y)) for x, y in zip(m, row[: len(m)], strict=True))
        left.append(Column(C - U * scaled, entries))
    factor = CoordinateFactor(X, U, inverse_D, tuple(row))
    return I_A.less(U, inverse_D), factor, tuple(left)


def name_factors(values: Any) -> Any:
    """Name the arrays of a pytree "factors", for policies of `jax.checkpoint`
    (`rbjax.compiler.jax.saved`)."""
    name = lambda x: checkpoint_name(x, "factors") if isinstance(x, jax.Array) else x  # noqa: E731
    return jax.tree.map(name, values)


def name_link_factors(factors: Any) -> Any:
    """Name U and 1 / D of the factors of all links, and the rows of coordinates, by
    `name_factors`."""

    def one(f: AnyFactor) -> AnyFactor:
        if isinstance(f, FrameFactor):
            return f
        U, inverse_D = name_factors((f.U, f.inverse_D))
        f = f._replace(U=U, inverse_D=inverse_D)
        return f._replace(row=name_factors(f.row)) if isinstance(f, CoordinateFactor) else f

    return jax.tree.map(one, factors, is_leaf=lambda x: isinstance(x, AnyFactor))
