"""System identification: parameters of a model from measured motion."""

from rbjax.sysid import inertia_metric, regression
from rbjax.sysid.balances import energy_balance, energy_regressor, momentum_balance, momentum_regressor
from rbjax.sysid.base_parameters import base_parameters, random_motions
from rbjax.sysid.channel_noise import ChannelNoise, noise_by_channel
from rbjax.sysid.comparison import Comparison, HeldOut, Scored, compare, held_out
from rbjax.sysid.consistent import Consistent, consistent
from rbjax.sysid.excitation import Fourier, Motion, Spline
from rbjax.sysid.experiments import Experiment, MotionLimits, design
from rbjax.sysid.filtering import Filtered, differentiate, low_pass
from rbjax.sysid.findings import Finding, findings
from rbjax.sysid.fit import Fit, Unknown, fit
from rbjax.sysid.identify import Identified, identify
from rbjax.sysid.inertia_metric import affine_invariant_distance, log_determinant_divergence, prior_residual, pullback_distance, pullback_metric
from rbjax.sysid.log_cholesky import from_log_cholesky, inertial_parameters_of, log_cholesky_parameters, log_cholesky_volume, model_log_cholesky, nearest_pseudo_inertia, pseudo_inertia_of, to_log_cholesky, with_inertial_parameters
from rbjax.sysid.rank import Combinations, combinations
from rbjax.sysid.readers import Column, read_csv, read_npz
from rbjax.sysid.recording import Channel, Recording, Split, split
from rbjax.sysid.regression import Equations, METHODS, Regression, regress
from rbjax.sysid.regressor import JOINT_TERMS, observation_matrix, parameter_names, parameter_values, regressor
from rbjax.sysid.simulation import Grid, PD, Sensor, Setup
from rbjax.sysid.splits import Split, split
from rbjax.sysid.statistics import ChannelNoise, Estimates, Interval, crlb, estimates, information, noise_by_channel
from rbjax.sysid.units import in_si
from rbjax.sysid.unknowns import Derived, FixedTotal, Inertia, Shared, Tilt, Unknown
from rbjax.sysid.whiteness import Whiteness, sandwich, whiteness

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
    "Identified",
    "identify",
    "Derived",
    "FixedTotal",
    "Inertia",
    "Shared",
    "Tilt",
    "Grid",
    "PD",
    "Sensor",
    "Setup",
    "affine_invariant_distance",
    "consistent",
    "energy_balance",
    "energy_regressor",
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
    "Filtered",
    "differentiate",
    "low_pass",
    "ChannelNoise",
    "Estimates",
    "Interval",
    "crlb",
    "estimates",
    "information",
    "noise_by_channel",
    "Whiteness",
    "sandwich",
    "whiteness",
    "Comparison",
    "HeldOut",
    "Scored",
    "compare",
    "held_out",
    "Fourier",
    "Motion",
    "Spline",
    "Experiment",
    "MotionLimits",
    "design",
]
