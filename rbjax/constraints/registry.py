"""The kinds of constraints, the formulations, and which one enforces those of a model."""

from __future__ import annotations

from typing import Any

from rbjax.constraints.methods.compliant import Compliant
from rbjax.constraints.methods.differential_algebraic import GGL, Index2, Index3
from rbjax.constraints.methods.formulation import Baumgarte, Formulation, Multipliers, Projected
from rbjax.constraints.methods.minimal import NullSpaceQR, NullSpaceSVD, Partitioning
from rbjax.constraints.methods.recursive import Recursive
from rbjax.constraints.methods.redundant import KKT
from rbjax.constraints.methods.soft import QuaternionWeld, Soft, is_soft
from rbjax.constraints.methods.tangent import TangentSpace
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

DEFAULT = Projected()
_ALL: tuple[Formulation, ...] = (
    DEFAULT, Multipliers(), Baumgarte(), KKT(),
    NullSpaceQR(), NullSpaceSVD(), Partitioning(), TangentSpace(), Recursive(),
    UdwadiaKalaba(), ForceProjection(), AugmentedLagrangian(), Penalty(), Compliant(),
    Index2(), Index3(), GGL(),
)  # fmt: skip
_FORMULATIONS: dict[str, Formulation] = {f.name: f for f in _ALL}


def formulations() -> dict[str, Formulation]:
    """The formulations by name, each with its `family` and `index`.

    | name | family | index | what it solves |
    |---|---|---|---|
    | projected | of another | of another | another's; puts states back after steps (default) |
    | multipliers | redundant | 1 | A l = c - G a_f by the factors of ABA |
    | baumgarte | redundant | 1 | the same, with feedback of the residual |
    | kkt | redundant | 1 | a and l at once |
    | null_space_qr | minimal | 0 | a = L c + Z z, Z of a pivoted QR |
    | null_space_svd | minimal | 0 | the same, Z of singular values |
    | partitioning | minimal | 0 | the same, z some of the velocities |
    | recursive | minimal | 0 | those of multipliers, loop by loop along the tree |
    | tangent_space | minimal | 0 | another's, at stages on the constraints |
    | udwadia_kalaba | unconstrained | 0 | the least change of a_f |
    | force_projection | unconstrained | 0 | forces without their part along the rows |
    | augmented_lagrangian | unconstrained | 0 | penalties on accelerations, iterated |
    | penalty | unconstrained | 0 | stiff springs: an approximation |
    | index_2 | redundant | 2 | G v + g_t = 0 at the stages of implicit methods |
    | index_3 | redundant | 3 | g = 0 there |
    | ggl | redundant | 2 | both, the second by a multiplier of positions |
    | compliant | unconstrained | 0 | rows that yield as MuJoCo's (`Soft`) and others |

    Those from "kkt" to "augmented_lagrangian" work on arrays, of nv and rows cubed; they are for
    comparison and small mechanisms. All but "penalty" and
    "compliant" give the same accelerations; "compliant" is the default of models with a `Soft`.

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
    name, a `Formulation`, or None for the default."""
    if not model.constraints:
        if given is not None:
            raise InputError(
                f"{where}: constraints={given!r}, and the model has none; "
                "model.with_constraints(...) adds some"
            )
        return None
    if given is None:
        return _FORMULATIONS["compliant"] if is_soft(model) else DEFAULT
    if isinstance(given, Formulation):
        return given
    if isinstance(given, str) and given in _FORMULATIONS:
        return _FORMULATIONS[given]
    raise UnknownName("formulation", given, _FORMULATIONS)
