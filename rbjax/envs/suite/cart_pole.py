"""Cart and pole on a rail: balance the pole, or swing it up first.

reward = upright * centered * small_control * small_velocity, each between 0 and 1:
    upright         (1 + cos q_1) / 2
    centered        (1 + tolerance(q_0, margin 2)) / 2
    small_control   (4 + tolerance(u, margin 1, quadratic, 0 at the margin)) / 5
    small_velocity  (1 + tolerance(v_1, margin 5)) / 2
or, sparse, 1 if |q_0| <= 0.25 m and cos q_1 >= 0.995, else 0. The control u in -1..1 is a force of
-10..10 N on the cart. A control step is 0.01 s, an episode 10 s.

Source: Tassa et al., *DeepMind Control Suite*, 2018 (cartpole); resets and numbers of MuJoCo
Playground 0.2.0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.envs.episode import Params
from rbjax.envs.registry import register
from rbjax.envs.robot_files import robot_file
from rbjax.envs.task import Observation, Reward, Task
from rbjax.envs.terms.products import product_of_rewards
from rbjax.envs.terms.sigmoids import tolerance
from rbjax.loading import load
from rbjax.model import State


@register("cart_pole_balance")
def cart_pole_balance(*, sparse: bool = False) -> Task:
    """Balance a pole that starts within 2 degrees of the upright position.

    sparse: True for the reward that is 0 or 1.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("cart_pole_balance", sparse=True).action_size
        1
    """
    return _task("cart_pole_balance", _near_the_top, sparse)


@register("cart_pole_swing_up")
def cart_pole_swing_up(*, sparse: bool = False) -> Task:
    """Swing up a pole that hangs down, and balance it.

    sparse: True for the reward that is 0 or 1.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.make("cart_pole_swing_up").episode
        1000
    """
    return _task("cart_pole_swing_up", _hanging, sparse)


def _task(name: str, start: Callable[[jax.Array, Params], State], sparse: bool) -> Task:
    return Task(
        name,
        load(robot_file("cart_pole_on_rail")),
        start,
        {
            "policy": (
                Observation("cart_position", lambda transition: transition.after.q[0]),
                Observation("pole_direction", pole_direction),
                Observation("velocity", lambda transition: transition.after.v),
            )
        },
        _SPARSE if sparse else _DENSE,
        total_reward=product_of_rewards,
        tracked="cart",
    )


def _near_the_top(key: jax.Array, params: Params) -> State:
    pose, velocity = jax.random.split(key)
    most = jnp.array([0.1, 0.034])  # m, rad
    q = jax.random.uniform(pose, (2,), minval=-most, maxval=most)
    return State(q, 0.01 * jax.random.normal(velocity, (2,)))


def _hanging(key: jax.Array, params: Params) -> State:
    x = 0.01 * jax.random.normal(key, (4,))
    return State(jnp.stack([x[0], math.pi + x[1]]), x[2:])


def pole_direction(transition: Any) -> jax.Array:
    """Observe the height and the horizontal offset (2,) of the tip of a pole of length 1."""
    return jnp.stack([jnp.cos(transition.after.q[1]), jnp.sin(transition.after.q[1])])


def upright(transition: Any) -> jax.Array:
    """Reward the height of the pole: 1 up, 0 down."""
    return (1 + jnp.cos(transition.after.q[1])) / 2


def centered(transition: Any) -> jax.Array:
    """Reward a cart near the center of the rail."""
    return (1 + tolerance(transition.after.q[0], margin=2)) / 2


def small_control(transition: Any) -> jax.Array:
    """Reward small controls."""
    return (4 + tolerance(transition.ctrl[0], (0, 0), 1, "quadratic", 0.0)) / 5


def small_velocity(transition: Any) -> jax.Array:
    """Reward a slow pole."""
    return (1 + tolerance(transition.after.v[1], margin=5)) / 2


def cart_in_bounds(transition: Any) -> jax.Array:
    """Reward 1 if the cart is within 0.25 m of the center."""
    return tolerance(transition.after.q[0], (-0.25, 0.25))


def angle_in_bounds(transition: Any) -> jax.Array:
    """Reward 1 if the pole is within 5.7 degrees of the upright position."""
    return tolerance(jnp.cos(transition.after.q[1]), (0.995, math.inf))


_DENSE = tuple(Reward(f.__name__, f) for f in (upright, centered, small_control, small_velocity))
_SPARSE = tuple(Reward(f.__name__, f) for f in (cart_in_bounds, angle_in_bounds))
