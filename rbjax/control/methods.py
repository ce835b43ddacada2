"""The methods by name, and what each needs."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

from rbjax.control.collocation import by_collocation
from rbjax.control.ddp import by_ddp
from rbjax.control.single_shooting import by_adam, by_bfgs, by_shooting, by_squares
from rbjax.solvers.tableau import Tableau, gauss, lobatto_iiia, radau_iia


class Method(NamedTuple):
    """solve: (problem, start, knots, ctrls, options, history) -> `Found`; constraints: whether it
    holds `Constraint`s; second_order: whether it needs derivatives; sentence: when to take it."""

    solve: Callable[..., Any]
    constraints: bool
    derivatives: bool
    sentence: str


def collocating(table: Tableau, sentence: str) -> Method:
    """Collocation by a tableau."""
    return Method(functools.partial(by_collocation, table=table), True, True, sentence)


METHODS: dict[str, Method] = {
    "ddp": Method(
        by_ddp, True, True,
        "feasibility-driven DDP with multiple shooting, boxes and an augmented Lagrangian: the "
        "default; converges fast from a rough guess, and leaves a feedback",
    ),
    "exact_ddp": Method(
        functools.partial(by_ddp, exact=True), True, True,
        "the same with second derivatives of the dynamics: fewer iterations to the last digits, "
        "each more expensive; for small robots, or where ddp is slow to settle",
    ),
    "hermite_simpson": collocating(
        lobatto_iiia(3),
        "collocation of order 4, controls at both ends and in the middle of each step: free final "
        "times, constraints on the path, and guesses of the states that no controls follow",
    ),
    "gauss_legendre": collocating(
        gauss(3), "the same of order 6, with three stages inside each step: few long steps"
    ),
    "gauss_legendre_4": collocating(gauss(2), "the same with two stages, of order 4"),
    "gauss_legendre_8": collocating(gauss(4), "the same with four stages, of order 8"),
    "radau": collocating(
        radau_iia(3), "the same of order 5; damps what is stiff, and holds constraints at knots"
    ),
    "adam": Method(
        functools.partial(by_shooting, inner=by_adam), True, True,
        "single shooting by the gradient: cheap iterations, many of them (1,000 or more); for "
        "costs with kinks or noise, and as a rough first guess",
    ),
    "bfgs": Method(
        functools.partial(by_shooting, inner=by_bfgs), True, True,
        "single shooting by BFGS: few controls and a short, tame horizon",
    ),
    "levenberg_marquardt": Method(
        functools.partial(by_shooting, inner=by_squares), True, True,
        "single shooting by Levenberg and Marquardt's method: costs that are all residuals",
    ),
    "trapezoidal": collocating(lobatto_iiia(2), "the same of order 2: rough and cheap"),
}  # fmt: skip


def methods() -> dict[str, Method]:
    """The methods of `solve` by name.

    Example:
        >>> import rbjax as rb
        >>> "ddp" in rb.control.methods()
        True
    """
    return dict(METHODS)
