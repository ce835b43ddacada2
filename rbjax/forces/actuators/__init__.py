"""Actuators: transmissions, force laws from controls to forces, and losses."""
