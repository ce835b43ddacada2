"""Linear systems: regulators, Riccati and Lyapunov equations, controllability, margins, filters."""

from rbjax.control.linear.lyapunov_equation import lyapunov
from rbjax.control.linear.regulators import feedback, kalman_gain, lqr, lqr_at
from rbjax.control.linear.riccati import LinearQuadratic, backward
from rbjax.control.linear.stability_margins import margins
from rbjax.control.linear.systems import (
    controllability,
    discretise,
    observability,
    poles,
)
from rbjax.control.linear.tracking import time_varying_lqr
from rbjax.control.status import LinearStatus

__all__ = [
    # regulators
    "LinearStatus", "feedback", "lqr", "lqr_at", "time_varying_lqr",
    # linear-quadratic problems of finite horizon
    "LinearQuadratic", "backward",
    # systems
    "controllability", "discretise", "lyapunov", "margins", "observability", "poles",
    # filters
    "kalman_gain",
]  # fmt: skip

__dir__ = __all__.copy
