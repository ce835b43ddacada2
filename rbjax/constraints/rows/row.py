"""Rows: scalar functions of the motion with two time derivatives. Constraints consist of rows.

    holonomic        g(t, q) = 0,     g' = G v + g_t,     g'' = G a + G' v + ...
    non-holonomic    y = G v + b = 0,                     y' = G a + ...

`gradient` represents G by the forces of a unit multiplier on the robot. Sums, products and
functions of rows are those of g or y, with derivatives by the chain rule. A new constraint
therefore needs only its residual.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.forces.element import Loads
from rbjax.lanes import Lane, add, is_literal, mul, neg, sub
from rbjax.lanes.arrays import pack
from rbjax.model.record import Record, check_fields


@dataclass(frozen=True)
class Row:
    """A scalar function of the motion with two time derivatives.

    Fields:
        value: g; None for a non-holonomic row.
        rate: g', or y of a non-holonomic row.
        gradient: G, as `Loads`.
        acceleration: g'' or y', at the accelerations of the context.
    """

    value: Lane | None
    rate: Lane
    gradient: Loads
    acceleration: Lane

    @classmethod
    def constant(cls, x: Lane) -> Row:
        """Return a row with a constant value."""
        return cls(x, 0.0, Loads(), 0.0)

    @property
    def holonomic(self) -> bool:
        return self.value is not None

    @property
    def residual(self) -> Lane:
        """Value g of a holonomic row; zero for a non-holonomic row."""
        return 0.0 if self.value is None else self.value

    @property
    def time_derivative(self) -> Row:
        """Non-holonomic row of g', for example `row.time_derivative - 0.3` for g' = 0.3."""
        if self.value is None:
            raise InputError("Row.time_derivative: the row has only a rate, expected a value g")
        return Row(None, self.rate, self.gradient, self.acceleration)

    def __add__(self, other: Row | Lane) -> Row:
        if not isinstance(other, Row):
            if self.value is None:
                return Row(None, add(self.rate, other), self.gradient, self.acceleration)
            return Row(add(self.value, other), self.rate, self.gradient, self.acceleration)
        if self.value is None and other.value is not None:  # y + g:  (y + g)' = y' + g'
            rate, acceleration = add(self.rate, other.value), add(self.acceleration, other.rate)
            return Row(None, rate, self.gradient, acceleration)
        if other.value is None and self.value is not None:
            return other + self
        return Row(
            None if self.value is None or other.value is None else add(self.value, other.value),
            add(self.rate, other.rate),
            self.gradient + other.gradient,
            add(self.acceleration, other.acceleration),
        )

    __radd__ = __add__

    def __neg__(self) -> Row:
        value = None if self.value is None else neg(self.value)
        return Row(value, neg(self.rate), -self.gradient, neg(self.acceleration))

    def __sub__(self, other: Row | Lane) -> Row:
        return self + (-other)

    def __rsub__(self, other: Lane) -> Row:
        return -self + other

    def __mul__(self, other: Row | Lane) -> Row:
        if not isinstance(other, Row):
            value = None if self.value is None else mul(self.value, other)
            rate, acceleration = mul(self.rate, other), mul(self.acceleration, other)
            return Row(value, rate, self.gradient * other, acceleration)
        if other.value is None:
            if self.value is None:
                raise InputError(
                    "Row: the product of two rows that have only a rate is not linear in the "
                    "velocities, expected at most one such factor; rbjax.constraints.Pfaffian "
                    "takes A(t, q) v = b(t, q)"
                )
            return other * self
        if self.value is None:  # y x:  (y x)' = y' x + y x'
            acceleration = add(mul(self.acceleration, other.value), mul(self.rate, other.rate))
            rate = mul(self.rate, other.value)
            return Row(None, rate, self.gradient * other.value, acceleration)
        twice = mul(2.0, mul(self.rate, other.rate))
        return Row(
            mul(self.value, other.value),
            add(mul(self.rate, other.value), mul(self.value, other.rate)),
            self.gradient * other.value + other.gradient * self.value,
            add(
                add(mul(self.acceleration, other.value), mul(self.value, other.acceleration)), twice
            ),
        )

    __rmul__ = __mul__

    def apply(self, f: Callable[[Any], Any]) -> Row:
        """Apply a smooth function of one scalar to a holonomic row."""
        _check_holonomic("Row.apply", [self])
        x: Any = self.value if not is_literal(self.value) else jnp.asarray(self.value, float)
        value, first, second = derivatives(f, x)
        curvature = mul(second, mul(self.rate, self.rate))
        acceleration = add(mul(first, self.acceleration), curvature)
        return Row(value, mul(first, self.rate), self.gradient * first, acceleration)


def derivatives(f: Callable[[Any], Any], x: Any) -> tuple[Any, Any, Any]:
    """Return f, f' and f'' at a scalar x."""
    one = jnp.ones_like(x)
    (value, first), (_, second) = jax.jvp(lambda x: jax.jvp(f, (x,), (one,)), (x,), (one,))
    return value, first, second


