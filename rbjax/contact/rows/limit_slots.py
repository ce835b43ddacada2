"""The active limits of hinges and slides, in consecutive slots.

A loop over both limits of each joint stores those that act. All further loops are of these, so
their cost follows the number of limits that act, which are few.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.contact.rows.dof_rows import limit_rows
from rbjax.contact.rows.options import Options
from rbjax.contact.rows.scalar_row import LIMIT, ScalarRow, Softness
from rbjax.lanes import Lane, pack, sub, unpack
from rbjax.model import Model
from rbjax.model.leaves import table


class JointLimits(NamedTuple):
    """The limits of hinges and slides at a state.

    Fields:
        joints: the joints.
        weights: (nv,) inverse inertias of the dofs.
    """

    model: Model
    joints: list[int]
    q: jax.Array
    v: jax.Array
    weights: Any
    options: Options

    @property
    def dofs(self) -> list[int]:
        """The dof of each joint."""
        return [self.model.topology.joint_v[j] for j in self.joints]

    @property
    def rows(self) -> list[ScalarRow]:
        """The rows of all limits, the lower one of each joint first."""
        return limit_rows(self.model, self.q, self.v, self.weights, self.options, self.joints)

    def active(self) -> LimitSlots:
        """Find the limits that act."""
        own, top, dtype = self.model.solver, self.model.topology, self.q.dtype
        assert own is not None
        if not self.joints:
            return LimitSlots(jnp.int32(0), jnp.zeros(0, jnp.int32), jnp.zeros((0, 3), dtype))
        every = np.array(self.joints * 2)
        signs = np.repeat([1.0, -1.0], len(self.joints))
        places, dofs = (np.array(x, np.int32)[every] for x in (top.joint_q, top.joint_v))
        ranges = table(self.model.joints.range, dtype)[every]
        side = np.arange(len(every)) // len(self.joints)
        bounds = ranges[np.arange(len(every)), side]
        given = own.limit_margin, own.limit_solref, own.limit_solimp
        margins, solref, solimp = (table(x, dtype)[every] for x in given)
        weights = table(self.weights, dtype)[dofs]

        def visit(found: LimitSlots, n: Any) -> tuple[LimitSlots, None]:
            def number(column: Any) -> Lane:
                if isinstance(column, np.ndarray) and (column == column[:1]).all():
                    return float(column[0])
                return jnp.asarray(column, dtype)[n]

            sign, margin, i = number(signs), number(margins), jnp.asarray(dofs)[n]
            distance = sign * (self.q[jnp.asarray(places)[n]] - number(bounds))

            def stored() -> LimitSlots:
                parameters = ([number(x) for x in t.T] for t in (solref, solimp))
                softness = Softness(number(weights), *parameters)
                given = distance, margin, [self.v[i]], softness, self.options, ("joint", 0)
                row = ScalarRow.limit({0: sign}, *given)
                k, lanes = found.length, pack([sign, row.D, row.reference], self.q)
                return LimitSlots(k + 1, found.dofs.at[k].set(i), found.rows.at[k].set(lanes))

            return jax.lax.cond(distance < margin, stored, lambda: found), None

        n = len(every)
        none = jnp.zeros(n, jnp.int32), jax.lax.empty((n, 3), dtype)
        start = LimitSlots(jnp.int32(0), *none)
        return jax.lax.scan(visit, start, jnp.arange(n))[0]


class LimitSlots(NamedTuple):
    """The limits that act.

    Fields:
        length: their number.
        dofs: (n,) the dof of each.
        rows: (n, 3) direction, 1 or -1, inverse regularization and reference acceleration of each.
    """

    length: Lane
    dofs: jax.Array
    rows: jax.Array

    def fold(self, step: Callable[[Any, Any], Any], carry: Any) -> Any:
        """Run carry = step(k, carry) over the indices k of the limits that act."""
        return jax.lax.fori_loop(0, self.length, step, carry) if len(self.dofs) else carry

    def subtract_forces(self, x: jax.Array, out: jax.Array) -> jax.Array:
        """Subtract the joint forces J^T f at the acceleration x (nv,) from `out` (nv,)."""

        def step(k: Any, out: jax.Array) -> jax.Array:
            limit = self._at(k, x)
            return out.at[limit.dof].add(-limit.sign * limit.response()[0])

        return self.fold(step, out)

    def hessian(self, x: jax.Array) -> jax.Array:
        """Compute the diagonal (nv,) of the Hessian J^T s'' J at the acceleration x (nv,)."""

        def step(k: Any, out: jax.Array) -> jax.Array:
            limit = self._at(k, x)
            return out.at[limit.dof].add(limit.response()[1])

        return self.fold(step, jnp.zeros_like(x))

    def along(self, x: jax.Array, p: jax.Array, carry: tuple) -> tuple:
        """Subtract J^T s'' J p from (nv,), add f^T J p to a number, and subtract p^T J^T s'' J p
        from a number, at the acceleration x (nv,)."""

        def step(k: Any, carry: tuple) -> tuple:
            change, slope, curvature = carry
            limit = self._at(k, x)
            (f, h), rate = limit.response(), limit.sign * p[limit.dof]
            change = change.at[limit.dof].add(-limit.sign * h * rate)
            return change, slope + f * rate, curvature - h * rate * rate

        return self.fold(step, carry)

    def add_slope(self, x: jax.Array, p: jax.Array, alpha: Lane, carry: tuple) -> tuple:
        """Add the slope and the curvature of the cost at x + alpha p along p to two numbers."""

        def step(k: Any, carry: tuple) -> tuple:
            limit = self._at(k, x)
            rate = limit.sign * p[limit.dof]
            f, h = limit.response(alpha * rate)
            return carry[0] - f * rate, carry[1] + h * rate * rate

        return self.fold(step, carry)

    def _at(self, k: Any, x: jax.Array) -> _Limit:
        (sign, D, reference), i = unpack(self.rows[k]), self.dofs[k]
        row = ScalarRow(LIMIT, {0: sign}, D, reference)
        return _Limit(i, sign, row, sub(row.along([x[i]]), reference))


class _Limit(NamedTuple):
    """A limit that acts: its dof, its direction, its row, and the residual of the row."""

    dof: Any
    sign: Lane
    row: ScalarRow
    residual: Lane

    def response(self, change: Lane = 0.0) -> tuple[Lane, Lane]:
        """Compute the force and the Hessian at the residual plus a change."""
        return self.row.response(self.residual + change)
