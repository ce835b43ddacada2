"""Searches for a path on a map."""
