"""Recordings of a robot: how they are read, checked, split, filtered and corrected."""
