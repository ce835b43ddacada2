"""What the legged tasks share: observations without noise, for the value function."""

from __future__ import annotations

from collections.abc import Sequence

from rbjax.envs import terms
from rbjax.envs.task import Observation
from rbjax.sensors import Accelerometer, AngularVelocity, Gyro, Velocimeter


def noise_free(site: str, home: Sequence[float]) -> tuple[Observation, ...]:
    """Return the motion of an IMU and of the joints as it is, for the group "critic".

    site: of the IMU. home: angles of the joints from which the positions are counted, rad.
    """
    return (
        Observation("true_gyro", Gyro(site)),
        Observation("accelerometer", Accelerometer(site)),
        Observation("true_gravity", terms.gravity_direction(site)),
        Observation("true_velocity", Velocimeter(site)),
        Observation("angular_velocity", AngularVelocity(site)),
        Observation("true_joint_positions", terms.joint_offsets(home)),
        Observation("true_joint_velocities", terms.joint_velocities(len(home))),
    )
