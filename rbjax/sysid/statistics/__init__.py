"""Statistics of residuals and Jacobians: rank, intervals, whiteness and comparisons."""

from rbjax.sysid.statistics.comparisons import Comparison, HeldOut, Scored, compare, held_out
from rbjax.sysid.statistics.intervals import Estimates, Interval, estimates
from rbjax.sysid.statistics.rank import Combinations, combinations
from rbjax.sysid.statistics.residual_tests import Whiteness, whiteness

__all__ = [
    "Combinations", "Comparison", "Estimates", "HeldOut", "Interval", "Scored", "Whiteness",
    "combinations", "compare", "estimates", "held_out", "whiteness",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
