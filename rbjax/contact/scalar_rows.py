"""Rows of the contact problem with one force each: joint limits, friction loss, equalities.

The residual of a row is r = J x - a_ref. Its force f = -ds/dr and Hessian h = d2s/dr2 are

    equality        s = D r^2 / 2
    limit           s = D r^2 / 2 for r < 0, else 0
    friction loss   s = D r^2 / 2 for |r| <= floss / D, else linear with the slope +-floss

(MuJoCo, *Computation*, "Constraint model").
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp

from rbjax.lanes import Lane, inner, mul, neg

EQUALITY, LIMIT, FRICTION = "equality", "limit", "friction loss"


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

    def along(self, x: list[Lane]) -> Lane:
        """Compute J x."""
        return inner(self.J.values(), [x[i] for i in self.J])

    def response(self, r: Lane) -> tuple[Lane, Lane]:
        """Compute the force and the Hessian at a residual."""
        push = neg(mul(self.D, r))
        if self.kind == EQUALITY:
            return push, self.D
        if self.kind == LIMIT:
            active = r < 0
            return jnp.where(active, push, 0.0), jnp.where(active, self.D, 0.0)
        sticks = jnp.abs(push) <= self.floss
        return jnp.clip(push, -self.floss, self.floss), jnp.where(sticks, self.D, 0.0)
