"""Impacts: impulses between geoms, and time stepping with impulses."""
