"""Unitree G1 follows a velocity command on a flat floor.

The numbers are those of MuJoCo Playground's G1JoystickFlatTerrain (Zakka et al., *MuJoCo
Playground*, 2025), whose names of reward terms are kept. Differences:

    - sensors are those of the state after the step; Playground reads the ones of the physics step
      before
    - the observed action is the last one, as on the robot
    - feet and hands touch if their shapes overlap; feet that touch each other end the episode and
      have no contact force
    - the load of a foot is computed from the acceleration of the robot (`terms.two_foot_loads`)
    - each contact problem is solved to convergence; Playground does three Newton steps
Playground's file has no contact of a foot with the other shin, so its termination by that contact
never happens, and is left out. Reward terms of weight zero are left out too.
"""

from __future__ import annotations

import math
from typing import Any
from xml.etree import ElementTree

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
from rbjax.loading import load
from rbjax.model import Model, State
from rbjax.sensors import Gyro, Velocimeter

#: control step, s, and physics steps in it
DT, DECIMATION = 0.02, 10
FEET, SIDES = ("left_foot", "right_foot"), ("left", "right")
#: pose of the joints, and height of the pelvis, m
HOME = (
    *(-0.312, 0.0, 0.0, 0.669, -0.363, 0.0) * 2,  # legs: hip pitch, roll, yaw, knee, ankle
    *(0.0, 0.0, 0.073),  # waist: yaw, roll, pitch
    *(0.2, 0.2, 0.0, 0.6, 0.0, 0.0, 0.0),  # left arm: shoulder pitch, roll, yaw, elbow, wrist
    *(0.2, -0.2, 0.0, 0.6, 0.0, 0.0, 0.0),  # right arm
)
HEIGHT = 0.755
PELVIS, TORSO, BODY = "imu_in_pelvis", "imu_in_torso", "torso_link"
#: part of the range of a joint beyond which a term counts
SOFT = 0.95
#: height of a swinging foot, m, and the largest load of a foot without a cost, N
SWING, LOAD = 0.15, 500.0
#: control steps between two commands, and a lateral command, m/s, that allows hip roll
EVERY, LATERAL = 501, 0.1


@register("g1_joystick")
def g1_joystick(
    *,
    pushes: bool = True,
    randomise: bool = False,
    hand_contacts: bool = True,
    iterations: int | None = None,
) -> Task:
    """A G1 follows a velocity command on a flat floor.

    Args:
        pushes: whether the velocity of the robot is changed every 5 to 10 s.
        randomise: whether friction, masses and the like are drawn at each reset.
        hand_contacts: whether hands and thighs exert contact forces; without them the contact
            problem is sparser. Their touch costs reward in both cases.
        iterations: most Newton steps of a contact problem; None: to convergence.

    Source: Zakka et al., *MuJoCo Playground*, 2025.

    Example:
        >>> import rbjax as rb
        >>> task = rb.envs.tasks()["g1_joystick"]()
        >>> task.model.nu, task.decimation
        (29, 10)
    """
    model = _model(hand_contacts)
    feet = terms.Feet(FEET, tuple((foot, "floor") for foot in FEET))
    pushed, push = terms.velocity_pushes(DT)
    variables = (
        *terms.periodic_commands(EVERY), *terms.gait_clock(DT, (0.0, math.pi)),
        *feet.variables(), *(pushed if pushes else ()),
    )  # fmt: skip
    policy = _policy()
    return Task(
        "g1_joystick", model, start=_start,
        observations={"policy": policy, "critic": (*policy, *_hidden(feet))},
        rewards=_rewards(model, feet),
        action=Offset(HOME, 0.5),
        variables=variables,
        events=(push,) if pushes else (),
        terminations={
            "fallen": terms.fallen(TORSO), "feet": terms.any_touching([FEET]),
        },
        randomise=_randomisations(model) if randomise else (),
        contact=None if iterations is None else SoftContact(iterations),
        decimation=DECIMATION, dt=DT / DECIMATION, episode=1000,
        values=_values(pushes), tracked=BODY,
    )  # fmt: skip


def _model(hand_contacts: bool) -> Model:
    """Load the robot, with or without the contact pairs of hands and thighs."""
    root = ElementTree.fromstring(robot_file("g1").read_text())
    pairs: Any = root.find("contact")
    for pair in list(pairs):
        if not hand_contacts and pair.get("name", "").endswith("hand_thigh"):
            pairs.remove(pair)
    return load(ElementTree.tostring(root, encoding="unicode"))


def _start(key: jax.Array, params: Params) -> State:
    """Draw a place, a yaw, a pose of the joints and a small velocity."""
    place, turn, pose, speed = jax.random.split(key, 4)
    base = terms.random_base(place, turn, HEIGHT)
    home = jnp.asarray(HOME, base.dtype)
    joints = home * jax.random.uniform(pose, home.shape, minval=0.5, maxval=1.5)
    v = jax.random.uniform(speed, (6,), minval=-0.5, maxval=0.5)
    return State(jnp.concatenate([base, joints]), jnp.concatenate([v, jnp.zeros_like(home)]))


