"""Contact forces: the rows of all candidates at a solution of the contact problem."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.contact.assemble import Assembly
from rbjax.contact.contact_rows import ContactSet
from rbjax.contact.geometry.narrow_phase import COUNTS
from rbjax.contact.geometry.shapes import contact_frame
from rbjax.contact.problem import residual
from rbjax.dynamics.algorithms.rnea import LinkForces
from rbjax.lanes import Vec3
from rbjax.model import Model
from rbjax.model.record import Record
from rbjax.spatial import Force


class ContactForces(Record):
    """The forces of contacts, one row a contact. The number n of rows is fixed.

    Fields:
        exists: (n,) whether the contact exists.
        distance: (n,) m, between the surfaces; negative if they overlap.
        position: (n, 3) m, in the world.
        frame: (n, 3, 3) axes row by row in world axes: the normal from the first geom to the
            second, and two tangents.
        force: (n, 6) [force N; torque N m] of the first geom on the second, in the axes of the
            contact; zero if the contact does not exist.
        geoms: the two geoms of each row, by index; static.
    """

    exists: jax.Array
    distance: jax.Array
    position: jax.Array
    frame: jax.Array
    force: jax.Array
    geoms: tuple[tuple[int, int], ...] = eqx.field(static=True)

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


def contact_forces(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array, f_ext: LinkForces | None, a: jax.Array
) -> ContactForces:
    """Compute the contact forces at the acceleration a (nv,) that solves the contact problem."""
    assembly = Assembly(model, q, v)
    problem = assembly.problem(tau, f_ext)
    twists = problem.tree.twists(a, problem.dtype)
    found, geoms = [], []
    for contacts in problem.sets:
        n = contacts.candidates

        def store(carry: tuple, row: Any, active: Any, of: ContactSet = contacts) -> tuple:
            k, rows, exists = carry
            f = of.cone(row).response(residual(of, row, twists)).f
            contact, zeros = row.contact, [0.0] * (6 - of.dim)
            axes = contact_frame(contact.normal, contact.tangent)
            lanes = [contact.distance, *(contact.position + assembly.origin)]
            lanes += [x for axis in axes for x in axis] + [*f, *zeros]
            values = jnp.stack([jnp.asarray(x, rows.dtype) for x in lanes])
            return k + 1, rows.at[k].set(values), exists.at[k].set(active)

        start = (jnp.int32(0), jnp.zeros((n, 19), problem.dtype), jnp.zeros(n, bool))
        _, rows, exists = contacts.scan(problem.touching, store, start)
        forces = jnp.where(exists[:, None], rows[:, 13:], 0.0)
        found.append((exists, rows[:, 0], rows[:, 1:4], rows[:, 4:13].reshape(n, 3, 3), forces))
        pairs = model.geoms.pairs  # type: ignore[union-attr]
        geoms += [pairs[k] for kind, at in contacts.kinds.items() for k in at
                  for _ in range(COUNTS[kind.kinds])]  # fmt: skip
    if not found:
        none = jnp.zeros((0, 3), problem.dtype)
        frame, force = jnp.zeros((0, 3, 3), problem.dtype), jnp.zeros((0, 6), problem.dtype)
        return ContactForces(none[:, 0] > 0, none[:, 0], none, frame, force, ())
    exists, distance, position, frame, force = map(jnp.concatenate, zip(*found, strict=True))
    return ContactForces(exists, distance, position, frame, force, tuple(geoms))
