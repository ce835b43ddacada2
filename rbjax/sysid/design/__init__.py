"""Design of experiments: excitation trajectories that show the parameters best."""

from rbjax.sysid.design.excitation import Fourier, Motion, Spline
from rbjax.sysid.design.experiments import Experiment, MotionLimits, design_experiment

__all__ = [
    "Experiment", "Fourier", "Motion", "MotionLimits", "Spline", "design_experiment",
]  # fmt: skip
