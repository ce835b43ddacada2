"""Kinematics and dynamics of trees: one algorithm a file."""
