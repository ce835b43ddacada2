"""The active limits of hinges and slides, in consecutive slots.

A loop over both limits of each joint stores those that act. All further loops are of these, so
their cost follows the number of limits that act, which are few.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiler.jax.turns import Rows, Turns
from rbjax.contact.rows.dof_rows import limit_rows
from rbjax.contact.rows.options import Options
from rbjax.contact.rows.scalar_row import LIMIT, ScalarRow, Softness
from rbjax.contact.rows.split_tables import SplitTables, entry
from rbjax.lanes import Lane, mul, pack, sub, unpack
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

    @property
    def _tables(self) -> LimitTables:
        """The parameters of all limits, the lower limits of all joints first."""
        own, dtype, n = self.model.solver, self.q.dtype, len(self.joints)
        assert own is not None
        every, side = np.array(self.joints * 2, int), np.repeat([0, 1], n)
        ranges = table(self.model.joints.range, dtype)
        given = own.limit_margin, own.limit_solref, own.limit_solimp
        margin, solref, solimp = (table(x, dtype)[every] for x in given)
        weight = table(self.weights, dtype)[self._dofs]
        return LimitTables(1.0 - 2.0 * side, ranges[every, side], margin, weight, solref, solimp)

    @property
    def _places(self) -> np.ndarray:
        """The index in q of each limit."""
        return np.array(self.model.topology.joint_q, np.int32)[self.joints * 2]

    @property
    def _dofs(self) -> np.ndarray:
        """The dof of each limit."""
        return np.array(self.dofs * 2, np.int32)

    def active(self) -> LimitSlots:
        """Find the limits that act."""
        dtype, n = self.q.dtype, 2 * len(self.joints)
        none = jnp.zeros(n, jnp.int32), jnp.zeros(n, jnp.int32)
        start = LimitSlots(jnp.int32(0), *none, jax.lax.empty((n, 3), dtype))
        if not n:
            return start
        tables, places, dofs = self._tables, jnp.asarray(self._places), jnp.asarray(self._dofs)

        def visit(found: LimitSlots, n: Any) -> tuple[LimitSlots, None]:
            limit = jax.tree.map(lambda column: entry(column, n), tables).lanes(dtype)
            distance, i = limit.distance(self.q[places[n]]), dofs[n]

            def stored() -> LimitSlots:
                row, k = limit.row(distance, self.v[i], self.options), found.length
                lanes = pack([limit.sign, row.D, row.reference], self.q)
                at = found.which.at[k].set(n), found.dofs.at[k].set(i), found.rows.at[k].set(lanes)
                return LimitSlots(k + 1, *at)

            return jax.lax.cond(distance < limit.margin, stored, lambda: found), None

        return jax.lax.scan(visit, start, jnp.arange(n, dtype=jnp.int32))[0]

    def forces(self, x: jax.Array, used: LimitsInUse) -> jax.Array:
        """Compute the joint forces J^T f (nv,) at the acceleration x (nv,) of the limits that act,
        with derivatives."""
        if not self.joints:
            return jnp.zeros_like(x)
        places, dofs = self._places, self._dofs
        tables, options = SplitTables.of(self._tables), SplitTables.of(self.options)
        count = len(tables.arrays)

        def loop(visit: Callable, carry: Any, counters: Sequence[Any]) -> Any:
            length, which = counters
            return jax.lax.fori_loop(0, length, lambda k, carry: visit(which[k], carry), carry)

        def reads(n: Any) -> list[Rows]:
            i, own = [(entry(dofs, n), 1)], [(n, 1)]
            return [[(entry(places, n), 1)], i, i, *[own] * count, *[None] * len(options.arrays)]

        def term(n: Any, q: Any, v: Any, x: Any, *rest: jax.Array) -> list[jax.Array]:
            one = jax.tree.map(lambda y: y[0], tables.filled(rest[:count], n)).lanes(x.dtype)
            row = one.row(one.distance(q[0]), v[0], options.filled(rest[count:], None))
            f, _ = row.response(sub(row.along([x[0]]), row.reference))
            return [pack([one.sign * f], x)]

        turns = Turns(loop, reads, lambda n: [[(entry(dofs, n), 1)]], term)
        return turns([self.q, self.v, x, *tables.arrays, *options.arrays], used, [x.shape])[0]


class LimitTables(NamedTuple):
    """Parameters of limits: arrays with one row a limit, or lanes of one limit.

    Fields:
        sign: direction, 1 for a lower limit or -1.
        bound: the coordinate at the limit.
        margin: distance below which the limit acts.
        weight: inverse inertia of the dof.
        solref, solimp: the reference and the impedance, as in MuJoCo.
    """

    sign: Any
    bound: Any
    margin: Any
    weight: Any
    solref: Any
    solimp: Any

    def lanes(self, dtype: Any) -> LimitTables:
        """Convert the row of one limit to lanes."""

        def converted(x: Any) -> Any:
            if x.ndim:
                return [converted(y) for y in x]
            return float(x) if isinstance(x, np.generic | np.ndarray) else x.astype(dtype)

        return LimitTables(*map(converted, self))

    def distance(self, q: Lane) -> Lane:
        """Compute the distance of a coordinate to the limit."""
        return mul(self.sign, sub(q, self.bound))

    def row(self, distance: Lane, v: Lane, options: Options) -> ScalarRow:
        """Return the row of the limit, at a distance and at the velocity v of its dof."""
        softness = Softness(self.weight, self.solref, self.solimp)
        return ScalarRow.limit(
            {0: self.sign}, distance, self.margin, [v], softness, options, ("joint", 0)
        )


class LimitsInUse(NamedTuple):
    """The limits that act.

    Fields:
        length: their number.
        which: (n,) the index of each limit in the tables.
    """

    length: jax.Array
    which: jax.Array


class LimitSlots(NamedTuple):
    """The limits that act, with their rows.

    Fields:
        length: their number.
        which: (n,) the index of each limit in the tables.
        dofs: (n,) the dof of each.
        rows: (n, 3) direction, 1 or -1, inverse regularization and reference acceleration of each.
    """

    length: Any
    which: jax.Array
    dofs: jax.Array
    rows: jax.Array

    @property
    def in_use(self) -> LimitsInUse:
        """The limits that act, without their rows."""
        return LimitsInUse(self.length, self.which)

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
