"""Robots in the browser by viser: motions, batches, contact forces, joint sliders.

Files:
    scene.py: the nodes of a film on a server: bodies, ghosts, tubes, arrows, ground.
    controls.py: buttons and sliders of a motion or of a posture.
    viewing.py: `view`, `Viewer`: a server, its scene and its controls.
    sources.py: the motion of a file, a trajectory, a task or a policy.
"""

from rbjax.viewer.sources import RobotMotion, motion_of, motion_of_policy
from rbjax.viewer.viewing import Viewer, view

__all__ = ["RobotMotion", "Viewer", "motion_of", "motion_of_policy", "view"]

__dir__ = __all__.copy
