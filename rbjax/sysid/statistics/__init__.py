"""Statistics of residuals and Jacobians: rank, intervals, whiteness and comparisons."""

from rbjax.sysid.statistics.comparisons import (
    Comparison,
    HeldOut,
    Scored,
    compare,
    held_out,
)
from rbjax.sysid.statistics.intervals import (
    Estimates,
    Interval,
    estimates,
)
from rbjax.sysid.statistics.rank import (
    Combinations,
    combinations,
)
from rbjax.sysid.statistics.whiteness_tests import (
    Whiteness,
    whiteness,
)

__all__ = [
    "estimates",
    "Estimates",
    "Interval",
    "combinations",
    "Combinations",
    "whiteness",
    "Whiteness",
    "compare",
    "Comparison",
    "Scored",
    "held_out",
    "HeldOut",
]
