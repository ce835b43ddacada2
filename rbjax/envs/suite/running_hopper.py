"""A planar hopper runs forward, with smooth rewards, for learners by gradients.

z is the height of the torso over its height at the start, th its pitch.
    forward   the speed v_x of the torso, m/s
    height    -200 d^2 if d < 0, else d,  d = clip(z + 0.3, -1, 0.3)
    upright   1 - (th / 30 deg)^2
    effort    -0.1 sum of u_i^2
The reward of a step is their sum. An episode begins upright at rest, up to 0.05 m, rad, m/s and
rad/s. It ends if z < -0.45 m, or after 1,000 control steps of 1/60 s. Controls in -1..1 are torques
of 200 N m.

The rewards have a slope nearly everywhere, and a robot that falls is not simulated on the floor.
`hopper_hop` has neither.

Source: Xu et al., *Accelerated policy learning with parallel differentiable simulation*, 2022, the
hopper. There, contacts are springs and dampers; here, those of the file.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.envs.episode import Params
from rbjax.envs.registry import register
from rbjax.envs.robot_files import robot_file
from rbjax.envs.task import Observation, Reward, Task
from rbjax.loading import load
from rbjax.model import State

#: least z of an episode, and z at which the reward of the height has its kink, m
LOW, BENT = -0.45, -0.3


@register("hopper_run")
def hopper_run() -> Task:
    """Run forward on one leg.

    Source: Xu et al., *Accelerated policy learning with parallel differentiable simulation*, 2022.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("hopper_run").observation_size
        11
    """
    return Task(
        "hopper_run",
        load(robot_file("running_hopper")),
        start,
        {
            "policy": (
                Observation("position", lambda transition: transition.after.q[1:]),
                Observation("velocity", lambda transition: transition.after.v),
            )
        },
        (
            Reward("forward", lambda transition: transition.after.v[0]),
            Reward("height", height),
            Reward("upright", upright),
            Reward("effort", lambda transition: (transition.ctrl**2).sum(), -0.1),
        ),
        terminations={"low": lambda transition: transition.after.q[1] < LOW},
        decimation=4,
        total_reward=lambda rewards, dt: sum(rewards.values()),
        tracked="torso",
    )


def start(key: jax.Array, params: Params) -> State:
    """Draw coordinates and velocities near zero."""
    drawn = jax.random.uniform(key, (2, params.model.nv), minval=-0.05, maxval=0.05)
    return State(*drawn)


def height(transition: Any) -> jax.Array:
    """Reward a high torso, and punish a low one."""
    d = jnp.clip(transition.after.q[1] - BENT, -1.0, 0.3)
    return jnp.where(d < 0, -200 * d * d, d)


def upright(transition: Any) -> jax.Array:
    """Reward an upright torso."""
    return 1 - (transition.after.q[2] / math.radians(30)) ** 2
