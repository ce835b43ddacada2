"""Forces of spatial tendons on bodies.

    f = T e / d on the end of each straight piece, and -T e / d on its start
with the direction e and the divisor d of the piece. T is the force that lengthens the tendon, the
sum of gear f of its actuators less the force of its spring and damper.
"""

from __future__ import annotations

from rbjax.forces.context import Context
from rbjax.forces.tendons.paths import tendon_pieces
from rbjax.forces.tendons.springs import spring_forces
from rbjax.lanes import Lane, add, is_zero, mul, sub
from rbjax.model import WORLD
from rbjax.sensors.actuators import forces_at_tendons
from rbjax.spatial import Force


def wrenches_of_tendons(context: Context) -> dict[int, Force]:
    """Sum the forces of spatial tendons on each body, in world axes at the body's origin."""
    tension: dict[int, Lane] = {}
    for tendon, gear, force in forces_at_tendons(context):
        tension[tendon] = add(tension.get(tendon, 0.0), mul(gear, force))
    for tendon, force in spring_forces(context).items():
        tension[tendon] = sub(tension.get(tendon, 0.0), force)
    out: dict[int, Force] = {}
    for tendon, value in tension.items():
        if is_zero(value):
            continue
        for piece in tendon_pieces(context, tendon):
            for body, sign in zip(piece.bodies, (-1.0, 1.0), strict=True):
                if body == WORLD or piece.bodies[0] == piece.bodies[1]:
                    continue
                force = piece.pull * mul(sign, value)
                arm = piece.point - context.body(body).position
                own = Force(arm.cross(force), force)
                out[body] = out[body] + own if body in out else own
    return out
