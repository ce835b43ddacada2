"""Rows of the limits, the friction loss and the armature of tendons.

    lower limit   d = l - lower,  row  J        upper limit   d = upper - l,  row -J
    friction loss                 row  J
with J = dl/dq. A limit acts if d is below its margin (MuJoCo, *Computation*, constraint model).

The armature m of a tendon adds the energy m l'^2 / 2. Its force is -m (J a + J' v) along J, as that
of an equality with the inverse regularization m and the reference acceleration -J' v.
"""

from __future__ import annotations

from typing import Any

from rbjax.constraints.equations.model_rows import gradient_by_dof
from rbjax.constraints.rows.tendons import tendon_row
from rbjax.contact.rows.options import Options
from rbjax.contact.rows.scalar_row import EQUALITY, ScalarRow, Softness, entry
from rbjax.forces.context import Context
from rbjax.forces.reach import Reach
from rbjax.forces.tendons.paths import tendon_reach
from rbjax.lanes import Lane, fusion_barrier, is_zero, neg, sub
from rbjax.model.leaves import numbers, table


def tendon_rows(context: Context, weights: Any, options: Options) -> list[ScalarRow]:
    """Return the rows of the friction loss of tendons, then of their limits and armatures.

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
        margin = entry(own.limit_margin, i, dtype)
        for distance, arms in tendon_limits(context, i):
            given = arms, distance, margin, v, softness, options, ("tendon", i)
            rows.append(ScalarRow.limit(*given))
    return rows + [_inertia(context, i) for i in own.inertial]


def _inertia(context: Context, i: int) -> ScalarRow:
    """Return the row of the armature of a tendon."""
    own: Any = context.model.tendons
    row = tendon_row(context, i)
    J = {n: x for n, x in gradient_by_dof(context, row).items() if not is_zero(x)}
    J, a = fusion_barrier((J, neg(row.acceleration)))
    return ScalarRow(EQUALITY, J, entry(own.armature, i, context.q.dtype), a, 0.0, ("tendon", i))


def tendon_limits(context: Context, i: int) -> list[tuple[Lane, dict[int, Lane]]]:
    """Compute the distance of a tendon to each of its limits, and the gradient of the distance."""
    own: Any = context.model.tendons
    length, J = _reach(context, i)
    low, high = numbers(table(own.range, context.q.dtype)[i], context.q.dtype)
    opposite = {n: neg(x) for n, x in J.items()}
    return [(sub(length, low), {**J}), (sub(high, length), opposite)]


def _reach(context: Context, i: int) -> Reach:
    """Return length and moment arms of a tendon behind a fusion barrier, because XLA would compute
    them again in each loop of the solver."""
    length, arms = tendon_reach(context, i)
    return Reach(*fusion_barrier((length, arms)))
