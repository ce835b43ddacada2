"""Valid calls of the terms of environments, as in `tests.public.calls`: an environment is made with
each term, which evaluates it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from rbjax import envs
from rbjax.envs import terms
from tests.public.transitions import FEET, MODEL, VARIABLES

Calls = dict[str, dict[str, Any]]


def environment_with(term: Callable[..., Any], **given: Any) -> None:
    """Make an environment with a term of these arguments among its observations."""
    made = term(**given)
    observed = envs.Observation("x", lambda transition: jnp.asarray(made(transition), float))
    variables = [
        envs.Variable(name, lambda key, params, x=x: jnp.asarray(x))
        for name, x in VARIABLES.items()
    ]
    task = envs.Task(
        "small", MODEL, start=lambda key, params: MODEL.default_state(),
        observations={"policy": (observed,)}, variables=tuple(variables), episode=5,
        rewards=(envs.Reward("height", lambda transition: transition.after.q[2]),),
    )  # fmt: skip
    envs.Environment(task, kernel=False)


COMMAND = {"frame": "imu", "command": "command", "width": 0.2}
POSE = {"home": (0.0, 0.1), "weights": 1.0}
TERMS: Calls = {
    "axis_error": {"frame": "imu", "target": (0.0, 0.0, 1.0)},
    "tilt": {"frame": "imu"},
    "fallen": {"frame": "imu", "least": 0.1},
    "gravity_direction": {"frame": "imu"},
    "roll_and_pitch_rate": {"frame": "imu"},
    "track_velocity": COMMAND,
    "track_yaw_rate": COMMAND,
    "joint_offsets": {"home": (0.0, 0.1)},
    "joint_velocities": {"count": 2},
    "pose_error": POSE,
    "pose_similarity": POSE,
    "joint_deviation": POSE,
    "stand_still": {"home": (0.0, 0.1), "command": "command"},
    "joint_limit_violation": {"lower": (-0.1, -0.1), "upper": (0.1, 0.1)},
    "follow_phase": {"feet": FEET, "height": 0.1, **COMMAND},
    "touching": {"pairs": FEET.pairs, "reach": 0.0},
    "any_touching": {"pairs": FEET.pairs, "reach": 0.0},
    "excess_load": {"feet": FEET, "most": 5.0, "floor": 0.0},
}
ROOMS: dict[str, tuple[Any, Calls]] = {"envs.terms": (terms, TERMS)}
OTHERS: dict[str, Callable] = {
    f"envs.terms.{name}": functools.partial(environment_with, getattr(terms, name))
    for name in TERMS
}
