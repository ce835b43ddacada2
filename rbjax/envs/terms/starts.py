"""`planar_start`: random initial angles of a planar robot."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.envs.episode import Params
from rbjax.model import Model, State


def planar_start(model: Model, root: str) -> Callable[[jax.Array, Params], State]:
    """Return the start of an episode at rest with random angles: those of joints with a range
    uniform in it, and that of the hinge `root`, the attitude of the robot, in -pi..pi.

    The robot may be in the floor at the start, which pushes it out.

    model: the robot, of slides and hinges. root: name of a joint.

    Source: Tassa et al., *DeepMind Control Suite*, 2018, `randomize_limited_and_rotational_joints`.
    """
    low, high = np.where(np.isfinite(model.joints.range), model.joints.range, 0.0).T
    at = model.topology.joint_q[model.joint(root)]
    low, high = np.array(low), np.array(high)
    low[at], high[at] = -math.pi, math.pi

    def start(key: jax.Array, params: Params) -> State:
        q = jax.random.uniform(key, (model.nq,), minval=jnp.asarray(low), maxval=jnp.asarray(high))
        return State(q, jnp.zeros(model.nv))

    return start
