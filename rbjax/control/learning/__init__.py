"""Policies trained through the dynamics of an environment."""

from rbjax.control.learning.environment import Environment, network
from rbjax.control.learning.policy_gradient import actor_critic
from rbjax.control.learning.training import Trained, through_time

__all__ = ["Environment", "Trained", "actor_critic", "network", "through_time"]
