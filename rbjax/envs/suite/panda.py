"""A Panda arm that picks up a cube and brings it to a target in the air.

reward = 4 gripper_box + 8 box_target + 0.25 no_floor_collision + 0.3 robot_target, with
    gripper_box         1 - tanh(5 |p_box - p_gripper|)
    box_target          1 - tanh(5 (0.9 |p_target - p_box| + 0.1 |E|)) once |p_box - p_gripper| was
                        below 0.012 m, before 0; E: two rows of R_target - R_box
    no_floor_collision  1 if neither the hand nor a finger touches the floor, else 0
    robot_target        1 - tanh(|q_arm - q_home|)
Controls are targets of servos; actions of -1..1 add 0.04 times themselves to them, in rad or m.
The cube begins at (0.7, 0, 0.03) m +- 0.2 m in x and y, the target at +- 0.2 m, 0.2 to 0.4 m above.
An episode is 150 control steps of 0.02 s. It ends if the cube is farther than 1 m along an axis, or
its center below the floor.

Source: MuJoCo Playground 0.2.0, PandaPickCube and PandaPickCubeOrientation (Zakka et al., 2025).
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.envs.actions import Increment
from rbjax.envs.episode import Params
from rbjax.envs.registry import register
from rbjax.envs.robot_files import robot_file
from rbjax.envs.task import Observation, Reward, Task, Variable
from rbjax.envs.terms.frames import norm
from rbjax.envs.terms.products import clipped_sum
from rbjax.envs.terms.touch import any_touching
from rbjax.lanes import Mat3
from rbjax.lanes.algebra import quaternion_matrix
from rbjax.loading import load
from rbjax.model import State

ARM, CUBE = 7, 9  # joints of the arm; the coordinate at which those of the cube begin
REACHED = 0.012  # m
LARGEST_TILT = math.radians(45)


@register("panda_pick_cube")
def panda_pick_cube(*, orientation: bool = False) -> Task:
    """Pick up a cube and bring it to a target.

    orientation: whether the target is turned by up to 45 degrees about a random axis.

    Example:
        >>> import rbjax as rb
        >>> env = rb.envs.make("panda_pick_cube")
        >>> env.observation_size, env.action_size
        (66, 8)
    """
    model = load(robot_file("panda_cube"))
    q_home = np.asarray(model.keyframe("home").q)

    def start(key: jax.Array, params: Params) -> State:
        shift = jax.random.uniform(key, (2,), minval=-0.2, maxval=0.2)
        q = jnp.asarray(q_home, shift.dtype)
        return State(q.at[CUBE : CUBE + 2].add(shift), jnp.zeros(model.nv, shift.dtype))

    def target(key: jax.Array, params: Params) -> jax.Array:
        low, high = jnp.array([-0.2, -0.2, 0.2]), jnp.array([0.2, 0.2, 0.4])
        return jnp.asarray(q_home[CUBE : CUBE + 3]) + jax.random.uniform(
            key, (3,), minval=low, maxval=high
        )

    def robot_target(transition: Any) -> jax.Array:
        """Reward an arm near its home."""
        return 1 - jnp.tanh(
            norm(transition.after.q[:ARM] - jnp.asarray(q_home[:ARM], transition.after.q.dtype))
        )

    variables = [
        Variable("target", target),
        Variable("reached", lambda key, params: jnp.zeros(()), measure=reached),
    ]
    if orientation:
        variables.append(Variable("target_attitude", tilted))
    return Task(
        "panda_pick_cube",
        model,
        start,
        {"policy": OBSERVATIONS},
        (
            Reward("gripper_box", gripper_box, 4.0),
            Reward("box_target", box_target, 8.0),
            Reward("no_floor_collision", no_floor_collision, 0.25),
            Reward("robot_target", robot_target, 0.3),
        ),
        action=Increment(0.04, q_home[: model.nu]),
        variables=tuple(variables),
        terminations={"out_of_bounds": out_of_bounds},
        decimation=4,
        episode=150,
        total_reward=clipped_sum(-1e4, 1e4),
        tracked="hand",
    )


def tilted(key: jax.Array, params: Params) -> jax.Array:
    """Draw an attitude (4,), a quaternion, up to 45 degrees about a random axis."""
    of_axis, of_angle = jax.random.split(key)
    axis = jax.random.uniform(of_axis, (3,), minval=-1.0, maxval=1.0)
    half = 0.5 * jax.random.uniform(of_angle, (), maxval=LARGEST_TILT)
    unit = axis / jnp.sqrt((axis * axis).sum())
    return jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * unit])


def _rows(R: Mat3, first: int, transition: Any) -> jax.Array:
    """Return two rows of a rotation matrix (6,)."""
    x = [jnp.asarray(R[i], transition.after.q.dtype) for i in range(first, first + 6)]
    return jnp.stack(x)


def _box(transition: Any) -> jax.Array:
    return transition.after.body("cube").position.array


def _gripper(transition: Any) -> jax.Array:
    """Observe the position (3,) of the gripper in world axes, m."""
    return transition.after.site("gripper").position.array


def attitude_error(transition: Any) -> jax.Array:
    """Observe the first two rows (6,) of R_target - R_box."""
    quaternion = transition.variables.get("target_attitude")
    goal = Mat3.identity() if quaternion is None else quaternion_matrix(*quaternion)
    return _rows(goal, 0, transition) - _rows(transition.after.body("cube").rotation, 0, transition)


def servo_error(transition: Any) -> jax.Array:
    """Observe the controls minus the coordinates that they drive (8,)."""
    return transition.ctrl - transition.after.q[: transition.model.nu]


OBSERVATIONS = (
    Observation("q", lambda transition: transition.after.q),
    Observation("v", lambda transition: transition.after.v),
    Observation("gripper", _gripper),
    Observation(
        "gripper_attitude",
        lambda transition: _rows(transition.after.site("gripper").rotation, 3, transition),
    ),
    Observation(
        "box_attitude",
        lambda transition: _rows(transition.after.body("cube").rotation, 3, transition),
    ),
    Observation("box_from_gripper", lambda transition: _box(transition) - _gripper(transition)),
    Observation(
        "target_from_box", lambda transition: transition.variables["target"] - _box(transition)
    ),
    Observation("attitude_error", attitude_error),
    Observation("servo_error", servo_error),
)


def reached(transition: Any) -> jax.Array:
    """Return 1 if the gripper has been at the box in this episode, else 0."""
    near = norm(_box(transition) - _gripper(transition)) < REACHED
    return jnp.where(near, 1.0, transition.variables["reached"])


def gripper_box(transition: Any) -> jax.Array:
    """Reward a gripper at the box."""
    return 1 - jnp.tanh(5 * norm(_box(transition) - _gripper(transition)))


def box_target(transition: Any) -> jax.Array:
    """Reward a box at the target, once the gripper has been at it."""
    distance, turned = (
        norm(transition.variables["target"] - _box(transition)),
        norm(attitude_error(transition)),
    )
    return (1 - jnp.tanh(5 * (0.9 * distance + 0.1 * turned))) * transition.variables["reached"]


_ON_THE_FLOOR = any_touching([(geom, "floor") for geom in ("left_tip", "right_tip", "hand")])


def no_floor_collision(transition: Any) -> jax.Array:
    """Reward 1 if neither the hand nor a finger touches the floor."""
    return jnp.where(_ON_THE_FLOOR(transition), 0.0, 1.0)


def out_of_bounds(transition: Any) -> jax.Array:
    """Check whether the box is farther than 1 m along an axis, or its center below the floor."""
    p = _box(transition)
    return jnp.any(jnp.abs(p) > 1.0) | (p[2] < 0.0)
