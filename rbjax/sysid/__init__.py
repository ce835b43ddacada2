"""System identification: estimation of the parameters of a model from measured motion.

Data: a `Recording` holds one `Channel` for each sensor. `read_recording` reads a
file, `findings` checks recordings, `split` divides them into training and validation data.

Unknowns: `Unknown`, `Inertia`, `Shared`, ... select parameters of a `Model`, or of a `Setup`, which
adds sensors (`rbjax.sensors`), a controller and a delay.

Estimators:
    `identify` fits simulated motions to recordings.
    `many_starts` fits from many first guesses.
    `prediction_error` fits models with process noise.
    `squares` returns the objective of `identify` with its gradient.
    `identifiability` finds the identifiable combinations of unknowns before a fit.

Validation: `Identified.verdict`, `diagnose`, `report`, `free_run`, `monte_carlo`.

Packages: `data` (filters, units), `parameters` (log-Cholesky coordinates of inertias), `statistics`
(rank, intervals, whiteness, model comparison), `torque` (linear regression on measured torques),
`design` (excitation trajectories), `jobs` (TOML files).
"""

from rbjax.status import Status
from rbjax.sysid import data, design, parameters, statistics, torque
from rbjax.sysid.data.readers import Column, read_recording
from rbjax.sysid.data.recording import Channel, Recording
from rbjax.sysid.data.recording_checks import findings
from rbjax.sysid.data.splits import split
from rbjax.sysid.estimators.identification import identifiability, identify
from rbjax.sysid.estimators.identified import Identified, free_run
from rbjax.sysid.estimators.multi_start import many_starts
from rbjax.sysid.estimators.prediction import prediction_error
from rbjax.sysid.judgement.diagnosis import diagnose
from rbjax.sysid.judgement.repeated_fits import monte_carlo
from rbjax.sysid.judgement.report_page import report
from rbjax.sysid.parameters.unknowns import Derived, FixedTotal, Inertia, Shared, Tilt, Unknown
from rbjax.sysid.simulation.objective import squares
from rbjax.sysid.simulation.setup import PD, Calibration, Grid, Setup

__all__ = [
    "Calibration", "Channel", "Column", "Derived", "FixedTotal", "Grid", "Identified", "Inertia",
    "PD", "Recording", "Setup", "Shared", "Status", "Tilt", "Unknown", "data", "design", "diagnose",
    "findings", "free_run", "identifiability", "identify", "many_starts", "monte_carlo",
    "parameters", "prediction_error", "read_recording", "report", "split", "squares", "statistics",
    "torque",
]  # fmt: skip

__dir__ = __all__.copy
