"""How a search for an optimum and a solver of linear systems ended: values that a program can
return, and what they say."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax

from rbjax.errors import InputError

GOING, CONVERGED, BUDGET, INFEASIBLE, STUCK, NOT_FINITE, FINISHED = range(7)

SENTENCES = {
    CONVERGED: "converged",
    BUDGET: "budget spent: raise iterations, or start nearer",
    INFEASIBLE: "infeasible: the constraints cannot be held together near this motion",
    STUCK: "stuck: no step lowers the cost; change the start, look for a kink in a cost, or take "
    "double precision",
    NOT_FINITE: "not finite: the cost or the dynamics of the first guess is nan or infinite",
    FINISHED: "finished: the best samples cost the same; if they are at an optimum is unknown: "
    "start ddp or sqp there (guess=)",
}


class LINEAR_RESULTS(eqx.Enumeration):
    """How a Lyapunov or Riccati equation ended. Only `successful` is the empty sentence."""

    successful = ""
    not_finite = "A number of the problem is not finite, or the solution is too large."
    indefinite_control_cost = (
        "The Hessian by the controls is not positive definite: R in continuous time, R + B'PB in "
        "discrete time. Give every control a cost."
    )
    not_stabilisable = (
        "No feedback stabilises the system: a mode that does not decay is out of reach of the "
        "controls. See controllability for its direction."
    )
    no_stabilising_solution = (
        "The iteration found no stabilising solution. Either a mode on the edge of stability has "
        "no cost, or the cost is not bounded from below."
    )
    not_stable = "The matrix is not stable, so the sum over all time has no limit."


def raise_failure(where: str, result: Any) -> None:
    """Raise `InputError` unless the result is `successful`. A traced result stays a value."""
    values = jax.tree.leaves(result)
    if any(isinstance(x, jax.core.Tracer) or x.ndim for x in values):
        return
    if not bool(result == LINEAR_RESULTS.successful):
        sentences: Any = LINEAR_RESULTS
        raise InputError(f"{where}: {sentences[result]}")


def first_of(*cases: tuple[Any, Any]) -> Any:
    """The result of the first case that is true, else `successful`."""
    found: Any = LINEAR_RESULTS.successful
    for wrong, result in reversed(cases):
        found = LINEAR_RESULTS.where(wrong, result, found)
    return found
