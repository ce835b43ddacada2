"""Statistics of residuals and Jacobians: rank, intervals, whiteness and comparisons."""

from rbjax.sysid.statistics.comparisons import Scored, compare, held_out
from rbjax.sysid.statistics.intervals import estimates
from rbjax.sysid.statistics.rank import combinations
from rbjax.sysid.statistics.residual_tests import whiteness

__all__ = [
    "Scored", "combinations", "compare", "estimates", "held_out", "whiteness",
]  # fmt: skip

__dir__ = __all__.copy
