"""Implicit and linearly implicit Runge-Kutta methods."""
