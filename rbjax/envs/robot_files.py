"""The MJCF files of the robots of tasks."""

from __future__ import annotations

from pathlib import Path


def robot_file(name: str) -> Path:
    """Return the path of the file of a robot in the folder `robots`, by its name without suffix.

    Example:
        >>> from rbjax.envs.robot_files import robot_file
        >>> robot_file("go1").name
        'go1.xml'
    """
    return Path(__file__).parent / "robots" / f"{name}.xml"
