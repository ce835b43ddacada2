"""System identification: parameters of a model from measured motion.

What was measured: `Recording`, of `Channel`s (`recording`, `readers`, `findings`, `splits`),
filtered and differentiated (`filtering`). What is sought: `Unknown`, `Inertia`, `Shared`, ...
(`unknowns`) of a `Model` or a `Setup` (`simulation`), whose sensors are `readings`. How it is
found: `identify`, by the error of simulated motions (`simulation_error`, `shooting`,
`least_squares`), or by `many_starts` where that has many minima; its gradient, `squares`;
`prediction_error`, where noise drives the motion, by a filter (`likelihood`); `regress`
and `consistent`, by torques that are linear in the parameters (`regressor`, `torque_rows`,
`equations`, `balances`), with the zeros of encoders (`encoder_zeros`). What the data can show:
`combinations` of any Jacobian (`rank`), `base_parameters`. What they do show: `estimates`,
`whiteness`, `compare`, `select`, `free_run`, `held_out`, `monte_carlo`. What is wrong with them:
`findings` before a fit, `diagnose` after it; `report` shows all. What to measure next: `design`
(`excitation`, `experiments`).
"""

from rbjax.callable_modules import make_modules_callable
from rbjax.motion.kalman import (
    KalmanFiltered,
    Smoothed,
    StateSpace,
    kalman_filter,
    kalman_smoother,
)
from rbjax.sysid.balances import (
    energy_balance,
    energy_regressor,
    momentum_balance,
    momentum_regressor,
)
from rbjax.sysid.base_parameters import base_parameters, random_motions
from rbjax.sysid.channel_noise import ChannelNoise, noise_by_channel
from rbjax.sysid.columns import Columns
from rbjax.sysid.comparison import Comparison, HeldOut, Scored, compare, held_out
from rbjax.sysid.consistent import Consistent, consistent
from rbjax.sysid.diagnosis import Cause, Diagnosis, diagnose
from rbjax.sysid.encoder_zeros import WithZeros, regress_with_zeros, zeros_of
from rbjax.sysid.equations import Equations, equations
from rbjax.sysid.excitation import Fourier, Motion, Spline
from rbjax.sysid.experiments import Experiment, MotionLimits, design
from rbjax.sysid.filtering import Filtered, differentiate, low_pass
from rbjax.sysid.findings import Finding, findings
from rbjax.sysid.fit import Fit, fit
from rbjax.sysid.free_run import free_run
from rbjax.sysid.identified import Identified
from rbjax.sysid.identify import identify
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
from rbjax.sysid.many_starts import Basin, ManyStarts, many_starts
from rbjax.sysid.monte_carlo import MonteCarlo, monte_carlo
from rbjax.sysid.prediction_error import Predicted, prediction_error
from rbjax.sysid.rank import Combinations, combinations
from rbjax.sysid.readers import Column, read_csv, read_npz
from rbjax.sysid.readings import (
    Accelerations,
    Accelerometer,
    Currents,
    Gyro,
    Moment,
    Pose,
    Position,
    Positions,
    Reading,
    Reads,
    Torques,
    Velocities,
)
from rbjax.sysid.recording import Channel, Recording
from rbjax.sysid.regression import METHODS, Regression, regress
from rbjax.sysid.regressor import (
    JOINT_TERMS,
    observation_matrix,
    parameter_names,
    parameter_values,
    regressor,
)
from rbjax.sysid.report import report
from rbjax.sysid.selection import Selected, select
from rbjax.sysid.simulation import PD, Grid, Sensor, Setup
from rbjax.sysid.splits import Split, split
from rbjax.sysid.squares import Squares, squares
from rbjax.sysid.statistics import Estimates, Interval, crlb, estimates, information
from rbjax.sysid.torque_rows import TorqueRows, torque_rows
from rbjax.sysid.traces import Trace
from rbjax.sysid.units import in_si
from rbjax.sysid.unknowns import Derived, FixedTotal, Inertia, Shared, Tilt, Unknown
from rbjax.sysid.whiteness import Whiteness, sandwich, whiteness

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
    "StateSpace",
    "kalman_filter",
    "KalmanFiltered",
    "kalman_smoother",
    "Smoothed",
    "free_run",
    "fit",
    "Fit",
    "Unknown",
    "Inertia",
    "Shared",
    "FixedTotal",
    "Tilt",
    "Derived",
    "Setup",
    "Sensor",
    "Reading",
    "Reads",
    "Moment",
    "Columns",
    "Positions",
    "Velocities",
    "Accelerations",
    "Torques",
    "Currents",
    "Pose",
    "Position",
    "Gyro",
    "Accelerometer",
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
    "energy_balance",
    "energy_regressor",
    "momentum_balance",
    "momentum_regressor",
    # what data can show
    "combinations",
    "Combinations",
    "base_parameters",
    "random_motions",
    # inertias
    "to_log_cholesky",
    "from_log_cholesky",
    "log_cholesky_parameters",
    "log_cholesky_volume",
    "pseudo_inertia_of",
    "inertial_parameters_of",
    "nearest_pseudo_inertia",
    "with_inertial_parameters",
    "model_log_cholesky",
    "log_determinant_divergence",
    "affine_invariant_distance",
    "pullback_distance",
    "pullback_metric",
    "prior_residual",
    # statistics
    "estimates",
    "Estimates",
    "Interval",
    "information",
    "crlb",
    "noise_by_channel",
    "ChannelNoise",
    "whiteness",
    "Whiteness",
    "sandwich",
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
