"""The solution of the contact problem with its forces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.contact.problem.problem import Problem, add_row
from rbjax.contact.rows.scalar_row import EQUALITY, FRICTION, LIMIT
from rbjax.contact.solver.contact_forces import ContactForces, contact_forces
from rbjax.dynamics.tracing.custom_rules import jvp_of, with_jvp
from rbjax.lanes import Lane, pack, sub, unpack
from rbjax.model.record import Record


class ContactSolution(Record):
    """The acceleration and the forces that solve the contact problem, and the solver's report.

    Fields:
        acceleration: (nv,) v', in the units of v per second.
        contacts: the forces of contacts, `ContactForces`.
        contact, limit, friction, equality: (nv,) generalized forces of the contacts, the limits,
            the friction loss and the equalities. Their sum is MuJoCo's qfrc_constraint.
        rows: (m,) N or N m, the force of each row of a limit, friction loss or equality.
        iterations: () the number of Newton steps; of iterations of the normal forces
            ("coulomb"); of sweeps ("impulse").
        error: () the norm of the gradient relative to the norm of the forces; the relative change
            of the normal forces ("coulomb"); the residual in m/s ("impulse").
        success: () whether the error is at most the tolerance of the law.
        sources: kind of each row, with the part of the model that it belongs to; static.
    """

    acceleration: jax.Array
    contacts: ContactForces
    contact: jax.Array
    limit: jax.Array
    friction: jax.Array
    equality: jax.Array
    rows: jax.Array
    iterations: jax.Array
    error: jax.Array
    success: jax.Array
    sources: tuple[tuple[str, str, int], ...] = eqx.field(static=True)

    @property
    def constraint(self) -> jax.Array:
        """The generalized forces (nv,) of all rows, MuJoCo's qfrc_constraint."""
        return self.contact + self.limit + self.friction + self.equality

    def forces_of(self, kind: str) -> jax.Array:
        """Return the forces of the rows of a kind: EQUALITY, LIMIT or FRICTION."""
        return self.rows[np.array([k for k, x in enumerate(self.sources) if x[0] == kind], int)]

    def force_of(self, kind: str, part: str, index: int) -> Lane:
        """Return the sum of the forces of the rows of a kind that belong to one part of the model.

        part, index: such as "joint" and the index of the joint.
        """
        found = [k for k, source in enumerate(self.sources) if source == (kind, part, index)]
        return sum((self.rows[k] for k in found), jnp.zeros((), self.rows.dtype))


#: the kinds of rows with one force
KINDS = (LIMIT, FRICTION, EQUALITY)


class SolutionArrays(NamedTuple):
    """The arrays from which `ContactSolution` is built, all of one dtype.

    contacts: (n, 20) the table of `contact_forces`. by_kind: the generalized forces (nv,) of each
        kind of `KINDS`. The other fields are those of `ContactSolution`.
    """

    contacts: jax.Array
    contact: jax.Array
    by_kind: list[jax.Array]
    rows: jax.Array
    a: jax.Array
    iterations: jax.Array
    error: jax.Array

    @classmethod
    def of(
        cls, problem: Problem, contacts: tuple[jax.Array, list[Lane]], a: jax.Array, *report: Any
    ) -> SolutionArrays:
        """Compute the forces of the other rows at the acceleration a.

        contacts: the rows of `contact_forces`, and J^T f of the contacts.
        """
        x, forces = unpack(a), list[Lane]()
        sums: dict[str, list[Lane]] = {kind: [0.0] * len(x) for kind in KINDS}
        for row in problem.rows:
            f, _ = row.response(sub(row.along(x), row.reference))
            sums[row.kind] = add_row(sums[row.kind], row, f)
            forces.append(f)
        by_kind = [pack(sums[kind], a) for kind in KINDS]
        scalar = jnp.zeros(len(forces), a.dtype)
        rows = pack(forces, scalar)
        return cls(contacts[0], pack(contacts[1], a), by_kind, rows, a, *report)

    def solution(
        self, geoms: tuple[tuple[int, int], ...], sources: tuple[tuple[str, str, int], ...],
        tolerance: float,
    ) -> ContactSolution:  # fmt: skip
        """Convert to a `ContactSolution`. geoms, sources: the geoms of its contacts, the sources of
        its rows. tolerance: the largest error of a converged solution."""
        limit, friction, equality = self.by_kind
        return ContactSolution(
            acceleration=self.a,
            contacts=contact_forces(self.contacts, geoms),
            contact=self.contact,
            limit=limit,
            friction=friction,
            equality=equality,
            rows=self.rows,
            iterations=self.iterations.astype(jnp.int32),
            error=self.error,
            success=self.error <= tolerance,
            sources=sources,
        )


def with_rule_of(plain: Callable, differentiable: Callable) -> Callable:
    """Return the function `plain`, with the derivatives of `differentiable`, which has the
    same values."""

    def rule(primals: tuple, tangents: tuple) -> tuple:
        value, rate = jvp_of(differentiable, primals, tangents)
        return value, jax.tree.map(jnp.zeros_like, value) if rate is None else rate

    return with_jvp(plain, rule)


def sources_of_rows(problem: Problem) -> tuple[tuple[str, str, int], ...]:
    """Return (kind, part, index) of each scalar row, the part of the model to which it belongs."""
    return tuple((row.kind, *row.source) for row in problem.rows)
