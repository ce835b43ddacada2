"""Identification jobs that are defined by a TOML file."""
