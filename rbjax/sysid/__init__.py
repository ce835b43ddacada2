"""System identification: parameters of a model from measured motion.

What was measured: `Recording`, of `Channel`s (`recording`, `readers`, `findings`, `splits`),
filtered and differentiated (`filtering`). What is sought: `Unknown`, `Inertia`, `Shared`, ...
(`unknowns`) of a `Model` or a `Setup` (`simulation`), whose sensors are in `rbjax.sensors`.
How it is found: `identify`, by the error of simulated motions (`simulation_error`, `shooting`,
`least_squares`), or by `many_starts` where that has many minima; its gradient, `squares`;
`prediction_error`, where noise drives the motion, by a filter (`likelihood`); `regress`
and `consistent`, by torques that are linear in the parameters (`regressor`, `torque_rows`,
`equations`), with the zeros of encoders (`encoder_zeros`). What the data can show:
`combinations` of any Jacobian (`rank`), `base_parameters`. What they do show: `estimates`,
`whiteness`, `compare`, `select`, `free_run`, `held_out`, `monte_carlo`. What is wrong with them:
`findings` before a fit, `diagnose` after it; `report` shows all. What to measure next: `design`
(`excitation`, `experiments`).
"""

from rbjax.callable_modules import make_modules_callable
from rbjax.sysid.data.filtering import Filtered, differentiate, low_pass
from rbjax.sysid.data.readers import Column, read_csv, read_npz
from rbjax.sysid.data.recording import Channel, Recording
from rbjax.sysid.data.recording_checks import Finding, findings
from rbjax.sysid.data.splits import Split, split
from rbjax.sysid.data.units import in_si
from rbjax.sysid.design.excitation import Fourier, Motion, Spline
from rbjax.sysid.design.experiments import Experiment, MotionLimits, design
from rbjax.sysid.estimators.free_running import free_run
from rbjax.sysid.estimators.identification import identify
from rbjax.sysid.estimators.identified import Identified
from rbjax.sysid.estimators.multi_start import Basin, ManyStarts, many_starts
from rbjax.sysid.estimators.prediction import Predicted, prediction_error
from rbjax.sysid.judgement.diagnosis import Cause, Diagnosis, diagnose
from rbjax.sysid.judgement.repeated_fits import MonteCarlo, monte_carlo
from rbjax.sysid.judgement.report_page import report
from rbjax.sysid.parameters.inertia_metric import (
    log_determinant_divergence,
    prior_residual,
)
from rbjax.sysid.parameters.log_cholesky import (
    from_log_cholesky,
    inertial_parameters_of,
    log_cholesky_parameters,
    model_log_cholesky,
    nearest_pseudo_inertia,
    pseudo_inertia_of,
    to_log_cholesky,
    with_inertial_parameters,
)
from rbjax.sysid.parameters.unknowns import Derived, FixedTotal, Inertia, Shared, Tilt, Unknown
from rbjax.sysid.simulation.objective import Squares, squares
from rbjax.sysid.simulation.setup import PD, Calibration, Grid, Setup
from rbjax.sysid.simulation.traces import Trace
from rbjax.sysid.statistics.comparisons import Comparison, HeldOut, Scored, compare, held_out
from rbjax.sysid.statistics.intervals import Estimates, Interval, estimates
from rbjax.sysid.statistics.rank import Combinations, combinations
from rbjax.sysid.statistics.whiteness_tests import Whiteness, whiteness
from rbjax.sysid.torque.base_combinations import base_parameters, random_motions
from rbjax.sysid.torque.consistency import Consistent, consistent
from rbjax.sysid.torque.encoder_zeros import WithZeros, regress_with_zeros, zeros_of
from rbjax.sysid.torque.regression import METHODS, Regression, regress
from rbjax.sysid.torque.regressors import (
    JOINT_TERMS,
    observation_matrix,
    parameter_names,
    parameter_values,
    regressor,
)
from rbjax.sysid.torque.rows import TorqueRows, torque_rows
from rbjax.sysid.torque.selection import Selected, select
from rbjax.sysid.torque.stacking import Equations, equations

__all__ = [
    # unknowns and simulation
    "identify",
    "Identified",
    "many_starts",
    "ManyStarts",
    "Basin",
    "squares",
    "Squares",
    "prediction_error",
    "Predicted",
    "free_run",
    "Unknown",
    "Inertia",
    "Shared",
    "FixedTotal",
    "Tilt",
    "Derived",
    "Setup",
    "Calibration",
    "PD",
    "Grid",
    # recordings
    "Channel",
    "Recording",
    "Split",
    "split",
    "Column",
    "read_csv",
    "read_npz",
    "Finding",
    "findings",
    "in_si",
    # signals
    "Filtered",
    "differentiate",
    "low_pass",
    # torques
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
    # what data can show
    "combinations",
    "Combinations",
    "base_parameters",
    "random_motions",
    # inertias
    "to_log_cholesky",
    "from_log_cholesky",
    "log_cholesky_parameters",
    "pseudo_inertia_of",
    "inertial_parameters_of",
    "nearest_pseudo_inertia",
    "with_inertial_parameters",
    "model_log_cholesky",
    "log_determinant_divergence",
    "prior_residual",
    # statistics
    "estimates",
    "Estimates",
    "Interval",
    "whiteness",
    "Whiteness",
    "compare",
    "Comparison",
    "monte_carlo",
    "MonteCarlo",
    "select",
    "Selected",
    "held_out",
    "HeldOut",
    "Scored",
    # what comes out
    "Trace",
    "diagnose",
    "Diagnosis",
    "Cause",
    "report",
    # excitation
    "Fourier",
    "Spline",
    "Motion",
    "design",
    "MotionLimits",
    "Experiment",
]

make_modules_callable(__name__)
