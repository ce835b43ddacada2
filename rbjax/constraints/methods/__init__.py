"""Formulations: methods that solve the equations of constrained motion."""
