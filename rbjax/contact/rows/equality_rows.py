"""Rows of the equalities: connects, welds and couplings, as soft constraints.

    g'' + R f = -b g' - d k g,      g'' = J x + J' v
so a row of the problem has D = 1 / R and a_ref = -b g' - d k g - J' v. The impedance d of a
constraint depends on the norm of all its residuals g (`rbjax.constraints.Soft`).

Source: MuJoCo, *Computation*, constraint model.
"""

from __future__ import annotations

from rbjax.constraints import Soft
from rbjax.constraints.equations.model_rows import gradient_by_dof, rows_of
from rbjax.constraints.equations.soft_weights import soft_weights
from rbjax.contact.rows.options import Options
from rbjax.contact.rows.scalar_row import EQUALITY, ScalarRow
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.lanes import fusion_barrier, is_zero, sub
from rbjax.model import Model


def check_soft(where: str, model: Model) -> None:
    """Raise InputError if a model has a rigid constraint."""
    rigid = [type(x).__name__ for x in model.constraints if not isinstance(x, Soft)]
    if rigid:
        raise InputError(
            f"{where}: contact='mujoco' solves soft constraints, and {len(rigid)} of "
            f"{len(model.constraints)} constraints of the model are rigid "
            f"({', '.join(dict.fromkeys(rigid))}); make each one soft by rbjax.constraints."
            "Soft.on(model, constraint), load the file by rb.load(contacts=True), which makes its "
            "equalities soft, or leave contacts out by model.replace(contact=None)"
        )


def equality_rows(context: Context, options: Options) -> list[ScalarRow]:
    """Return the rows of all constraints of a model, which are `Soft`."""
    model, dtype = context.model, context.q.dtype
    if not model.constraints:
        return []
    check_soft("the contact problem", model)
    all_rows, out = rows_of(model, context), list[ScalarRow]()
    for k, (constraint, weight) in enumerate(
        zip(model.constraints, soft_weights(model), strict=True)
    ):
        assert isinstance(constraint, Soft)
        rows = [all_rows.pop(0) for _ in range(constraint.size)]
        found = constraint.soft_terms(
            rows, weight, dtype, options.dt, refsafe=options.refsafe, at_the_end=options.discrete
        )
        for row, softness, reference, factor in zip(rows, *found, strict=True):
            J = gradient_by_dof(context, row)
            J = fusion_barrier({i: x for i, x in J.items() if not is_zero(x)})
            a = reference
            if constraint.bias:
                a = sub(a, row.acceleration / factor if options.discrete else row.acceleration)
            out.append(ScalarRow(EQUALITY, J, 1.0 / softness, a, 0.0, ("constraint", k)))
    return out
