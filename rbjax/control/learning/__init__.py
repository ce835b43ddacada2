"""Policies trained through the dynamics of an environment."""
