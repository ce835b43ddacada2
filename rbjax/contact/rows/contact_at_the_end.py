"""The rows of a contact whose spring and damper act at the end of a step, for `discrete`.

Source: MuJoCo, *Computation*, numerical integration.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.forces.impedance import end_of_step
from rbjax.lanes import Lane, unpack
from rbjax.spatial import ArticulatedInertia, Motion


def contact_at_the_end(
    r: Lane, v: Sequence[Lane], d: Lane, weight: Lane, solref: Sequence[Lane],
    sliding: Sequence[Lane] | None, solimp: Sequence[Lane], mu: Sequence[Lane], impratio: Lane,
    dt: Any, resolve: bool,
) -> tuple[Lane, list[Lane]]:  # fmt: skip
    """Compute the inverse regularization and the reference accelerations of the rows of a contact.

    Args:
        r: distance less margin, m.
        v: velocity of each row.
        d, weight: impedance and inverse inertia.
        solref, solimp: as in MuJoCo.
        sliding: solref of the tangents of an elliptic cone; None for a pyramid.
        mu: friction coefficients of the other rows.
        impratio: impedance of friction over the impedance of the normal row.
        resolve: as in `end_of_step`.
    """
    if mu and sliding is None:
        weight = weight * (1.0 + mu[0] * mu[0]) * (2.0 * mu[0] * mu[0] / impratio)
    normal = end_of_step(d, weight, solref, solimp, dt, resolve=resolve)
    tangents = normal
    if sliding is not None:
        tangents = end_of_step(d, weight, sliding, solimp, dt, spring=False)
    return 1.0 / normal.R, [normal.reference(r, v[0]), *(tangents.reference(0.0, x) for x in v[1:])]


def stretch(axis: Motion, responses: jax.Array) -> Lane:
    """Compute the ratio sum J_j^2 / m_j over sum J_j^2 / m'_j of the first row of a contact.

    axis: unit motion of the row: the normal, or the first edge of a pyramid.
    responses: (2, 21) sums of S_j S_j^T / m_j and S_j S_j^T / m'_j, with the diagonals of the mass
        matrix and of the matrix of the solver.
    """
    own, solver = (axis.dot(ArticulatedInertia.from_lanes(unpack(x))(axis)) for x in responses)
    some = own > 0
    return jnp.where(some, own / jnp.where(some, solver, 1.0), 1.0)
