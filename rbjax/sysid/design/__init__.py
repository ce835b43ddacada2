"""Design of experiments: excitation trajectories with the most information on the parameters."""

from rbjax.sysid.design.excitation import Fourier, Motion, Spline
from rbjax.sysid.design.experiments import MotionLimits, design_experiment

__all__ = [
    "Fourier", "Motion", "MotionLimits", "Spline", "design_experiment",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
