"""Linear systems: regulators, Riccati and Lyapunov equations, controllability, margins, filters."""

from rbjax.control.linear.algebraic_riccati import Regulator
from rbjax.control.linear.lyapunov_equation import Lyapunov, lyapunov
from rbjax.control.linear.parallel_riccati import parallel_backward, parallel_roll
from rbjax.control.linear.regulators import (
    SteadyFilter,
    feedback,
    kalman_gain,
    lqr,
    lqr_at,
    lqr_finite,
)
from rbjax.control.linear.riccati import (
    Gains,
    LinearQuadratic,
    Steered,
    backward,
    constant_problem,
    quadratic_cost,
    roll,
    steer,
)
from rbjax.control.linear.stability_margins import Margins, margins
from rbjax.control.linear.systems import (
    Reach,
    controllability,
    controllability_gramian,
    discretise,
    observability,
    observability_gramian,
    poles,
    unreachable_directions,
)
from rbjax.control.linear.tracking import Tracking, time_varying_lqr
from rbjax.control.status import LinearStatus

__all__ = [
    # regulators
    "Regulator", "Tracking", "feedback", "lqr", "lqr_at", "lqr_finite", "time_varying_lqr",
    "LinearStatus",
    # linear-quadratic problems of finite horizon
    "Gains", "LinearQuadratic", "Steered", "backward", "constant_problem", "parallel_backward",
    "parallel_roll", "quadratic_cost", "roll", "steer",
    # systems
    "Lyapunov", "Margins", "Reach", "controllability", "controllability_gramian", "discretise",
    "lyapunov", "margins", "observability", "observability_gramian", "poles",
    "unreachable_directions",
    # filters
    "SteadyFilter", "kalman_gain",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
