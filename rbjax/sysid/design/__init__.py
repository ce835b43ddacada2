"""Design of experiments: excitation trajectories with the most information on the parameters."""

from rbjax.sysid.design.excitation import Fourier, Motion, Spline
from rbjax.sysid.design.experiments import MotionLimits, design_experiment

__all__ = [
    "Fourier", "Motion", "MotionLimits", "Spline", "design_experiment",
]  # fmt: skip

__dir__ = __all__.copy
