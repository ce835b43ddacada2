"""Robot files: load MJCF and URDF, write MJCF, update a user's own file; bundled scenes; files of
trajectories."""

from rbjax.loading.builder import ModelBuilder
from rbjax.loading.loader import load
from rbjax.loading.sources import compile_model, scenes
from rbjax.loading.trajectory_file import SavedTrajectory, load_trajectory, save_trajectory
from rbjax.loading.write.back import write_back
from rbjax.loading.write.mjcf import write_mjcf

__all__ = [
    "ModelBuilder",
    "SavedTrajectory",
    "compile_model",
    "load",
    "load_trajectory",
    "save_trajectory",
    "scenes",
    "write_back",
    "write_mjcf",
]

__dir__ = __all__.copy
