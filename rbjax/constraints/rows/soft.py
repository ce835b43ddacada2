"""A constraint that is soft: its rows have an impedance, as MuJoCo's equalities.

    g'' + R f = -b g' - d k g
with the impedance d, the stiffness k and the damping b of `rbjax.forces.impedance`.

Source: MuJoCo, *Computation*, constraint model, parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike
from rbjax.constraints.rows.row import Constraint, Row
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.forces.impedance import end_of_step, impedance, reference, regularisation
from rbjax.lanes import Lane, inner, safe_sqrt
from rbjax.model import Model
from rbjax.model.leaves import numbers
from rbjax.model.record import check_fields, floats
from rbjax.model.solver_parameters import SOLIMP, SOLREF


def _optional(x: Any) -> Any:
    return None if x is None else floats(x)


class Soft(Constraint):
    """A constraint that is soft in the formulation "compliant", and rigid in other formulations.

    Fields:
        of: the constraint to make soft.
        solref: (2,) (time constant s, damping ratio) or (-stiffness 1/s^2, -damping 1/s).
        solimp: (5,) impedances d_0 and d_w, width in the unit of the rows, midpoint m, power p.
        weight: (rows,) inverse inertias of the rows. None: they follow from the masses of the
            model (`rbjax.constraints.equations.soft_weights`).
        at: (nq,) configuration of these inverse inertias. None: the one of the file, with MuJoCo's
            estimate for pairs of bodies and couplings.
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
    weight: jax.Array | None = eqx.field(converter=_optional, default=None)
    at: jax.Array | None = eqx.field(converter=_optional, default=None)
    bias: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        if not isinstance(self.of, Constraint) or isinstance(self.of, Soft):
            raise InputError(
                f"Soft(of=...): got {type(self.of).__name__}, expected a Constraint that is not "
                "soft already"
            )
        check_fields(self)
        for name, due in {"solref": (2,), "solimp": (5,), "weight": (self.of.size,)}.items():
            if getattr(self, name) is not None and jnp.shape(getattr(self, name)) != due:
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
        q: ArrayLike | None = None,
    ) -> Soft:
        """Make a constraint soft, with weights diag(G M^-1 G^T) at a configuration, which follow
        the masses of the model.

        Args:
            model: the robot.
            of: the constraint.
            solref, solimp: MuJoCo's parameters, as in the fields of `Soft`.
            q: (nq,) configuration; None for the model's default state.
        """
        return cls(of, solref, solimp, at=model.default_state().q if q is None else q)

    @property
    def size(self) -> int:
        return self.of.size

    def rows(self, context: Context) -> Sequence[Row]:
        return self.of.rows(context)

    def soft_terms(
        self, rows: Sequence[Row], weight: Any, dtype: Any, dt: Any = 0.0,
        *, refsafe: bool = False, at_the_end: bool = False,
    ) -> tuple[list[Lane], list[Lane], list[Lane]]:  # fmt: skip
        """Compute R, the right-hand side, and the divisor F of the soft row equations
        g'' / F + R f = -b g' - d k g. F is 1 unless they hold at the end of a step.

        weight: (rows,) inverse inertias.
        refsafe: whether the time constant is at least two steps dt.
        at_the_end: whether the spring and the damper of a row act at the end of a step.
        """
        own = self.solref, self.solimp, weight
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
    return safe_sqrt(inner(g, g))
