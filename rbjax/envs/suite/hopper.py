"""A planar hopper: stand, or hop forward.

h is the height of the torso's center of mass over that of the foot, v_x the mean forward velocity.
    hopper_stand   standing * small_control
    hopper_hop     standing * hopping
    standing       1 if 0.6 <= h <= 2 m, else 0
    small_control  (4 + mean of tolerance(u_i, margin 1, quadratic, 0 at the margin)) / 5
    hopping        tolerance(v_x, at least 2 m/s, margin 1 m/s, linear, 0.5 at the margin)
Controls in -1..1 are torques of 30, 40, 30 and 10 N m. Episodes of 20 s, in control steps of
0.02 s, begin with random angles, and have no other end. The observation "touch" is the logarithm of
the forces under toe and heel at the end of a control step, one solution of the contacts more than
the physics needs; Playground's are those at the beginning of the last physics step.

The reward "standing" has no slope, so a learner by gradients does not see it.

Source: Tassa et al., *DeepMind Control Suite*, 2018 (hopper); step and resets of MuJoCo Playground
0.2.0.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.envs.registry import register
from rbjax.envs.robot_files import robot_file
from rbjax.envs.task import Observation, Reward, Task
from rbjax.envs.terms.products import product_of_rewards
from rbjax.envs.terms.sigmoids import tolerance
from rbjax.envs.terms.starts import planar_start
from rbjax.loading import load
from rbjax.model import Frame
from rbjax.sensors import SubtreeVelocity, Touch, Volume

STANDING_HEIGHT = 0.6
HOPPING_SPEED = 2.0

_PAD = Volume("sphere", (0.05,))
_TOE, _HEEL = (Touch(Frame(site=name), volume=_PAD) for name in ("toe", "heel"))
_VELOCITY = SubtreeVelocity("torso")


@register("hopper_stand")
def hopper_stand(*, touch: bool = True) -> Task:
    """Stand up and keep the balance.

    touch: whether the forces under the foot are observed.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("hopper_stand").observation_size
        15
    """
    return _task("hopper_stand", small_control, touch)


@register("hopper_hop")
def hopper_hop(*, touch: bool = True) -> Task:
    """Stand up and hop forward at 2 m/s or more.

    touch: whether the forces under the foot are observed.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("hopper_hop", touch=False).observation_size
        13
    """
    return _task("hopper_hop", hopping, touch)


def _task(name: str, second: Any, touch: bool) -> Task:
    model = load(robot_file("hopper"))
    terms = [
        Observation("position", lambda transition: transition.after.q[1:]),
        Observation("velocity", lambda transition: transition.after.v),
    ]
    if touch:
        terms.append(Observation("touch", foot_forces))
    return Task(
        name,
        model,
        planar_start(model, "rooty"),
        {"policy": tuple(terms)},
        (Reward("standing", standing), Reward(second.__name__, second)),
        decimation=4,
        total_reward=product_of_rewards,
        tracked="torso",
    )


def foot_forces(transition: Any) -> jax.Array:
    """Observe log(1 + f) (2,) of the normal forces f under toe and heel, N."""
    return jnp.log1p(jnp.concatenate([_TOE(transition.after), _HEEL(transition.after)]))


def standing(transition: Any) -> jax.Array:
    """Reward a torso that is high over the foot."""
    torso, foot = (
        transition.after.frame(Frame(center=name)).position[2] for name in ("torso", "foot")
    )
    return tolerance(torso - foot, (STANDING_HEIGHT, 2.0))


def hopping(transition: Any) -> jax.Array:
    """Reward the forward speed of the center of mass."""
    speed, bounds = _VELOCITY(transition.after)[0], (HOPPING_SPEED, math.inf)
    return tolerance(speed, bounds, HOPPING_SPEED / 2, "linear", 0.5)


def small_control(transition: Any) -> jax.Array:
    """Reward small controls."""
    return (4 + tolerance(transition.ctrl, (0, 0), 1, "quadratic", 0.0).mean()) / 5
