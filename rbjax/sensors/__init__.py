"""Sensors of a robot: what an ideal sensor measures at an instant of a motion."""

from rbjax.sensors.columns import Columns
from rbjax.sensors.readings import (
    Accelerations,
    Accelerometer,
    Currents,
    Gyro,
    Moment,
    Pose,
    Position,
    Positions,
    Reading,
    Reads,
    Torques,
    Velocities,
)

__all__ = [
    "Moment",
    "Reading",
    "Columns",
    "Positions",
    "Velocities",
    "Accelerations",
    "Torques",
    "Currents",
    "Pose",
    "Position",
    "Gyro",
    "Accelerometer",
    "Reads",
]
