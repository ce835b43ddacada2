"""The methods of `solve` by name."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

from rbjax.arguments import choice
from rbjax.control.optimal.collocation.collocation import solve_collocation
from rbjax.control.optimal.shooting.ddp import solve_ddp
from rbjax.control.optimal.shooting.sampling import Sampling, solve_sampled_ddp, solve_sampling
from rbjax.control.optimal.shooting.single_shooting import (
    adam_search,
    bfgs_search,
    levenberg_marquardt_search,
    solve_single_shooting,
)
from rbjax.control.optimal.shooting.sqp import solve_sqp
from rbjax.display import displayed
from rbjax.solvers.tableau import Tableau, gauss, lobatto_iiia, radau_iia


@displayed
class Method(NamedTuple):
    """A method of `solve`.

    solve: (problem, start, knots, ctrls, options, history) -> `SearchResult`.
    constraints: true if it accepts `Constraint`s.
    derivatives: true if it needs derivatives of the problem.
    description: when to use it.
    differentiable: true if its solutions have derivatives.
    gaps: true if a step along its search direction leaves gaps between states and dynamics.
    """

    solve: Callable[..., Any]
    constraints: bool
    derivatives: bool
    description: str
    differentiable: bool = True
    gaps: bool = False


def collocation(table: Tableau, description: str) -> Method:
    """Build the collocation method of a tableau."""
    return Method(functools.partial(solve_collocation, table=table), True, True, description, False)


METHODS: dict[str, Method] = {
    "ddp": Method(
        solve_ddp, True, True,
        "feasibility-driven DDP with multiple shooting, boxes and an augmented Lagrangian: the "
        "default; converges fast from a rough guess, and leaves a feedback",
    ),
    "exact_ddp": Method(
        functools.partial(solve_ddp, exact=True), True, True,
        "the same with second derivatives of the dynamics: fewer iterations to the last digits, "
        "each more expensive; for small robots, or where ddp is slow to settle",
    ),
    "sqp": Method(
        solve_sqp, True, True,
        "ddp without its rollouts, all knots side by side: sequential quadratic programming with "
        "multiple shooting; from guesses of states that no controls produce, for MPC, and for "
        "one problem on a GPU; from a rough guess under tight bounds it ends in worse optima",
        gaps=True,
    ),
    "exact_sqp": Method(
        functools.partial(solve_sqp, exact=True), True, True,
        "the same with second derivatives of the dynamics: the fewest iterations; for small robots",
        gaps=True,
    ),
    "predictive": Method(
        functools.partial(solve_sampling, Sampling("predictive")), True, False,
        "the best of many random motions, again and again: needs no derivative; the simplest start "
        "for another method",
        False,
    ),
    "mppi": Method(
        functools.partial(solve_sampling, Sampling("mppi")), True, False,
        "random motions weighed by their costs: needs no derivative, smoother than predictive",
        False,
    ),
    "cross_entropy": Method(
        functools.partial(solve_sampling, Sampling("cross_entropy")), True, False,
        "random motions drawn ever closer to the best tenth: needs no derivative; finds its way "
        "where ddp is stuck, ends at a few digits",
        False,
    ),
    "sampled_ddp": Method(
        functools.partial(solve_sampled_ddp, Sampling(ddp_after=30)), True, True,
        "30 rounds of cross_entropy, then ddp: where ddp depends on the first guess, such as "
        "swing-ups under tight bounds",
    ),
    "hermite_simpson": collocation(
        lobatto_iiia(3),
        "collocation of order 4, controls at both ends and in the middle of each step: free final "
        "times, constraints on the path, and guesses of states that no controls produce",
    ),
    "gauss_legendre": collocation(
        gauss(3), "collocation of order 6, with three stages inside each step: few long steps"
    ),
    "gauss_legendre_4": collocation(gauss(2), "collocation with two stages, of order 4"),
    "gauss_legendre_8": collocation(gauss(4), "collocation with four stages, of order 8"),
    "radau": collocation(
        radau_iia(3), "collocation of order 5; damps stiff modes, and enforces constraints at knots"
    ),
    "adam": Method(
        functools.partial(solve_single_shooting, inner=adam_search), True, True,
        "single shooting by the gradient: cheap iterations, many of them (1,000 or more); for "
        "costs with kinks or noise, and as a rough first guess",
    ),
    "bfgs": Method(
        functools.partial(solve_single_shooting, inner=bfgs_search), True, True,
        "single shooting by BFGS: few controls and a short, tame horizon",
    ),
    "levenberg_marquardt": Method(
        functools.partial(solve_single_shooting, inner=levenberg_marquardt_search), True, True,
        "single shooting by Levenberg and Marquardt's method: costs that are all residuals",
    ),
    "trapezoidal": collocation(lobatto_iiia(2), "collocation of order 2: rough and cheap"),
}  # fmt: skip


def methods() -> dict[str, Method]:
    """Return the methods of `solve` by name.

    Example:
        >>> import rbjax as rb
        >>> "ddp" in rb.control.methods()
        True
    """
    return dict(METHODS)


def method_of(method: Any) -> Method:
    """Return the method of a name, a `Method` or a `Sampling`."""
    if isinstance(method, Method):
        return method
    if isinstance(method, Sampling):
        ddp = method.ddp_after is not None
        search = functools.partial(solve_sampled_ddp if ddp else solve_sampling, method)
        return Method(search, True, ddp, "with the parameters of the caller", ddp)
    return METHODS[choice("method of rb.control", method, METHODS)]


def name_of(method: Any) -> str:
    """Return the name of a method."""
    return method if isinstance(method, str) else type(method).__name__
