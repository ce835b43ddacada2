"""Identification from torques, which are linear in the inertial parameters."""

from rbjax.sysid.torque.consistency import consistent
from rbjax.sysid.torque.encoder_zeros import regress_with_zeros
from rbjax.sysid.torque.regression import regress
from rbjax.sysid.torque.regressors import (
    JOINT_TERMS,
    base_parameters,
    parameter_names,
    parameter_values,
    regressor,
)
from rbjax.sysid.torque.rows import torque_rows
from rbjax.sysid.torque.selection import select

__all__ = [
    "JOINT_TERMS", "base_parameters", "consistent", "parameter_names", "parameter_values",
    "regress", "regress_with_zeros", "regressor", "select", "torque_rows",
]  # fmt: skip

__dir__ = __all__.copy
