"""The methods by name, and what each needs."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

from rbjax.control.ddp import by_ddp
from rbjax.control.sampling import SampledStart, Sampling
from rbjax.errors import UnknownName


class Method(NamedTuple):
    """solve: (problem, start, knots, ctrls, options, history) -> `Found`; constraints: whether it
    holds `Constraint`s; second_order: whether it needs derivatives; sentence: when to take it."""

    solve: Callable[..., Any]
    constraints: bool
    derivatives: bool
    sentence: str


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
    "predictive": Method(
        Sampling("predictive"), True, False,
        "the best of many random motions, again and again: needs no derivative; the simplest start "
        "for another method",
    ),
    "mppi": Method(
        Sampling("mppi"), True, False,
        "random motions weighed by their costs: needs no derivative, smoother than predictive",
    ),
    "cross_entropy": Method(
        Sampling("cross_entropy"), True, False,
        "random motions drawn ever closer to the best tenth: needs no derivative; finds its way "
        "where ddp is stuck, ends at a few digits",
    ),
    "sampled_ddp": Method(
        SampledStart(), True, True,
        "30 rounds of cross_entropy, then ddp: where ddp depends on the first guess, such as "
        "swing-ups under tight bounds",
    ),
}  # fmt: skip


def methods() -> dict[str, Method]:
    """The methods of `solve` by name.

    Example:
        >>> import rbjax as rb
        >>> "ddp" in rb.control.methods()
        True
    """
    return dict(METHODS)


def method_of(method: Any) -> Method:
    """A method by its name, or itself; a `Sampling` or a `SampledStart` as one."""
    if isinstance(method, Method):
        return method
    if isinstance(method, (Sampling, SampledStart)):
        return Method(method, True, isinstance(method, SampledStart), "the caller's own numbers")
    if method not in METHODS:
        raise UnknownName("method of rb.control", method, METHODS)
    return METHODS[method]


def name_of(method: Any) -> str:
    """The name of a method."""
    return method if isinstance(method, str) else type(method).__name__
