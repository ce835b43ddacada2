"""Design of experiments: excitation trajectories that show the parameters best."""

from rbjax.sysid.design.excitation import (
    Fourier,
    Motion,
    Spline,
)
from rbjax.sysid.design.experiments import (
    Experiment,
    MotionLimits,
    design_experiment,
)

__all__ = [
    "Fourier",
    "Spline",
    "Motion",
    "design_experiment",
    "MotionLimits",
    "Experiment",
]
