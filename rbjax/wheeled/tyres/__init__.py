"""Tyres: force laws, relaxation, rolling resistance, and a force element for any model."""
