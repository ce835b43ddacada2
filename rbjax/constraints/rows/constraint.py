"""The protocol of constraints.

A constraint is a record of numbers with a method `rows`: from what it sees of the motion at an
instant to rows g = 0 or y = 0 (`Row`). It has no say in how the rows are enforced: that is a
formulation's. Its numbers are leaves of the model.
"""

from __future__ import annotations

from collections.abc import Sequence

from rbjax.constraints.rows.row import Row
from rbjax.forces.context import Context
from rbjax.model.record import Record, check_fields


class Constraint(Record):
    """A constraint on the motion of a robot. Make a subclass: its fields are its numbers.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.constraints import Constraint, coordinate
        >>> class Mirror(Constraint):
        ...     size = 1
        ...     def rows(self, now):
        ...         return [coordinate(now, "shoulder") + coordinate(now, "elbow")]
        >>> model = rb.load("double_pendulum").with_constraints(Mirror())
    """

    def __check_init__(self) -> None:
        check_fields(self)

    @property
    def size(self) -> int:
        """How many rows it has."""
        raise NotImplementedError(f"{type(self).__name__} does not say its size")

    def rows(self, now: Context) -> Sequence[Row]:
        """Its rows at an instant."""
        raise NotImplementedError(f"{type(self).__name__} has no method rows(self, now) -> rows")
