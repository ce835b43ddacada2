"""Motions of wheeled robots: rollout, simulation, tracking, the system for optimal control."""
