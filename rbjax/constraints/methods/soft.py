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

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints.equations.constrained_motion import (
    DelassusMatrix,
    LinearProblem,
    Solve,
    baumgarte_residual,
    constrained_motion,
)
from rbjax.constraints.equations.model_rows import gradient_matrix, jacobian
from rbjax.constraints.methods.method import Method
from rbjax.constraints.rows.row import Constraint, Row
from rbjax.dynamics.algorithms.aba import aba
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.rnea import LinkForces
from rbjax.dynamics.drivers.choice import Driver
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.forces.impedance import end_of_step, impedance, reference, regularisation
from rbjax.lanes import Lane, inner, is_literal, sub
from rbjax.lanes.arrays import matvec, pack
from rbjax.model import Model, State
from rbjax.model.leaves import numbers
from rbjax.model.record import check_fields, floats
from rbjax.model.solver_parameters import SOLIMP, SOLREF


class Soft(Constraint):
    """A constraint that is soft in the formulation "compliant", and rigid in other formulations.

    Fields:
        of: the constraint to make soft.
        solref: (2,) (time constant s, damping ratio) or (-stiffness 1/s^2, -damping 1/s).
        solimp: (5,) impedances d_0 and d_w, width in the unit of the rows, midpoint m, power p.
        weight: (rows,) inverse inertias of the rows.
        bias: static, whether g'' includes G' v.

    Source: MuJoCo, *Computation*, constraint model, parameters.

    Example:
        >>> import rbjax as rb
        >>> from rbjax import constraints as rc
        >>> model = rb.load("double_pendulum")
        >>> tip = rc.Inplane.between(model, None, "lower", point=[0.0, 0.0, 1.2])
        >>> model = model.with_constraints(rc.Soft.on(model, tip, solref=(0.01, 1.0)))
        >>> path = rb.rollout(model, model.default_state(), None, 1e-3, steps=9)
    """

    of: Constraint
    solref: jax.Array = eqx.field(converter=floats)
    solimp: jax.Array = eqx.field(converter=floats)
    weight: jax.Array = eqx.field(converter=floats)
    bias: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        if not isinstance(self.of, Constraint) or isinstance(self.of, Soft):
            raise InputError(
                f"Soft(of=...): got {type(self.of).__name__}, expected a Constraint that is not "
                "soft already"
            )
        check_fields(self)
        for name, due in {"solref": (2,), "solimp": (5,), "weight": (self.of.size,)}.items():
            if jnp.shape(getattr(self, name)) != due:
                raise InputError(
                    f"Soft({name}=...): got the shape {jnp.shape(getattr(self, name))}, "
                    f"expected {due}"
                )
        if not isinstance(self.solref, jax.core.Tracer):
            first, second = np.asarray(self.solref)
            if (first > 0) != (second > 0):
                raise InputError(
                    f"Soft(solref=...): got {[float(first), float(second)]}, expected two numbers "
                    "above zero (time constant, damping ratio), or none (-stiffness, -damping)"
                )

    @classmethod
    def on(
        cls,
        model: Model,
        of: Constraint,
        solref: Any = SOLREF,
        solimp: Any = SOLIMP,
        q: jax.Array | None = None,
    ) -> Soft:
        """Make a constraint soft, with weights diag(G M^-1 G^T) at a configuration.

        Args:
            model: the robot.
            of: the constraint.
            solref, solimp: MuJoCo's parameters, as in the fields of `Soft`.
            q: (nq,) configuration; None for the model's default state.
        """
        q = model.default_state().q if q is None else q
        G = jacobian(model.replace(constraints=(of,)), q)
        weight = (G * jnp.linalg.solve(mass_matrix(model, q), G.T).T).sum(-1)
        return cls(of, solref, solimp, weight)

    @property
    def size(self) -> int:
        return self.of.size

    def rows(self, context: Context) -> Sequence[Row]:
        return self.of.rows(context)

    def soft_terms(
        self, rows: Sequence[Row], dtype: Any, dt: Any = 0.0,
        *, refsafe: bool = False, at_the_end: bool = False,
    ) -> tuple[list[Lane], list[Lane], list[Lane]]:  # fmt: skip
        """Compute R, the right-hand side, and the divisor F of the soft row equations
        g'' / F + R f = -b g' - d k g. F is 1 unless they hold at the end of a step.

        refsafe: whether the time constant is at least two steps dt.
        at_the_end: whether the spring and the damper of a row act at the end of a step.
        """
        own = self.solref, self.solimp, self.weight
        solref, solimp, weight = (numbers(x, dtype) for x in own)
        d = impedance(_norm([row.residual for row in rows]), solimp)

        def right_hand_side(row: Row) -> Lane:
            g = row.residual
            return reference(g, row.rate, d, solref, solimp, dt, refsafe=refsafe)

        if at_the_end:
            found = [end_of_step(d, w, solref, solimp, dt) for w in weight]
            pairs = zip(rows, found, strict=True)
            right = [x.reference(row.residual, row.rate) for row, x in pairs]
            return [x.R for x in found], right, [x.factor for x in found]
        right = [right_hand_side(row) for row in rows]
        return [regularisation(d, w) for w in weight], right, [1.0] * len(right)


def is_soft(model: Model) -> bool:
    """Return whether a model has a `Soft` constraint."""
    return any(isinstance(x, Soft) for x in model.constraints)


def _norm(g: Sequence[Lane]) -> Lane:
    """Return the norm |g| of several residuals, with a zero derivative at g = 0. A single residual
    is returned with its sign."""
    if len(g) == 1:
        return g[0]
    square = inner(g, g)
    if is_literal(square):
        return math.sqrt(square)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def regularizer_and_residual(
    context: Context, rows: Sequence[Row], alpha: Any = 0.0, beta: Any = 0.0
) -> tuple[jax.Array, jax.Array]:
    """Compute R (rows,) and the residual of the rows' equations at f = 0. R is zero for rigid rows.
    The residual (rows,) is at the accelerations of the context, with Baumgarte's feedback of rigid
    rows."""
    R: list[Any] = []
    residual: list[Any] = []
    a = context.a
    without_bias = matvec(gradient_matrix(context, rows), a)
    for constraint in context.model.constraints:
        at = slice(len(R), len(R) + constraint.size)
        if isinstance(constraint, Soft):
            own, right, _ = constraint.soft_terms(rows[at], a.dtype)
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
