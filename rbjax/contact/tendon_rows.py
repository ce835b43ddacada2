"""Rows of the limits and the friction loss of tendons, and their weights.

    lower limit   d = l - lower,  row  J        upper limit   d = upper - l,  row -J
    friction loss                 row  J
with J = dl/dq. A limit acts if d is below its margin. The weight J M^-1 J^T, at the configuration
in which the file draws the robot, scales the regularisation of a row as in MuJoCo
(tendon_invweight0; MuJoCo, *Computation*, constraint model).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.dynamics import inverse_mass_matrix
from rbjax.forces.context import Context
from rbjax.forces.reach import Arms
from rbjax.forces.tendons.lengths import tendon_jacobian
from rbjax.forces.tendons.paths import tendon_reach
from rbjax.lanes import Lane, neg, sub
from rbjax.model import Model
from rbjax.model.leaves import scalar


class TendonRow(NamedTuple):
    """A row of the constraint problem of a tendon.

    Fields:
        tendon: index of the tendon; static.
        arms: the row by dof, without structural zeros.
        speed: J v, m/s.
        distance: distance to the limit, m; 0 for friction loss.
        margin: distance below which a limit acts, m; 0 for friction loss.
        loss: friction loss, N; None for a limit.
        solref, solimp: (2,) and (5,), softness of the row, as in MuJoCo.
    """

    tendon: int
    arms: Arms
    speed: Lane
    distance: Lane
    margin: Lane
    loss: Lane | None
    solref: jax.Array
    solimp: jax.Array


def friction_rows(context: Context) -> list[TendonRow]:
    """Compute the rows of the friction loss of tendons, in the order of the tendons."""
    own, dtype = context.model.tendons, context.q.dtype
    found = []
    for i in () if own is None else own.rubbing:
        reach, loss = tendon_reach(context, i), scalar(own.frictionloss[i], dtype)
        softness = (own.friction_solref[i], own.friction_solimp[i])
        found.append(TendonRow(i, reach.arms, reach.speed(context), 0.0, 0.0, loss, *softness))
    return found


def limit_rows(context: Context) -> list[TendonRow]:
    """Compute the rows of the limits of tendons: of each tendon the lower one, then the upper."""
    own, dtype = context.model.tendons, context.q.dtype
    found = []
    for i in () if own is None else own.limited:
        reach, margin = tendon_reach(context, i), scalar(own.limit_margin[i], dtype)
        speed, low, high = reach.speed(context), *(scalar(own.range[i, k], dtype) for k in (0, 1))
        softness: Any = (None, own.limit_solref[i], own.limit_solimp[i])
        opposite = {n: neg(arm) for n, arm in reach.arms.items()}
        for arms, rate, gap in (
            (reach.arms, speed, sub(reach.length, low)),
            (opposite, neg(speed), sub(high, reach.length)),
        ):
            found.append(TendonRow(i, arms, rate, gap, margin, *softness))
    return found


def tendon_weights(model: Model) -> jax.Array:
    """Compute MuJoCo's tendon_invweight0 (nt,), diag(J M^-1 J^T) in the reference configuration.

    It is a function of the model's leaves: masses, lengths and geoms change it as mj_setConst does.
    """
    q = model.joints.reference
    J, inverse = tendon_jacobian(model, q), inverse_mass_matrix(model, q)
    return (J[:, :, None] * inverse * J[:, None, :]).sum((1, 2)) if J.size else jnp.zeros(len(J))
