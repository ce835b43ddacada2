"""Status values of `solve`, with advice, and of linear matrix equations, with their texts."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax

from rbjax.errors import InputError
from rbjax.status import Status

GOING, CONVERGED, BUDGET, INFEASIBLE, STUCK, NOT_FINITE, FINISHED = map(int, Status)

#: what to change, by status
ADVICE = {
    BUDGET: "raise iterations, or start nearer",
    STUCK: "change the start, look for a kink in a cost, or use double precision",
    FINISHED: "continue with ddp or sqp (guess=)",
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
