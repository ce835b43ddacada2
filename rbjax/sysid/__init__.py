"""System identification: parameters of a model from measured motion."""

from rbjax.sysid import inertia_metric
from rbjax.sysid.fit import Fit, Unknown, fit
from rbjax.sysid.inertia_metric import (
    affine_invariant_distance,
    log_determinant_divergence,
    prior_residual,
    pullback_distance,
    pullback_metric,
)
from rbjax.sysid.log_cholesky import (
    from_log_cholesky,
    inertial_parameters_of,
    log_cholesky_parameters,
    log_cholesky_volume,
    model_log_cholesky,
    nearest_pseudo_inertia,
    pseudo_inertia_of,
    to_log_cholesky,
    with_inertial_parameters,
)

__all__ = [
    "Fit",
    "Unknown",
    "fit",
    "affine_invariant_distance",
    "from_log_cholesky",
    "inertia_metric",
    "inertial_parameters_of",
    "log_cholesky_parameters",
    "log_cholesky_volume",
    "log_determinant_divergence",
    "model_log_cholesky",
    "nearest_pseudo_inertia",
    "prior_residual",
    "pseudo_inertia_of",
    "pullback_distance",
    "pullback_metric",
    "to_log_cholesky",
    "with_inertial_parameters",
]
