"""The kinds of constraints, the formulations, and which one enforces those of a model."""

from __future__ import annotations

from typing import Any

from rbjax.constraints.formulation import (
    Baumgarte,
    Formulation,
    Projection,
    TangentSpace,
    as_formulation,
)
from rbjax.constraints.methods.compliant import Compliant
from rbjax.constraints.methods.differential_algebraic import GGL, Index2, Index3
from rbjax.constraints.methods.method import Method
from rbjax.constraints.methods.minimal import NullSpaceQR, NullSpaceSVD, Partitioning
from rbjax.constraints.methods.recursive import Recursive
from rbjax.constraints.methods.redundant import KKT
from rbjax.constraints.methods.soft import QuaternionWeld, Soft, is_soft
from rbjax.constraints.methods.unconstrained import (
    AugmentedLagrangian,
    ForceProjection,
    Penalty,
    UdwadiaKalaba,
)
from rbjax.constraints.rows import couplings, curve, functions, pairs, rolling
from rbjax.constraints.rows.constraint import Constraint
from rbjax.errors import InputError, UnknownName
from rbjax.model import Model

DEFAULT = Formulation(projection=Projection())
#: methods that stand in the registry with neither feedback nor projection
METHODS: tuple[Method, ...] = (
    KKT(), NullSpaceQR(), NullSpaceSVD(), Partitioning(), Recursive(), UdwadiaKalaba(),
    ForceProjection(), AugmentedLagrangian(), Penalty(), Index2(), Index3(), GGL(),
)  # fmt: skip
_FORMULATIONS: dict[str, Formulation] = {
    "projected": DEFAULT,
    "multipliers": Formulation(),
    "baumgarte": Formulation(feedback=Baumgarte()),
    "tangent_space": Formulation(projection=TangentSpace()),
    **{method.name: Formulation(method) for method in METHODS},
    "compliant": Formulation(Compliant(), projection=Projection()),
}


def formulations() -> dict[str, Formulation]:
    """List formulations by name: each method, and the usual feedback and projections.

    | name | method | family | index | equation |
    |---|---|---|---|---|
    | projected | multipliers | redundant | 1 | with a projection after each step (the default) |
    | multipliers | multipliers | redundant | 1 | A l = c - G a_f by the factors of ABA |
    | baumgarte | multipliers | redundant | 1 | with feedback of the residual |
    | tangent_space | multipliers | minimal | 0 | with a projection at each stage |
    | kkt | kkt | redundant | 1 | a and l at once |
    | null_space_qr | the same | minimal | 0 | a = L c + Z z, Z of a pivoted QR |
    | null_space_svd | the same | minimal | 0 | Z of singular values |
    | partitioning | the same | minimal | 0 | z some of the velocities |
    | recursive | the same | minimal | 0 | multipliers, loop by loop along the tree |
    | udwadia_kalaba | the same | unconstrained | 0 | the least change of a_f |
    | force_projection | the same | unconstrained | 0 | forces without their part along the rows |
    | augmented_lagrangian | the same | unconstrained | 0 | penalties on accelerations, iterated |
    | penalty | the same | unconstrained | 0 | stiff springs: an approximation |
    | index_2 | the same | redundant | 2 | G v + g_t = 0 at the stages of implicit methods |
    | index_3 | the same | redundant | 3 | g = 0 at these stages |
    | ggl | the same | redundant | 2 | both, the second by a multiplier of positions |
    | compliant | the same | unconstrained | 0 | soft rows by MuJoCo's law, others projected |

    Any method combines with any feedback and projection: `Formulation(KKT(), Baumgarte(),
    Projection())`. The methods from "kkt" to "augmented_lagrangian", without "recursive", work on
    arrays, at a cost of nv and rows cubed; they are for comparison and small mechanisms. All but
    "penalty" and "compliant" give the same accelerations, "augmented_lagrangian" to 1e-5 of its
    correction; "compliant" is the default of models with a `Soft`.

    Example:
        >>> import rbjax as rb
        >>> rb.constraints.formulations()["baumgarte"].index
        1
    """
    return dict(_FORMULATIONS)


def kinds() -> dict[str, type[Constraint]]:
    """The kinds of constraints that come with rbjax, by name.

    Example:
        >>> import rbjax as rb
        >>> rb.constraints.kinds()["Weld"].size
        6
    """
    rooms = pairs, couplings, curve, functions, rolling
    every = (x for room in rooms for x in vars(room).values() if isinstance(x, type))
    bases = Constraint, pairs.Pair, pairs.HalfAngle, rolling.Rolling
    found = {x.__name__: x for x in every if issubclass(x, Constraint) and x not in bases}
    return found | {x.__name__: x for x in (QuaternionWeld, Soft)}


def formulation_of(where: str, model: Model, given: Any) -> Formulation | None:
    """The formulation that enforces the model's constraints; None where it has none. `given`: a
    name, a `Formulation` or one of its factors, or None for the default."""
    if not model.constraints:
        if given is not None:
            raise InputError(
                f"{where}: constraints={given!r}, and the model has none; "
                "model.with_constraints(...) adds some"
            )
        return None
    if given is None:
        return _FORMULATIONS["compliant"] if is_soft(model) else DEFAULT
    found = as_formulation(given)
    if found is not None:
        return found
    if isinstance(given, str) and given in _FORMULATIONS:
        return _FORMULATIONS[given]
    raise UnknownName("formulation", given, _FORMULATIONS)
