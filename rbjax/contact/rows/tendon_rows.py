"""Rows of the limits and the friction loss of tendons.

    lower limit   d = l - lower,  row  J        upper limit   d = upper - l,  row -J
    friction loss                 row  J
with J = dl/dq. A limit acts if d is below its margin (MuJoCo, *Computation*, constraint model).
"""

from __future__ import annotations

from typing import Any

from rbjax.contact.rows.options import Options
from rbjax.contact.rows.scalar_row import ScalarRow, Softness, entry
from rbjax.forces.context import Context
from rbjax.forces.reach import Reach
from rbjax.forces.tendons.paths import tendon_reach
from rbjax.lanes import Lane, fusion_barrier, neg, sub
from rbjax.model.leaves import numbers, table


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
        margin = entry(own.limit_margin, i, dtype)
        for distance, arms in tendon_limits(context, i):
            given = arms, distance, margin, v, softness, options, ("tendon", i)
            rows.append(ScalarRow.limit(*given))
    return rows


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
