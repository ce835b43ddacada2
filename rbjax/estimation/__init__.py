"""State estimation: Kalman filters and smoothers on the tangent space of a model's states."""

from rbjax.estimation.kalman import (
    Estimate,
    KalmanFiltered,
    Smoothed,
    kalman_filter,
    kalman_predict,
    kalman_smoother,
    kalman_update,
)
from rbjax.estimation.state_space import StateSpace, model_state_space

__all__ = [
    "StateSpace",
    "model_state_space",
    "Estimate",
    "kalman_update",
    "kalman_predict",
    "kalman_filter",
    "KalmanFiltered",
    "kalman_smoother",
    "Smoothed",
]

__dir__ = __all__.copy
