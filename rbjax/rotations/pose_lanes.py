"""Poses, twists and 6 by 6 blocks on lanes."""

from __future__ import annotations

from collections.abc import Callable

import jax

from rbjax.lanes import Mat3, Vec3
from rbjax.rotations.arguments import stacked


def pose_of(R, p) -> jax.Array:
    """Assemble the pose [R p; 0 1] (..., 4, 4)."""
    return with_last_row(R, p, 1.0)


def with_last_row(R, p, corner: float) -> jax.Array:
    """Assemble [R p; 0 corner] (..., 4, 4)."""
    r, p = list(R), list(p)
    return stacked([*r[0:3], p[0], *r[3:6], p[1], *r[6:9], p[2], 0.0, 0.0, 0.0, corner], 4, 4)


def halves(xi: list) -> tuple[Vec3, Vec3]:
    """Return the angular and the linear part of a twist."""
    return Vec3(*xi[:3]), Vec3(*xi[3:])


def skew_part(W: Mat3) -> Vec3:
    """Return the vector of the skew-symmetric part of a matrix."""
    return 0.5 * Vec3(W[7] - W[5], W[2] - W[6], W[3] - W[1])


def lower_blocks(A: list, B: list) -> jax.Array:
    """Assemble the block matrix [[A, 0], [B, A]] (..., 6, 6)."""
    rows = [[*A[3 * i : 3 * i + 3], 0.0, 0.0, 0.0] for i in range(3)]
    rows += [[*B[3 * i : 3 * i + 3], *A[3 * i : 3 * i + 3]] for i in range(3)]
    return stacked([x for row in rows for x in row], 6, 6)


def dual_jacobian(J: Callable[[list], list], xi: list) -> jax.Array:
    """Compute the 6 by 6 Jacobian [[J, 0], [Q, J]] of xi = (phi, rho) from the Jacobian J of SO(3).
    Q is the derivative of J at phi along rho."""
    return lower_blocks(*jax.jvp(J, (xi[:3],), (xi[3:],)))
