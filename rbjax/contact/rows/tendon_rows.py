"""Rows of the limits and the friction loss of tendons, and their weights.

    lower limit   d = l - lower,  row  J        upper limit   d = upper - l,  row -J
    friction loss                 row  J
with J = dl/dq. A limit acts if d is below its margin. The weight J M^-1 J^T, at the configuration
in which the file draws the robot, scales the regularisation of a row as in MuJoCo
(tendon_invweight0; MuJoCo, *Computation*, constraint model).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.contact.contact_rows import Options
from rbjax.contact.rows.scalar_row import ScalarRow, Softness, entry
from rbjax.dynamics import inverse_mass_matrix
from rbjax.dynamics.tracing.custom_rules import is_traced
from rbjax.forces.context import Context
from rbjax.forces.reach import Reach
from rbjax.forces.tendons.lengths import tendon_jacobian
from rbjax.forces.tendons.paths import tendon_reach
from rbjax.lanes import fusion_barrier, neg, sub
from rbjax.model import Model
from rbjax.model.leaves import numbers, table


def has_tendon_rows(model: Model) -> bool:
    """Check whether a tendon of a model has limits or friction loss."""
    own = model.tendons
    return own is not None and bool(own.limited or own.rubbing)


def tendon_rows(context: Context, weights: Any, options: Options) -> list[ScalarRow]:
    """Return the rows of the friction loss of tendons, then of their limits.

    weights: (nt,) inverse inertias of the tendons.
    """
    own, dtype, v = context.model.tendons, context.q.dtype, context.v
    rows: list[ScalarRow] = []
    if own is None:
        return rows
    for i in own.rubbing:
        tables = own.friction_solref, own.friction_solimp
        softness = Softness.of(entry(weights, i, dtype), *tables, i, dtype)
        J, floss = _reach(context, i).arms, entry(own.frictionloss, i, dtype)
        rows.append(ScalarRow.friction(J, floss, v, softness, options, ("tendon", i)))
    for i in own.limited:
        tables = own.limit_solref, own.limit_solimp
        softness = Softness.of(entry(weights, i, dtype), *tables, i, dtype)
        length, J = _reach(context, i)
        low, high = numbers(table(own.range, dtype)[i], dtype)
        margin = entry(own.limit_margin, i, dtype)
        opposite = {n: neg(x) for n, x in J.items()}
        for arms, distance in ((J, sub(length, low)), (opposite, sub(high, length))):
            given = arms, distance, margin, v, softness, options, ("tendon", i)
            rows.append(ScalarRow.limit(*given))
    return rows


def _reach(context: Context, i: int) -> Reach:
    """Return length and moment arms of a tendon behind a fusion barrier, because XLA would compute
    them again in each loop of the solver."""
    length, arms = tendon_reach(context, i)
    return Reach(*fusion_barrier((length, arms)))


def tendon_weights(model: Model) -> Any:
    """Compute MuJoCo's tendon_invweight0 (nt,), diag(J M^-1 J^T) in the reference configuration.

    It is a function of the model's leaves: masses, lengths and geoms change it as mj_setConst does.
    It is a NumPy array if the model is constant while tracing.
    """
    if is_traced(model):
        return _weights(model)
    with jax.ensure_compile_time_eval():
        return np.asarray(_weights(model), np.float64)


def _weights(model: Model) -> jax.Array:
    q = model.joints.reference
    J, inverse = tendon_jacobian(model, q), inverse_mass_matrix(model, q)
    return (J[:, :, None] * inverse * J[:, None, :]).sum((1, 2)) if J.size else jnp.zeros(len(J))
