"""Final status of a search: `Status`, which optimal control and identification share."""

from __future__ import annotations

import enum


class Status(enum.IntEnum):
    """Final status of a search. Traced results have an array of these integers.

    GOING: not finished.
    CONVERGED: an optimum within the tolerance.
    BUDGET: the iterations or evaluations ran out.
    INFEASIBLE: the constraints or ranges leave no step.
    STUCK: no step lowers the cost, but its gradient is not 0.
    NOT_FINITE: the cost or the motion of the first guess is not finite.
    FINISHED: the best samples cost the same, which does not show an optimum.
    """

    GOING = 0
    CONVERGED = 1
    BUDGET = 2
    INFEASIBLE = 3
    STUCK = 4
    NOT_FINITE = 5
    FINISHED = 6

    @classmethod
    def of(cls, converged: bool) -> Status:
        """Return `CONVERGED` if a search converged, and `BUDGET` otherwise."""
        return cls.CONVERGED if converged else cls.BUDGET

    @property
    def text(self) -> str:
        """The status as text for users."""
        return TEXTS[self]


TEXTS = {
    Status.GOING: "not finished",
    Status.CONVERGED: "converged",
    Status.BUDGET: "not converged",
    Status.INFEASIBLE: "infeasible: the constraints contradict each other near this point, or the "
    "first guess is at the border of its range",
    Status.STUCK: "stuck: no step lowers the cost, but its slope is not 0",
    Status.NOT_FINITE: "not finite: the cost or the motion of the first guess is nan or infinite",
    Status.FINISHED: "finished: the best samples cost the same, which does not show an optimum",
}


class HasStatus:
    """Base class of results with a field `status`, a `Status`."""

    status: Status

    @property
    def success(self) -> bool:
        """Whether the search converged."""
        return self.status == Status.CONVERGED
