"""Sensors of a robot: what an ideal sensor measures at an instant of a motion."""

from rbjax.sensors.accelerometer import Accelerometer
from rbjax.sensors.columns import Columns
from rbjax.sensors.custom import CustomSensor
from rbjax.sensors.gyro import Gyro
from rbjax.sensors.joint_accelerations import Accelerations
from rbjax.sensors.joint_positions import Positions
from rbjax.sensors.joint_torques import Torques
from rbjax.sensors.joint_velocities import Velocities
from rbjax.sensors.motor_currents import Currents
from rbjax.sensors.pose import Pose
from rbjax.sensors.position import Position
from rbjax.sensors.protocol import Context, Sensor
from rbjax.sensors.registry import Kind, kinds, register, sensor_of

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
