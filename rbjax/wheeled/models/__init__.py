"""Equations of motion of wheeled robots, one fidelity a file."""
