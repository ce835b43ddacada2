"""Wheeled robots: bodies, wheels, drives, steerings, motors, and the catalogue of kinds."""
