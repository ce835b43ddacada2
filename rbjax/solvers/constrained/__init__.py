"""Implicit methods for differential-algebraic equations of motion."""
