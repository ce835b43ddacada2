"""Tendons: paths around geoms, lengths and moment arms, springs."""
