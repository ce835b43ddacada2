"""System identification: parameters of a model from measured motion."""

from rbjax.sysid import inertia_metric, regression
from rbjax.sysid.balances import (
    energy_balance,
    energy_regressor,
    momentum_balance,
    momentum_regressor,
)
from rbjax.sysid.base_parameters import base_parameters, random_motions
from rbjax.sysid.consistent import Consistent, consistent
from rbjax.sysid.equations import Equations, equations
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
from rbjax.sysid.rank import Combinations, combinations
from rbjax.sysid.regression import METHODS, Regression, regress
from rbjax.sysid.regressor import (
    JOINT_TERMS,
    observation_matrix,
    parameter_names,
    parameter_values,
    regressor,
)

__all__ = [
    "Combinations",
    "Consistent",
    "Equations",
    "Fit",
    "JOINT_TERMS",
    "METHODS",
    "Regression",
    "Unknown",
    "base_parameters",
    "combinations",
    "fit",
    "affine_invariant_distance",
    "consistent",
    "energy_balance",
    "energy_regressor",
    "equations",
    "from_log_cholesky",
    "inertia_metric",
    "inertial_parameters_of",
    "log_cholesky_parameters",
    "log_cholesky_volume",
    "log_determinant_divergence",
    "model_log_cholesky",
    "momentum_balance",
    "momentum_regressor",
    "nearest_pseudo_inertia",
    "observation_matrix",
    "parameter_names",
    "parameter_values",
    "prior_residual",
    "pseudo_inertia_of",
    "pullback_distance",
    "pullback_metric",
    "random_motions",
    "regress",
    "regression",
    "regressor",
    "to_log_cholesky",
    "with_inertial_parameters",
]
