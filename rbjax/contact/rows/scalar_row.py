"""A row of the contact problem with one force: a limit, a friction loss or an equality.

The residual of a row is r = J x - a_ref. Its force f = -ds/dr and Hessian h = d2s/dr2 are

    equality        s = D r^2 / 2
    limit           s = D r^2 / 2 for r < 0, else 0
    friction loss   s = D r^2 / 2 for |r| <= floss / D, else linear with the slope +-floss

(MuJoCo, *Computation*, "Constraint model").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from rbjax.contact.rows.options import Options
from rbjax.forces.impedance import end_of_step, impedance, reference, regularisation
from rbjax.lanes import Lane, inner, mul, neg, sub, total
from rbjax.model.leaves import numbers, table
from rbjax.model.links import lane

EQUALITY, LIMIT, FRICTION = "equality", "limit", "friction loss"


class Softness(NamedTuple):
    """Parameters of the regularization of a row.

    Fields:
        weight: the inverse inertia of the row.
        solref: two lanes, the reference, as in MuJoCo.
        solimp: five lanes, the impedance, as in MuJoCo.
    """

    weight: Lane
    solref: list[Lane]
    solimp: list[Lane]

    @classmethod
    def of(cls, weight: Lane, solref: Any, solimp: Any, i: int, dtype: Any) -> Softness:
        """Return row i of the tables solref (n, 2) and solimp (n, 5)."""
        return cls(weight, *(numbers(table(x, dtype)[i], dtype) for x in (solref, solimp)))

    def terms(
        self, r: Lane, rate: Lane, options: Options, *, spring: bool = True
    ) -> tuple[Lane, Lane]:
        """Compute the inverse regularization and the reference acceleration of a row.

        r: residual of the position. rate: its rate. spring: whether the row has a stiffness.
        """
        d, (dt, refsafe) = impedance(r, self.solimp), (options.dt, options.refsafe)
        if options.discrete:
            given = d, self.weight, self.solref, self.solimp, dt
            found = end_of_step(*given, spring=spring, resolve=refsafe)
            return 1.0 / found.R, found.reference(r, rate)
        a = reference(r, rate, d, self.solref, self.solimp, dt, refsafe=refsafe)
        return 1.0 / regularisation(d, self.weight), a


class ScalarRow(NamedTuple):
    """A row of the problem with one force.

    Fields:
        kind: EQUALITY, LIMIT or FRICTION.
        J: dof -> coefficient.
        D: the inverse regularization; 0 if the row is not active.
        reference: the reference acceleration a_ref.
        floss: the friction loss.
        source: "joint", "dof", "tendon" or "constraint", and its index in the model.
    """

    kind: str
    J: Mapping[int, Lane]
    D: Lane
    reference: Lane
    floss: Lane = 0.0
    source: tuple[str, int] = ("dof", 0)

    @classmethod
    def limit(
        cls, J: Mapping[int, Lane], distance: Lane, margin: Lane, v: Any, softness: Softness,
        options: Options, source: tuple[str, int],
    ) -> ScalarRow:  # fmt: skip
        """Return the row of a limit, which acts if the distance to it is below the margin.

        J: gradient of the distance.
        """
        active = distance < margin
        r = jnp.where(active, sub(distance, margin), 0.0)
        D, a = softness.terms(r, _along(J, v), options)
        return cls(LIMIT, J, jnp.where(active, D, 0.0), a, 0.0, source)

    @classmethod
    def friction(
        cls, J: Mapping[int, Lane], floss: Lane, v: Any, softness: Softness, options: Options,
        source: tuple[str, int],
    ) -> ScalarRow:  # fmt: skip
        """Return the row of a friction loss, which opposes the rate J v."""
        D, a = softness.terms(0.0, _along(J, v), options, spring=False)
        return cls(FRICTION, J, D, a, floss, source)

    def along(self, x: list[Lane]) -> Lane:
        """Compute J x, the acceleration along the row, from the lanes x of all dofs."""
        return _along(self.J, x)

    def stretched(self, own: Sequence[Lane], solver: Sequence[Lane]) -> ScalarRow:
        """Return the row with D times sum J_j^2 / m_j over sum J_j^2 / m'_j.

        own, solver: the inverse diagonals of the mass matrix and of the matrix of the solver.
        """
        squares = {i: mul(x, x) for i, x in self.J.items()}
        a, b = (total(mul(x, m[i]) for i, x in squares.items()) for m in (own, solver))
        some = a > 0
        return self._replace(D=mul(self.D, jnp.where(some, a / jnp.where(some, b, 1.0), 1.0)))

    def response(self, r: Lane) -> tuple[Lane, Lane]:
        """Compute the force and the Hessian of the cost at a residual r = J x - a_ref."""
        push = neg(mul(self.D, r))
        if self.kind == EQUALITY:
            return push, self.D
        if self.kind == LIMIT:
            active = r < 0
            return jnp.where(active, push, 0.0), jnp.where(active, self.D, 0.0)
        sticks = jnp.abs(push) <= self.floss
        return jnp.clip(push, -self.floss, self.floss), jnp.where(sticks, self.D, 0.0)


def _along(J: Mapping[int, Lane], x: Any) -> Lane:
    """Compute J x, for a row J (dof -> coefficient) and a vector x (nv,) or its lanes."""
    return inner(J.values(), [x[i] for i in J])


def entry(column: Any, i: int, dtype: Any) -> Lane:
    """Return entry i of a model parameter (n,) as a lane."""
    return lane(table(column, dtype), i)
