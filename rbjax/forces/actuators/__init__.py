"""Actuators: transmissions, laws from controls to forces, and their losses."""
