"""Robots in the browser by viser: motions, batches, contact forces, joint sliders.

Files:
    scene.py: the nodes of a film on a server: bodies, ghosts, tubes, arrows, ground.
    controls.py: buttons and sliders of a motion or of a posture.
    viewing.py: `view`, `Viewer`: a server, its scene and its controls.
    sources.py: what a file, a trajectory or a task has to show.
"""

from rbjax.viewer.sources import Subject, subject_of, subject_of_policy
from rbjax.viewer.viewing import Viewer, view

__all__ = ["Subject", "Viewer", "subject_of", "subject_of_policy", "view"]


def __dir__() -> list[str]:
    return __all__
