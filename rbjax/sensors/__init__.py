"""Ideal sensors of a robot: functions from the state of motion to measured values."""

from rbjax.forces.context import Context
from rbjax.sensors.columns import Columns
from rbjax.sensors.ideal import (
    Accelerations,
    Accelerometer,
    Currents,
    CustomSensor,
    Gyro,
    Pose,
    Position,
    Positions,
    Torques,
    Velocities,
)
from rbjax.sensors.protocol import Kind, Sensor, kinds, register, sensor_of

__all__ = [
    "Accelerations",
    "Accelerometer",
    "Columns",
    "Context",
    "Currents",
    "CustomSensor",
    "Gyro",
    "Kind",
    "Pose",
    "Position",
    "Positions",
    "Sensor",
    "Torques",
    "Velocities",
    "kinds",
    "register",
    "sensor_of",
]
