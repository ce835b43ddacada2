"""Paths in the plane: shortest curves, chains of twists, smoothing."""
