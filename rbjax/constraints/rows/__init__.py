"""Constraints and their rows: scalars of the motion with two derivatives in time."""
