"""Unitree Go1 follows a velocity command, on a flat floor or on rough ground.

The numbers are those of MuJoCo Playground's Go1JoystickFlatTerrain and Go1JoystickRoughTerrain
(Zakka et al., *MuJoCo Playground*, 2025), whose names of reward terms are kept. Differences:

    - sensors and actuator forces are those of the state after the step; Playground reads the ones
      of the physics step before
    - the observed action is the last one, as on the robot
    - a foot touches if its sphere overlaps the floor
    - each contact problem is solved to convergence; Playground does one Newton step

A learner by gradients needs the rewards of `go1_joystick_smooth`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.contact import SoftContact
from rbjax.envs import terms
from rbjax.envs.actions import Offset
from rbjax.envs.episode import Params
from rbjax.envs.registry import register
from rbjax.envs.robot_files import robot_file
from rbjax.envs.suite.legged import noise_free
from rbjax.envs.task import Observation, Randomisation, Reward, Task
from rbjax.envs.terrain import rough_ground
from rbjax.loading import load
from rbjax.model import Model, State
from rbjax.sensors import Gyro, Velocimeter

#: control step, s, and physics steps in it
DT, DECIMATION = 0.02, 5
FEET = ("FR", "FL", "RR", "RL")
HOME = (0.1, 0.9, -1.8, -0.1, 0.9, -1.8) * 2
#: height of the base at a reset, m, on the flat floor and on rough ground
HEIGHT, ROUGH_HEIGHT = 0.278, 0.35
BODY, IMU = "trunk", "imu"
_VELOCITY, _GYRO = Velocimeter(IMU), Gyro(IMU)
#: factor of the joint limits beyond which a term counts
SOFT = 0.95
#: height of a swinging foot, m
SWING = 0.1


@register("go1_joystick_flat")
def go1_joystick_flat(
    *,
    pushes: bool = False,
    randomise: bool = False,
    iterations: int | None = None,
) -> Task:
    """A Go1 follows a velocity command on a flat floor.

    Args:
        pushes: whether forces push the robot (`params.values["push_speed"]`, m/s).
        randomise: whether friction, masses and the like are drawn at each reset.
        iterations: most Newton steps of a contact problem; None: to convergence, 3 to 4 on average.

    Source: Zakka et al., *MuJoCo Playground*, 2025.

    Example:
        >>> import rbjax as rb
        >>> task = rb.envs.tasks()["go1_joystick_flat"]()
        >>> task.model.nu, task.decimation
        (12, 5)
    """
    model = load(robot_file("go1"))
    return _task("go1_joystick_flat", model, HEIGHT, pushes, randomise, iterations)


@register("go1_joystick_rough")
def go1_joystick_rough(
    *,
    pushes: bool = False,
    randomise: bool = False,
    iterations: int | None = None,
    height: float = 0.05,
    seed: int = 0,
) -> Task:
    """A Go1 follows a velocity command on rough ground.

    The ground is a height field of 20 m by 20 m with random heights at 256 by 256 points
    (`rb.envs.rough_ground`).

    Args:
        pushes, randomise, iterations: as `go1_joystick_flat`.
        height: greatest height of the ground, m.
        seed: of the heights.

    Source: Zakka et al., *MuJoCo Playground*, 2025.

    Example:
        >>> import rbjax as rb
        >>> task = rb.envs.tasks()["go1_joystick_rough"]()
        >>> task.model.geoms.heights[0].shape
        (256, 256)
    """
    xml = robot_file("go1").read_text()
    model = load(rough_ground(xml, height=height, seed=seed, friction=1.0))
    return _task("go1_joystick_rough", model, ROUGH_HEIGHT, pushes, randomise, iterations)


def _task(
    name: str, model: Model, height: float, pushes: bool, randomise: bool, iterations: int | None
) -> Task:
    feet = terms.Feet(FEET, tuple((foot, "floor") for foot in FEET))
    pushed, push = terms.force_pushes(DT)
    variables = (*terms.switched_commands(DT), *feet.variables(), *(pushed if pushes else ()))
    policy = _policy()
    return Task(
        name, model, start=start(height),
        observations={"policy": policy, "critic": (*policy, *_hidden(feet, pushes))},
        rewards=_rewards(model, feet),
        action=Offset(HOME, 0.5),
        variables=variables,
        events=(push,) if pushes else (),
        terminations={"fallen": terms.fallen(IMU)},
        randomise=_randomisations(model) if randomise else (),
        contact=None if iterations is None else SoftContact(iterations),
        decimation=DECIMATION, dt=DT / DECIMATION, episode=1000,
        values=_values(pushes), total_reward=terms.clipped_sum(0.0, 1e4, times_dt=True),
        tracked=BODY,
    )  # fmt: skip


def start(height: float) -> Any:
    """Return the function of the initial state: a random place and yaw, a small velocity."""

    def drawn(key: jax.Array, params: Params) -> State:
        place, turn, speed = jax.random.split(key, 3)
        base = terms.random_base(place, turn, height)
        v = jax.random.uniform(speed, (6,), minval=-0.5, maxval=0.5)
        home = jnp.asarray(HOME, base.dtype)
        return State(jnp.concatenate([base, home]), jnp.concatenate([v, jnp.zeros_like(home)]))

    return drawn


def _policy() -> tuple[Observation, ...]:
    return (
        Observation("velocity", _VELOCITY, noise=0.1),
        Observation("gyro", _GYRO, noise=0.2),
        Observation("gravity", terms.gravity_direction(IMU), noise=0.05),
        Observation("joint_positions", terms.joint_offsets(HOME), noise=0.03),
        Observation("joint_velocities", terms.joint_velocities(len(HOME)), noise=1.5),
        Observation("last_action", lambda transition: transition.action),
        Observation("command", lambda transition: transition.variables["command"]),
    )


def _hidden(feet: terms.Feet, pushes: bool) -> tuple[Observation, ...]:
    """Return the observations that a robot cannot measure."""

    def push(transition: Any) -> jax.Array:
        if not pushes:
            return jnp.zeros(4, transition.after.q.dtype)
        a = transition.variables["push"]
        mass = transition.model.bodies.mass.sum()
        return jnp.concatenate([mass * a, jnp.any(a != 0)[None].astype(a.dtype)])

    return (
        *noise_free(IMU, HOME),
        Observation("actuator_forces", terms.forces),
        Observation("contact", lambda transition: transition.variables["last_contact"]),
        Observation("foot_velocities", feet.velocities),
        Observation("air_time", lambda transition: transition.variables["air_time"]),
        Observation("push", push),
    )


def _rewards(model: Model, feet: terms.Feet) -> tuple[Reward, ...]:
    lower, upper = np.asarray(model.joints.range)[1:].T
    return (
        Reward("tracking_lin_vel", terms.track_velocity(IMU), 1.0),
        Reward("tracking_ang_vel", terms.track_yaw_rate(IMU), 0.5),
        Reward("lin_vel_z", terms.vertical_velocity(IMU), -0.5),
        Reward("ang_vel_xy", terms.roll_and_pitch_rate(IMU), -0.05),
        Reward("orientation", terms.tilt(IMU), -5.0),
        Reward("dof_pos_limits", terms.joint_limit_violation(SOFT * lower, SOFT * upper), -1.0),
        Reward("pose", terms.pose_similarity(HOME, [1.0, 1.0, 0.1] * 4), 0.5),
        Reward("termination", terms.terminated, -1.0),
        Reward("stand_still", terms.stand_still(HOME), -1.0),
        Reward("torques", terms.force_norms, -0.0002),
        Reward("action_rate", terms.action_rate, -0.01),
        Reward("energy", terms.power, -0.001),
        Reward("feet_clearance", feet.clearance(SWING), -2.0),
        Reward("feet_height", feet.swing_height(SWING), -0.2),
        Reward("feet_slip", feet.slip, -0.1),
        Reward("feet_air_time", feet.air_time_reward(0.1), 0.1),
    )


def _values(pushes: bool) -> dict[str, Any]:
    """Return the ranges of commands, m/s and rad/s, and of pushes."""
    values: dict[str, Any] = {
        "command_range": np.array([1.5, 0.8, 1.2]),
        "command_on": np.array([0.9, 0.25, 0.5]),
        "command_time": 5.0,
    }
    if pushes:
        values |= {
            "push_speed": np.array([0.0, 3.0]),
            "push_duration": np.array([0.05, 0.2]),
            "push_wait": np.array([1.0, 3.0]),
        }
    return values


def _randomisations(model: Model) -> tuple[Randomisation, ...]:
    floor = model.geom("floor")
    return (
        terms.set_friction("floor_friction", [floor], 0.4, 1.0),
        *terms.joint_randomisations(model, friction=(0.9, 1.1), armature=(1.0, 1.05), zero=0.05),
        terms.shift_center_of_mass(model, BODY, 0.05),
        *terms.mass_randomisations(model, BODY, factor=(0.9, 1.1), added=1.0),
    )
