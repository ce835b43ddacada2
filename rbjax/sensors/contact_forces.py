"""Contact forces as sensors read them.

The contacts are rows of arrays, of which those that do not exist have no force. A contact law gives
them (`Solution.contacts`).
"""

from __future__ import annotations

import equinox as eqx
import jax

from rbjax.forces.context import Context
from rbjax.lanes import Vec3
from rbjax.model import WORLD
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


def wrenches_of_contacts(context: Context, contacts: ContactForces) -> dict[int, Force]:
    """Sum the contact forces on each body, in world axes at the body's origin."""
    geoms = context.model.geoms
    assert geoms is not None
    out: dict[int, Force] = {}
    for row, pair in enumerate(contacts.geoms):
        wrench, point = contacts.wrench(row), contacts.point(row)
        for geom, sign in zip(pair, (-1.0, 1.0), strict=True):
            body = geoms.bodies[geom]
            if body == WORLD:
                continue
            arm = point - context.body(body).position
            moved = Force(wrench.ang + arm.cross(wrench.lin), wrench.lin) * sign
            out[body] = out[body] + moved if body in out else moved
    return out
