"""Wheeled robots from MJCF and URDF files, and as MJCF files."""
