"""Attitude: unit quaternions, exponential and logarithm, exact near the identity."""

from rbjax.rotations import quaternion

__all__ = ["quaternion"]
