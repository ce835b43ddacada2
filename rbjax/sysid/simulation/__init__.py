"""Simulation of recordings: the set-up, its motions, the simulation error and its Jacobian."""
