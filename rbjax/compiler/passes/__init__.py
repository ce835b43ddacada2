"""Analyses and transformations of a finished program."""
