"""Contact forces at a solution of the contact problem, from its slots or at a given acceleration.

The slots hold the contacts that the solver has found. Forces at a given acceleration have
derivatives in both modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.contact.geometry.narrow_phase import COUNTS
from rbjax.contact.problem.contact_rows import ContactSet, Slots, place_of
from rbjax.contact.problem.in_use import wrenches_in_use
from rbjax.contact.problem.problem import Problem, RowsInUse
from rbjax.contact.solver.newton import Solution
from rbjax.lanes import Lane, Vec3, pack
from rbjax.model import Model
from rbjax.model.record import Record
from rbjax.spatial import Force

#: numbers of a row of `contact_forces`
WIDTH = 20


class ContactForces(Record):
    """The forces of contacts, one row a contact. The number n of rows is fixed.

    Fields:
        exists: (n,) whether the contact exists: its distance is below margin + gap of the pair.
        distance: (n,) m, between the surfaces; negative if they overlap.
        position: (n, 3) m, in the world.
        frame: (n, 3, 3) axes row by row in world axes: the normal from the first geom to the
            second, and two tangents.
        force: (n, 6) [force N; torque N m] of the first geom on the second, in the axes of the
            contact.
        geoms: the two geoms of each row, by index; static.

    The distance of a contact that does not exist is infinite. Its other numbers are zero.
    """

    exists: jax.Array
    distance: jax.Array
    position: jax.Array
    frame: jax.Array
    force: jax.Array
    geoms: tuple[tuple[int, int], ...] = eqx.field(static=True)

    @property
    def world_force(self) -> jax.Array:
        """The forces (..., n, 3) of the first geoms on the second ones, N, in world axes."""
        return (self.frame.swapaxes(-1, -2) * self.force[..., None, :3]).sum(-1)

    def normal(self, row: int) -> Vec3:
        """Return the normal of a contact, from its first geom to its second, in world axes."""
        return Vec3(*(self.frame[row, 0, k] for k in range(3)))

    def point(self, row: int) -> Vec3:
        """Return the position of a contact in the world."""
        return Vec3(*(self.position[row, k] for k in range(3)))

    def wrench(self, row: int) -> Force:
        """Return the wrench on the second geom, in world axes at the position of the contact."""
        axes = [Vec3(*(self.frame[row, i, k] for k in range(3))) for i in range(3)]
        force, torque = (
            axes[0] * self.force[row, i]
            + axes[1] * self.force[row, i + 1]
            + axes[2] * self.force[row, i + 2]
            for i in (0, 3)
        )
        return Force(torque, force)


def geoms_of_rows(model: Model, sets: Sequence[ContactSet]) -> tuple[tuple[int, int], ...]:
    """Return, for each candidate contact of all sets, the indices of its two geoms."""
    pairs = model.geoms.pairs if sets else ()  # type: ignore[union-attr]
    return tuple(
        pairs[k]
        for contacts in sets
        for kind, members in contacts.kinds.items()
        for k in members
        for _ in range(COUNTS[kind.kinds])
    )


def rows_of_slots(
    problem: Problem, solution: Solution, origin: Vec3
) -> tuple[jax.Array, list[Lane]]:
    """Compute the table of `contact_forces`, and J^T f (nv lanes), from the solver's active
    contacts."""
    found, wrenches = [], _no_wrenches(problem)
    for contacts, slots, r in zip(problem.sets, problem.slots, solution.residuals, strict=True):

        def store(
            k: Any, carry: tuple, of: ContactSet = contacts, slots: Slots = slots, r: Any = r
        ) -> tuple:
            row, (rows, wrenches) = slots.row(k, of.dim), carry
            f = of.cone(row).response([r[k, i] for i in range(of.dim)]).f
            values = _row(place_of(row.contact), origin, f, rows[0])
            wrenches = of.add_forces(row, wrenches, f)
            return rows.at[row.candidate].set(values), wrenches

        none = _no_contacts(contacts, problem.dtype)
        rows, wrenches = slots.fold(store, (none, wrenches))
        found.append(rows)
    return _joined(found, problem.dtype), _generalized(problem, wrenches)


def rows_in_use(
    problem: Problem, used: RowsInUse, a: jax.Array, origin: Vec3
) -> tuple[jax.Array, list[Lane]]:
    """Compute the rows of `contact_forces` and the joint forces J^T f of the contacts at an
    acceleration a, from the contacts in use. Derivatives exist in both modes."""
    found, wrenches = [], _no_wrenches(problem)
    twists = problem.tree.twists(a, problem.dtype)
    for contacts, own in zip(problem.sets, used.contacts, strict=True):
        given = contacts, problem.touching, twists, own
        more, rows = wrenches_in_use(*given, _numbers, WIDTH)
        wrenches = wrenches + more
        exists = rows[:, :1]
        distance = jnp.where(exists > 0, rows[:, 1:2], jnp.inf)
        position = rows[:, 2:5] + exists * pack(list(origin), rows[0])
        found.append(jnp.concatenate([exists, distance, position, rows[:, 5:]], axis=1))
    return _joined(found, problem.dtype), _generalized(problem, wrenches)


def _numbers(contacts: Any, row: Any, f: list[Lane], r: list[Lane]) -> jax.Array:
    del contacts, r
    none = jnp.zeros(WIDTH, row.contact.distance.dtype)
    return _row(place_of(row.contact), Vec3.zero(), f, none)


def contact_forces(rows: jax.Array, geoms: tuple[tuple[int, int], ...]) -> ContactForces:
    """Convert a table (n, 20) of contacts to `ContactForces`.

    Columns: whether the contact exists, distance, position, contact axes, forces.
    """
    frame = rows[:, 5:14].reshape(len(geoms), 3, 3)
    return ContactForces(rows[:, 0] > 0, rows[:, 1], rows[:, 2:5], frame, rows[:, 14:], geoms)


def _row(place: Sequence[Lane], origin: Vec3, f: Sequence[Lane], like: jax.Array) -> jax.Array:
    """Return the table entry of a contact: `place` as by `place_of`, about the origin, and forces
    f."""
    distance, *rest = place
    position = Vec3(*rest[:3]) + origin
    return pack([1.0, distance, *position, *rest[3:], *f, *[0.0] * (6 - len(f))], like)


def _no_contacts(contacts: ContactSet, dtype: Any) -> jax.Array:
    return jnp.zeros((contacts.candidates, WIDTH), dtype).at[:, 1].set(jnp.inf)


def _no_wrenches(problem: Problem) -> jax.Array:
    return jnp.zeros((len(problem.tree.touching) + 1, 6), problem.dtype)


def _generalized(problem: Problem, wrenches: jax.Array) -> list[Lane]:
    tree = problem.tree
    return tree.generalized(wrenches) if tree.touching else [0.0] * len(problem.rhs)


def _joined(found: list[jax.Array], dtype: Any) -> jax.Array:
    return jnp.concatenate(found) if found else jnp.zeros((0, WIDTH), dtype)
