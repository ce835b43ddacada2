"""Contact forces as sensors read them.

The contacts are rows of arrays, of which those that do not exist have no force. A contact law gives
them (`Solution.contacts`).
"""

from __future__ import annotations

from rbjax.contact.contact_forces import ContactForces as ContactForces
from rbjax.forces.context import Context
from rbjax.model import WORLD
from rbjax.spatial import Force


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
