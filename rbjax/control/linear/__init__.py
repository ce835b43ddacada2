"""Linear systems: regulators, Riccati and Lyapunov equations, controllability, margins, filters."""

from rbjax.control.linear.algebraic_riccati import Regulator
from rbjax.control.linear.lyapunov_equation import Lyapunov, lyapunov
from rbjax.control.linear.parallel_riccati import parallel_backward
from rbjax.control.linear.regulators import SteadyFilter, feedback, kalman_gain, lqr, lqr_at
from rbjax.control.linear.riccati import Gains, LinearQuadratic, backward, constant_problem, roll
from rbjax.control.linear.stability_margins import Margins, margins
from rbjax.control.linear.systems import (
    Reach,
    controllability,
    discretise,
    observability,
    poles,
    unreachable_directions,
)
from rbjax.control.linear.tracking import Tracking, time_varying_lqr
from rbjax.control.status import LinearStatus

__all__ = [
    # regulators
    "LinearStatus", "Regulator", "Tracking", "feedback", "lqr", "lqr_at", "time_varying_lqr",
    # linear-quadratic problems of finite horizon
    "Gains", "LinearQuadratic", "backward", "constant_problem", "parallel_backward",
    "roll",
    # systems
    "Lyapunov", "Margins", "Reach", "controllability", "discretise", "lyapunov", "margins",
    "observability", "poles", "unreachable_directions",
    # filters
    "SteadyFilter", "kalman_gain",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
