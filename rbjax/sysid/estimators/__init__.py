"""Estimators of unknown parameters from the motion of a robot."""
