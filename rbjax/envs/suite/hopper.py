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

The reward "standing" has no slope. With the option `guided` it has a margin below 0.6 m, which the
curriculum narrows from 0.6 m to 0 over the first two thirds of a training by gradients.

Source: Tassa et al., *DeepMind Control Suite*, 2018 (hopper); step and resets of MuJoCo Playground
0.2.0.
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
from rbjax.envs.terms.products import product_of_rewards
from rbjax.envs.terms.sigmoids import tolerance
from rbjax.envs.terms.starts import planar_start
from rbjax.loading import load
from rbjax.model import Frame
from rbjax.sensors import SubtreeVelocity, Touch, Volume

STANDING_HEIGHT = 0.6
HOPPING_SPEED = 2.0
#: of the curriculum: margin at the beginning, m, and progress of the training at which it is 0
FIRST_MARGIN, NO_MARGIN_FROM = 0.6, 2 / 3

_PAD = Volume("sphere", (0.05,))
_TOE, _HEEL = (Touch(Frame(site=name), volume=_PAD) for name in ("toe", "heel"))
_VELOCITY = SubtreeVelocity("torso")


@register("hopper_stand")
def hopper_stand(*, touch: bool = True, guided: bool = False) -> Task:
    """Stand up and keep the balance.

    touch: whether the forces under the foot are observed.
    guided: whether the reward of standing has a slope at the beginning of a training, for SHAC.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("hopper_stand").observation_size
        15
    """
    return _task("hopper_stand", small_control, touch, guided)


@register("hopper_hop")
def hopper_hop(*, touch: bool = True, guided: bool = False) -> Task:
    """Stand up and hop forward at 2 m/s or more.

    touch: whether the forces under the foot are observed.
    guided: whether the reward of standing has a slope at the beginning of a training, for SHAC.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("hopper_hop", touch=False).observation_size
        13
    """
    return _task("hopper_hop", hopping, touch, guided)


def _task(name: str, second: Any, touch: bool, guided: bool) -> Task:
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
        values={"standing_margin": 0.0} if guided else {},
        total_reward=product_of_rewards,
        curriculum=narrow_margin if guided else None,
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
    margin = transition.params.values.get("standing_margin", 0.0)
    return tolerance(torso - foot, (STANDING_HEIGHT, 2.0), margin)


def narrow_margin(params: Params, progress: Any) -> Params:
    """Return the parameters at a progress of the training, with the margin of "standing"."""
    margin = FIRST_MARGIN * jnp.maximum(0.0, 1 - progress / NO_MARGIN_FROM)
    return params.replace(values={**params.values, "standing_margin": margin})


def hopping(transition: Any) -> jax.Array:
    """Reward the forward speed of the center of mass."""
    speed, bounds = _VELOCITY(transition.after)[0], (HOPPING_SPEED, math.inf)
    return tolerance(speed, bounds, HOPPING_SPEED / 2, "linear", 0.5)


def small_control(transition: Any) -> jax.Array:
    """Reward small controls."""
    return (4 + tolerance(transition.ctrl, (0, 0), 1, "quadratic", 0.0).mean()) / 5
