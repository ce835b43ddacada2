"""A planar walker of two legs: stand, walk, or run.

    walker_stand  stand = (3 standing + upright) / 4
    walker_walk   stand * (5 moving + 1) / 6,  with the speed s = 1 m/s
    walker_run    the same with s = 8 m/s
    standing      tolerance(height of the torso, at least 1.2 m, margin 0.6 m)
    upright       (1 + z_z) / 2, with the axis z of the torso
    moving        tolerance(v_x, at least s, margin s / 2, linear, 0.5 at the margin)
Controls in -1..1 are torques of 100, 50 and 20 N m at hip, knee and ankle. Episodes of 25 s, in
control steps of 0.025 s, begin with random angles, and have no other end.

Source: Tassa et al., *DeepMind Control Suite*, 2018 (walker); step and resets of MuJoCo Playground
0.2.0, whose observation "height" is z_z instead of the height.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import real_number
from rbjax.envs.registry import register
from rbjax.envs.robot_files import robot_file
from rbjax.envs.task import Observation, Reward, Task
from rbjax.envs.terms.sigmoids import tolerance
from rbjax.envs.terms.starts import planar_start
from rbjax.loading import load
from rbjax.sensors import SubtreeVelocity

STANDING_HEIGHT = 1.2

_VELOCITY = SubtreeVelocity("torso")


@register("walker_stand")
def walker_stand() -> Task:
    """Stand up and keep the balance.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("walker_stand").observation_size
        24
    """
    return _task("walker_stand", None)


@register("walker_walk")
def walker_walk(*, speed: float = 1.0) -> Task:
    """Walk forward.

    speed: velocity of the center of mass from which on the reward is full, m/s.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("walker_walk").action_size
        6
    """
    return _task("walker_walk", speed)


@register("walker_run")
def walker_run(*, speed: float = 8.0) -> Task:
    """Run forward.

    speed: velocity of the center of mass from which on the reward is full, m/s.

    Example:
        >>> import rbjax as rb
        >>> float(rb.envs.make("walker_run").default_params.values["speed"])
        8.0
    """
    return _task("walker_run", speed)


def _task(name: str, speed: float | None) -> Task:
    model = load(robot_file("walker"))
    rewards = [Reward("standing", standing), Reward("upright", upright)]
    if speed is not None:
        rewards.append(Reward("moving", moving))
    return Task(
        name,
        model,
        planar_start(model, "rooty"),
        {
            "policy": (
                Observation("orientations", orientations),
                Observation(
                    "height", lambda transition: transition.after.body("torso").position[2]
                ),
                Observation("velocity", lambda transition: transition.after.v),
            )
        },
        tuple(rewards),
        decimation=10,
        values={} if speed is None else {"speed": real_number(name, "speed", speed, above=0.0)},
        total_reward=total_of_walker,
        tracked="torso",
    )


def orientations(transition: Any) -> jax.Array:
    """Observe the x and z components of the x axis in the frame of each body (14,)."""
    out = []
    for b in range(transition.model.nb):
        R = transition.after.body(b).rotation
        out += [R[0], R[2]]
    return jnp.stack([jnp.asarray(x, transition.after.q.dtype) for x in out])


def standing(transition: Any) -> jax.Array:
    """Reward a high torso."""
    height = transition.after.body("torso").position[2]
    return tolerance(height, (STANDING_HEIGHT, math.inf), STANDING_HEIGHT / 2)


def upright(transition: Any) -> jax.Array:
    """Reward an upright torso: 1 up, 0 down."""
    return (1 + transition.after.body("torso").rotation[8]) / 2


def moving(transition: Any) -> jax.Array:
    """Reward the forward speed of the center of mass."""
    speed = transition.params.values["speed"]
    return tolerance(_VELOCITY(transition.after)[0], (speed, math.inf), speed / 2, "linear", 0.5)


def total_of_walker(rewards: Mapping[str, jax.Array], dt: Any) -> Any:
    """Compute the reward of a control step from the weighted terms. dt is not used."""
    stand = (3 * rewards["standing"] + rewards["upright"]) / 4
    return stand * (5 * rewards["moving"] + 1) / 6 if "moving" in rewards else stand
