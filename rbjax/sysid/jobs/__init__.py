"""Identification jobs that are described by a TOML file."""
