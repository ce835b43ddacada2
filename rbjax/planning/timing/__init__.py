"""Motions in time along a path, within limits of torque, speed and steering."""
