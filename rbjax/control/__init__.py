"""Control: feedback and motions, designed on exact derivatives.

    linear-quadratic      LinearQuadratic, Gains; backward and roll, parallel_backward and
                          parallel_roll (all knots at once), steer (a fixed end)
"""

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

__all__ = [
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
]
