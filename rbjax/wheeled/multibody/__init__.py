"""Wheeled robots as a `Model` with rows for rolling wheels."""
