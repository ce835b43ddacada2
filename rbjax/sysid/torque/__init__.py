"""Identification from torques, which are linear in the inertial parameters."""

from rbjax.sysid.torque.base_combinations import (
    base_parameters,
    random_motions,
)
from rbjax.sysid.torque.consistency import (
    Consistent,
    consistent,
)
from rbjax.sysid.torque.encoder_zeros import (
    WithZeros,
    regress_with_zeros,
    zeros_of,
)
from rbjax.sysid.torque.regression import (
    METHODS,
    Regression,
    regress,
)
from rbjax.sysid.torque.regressors import (
    JOINT_TERMS,
    observation_matrix,
    parameter_names,
    parameter_values,
    regressor,
)
from rbjax.sysid.torque.rows import (
    TorqueRows,
    torque_rows,
)
from rbjax.sysid.torque.selection import (
    Selected,
    select,
)
from rbjax.sysid.torque.stacking import (
    Equations,
    equations,
)

__all__ = [
    "regressor",
    "JOINT_TERMS",
    "observation_matrix",
    "parameter_names",
    "parameter_values",
    "equations",
    "Equations",
    "regress",
    "METHODS",
    "Regression",
    "consistent",
    "Consistent",
    "torque_rows",
    "TorqueRows",
    "regress_with_zeros",
    "WithZeros",
    "zeros_of",
    "base_parameters",
    "random_motions",
    "select",
    "Selected",
]
