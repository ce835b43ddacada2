"""Control: feedback and motions, designed on exact derivatives.

    regulators            lqr, lqr_at (a model), lqr_finite, time_varying_lqr (a motion), feedback
    linear-quadratic      LinearQuadratic, Gains; backward and roll, parallel_backward and
                          parallel_roll (all knots at once), steer (a fixed end)
    linear systems        controllability, observability, directions (by joints), their Gramians,
                          poles, margins, discretise, lyapunov
    what is not measured  kalman_gain, observed with kalman_update and kalman_predict
"""

from rbjax.control.linear_systems import (
    Reach,
    controllability,
    controllability_gramian,
    directions,
    discretise,
    observability,
    observability_gramian,
    poles,
)
from rbjax.control.lqr import Regulator, feedback, lqr, lqr_at, lqr_finite
from rbjax.control.lyapunov import Lyapunov, lyapunov
from rbjax.control.margins import Margins, margins
from rbjax.control.observer import SteadyFilter, kalman_gain, observed
from rbjax.control.outcomes import LINEAR_RESULTS
from rbjax.control.parallel_riccati import parallel_backward, parallel_roll
from rbjax.control.riccati import (
    Gains,
    LinearQuadratic,
    Steered,
    backward,
    constant_problem,
    quadratic_cost,
    roll,
    steer,
)
from rbjax.control.tracking import Tracking, time_varying_lqr
from rbjax.motion.kalman import Estimate, StateSpace, kalman_predict, kalman_update

__all__ = [
    # regulators
    "LINEAR_RESULTS",
    "Regulator",
    "Tracking",
    "feedback",
    "lqr",
    "lqr_at",
    "lqr_finite",
    "time_varying_lqr",
    # linear-quadratic problems
    "Gains",
    "LinearQuadratic",
    "Steered",
    "backward",
    "constant_problem",
    "parallel_backward",
    "parallel_roll",
    "quadratic_cost",
    "roll",
    "steer",
    # linear systems
    "Lyapunov",
    "Margins",
    "Reach",
    "controllability",
    "controllability_gramian",
    "directions",
    "discretise",
    "lyapunov",
    "margins",
    "observability",
    "observability_gramian",
    "poles",
    # what is not measured
    "Estimate",
    "SteadyFilter",
    "StateSpace",
    "kalman_gain",
    "kalman_predict",
    "kalman_update",
    "observed",
]
