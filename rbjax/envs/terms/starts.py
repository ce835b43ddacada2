"""Random initial states: angles of a planar robot, pose of a floating base."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.arguments import check_model
from rbjax.envs.episode import Params
from rbjax.model import Model, State


def planar_start(model: Model, root: str) -> Callable[[jax.Array, Params], State]:
    """Return the start of an episode at rest with random angles: those of joints with a range
    uniform in it, and that of the hinge `root`, the attitude of the robot, in -pi..pi.

    The robot may be in the floor at the start, which pushes it out.

    Args:
        model: the robot, of slides and hinges.
        root: name of a joint.

    Returns:
        Function (key, params) that returns a `State` with q (nq,), rad or m, and zero velocity.

    Raises:
        UnknownName: no joint has this name.

    Source: Tassa et al., *DeepMind Control Suite*, 2018, `randomize_limited_and_rotational_joints`.

    Example:
        >>> import jax, rbjax as rb
        >>> start = rb.envs.terms.planar_start(rb.load("pendulum"), "hinge")
        >>> start(jax.random.key(0), None).q.shape
        (1,)
    """
    check_model("planar_start", model)
    low, high = np.where(np.isfinite(model.joints.range), model.joints.range, 0.0).T
    at = model.topology.joint_q[model.joint(root)]
    low, high = np.array(low), np.array(high)
    low[at], high[at] = -math.pi, math.pi

    def start(key: jax.Array, params: Params) -> State:
        q = jax.random.uniform(key, (model.nq,), minval=jnp.asarray(low), maxval=jnp.asarray(high))
        return State(q, jnp.zeros(model.nv))

    return start


def random_base(place: jax.Array, turn: jax.Array, height: float, reach: float = 0.5) -> jax.Array:
    """Draw the pose of a level floating base.

    Args:
        place, turn: keys () of `jax.random`, of the position and of the yaw.
        height: height of the base, m.
        reach: x and y are uniform in -reach..reach, m. The yaw is uniform in -pi..pi.

    Returns:
        (7,), position in m and unit quaternion (w, x, y, z).

    Source: Zakka et al., *MuJoCo Playground*, 2025, Go1 and G1 joystick.

    Example:
        >>> import jax
        >>> from rbjax.envs.terms import random_base
        >>> random_base(*jax.random.split(jax.random.key(0)), 0.3).shape
        (7,)
    """
    xy = jax.random.uniform(place, (2,), minval=-reach, maxval=reach)
    half = 0.5 * jax.random.uniform(turn, (), minval=-math.pi, maxval=math.pi)
    quaternion = jnp.stack([jnp.cos(half), 0.0 * half, 0.0 * half, jnp.sin(half)])
    return jnp.concatenate([xy, jnp.asarray([height], xy.dtype), quaternion])
