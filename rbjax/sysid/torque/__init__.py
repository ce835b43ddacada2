"""Identification from torques, which are linear in the inertial parameters."""
