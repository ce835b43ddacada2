"""Policies trained through the dynamics of an environment."""

from rbjax.control.learning.environment import Environment
from rbjax.control.learning.networks import network
from rbjax.control.learning.policy_gradient import Trained, actor_critic, through_time

__all__ = ["Environment", "Trained", "actor_critic", "network", "through_time"]
