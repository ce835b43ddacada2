"""Side-by-side comparison with MuJoCo C and MJX."""

from rbjax.validation.comparison import compare
from rbjax.validation.policies import evaluate_in_mujoco
from rbjax.validation.report import Error, Report, ReportRow

__all__ = ["Error", "Report", "ReportRow", "compare", "evaluate_in_mujoco"]

__dir__ = __all__.copy
