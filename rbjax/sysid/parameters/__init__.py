"""Unknown parameters of a model: their names, coordinates, bounds and first guesses."""

from rbjax.sysid.parameters.log_cholesky import (
    from_log_cholesky,
    inertial_parameters_of,
    log_determinant_divergence,
    nearest_pseudo_inertia,
    pseudo_inertia_of,
    to_log_cholesky,
    with_inertial_parameters,
)

__all__ = [
    "from_log_cholesky", "inertial_parameters_of", "log_determinant_divergence",
    "nearest_pseudo_inertia", "pseudo_inertia_of", "to_log_cholesky", "with_inertial_parameters",
]  # fmt: skip

__dir__ = __all__.copy
