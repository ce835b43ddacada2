"""Trajectories and controllers, designed by gradients."""
