"""Attitude and pose: SO(3), unit quaternions, SE(3), and every representation of attitude.

Arrays are (..., n). Leading axes are a batch and broadcast against each other, as with `vmap`.
Functions and all their derivatives are smooth at removable singularities. At a genuine singularity
`singularity_distance` is 0. The result is then one of several solutions, or very large but finite.
"""

from rbjax.rotations import incremental, quaternion, screws, se3, so3
from rbjax.rotations.representation import Representation, convert, representations
from rbjax.rotations.vectorial import mrp_shadow, mrp_short

__all__ = [
    "Representation",
    "convert",
    "incremental",
    "mrp_shadow",
    "mrp_short",
    "quaternion",
    "representations",
    "screws",
    "se3",
    "so3",
]

__dir__ = __all__.copy
