"""Optimal control: problems, methods, their solutions, and model predictive control."""
