"""Simulation of recordings: set-up, motion, simulation error and its Jacobian."""