def _policy() -> tuple[Observation, ...]:
    return (
        Observation("velocity", Velocimeter(PELVIS), noise=0.1),
        Observation("gyro", Gyro(PELVIS), noise=0.2),
        Observation("gravity", terms.gravity_direction(PELVIS), noise=0.05),
        Observation("command", lambda transition: transition.variables["command"]),
        Observation("joint_positions", terms.joint_offsets(HOME), noise=0.03),
        Observation("joint_velocities", terms.joint_velocities(len(HOME)), noise=1.5),
        Observation("last_action", lambda transition: transition.action),
        Observation("phase", terms.phase_cosines),
    )


def _hidden(feet: terms.Feet) -> tuple[Observation, ...]:
    """Return the observations that a robot cannot measure."""
    return (
        *noise_free(PELVIS, HOME),
        Observation("height", lambda transition: transition.after.q[2]),
        Observation("actuator_forces", terms.forces),
        Observation("contact", lambda transition: transition.variables["last_contact"]),
        Observation("foot_velocities", feet.velocities),
        Observation("air_time", lambda transition: transition.variables["air_time"]),
    )


def _rewards(model: Model, feet: terms.Feet) -> tuple[Reward, ...]:
    lower, upper = np.asarray(model.joints.range)[1:].T
    mid, half = 0.5 * (lower + upper), 0.5 * SOFT * (upper - lower)
    hands = [(f"{side}_hand", f"{side}_thigh") for side in SIDES]
    return (
        Reward("tracking_lin_vel", terms.track_velocity(PELVIS), 1.0),
        Reward("tracking_ang_vel", terms.track_yaw_rate(PELVIS), 0.75),
        Reward("ang_vel_xy", terms.roll_and_pitch_rate(TORSO), -0.15),
        Reward("orientation", terms.axis_error(TORSO, (0.073, 0.0, 1.0)), -2.0),
        Reward("feet_air_time", feet.air_time_reward(0.2, 0.5, always=True), 2.0),
        Reward("feet_slip", feet.base_slip(PELVIS), -0.25),
        Reward("feet_phase", terms.follow_phase(feet, SWING, PELVIS), 1.0),
        Reward("stand_still", terms.stand_still(HOME), -1.0),
        Reward("termination", terms.terminated, -100.0),
        Reward("collision", terms.any_touching(hands), -0.1),
        Reward("contact_force", terms.excess_load(feet, LOAD), -0.01),
        Reward("joint_deviation_knee", _deviation(model, ["knee"]), -0.1),
        Reward("joint_deviation_hip", _hip_deviation(model), -0.25),
        Reward("dof_pos_limits", terms.joint_limit_violation(mid - half, mid + half), -1.0),
        Reward("pose", terms.pose_error(HOME), -0.1),
    )


def _joints(model: Model, kinds: list[str]) -> np.ndarray:
    """Return 1 for the joints of some kinds on both sides, else 0, (29,)."""
    names = [f"{side}_{kind}_joint" for side in SIDES for kind in kinds]
    return np.array([float(name in names) for name in model.joint_names[1:]])


def _deviation(model: Model, kinds: list[str]) -> terms.Term:
    return terms.joint_deviation(HOME, _joints(model, kinds))


def _hip_deviation(model: Model) -> terms.Term:
    """Return the term of hip roll and yaw; the roll is free if the lateral command is large."""
    roll, yaw = (_joints(model, [kind]) for kind in ("hip_roll", "hip_yaw"))

    def weights(transition: Any) -> jax.Array:
        free = transition.variables["command"][1] > LATERAL
        return jnp.where(free, jnp.asarray(yaw), jnp.asarray(roll + yaw))

    return terms.joint_deviation(HOME, weights)


def _values(pushes: bool) -> dict[str, Any]:
    """Return the ranges of commands, m/s and rad/s, of the gait, Hz, and of pushes."""
    values: dict[str, Any] = {
        "command_low": np.array([-1.0, -0.5, -1.0]),
        "command_high": np.array([1.0, 0.5, 1.0]),
        "command_stop": 0.1,
        "gait_rate": np.array([1.25, 1.5]),
    }
    if pushes:
        values |= {"push_time": np.array([5.0, 10.0]), "push_speed": np.array([0.1, 2.0])}
    return values


def _randomisations(model: Model) -> tuple[Randomisation, ...]:
    return (
        terms.set_pair_friction("floor_friction", range(len(FEET)), 0.4, 1.0),
        *terms.joint_randomisations(model, friction=(0.5, 2.0), armature=(1.0, 1.05), zero=0.05),
        *terms.mass_randomisations(model, BODY, factor=(0.9, 1.1), added=1.0),
    )
