"""The common result of all recommendations, and their checks and measurements."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from rbjax.arguments import flag, real_number
from rbjax.display import Display, displayed, value_text
from rbjax.errors import InputError

#: the least number of runs in a measurement of time
ROUNDS = 5
#: the accuracy of the reference motion
FINEST = 1e-10


@displayed
@dataclass(frozen=True)
class Recommendation:
    """A choice with its reason. Each recommender returns a subclass with more fields.

    Fields:
        name: the name of the choice, in the registry of its kind.
        cost: the cost of the choice, the lowest of all candidates that fulfil the request.
        candidates: a record of each measured candidate, with at least its `name`, its `cost`, and
            `success`, whether it fulfils the request.
        reason: a sentence with the deciding number.
    """

    name: str
    cost: float
    candidates: tuple[Any, ...]
    reason: str

    def _display_(self) -> Display:
        title = f"{type(self).__name__}: {self.name!r}, cost {value_text(self.cost)}"
        heads = self.candidates[0]._fields if self.candidates else ()
        rows = [[value_text(getattr(x, h), 20) for h in heads] for x in self.candidates]
        return Display(title, rows, heads, [self.reason])

    def table(self) -> str:
        """Return the candidates as a table, one a line."""
        if not self.candidates:
            return "no candidate was measured"
        heads = [*self.candidates[0]._fields]
        heads += [] if "cost" in heads else ["cost"]
        rows = [heads, *([_text(getattr(x, h)) for h in heads] for x in self.candidates)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        return "\n".join(lines)

    def summary(self) -> str:
        """Return the reason and the table."""
        return f"{self.reason}\n\n{self.table()}"


def _text(x: Any) -> str:
    return f"{x:.3g}" if isinstance(x, float) else str(x)


def check_request(accuracy: Any, progress: bool, **times: Any) -> None:
    """Raise `InputError` if the accuracy is too fine, if a time is not positive, or if `progress`
    is not a flag."""
    flag("recommend", "progress", progress)
    real_number("recommend", "accuracy", accuracy, "a number")
    if not accuracy >= FINEST:
        raise InputError(
            f"recommend: accuracy is {accuracy}, expected at least {FINEST:.0e}: the reference is "
            "not more accurate"
        )
    for name, x in times.items():
        real_number("recommend", name, x, "a positive time in seconds", above=0.0)


def fastest(run: Callable[[], object], seconds: float = 0.0) -> float:
    """Measure the fastest of at least five runs that last at least `seconds` in total, s."""
    taken: list[float] = []
    while len(taken) < ROUNDS or math.fsum(taken) < seconds:
        begin = time.perf_counter()
        run()
        taken.append(time.perf_counter() - begin)
    return min(taken)


def double(x: Any) -> Any:
    """Convert floating numbers to f64."""
    floating = jnp.issubdtype(jnp.result_type(x), jnp.floating)
    return jnp.asarray(x, jnp.float64) if floating else x
