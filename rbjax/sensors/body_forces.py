"""Forces on bodies that force sensors subtract: of contacts and of spatial tendons.

Contacts are rows of arrays (`MotionSolution.contacts`). A row that is not in contact has no force.
Spatial tendons:
    f = T e / d on the end of each straight piece, and -T e / d on its start
with the direction e and the divisor d of the piece. T is the force that lengthens the tendon, the
sum of gear f of its actuators less the force of its spring and damper.
"""

from __future__ import annotations

from rbjax.contact.solver.contact_forces import ContactForces
from rbjax.forces.context import Context
from rbjax.forces.tendons.paths import tendon_pieces
from rbjax.forces.tendons.springs import spring_forces
from rbjax.lanes import Lane, Vec3, add, is_zero, mul, sub
from rbjax.model import WORLD
from rbjax.sensors.actuators import forces_at_tendons
from rbjax.spatial import Force

Wrenches = dict[int, Force]


def wrenches_of_contacts(context: Context, contacts: ContactForces) -> Wrenches:
    """Sum the contact forces on each body, in world axes at the body's origin."""
    geoms = context.model.geoms
    assert geoms is not None
    out: Wrenches = {}
    for row, pair in enumerate(contacts.geoms):
        wrench, point = contacts.wrench(row), contacts.point(row)
        for geom, sign in zip(pair, (-1.0, 1.0), strict=True):
            _push(out, context, geoms.bodies[geom], point, wrench * sign)
    return out


def wrenches_of_tendons(context: Context) -> Wrenches:
    """Sum the forces of spatial tendons on each body, in world axes at the body's origin."""
    tension: dict[int, Lane] = {}
    for tendon, gear, force in forces_at_tendons(context):
        tension[tendon] = add(tension.get(tendon, 0.0), mul(gear, force))
    for tendon, force in spring_forces(context).items():
        tension[tendon] = sub(tension.get(tendon, 0.0), force)
    out: Wrenches = {}
    for tendon, value in tension.items():
        if is_zero(value):
            continue
        for piece in tendon_pieces(context, tendon):
            if piece.bodies[0] == piece.bodies[1]:
                continue
            for body, sign in zip(piece.bodies, (-1.0, 1.0), strict=True):
                force = piece.pull * mul(sign, value)
                _push(out, context, body, piece.point, Force(Vec3.zero(), force))
    return out


def _push(out: Wrenches, context: Context, body: int, point: Vec3, wrench: Force) -> None:
    """Add a wrench at a point, in world axes, to the wrench of a body at its origin."""
    if body == WORLD:
        return
    arm = point - context.body(body).position
    own = Force(wrench.ang + arm.cross(wrench.lin), wrench.lin)
    out[body] = out[body] + own if body in out else own
