"""Kinematics and dynamics of trees: one file for each algorithm."""
