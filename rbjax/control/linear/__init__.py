"""Linear systems: regulators, Riccati and Lyapunov equations, controllability, margins, filters."""

from rbjax.control.linear.lyapunov_equation import lyapunov
from rbjax.control.linear.parallel_riccati import parallel_backward
from rbjax.control.linear.regulators import feedback, kalman_gain, lqr, lqr_at
from rbjax.control.linear.riccati import LinearQuadratic, backward, constant_problem, roll
from rbjax.control.linear.stability_margins import margins
from rbjax.control.linear.systems import (
    controllability,
    discretise,
    observability,
    poles,
    unreachable_directions,
)
from rbjax.control.linear.tracking import time_varying_lqr
from rbjax.control.status import LinearStatus

__all__ = [
    # regulators
    "LinearStatus", "feedback", "lqr", "lqr_at", "time_varying_lqr",
    # linear-quadratic problems of finite horizon
    "LinearQuadratic", "backward", "constant_problem", "parallel_backward", "roll",
    # systems
    "controllability", "discretise", "lyapunov", "margins", "observability", "poles",
    "unreachable_directions",
    # filters
    "kalman_gain",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
