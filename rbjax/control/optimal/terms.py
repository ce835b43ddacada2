"""Terms of costs and constraints: functions of a robot's state and controls.

A term is a function (model, t, state, ctrl) -> a number, or a vector of residuals r. As a cost a
number counts as it is, a vector as sum w r^2 / 2 (`Cost`). Any function (t, state, ctrl) or
(model, t, state, ctrl) is a term; the standard ones are in `residuals` and `clearances`.

A cost of residuals is expanded by Gauss and Newton: gradient J^T w r, Hessian J^T w J. A number is
expanded by its gradient and its Hessian.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_bound, known_array
from rbjax.model.record import Record


class Term(Record):
    """A function of a robot's state and controls. Subclasses are final."""

    @property
    def label(self) -> str:
        """The name in messages."""
        return type(self).__name__

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        raise NotImplementedError(f"{type(self).__name__} has no method __call__")


class Given(Term):
    """A function of the caller, (t, state, ctrl) or (model, t, state, ctrl)."""

    function: Callable[..., Any]
    takes_model: bool = eqx.field(static=True)
    name: str = eqx.field(static=True)

    @property
    def label(self) -> str:
        return self.name

    def __call__(self, model: Any, t: Any, state: Any, ctrl: jax.Array) -> jax.Array:
        args = (model,) if self.takes_model else ()
        return self.function(*args, t, state, ctrl)


class Cost(Record):
    """A term with its weight.

    Fields: term; weight, () or (m,) of residuals, not negative; () of a number.
    """

    term: Term
    weight: jax.Array

    def __init__(self, term: Any, weight: Any = 1.0) -> None:
        self.term = term_of("Cost", term)
        self.weight = check_bound(f"Cost({self.term.label})", "weight", weight)
        known = known_array(self.weight)
        if known is not None and ((known < 0).any() or not np.isfinite(known).all()):
            raise InputError(
                f"Cost({self.term.label}): the weight is {known.tolist()}, expected finite "
                "numbers that are not negative"
            )


class Constraint(Record):
    """low <= term <= high; an equation where both are equal.

    Fields: term; low and high, () or as the term, infinite without a bound; where: at which
    knots: "path" (those with controls), "end" or "all"; name.
    """

    term: Term
    low: jax.Array
    high: jax.Array
    where: str = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(
        self, term: Any, low: Any = 0.0, high: Any = 0.0, where: str = "path",
        name: str | None = None,
    ) -> None:  # fmt: skip
        self.term = term_of("Constraint", term)
        self.name = self.term.label if name is None else name
        if not isinstance(self.name, str):
            raise InputError(f"Constraint: name is {name!r}, expected a string")
        here = f"Constraint({self.name})"
        self.low, self.high = check_bound(here, "low", low), check_bound(here, "high", high)
        self.where = where
        if where not in ("path", "end", "all"):
            raise InputError(
                f"Constraint({self.name}): where is {where!r}, expected 'path', 'end' or 'all'"
            )
        lowest, highest = known_array(self.low), known_array(self.high)
        if lowest is not None and highest is not None and (lowest > highest).any():
            raise InputError(
                f"Constraint({self.name}): low {lowest.tolist()} is above high "
                f"{highest.tolist()}; give low <= high"
            )


def term_of(where: str, f: Any) -> Term:
    """A term, or a function as one."""
    if isinstance(f, Term):
        return f
    if not callable(f):
        raise InputError(
            f"{where}: got {type(f).__name__}, expected a term such as rb.control.StateError(...), "
            "or a function (t, state, ctrl) -> a number or a vector of residuals"
        )
    try:
        kinds = inspect.signature(f).parameters.values()
    except (TypeError, ValueError):
        kinds = None
    count = 3
    if kinds is not None:
        needed = [p for p in kinds if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
                  and p.default is p.empty]  # fmt: skip
        count = len(needed)
    if count not in (3, 4):
        raise InputError(
            f"{where}: {_name(f)} takes {count} arguments, expected (t, state, ctrl) or "
            "(model, t, state, ctrl)"
        )
    return Given(f, count == 4, _name(f))


def cost_of(where: str, given: Any) -> Cost:
    """A cost, or a term or a function as one with weight 1."""
    return given if isinstance(given, Cost) else Cost(term_of(where, given))


def _name(f: Any) -> str:
    return getattr(f, "__name__", type(f).__name__)
