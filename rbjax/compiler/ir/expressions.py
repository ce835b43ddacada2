"""Values of a program with the operators of numbers, for formulas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rbjax.compiler.ir.statements import BOOL, Value

if TYPE_CHECKING:
    from rbjax.compiler.ir.builder import Builder


@dataclass(frozen=True, eq=False)
class Number:
    """A value, and the builder that writes what is computed from it."""

    builder: Builder
    value: Value

    def op(self, name: str, *others: Number | float, dtype: np.dtype | None = None) -> Number:
        """An operation of programs on this and others of its type."""
        own = self.value.dtype
        rest = [x.value if isinstance(x, Number) else own.type(x) for x in others]
        return Number(self.builder, self.builder.op(name, dtype or own, self.value, *rest))

    def cast(self, dtype: np.dtype) -> Number:
        return Number(self.builder, self.builder.cast(self.value, dtype))

    def bits(self, dtype: np.dtype) -> Number:
        """The number with the same bits."""
        return self.op("bitcast", dtype=dtype)

    def known(self, x: float) -> Number:
        """A known number of this type."""
        return Number(self.builder, self.value.dtype.type(x))

    def where(self, yes: Number | float, no: Number | float, dtype: type = np.float64) -> Number:
        """yes where this condition holds, else no."""
        values = [x.value if isinstance(x, Number) else dtype(x) for x in (yes, no)]
        return Number(self.builder, self.builder.select(self.value, *values))

    def __add__(self, x: Number | float) -> Number:
        return self.op("add", x)

    def __radd__(self, x: float) -> Number:
        return self.known(x) + self

    def __sub__(self, x: Number | float) -> Number:
        return self.op("sub", x)

    def __rsub__(self, x: float) -> Number:
        return self.known(x) - self

    def __mul__(self, x: Number | float) -> Number:
        return self.op("mul", x)

    def __rmul__(self, x: float) -> Number:
        return self.known(x) * self

    def __truediv__(self, x: Number | float) -> Number:
        return self.op("div", x)

    def __rtruediv__(self, x: float) -> Number:
        return self.known(x) / self

    def __neg__(self) -> Number:
        return self.op("neg")

    def __abs__(self) -> Number:
        return self.op("abs")

    def __and__(self, x: Number | int) -> Number:
        return self.op("and", x)

    def __or__(self, x: Number | int) -> Number:
        return self.op("or", x)

    def __lshift__(self, x: int) -> Number:
        return self.op("shl", x)

    def __rshift__(self, x: int) -> Number:
        return self.op("shr", x)

    def __lt__(self, x: Number | float) -> Number:
        return self.op("lt", x, dtype=BOOL)

    def __gt__(self, x: Number | float) -> Number:
        return self.op("gt", x, dtype=BOOL)

    def __ge__(self, x: Number | float) -> Number:
        return self.op("ge", x, dtype=BOOL)

    def equals(self, x: Number | float) -> Number:
        return self.op("eq", x, dtype=BOOL)
