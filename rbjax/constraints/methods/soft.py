"""Soft constraints by MuJoCo's model, and the method that solves them together with rigid ones.

    M a + b = tau + sum of J_i^T f_i + G^T f
    g'' + R f = -b g' - d k g     of soft rows,      R = (1 - d) / d w
    g'' = 0                       of rigid rows,     R = 0
so (A + R) f = (right-hand side) - g''(a_0). f is the force on a row, w its inverse inertia, and d
its impedance, from 0 to 1, a function of the residual |g| of the constraint. k, b and d follow from
solref and solimp (`rbjax.forces.impedance`). The distance to the rigid motion decreases as T^2,
with the time constant T.

MuJoCo 4 includes G' v in connects and welds, but not in couplings of joints; MJX neglects it.

Source: MuJoCo, *Computation*, constraint model; Todorov 2014.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax

from rbjax.constraints.equations.constrained_motion import (
    DelassusMatrix,
    LinearProblem,
    Solve,
    baumgarte_residual,
    constrained_motion,
)
from rbjax.constraints.equations.model_rows import gradient_matrix
from rbjax.constraints.equations.soft_weights import soft_weights
from rbjax.constraints.methods.method import Method
from rbjax.constraints.rows.row import Row
from rbjax.constraints.rows.soft import Soft
from rbjax.dynamics.algorithms.aba import aba
from rbjax.dynamics.algorithms.rnea import LinkForces
from rbjax.dynamics.drivers.choice import Driver
from rbjax.forces.context import Context
from rbjax.lanes import Lane, sub
from rbjax.lanes.arrays import matvec, pack
from rbjax.model import Model, State


def regularizer_and_residual(
    context: Context, rows: Sequence[Row], alpha: Any = 0.0, beta: Any = 0.0
) -> tuple[jax.Array, jax.Array]:
    """Compute R (rows,) and the residual of the rows' equations at f = 0. R is zero for rigid rows.
    The residual (rows,) is at the accelerations of the context, with Baumgarte's feedback of rigid
    rows."""
    R: list[Any] = []
    residual: list[Any] = []
    weights = soft_weights(context.model)
    a = context.a
    without_bias = matvec(gradient_matrix(context, rows), a)
    for constraint, weight in zip(context.model.constraints, weights, strict=True):
        at = slice(len(R), len(R) + constraint.size)
        if isinstance(constraint, Soft):
            own, right, _ = constraint.soft_terms(rows[at], weight, a.dtype)
            R += own
            bias = [row.acceleration for row in rows[at]]
            left = bias if constraint.bias else list(without_bias[at])
            residual += [sub(x, y) for x, y in zip(right, left, strict=True)]
        else:
            R += [0.0] * constraint.size
            residual += [baumgarte_residual(row, alpha, beta) for row in rows[at]]
    return pack(R, a), pack(residual, a)


@dataclass(frozen=True)
class Compliant(Method):
    """MuJoCo's soft constraints: index 0 for soft rows, index 1 for rigid rows.

    Feedback and projection apply to rigid rows only. An explicit step must be well below the time
    constant T. The formulation "compliant" is this method with a projection. It is the default
    formulation of models with a `Soft` constraint.

    Source: MuJoCo, *Computation*, constraint model.
    """

    name: ClassVar[str] = "compliant"
    family: ClassVar[str] = "unconstrained"
    index: ClassVar[int] = 0

    def __call__(self, model, t, state, tau, f_ext, alpha=0.0, beta=0.0):
        return compliant_motion(model, t, state, tau, f_ext, alpha, beta)[0]

    def projected_rows(self, model: Model) -> Model:
        rigid = tuple(x for x in model.constraints if not isinstance(x, Soft))
        return model.replace(constraints=rigid)


def compliant_motion(
    model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces,
    alpha: Any = 0.0, beta: Any = 0.0,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """Compute the accelerations a (nv,) and the forces f (rows,) on the rows."""
    method, residual = soft_problem, soft_right_hand_side
    return constrained_motion(model, t, state, tau, f_ext, alpha, beta, method, residual)


def soft_problem(d: Driver, context: Context, tau: jax.Array, f_ext: LinkForces) -> LinearProblem:
    """Set up the equations (G M^-1 G^T + R) df = residual, starting from the free acceleration."""
    qdd, factors = aba(d, context.links.joints, d.lanes(tau), d.prepared.gravity, f_ext)

    def factor(context: Context, rows: Sequence[Row]) -> Solve:
        R, _ = regularizer_and_residual(context, rows)
        return DelassusMatrix(d, factors, context, rows, R=R).solve

    return LinearProblem(d.pack(qdd, tau), None, factor)


def soft_right_hand_side(
    context: Context, rows: Sequence[Row], f: jax.Array | None, alpha: Any, beta: Any
) -> Sequence[Lane]:
    """Return the residual of the rows' equations at the forces f on the rows; None for zero."""
    R, residual = regularizer_and_residual(context, rows, alpha, beta)
    return list(residual if f is None else residual - R * f)
