"""Environments: tasks for policies, as pure functions `reset` and `step` of one sample.

Files:
    task.py: `Task` and its terms (observations, rewards, variables, events, randomisation).
    task_table.py: the displays of tasks and environments.
    transition.py: `Transition`, the argument of all terms.
    actions.py: maps of actions to controls.
    episode.py: `Params` and `EnvState`, the pytrees.
    environment.py: `Environment`, `reset`, `step`, `unroll`.
    control_step.py: a control step of one sample.
    batch_step.py: a control step of a batch of episodes under a policy.
    optimal_control.py: a task as an optimal control problem.
    identification.py: observations as sensors, logs as recordings.
    checks.py: checks of tasks and parameters.
    registry.py: `tasks`, `make`, `register`.
    terrain.py: `rough_ground`.
    robot_files.py: the paths of the files of robots.

Subpackages:
    adapters: the environments in the interfaces of learning libraries.
    learning: learners of policies: PPO, SHAC, checkpoints.
    suite: the tasks, one a file.
    terms: observation and reward terms that tasks share.
    robots: MJCF files of robots.
"""

from rbjax.envs import adapters, learning, terms
from rbjax.envs.actions import Direct, Increment, Offset, Scaled
from rbjax.envs.environment import Environment
from rbjax.envs.episode import EnvState, Params
from rbjax.envs.identification import control_grid, log_recording, observation_sensors
from rbjax.envs.registry import make, register, tasks
from rbjax.envs.task import (
    Event,
    Observation,
    Randomisation,
    Reward,
    Task,
    Variable,
    random_offset,
    random_scale,
    sum_of_rewards,
)
from rbjax.envs.terrain import rough_ground
from rbjax.envs.transition import Transition

__all__ = [
    "Direct",
    "EnvState",
    "Environment",
    "Event",
    "Increment",
    "Observation",
    "Offset",
    "Params",
    "Randomisation",
    "Reward",
    "Scaled",
    "Task",
    "Transition",
    "Variable",
    "adapters",
    "control_grid",
    "learning",
    "log_recording",
    "make",
    "observation_sensors",
    "random_offset",
    "random_scale",
    "register",
    "rough_ground",
    "sum_of_rewards",
    "tasks",
    "terms",
]

__dir__ = __all__.copy
