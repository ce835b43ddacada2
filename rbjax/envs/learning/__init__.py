"""Learners of policies on environments: PPO by Brax, SHAC by gradients through the environment.

Files:
    training.py: `train`, a policy for a named task, with progress, table, chart and checkpoint.
    task_settings.py: settings of trainings by task and algorithm.
    proximal.py: proximal policy optimisation, by Brax.
    brax_networks.py: conversion of networks that Brax trained.
    short_horizon.py: SHAC, short-horizon actor-critic.
    whole_episodes.py: back-propagation through whole episodes.
    samples.py: a batch of episodes that advances with a policy, differentiably.
    targets.py: objective of the policy, targets of the value function.
    critic.py: the value function.
    policy.py: `Policy`, an observation to an action.
    networks.py: feed-forward networks, running statistics of observations.
    updates.py: gradient steps that skip gradients that are not finite.
    iterations.py: compiled loops on one device or several.
    evaluation.py: returns of whole episodes.
    report.py: progress, table and chart.
    checkpoint.py: checkpoints of policies.
    trained.py: the result of a training.
    checks.py: checks of arguments.
"""

from rbjax.envs.learning.checkpoint import load_policy, save_policy
from rbjax.envs.learning.critic import Critic, new_critic
from rbjax.envs.learning.evaluation import Episodes, evaluate
from rbjax.envs.learning.networks import Network, Normaliser, network
from rbjax.envs.learning.policy import Policy, new_policy
from rbjax.envs.learning.proximal import ppo
from rbjax.envs.learning.report import Monitor
from rbjax.envs.learning.short_horizon import shac
from rbjax.envs.learning.task_settings import settings
from rbjax.envs.learning.trained import Trained
from rbjax.envs.learning.training import train
from rbjax.envs.learning.whole_episodes import through_time

__all__ = [
    "Critic",
    "Episodes",
    "Monitor",
    "Network",
    "Normaliser",
    "Policy",
    "Trained",
    "evaluate",
    "load_policy",
    "network",
    "new_critic",
    "new_policy",
    "ppo",
    "save_policy",
    "settings",
    "shac",
    "through_time",
    "train",
]

__dir__ = __all__.copy
