"""The methods by name, and what each needs."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

from rbjax.control.ddp import by_ddp


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
}  # fmt: skip


def methods() -> dict[str, Method]:
    """The methods of `solve` by name.

    Example:
        >>> import rbjax as rb
        >>> "ddp" in rb.control.methods()
        True
    """
    return dict(METHODS)
