"""Termination status of estimators: `FitStatus`, and the base class of results that have one."""

from __future__ import annotations

import enum


class FitStatus(enum.IntEnum):
    """Termination status of an estimator, with the same integers as `rb.control.Status`."""

    CONVERGED = 1
    BUDGET = 2
    INFEASIBLE = 3
    STUCK = 4
    NOT_FINITE = 5

    @classmethod
    def of(cls, converged: bool) -> FitStatus:
        """Return `CONVERGED` if a search converged, and `BUDGET` otherwise."""
        return cls.CONVERGED if converged else cls.BUDGET

    @property
    def text(self) -> str:
        """The status as text for users."""
        return TEXTS[self]


TEXTS = {
    FitStatus.CONVERGED: "converged",
    FitStatus.BUDGET: "not converged",
    FitStatus.INFEASIBLE: "the first guess is at the border of its range",
    FitStatus.STUCK: "stalled: no step lowers the error, but its slope is not 0",
    FitStatus.NOT_FINITE: "the motion or cost of the first guess is not finite",
}


class HasStatus:
    """Base class of results with a field `status`."""

    status: FitStatus

    @property
    def success(self) -> bool:
        """Whether the estimator converged."""
        return self.status == FitStatus.CONVERGED
