"""The drive and the turning radius of a wheeled robot, from its wheels."""

from __future__ import annotations

import numpy as np

from rbjax.errors import InputError
from rbjax.wheeled import Robot
from rbjax.wheeled.robot.arrangement import constraint_row

#: the largest sideways velocity of a wheel in units of its speed, for rounded positions in f32
_SLIP = 1e-5


def drive_of(robot: Robot, steering: float) -> tuple[str, float | None]:
    """Return the name of the drive that the wheels of a robot allow, and its turning radius, m.

    The radius is None for a robot that turns on the spot. steering: the largest angle, rad.

    Raises:
        InputError: a robot with trailers, or whose wheels do not fit the motions of a drive.
    """
    leaders = robot.arrangement.leaders
    straight = np.zeros(len(robot.steerings))
    rows = {x: constraint_row(robot, x, straight) for x in leaders}
    steered = [x for x in leaders if x.what == "steering"]
    fixed = [rows[x][[0, 2]] for x in leaders if x.what != "steering"]
    sideways = [rows[x][0] for x in steered]
    fits = np.abs(np.concatenate([sideways, *fixed])).max(initial=0.0) < _SLIP
    if len(robot.bodies) > 1 or not fits or len(steered) > 1 or len(steered) > len(fixed):
        raise InputError(
            "plan: the robot fits no drive, expected no trailers, and wheels that let the chassis "
            "drive along x and turn about its origin or about points on the y axis; give a "
            "Footprint with drive=... or controls=..."
        )
    if not steered:
        return ("differential" if fixed else "omnidirectional"), None
    rows_at = (constraint_row(robot, steered[0], straight + b) for b in (steering, -steering))
    return "car", max(abs(float(row[2] / row[0])) for row in rows_at)
