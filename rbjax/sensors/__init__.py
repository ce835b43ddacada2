"""Ideal sensors of a robot: functions from the state of motion to measured values."""

from rbjax.contact.solver.contact_forces import ContactForces
from rbjax.forces.context import Context
from rbjax.sensors.actuators import (
    ActuatorForce,
    ActuatorPosition,
    ActuatorVelocity,
    TendonActuatorForce,
    TendonLimitPosition,
    TendonLimitVelocity,
    TendonPosition,
    TendonVelocity,
)
from rbjax.sensors.bodies import (
    Clock,
    KineticEnergy,
    PotentialEnergy,
    SubtreeAngularMomentum,
    SubtreeCenter,
    SubtreeVelocity,
)
from rbjax.sensors.columns import Columns
from rbjax.sensors.contacts import ContactSensor
from rbjax.sensors.frames import (
    AngularAcceleration,
    AngularVelocity,
    Attitude,
    FrameXAxis,
    FrameYAxis,
    FrameZAxis,
    LinearAcceleration,
    LinearVelocity,
    Pose,
    Position,
)
from rbjax.sensors.geometry.cameras import CameraProjection
from rbjax.sensors.geometry.rangefinder import Rangefinder
from rbjax.sensors.geometry.volumes import InsideSite, Touch, Volume
from rbjax.sensors.inertial import (
    Accelerometer,
    ForceSensor,
    Gyro,
    Magnetometer,
    TorqueSensor,
    Velocimeter,
)
from rbjax.sensors.joints import (
    Accelerations,
    BallAngularVelocity,
    BallQuaternion,
    Currents,
    CustomSensor,
    JointActuatorForce,
    JointLimitPosition,
    JointLimitVelocity,
    JointPosition,
    JointVelocity,
    Positions,
    Torques,
    Velocities,
)
from rbjax.sensors.limit_forces import JointLimitForce, TendonLimitForce
from rbjax.sensors.model_sensors import sense
from rbjax.sensors.named import ModelSensor, NamedSensor
from rbjax.sensors.protocol import Kind, Sensor, kinds, register, sensor_of
from rbjax.sensors.solution import MotionSolution

__all__ = [
    "Accelerations",
    "Accelerometer",
    "ActuatorForce",
    "ActuatorPosition",
    "ActuatorVelocity",
    "AngularAcceleration",
    "AngularVelocity",
    "Attitude",
    "BallAngularVelocity",
    "BallQuaternion",
    "CameraProjection",
    "Clock",
    "Columns",
    "ContactForces",
    "ContactSensor",
    "Context",
    "Currents",
    "CustomSensor",
    "ForceSensor",
    "FrameXAxis",
    "FrameYAxis",
    "FrameZAxis",
    "Gyro",
    "InsideSite",
    "JointActuatorForce",
    "JointLimitForce",
    "JointLimitPosition",
    "JointLimitVelocity",
    "JointPosition",
    "JointVelocity",
    "Kind",
    "KineticEnergy",
    "LinearAcceleration",
    "LinearVelocity",
    "Magnetometer",
    "ModelSensor",
    "MotionSolution",
    "NamedSensor",
    "Pose",
    "Position",
    "Positions",
    "PotentialEnergy",
    "Rangefinder",
    "Sensor",
    "SubtreeAngularMomentum",
    "SubtreeCenter",
    "SubtreeVelocity",
    "TendonActuatorForce",
    "TendonLimitForce",
    "TendonLimitPosition",
    "TendonLimitVelocity",
    "TendonPosition",
    "TendonVelocity",
    "TorqueSensor",
    "Torques",
    "Touch",
    "Velocimeter",
    "Velocities",
    "Volume",
    "kinds",
    "register",
    "sense",
    "sensor_of",
]

__dir__ = __all__.copy
