"""Status values of `solve` and of linear matrix equations, and their texts."""

from __future__ import annotations

import enum
from typing import Any

import equinox as eqx
import jax

from rbjax.errors import InputError


class Status(enum.IntEnum):
    """Final status of `solve`. The status of a `Solution` is an array of these integers."""

    GOING = 0
    CONVERGED = 1
    BUDGET = 2
    INFEASIBLE = 3
    STUCK = 4
    NOT_FINITE = 5
    FINISHED = 6


GOING, CONVERGED, BUDGET, INFEASIBLE, STUCK, NOT_FINITE, FINISHED = map(int, Status)

SENTENCES = {
    CONVERGED: "converged",
    BUDGET: "budget spent: raise iterations, or start nearer",
    INFEASIBLE: "infeasible: near this motion the constraints contradict each other",
    STUCK: "stuck: no step lowers the cost; change the start, look for a kink in a cost, or use "
    "double precision",
    NOT_FINITE: "not finite: the cost or the dynamics of the first guess is nan or infinite",
    FINISHED: "finished: the best samples cost the same, which does not show an optimum: "
    "continue with ddp or sqp (guess=)",
}


class LinearStatus(eqx.Enumeration):
    """Final status of the solver of a Lyapunov or Riccati equation."""

    success = ""
    not_finite = "A number of the problem is not finite, or the solution is too large."
    indefinite_control_cost = (
        "The Hessian by the controls is not positive definite: R in continuous time, R + B'PB in "
        "discrete time. Give every control a cost."
    )
    not_stabilisable = (
        "No feedback stabilises the system: a mode that does not decay is not controllable. See "
        "controllability for its direction."
    )
    no_stabilising_solution = (
        "The iteration found no stabilising solution. Either a mode on the edge of stability has "
        "no cost, or the cost is not bounded from below."
    )
    not_stable = "The matrix is not stable, so the sum over all time has no limit."


def raise_failure(where: str, status: Any) -> None:
    """Raise InputError unless the status is `success`. Traced or batched ones pass."""
    values = jax.tree.leaves(status)
    if any(isinstance(x, jax.core.Tracer) or x.ndim for x in values):
        return
    if not bool(status == LinearStatus.success):
        sentences: Any = LinearStatus
        raise InputError(f"{where}: {sentences[status]}")


def first_of(*cases: tuple[Any, Any]) -> Any:
    """Return the status of the first case (condition, status) that is true, else `success`."""
    found: Any = LinearStatus.success
    for wrong, status in reversed(cases):
        found = LinearStatus.where(wrong, status, found)
    return found