def _check_holonomic(where: str, rows: Sequence[Row]) -> None:
    """Raise InputError if a row has no value, because functions of its rate are not linear in v."""
    if any(row.value is None for row in rows):
        raise InputError(
            f"{where}: a row has only a rate, expected rows with a value g; rbjax.constraints."
            "Pfaffian takes A(t, q) v = b(t, q)"
        )


def angle(sine: Row, cosine: Row) -> Row:
    """Return the row atan2(sine, cosine), in (-pi, pi]. The two rows may have any common scale."""
    _check_holonomic("angle", [sine, cosine])
    s: Any = sine.value
    c: Any = cosine.value
    inverse = 1.0 / add(mul(s, s), mul(c, c))  # 1 / (s^2 + c^2)
    x, y = mul(c, inverse), mul(s, inverse)
    rate = sub(mul(x, sine.rate), mul(y, cosine.rate))
    longer = add(mul(y, sine.rate), mul(x, cosine.rate))
    acceleration = sub(mul(x, sine.acceleration), mul(y, cosine.acceleration))
    return Row(
        jnp.arctan2(s, c),
        rate,
        sine.gradient * x + cosine.gradient * neg(y),
        sub(acceleration, mul(2.0, mul(rate, longer))),
    )


def function_of(rows: Sequence[Row], f: Callable[[jax.Array], jax.Array], dtype: Any) -> list[Row]:
    """Apply a smooth function f (n,) -> (m,) to n holonomic rows."""
    _check_holonomic("function_of", rows)
    one = jnp.ones((), dtype)
    columns = zip(*((row.value, row.rate, row.acceleration) for row in rows), strict=True)
    x, rate, acceleration = (pack(column, one[None]) for column in columns)
    value, first, second = derivatives(
        lambda s: f(x + s * rate + (s * s / 2) * acceleration), jnp.zeros_like(one)
    )
    J = jax.jacfwd(f)(x)
    return [
        Row(
            value[r],
            first[r],
            sum((row.gradient * J[r, k] for k, row in enumerate(rows)), Loads()),
            second[r],
        )
        for r in range(value.shape[0])
    ]


class Constraint(Record):
    """Base class of constraints on the motion of a robot.

    Subclasses implement `size` and `rows`. Their fields are parameters and leaves of the model. A
    formulation enforces the rows.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.constraints import Constraint, coordinate
        >>> class Mirror(Constraint):
        ...     size = 1
        ...     def rows(self, context):
        ...         return [coordinate(context, "shoulder") + coordinate(context, "elbow")]
        >>> model = rb.load("double_pendulum").with_constraints(Mirror())
    """

    def __check_init__(self) -> None:
        check_fields(self)

    @property
    def size(self) -> int:
        """Number of rows."""
        raise NotImplementedError(f"{type(self).__name__} has no size")

    def rows(self, context: Context) -> Sequence[Row]:
        """Build the rows of the constraint in a context."""
        raise NotImplementedError(
            f"{type(self).__name__} has no method rows(self, context) -> rows"
        )
