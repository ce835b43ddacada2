"""Constant folding, and simplification of operations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from rbjax.compiler.ir.program import Builder

BOOL = np.dtype(bool)
Value = Any  # a numpy scalar where it is known, else a Var


def _shift(f):
    return lambda a, b: f(a, b) if 0 <= int(b) < a.dtype.itemsize * 8 else a.dtype.type(0)


FOLD = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative,
    "index_add": np.add, "index_mul": np.multiply,
    "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "eq": np.equal, "ne": np.not_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "not": np.invert,
    "shl": _shift(np.left_shift), "sqrt": np.sqrt, "exp": np.exp, "log": np.log, "sin": np.sin,
    "cos": np.cos, "tan": np.tan, "tanh": np.tanh, "floor": np.floor, "ceil": np.ceil,
    "rint": np.rint, "abs": np.abs, "max": np.maximum, "min": np.minimum, "pow": np.power,
    "atan2": np.arctan2, "isfinite": np.isfinite,
}  # fmt: skip
"""The numpy function of an operation on known values; others are left to the program."""

COMMUTATIVE = {"add", "mul", "index_add", "index_mul", "and", "or", "xor", "eq", "ne"}


def folded(name: str, dtype: np.dtype, args: tuple) -> Value | None:
    """The result of an operation on known values, or None if the program must compute it."""
    with np.errstate(all="ignore"):
        if name == "cast":
            return dtype.type(args[0]) if args[0].dtype.kind in "biu" or dtype.kind == "f" else None
        if name == "div" and dtype.kind == "f":
            return dtype.type(np.divide(*args))
        if name in FOLD:
            return dtype.type(FOLD[name](*args))
    return None


def is_number(x: Value, number: int) -> bool:
    """Whether a value is known to be this number."""
    return isinstance(x, np.generic) and x.dtype != BOOL and x == number


def simpler(builder: Builder, name: str, args: tuple) -> Value | None:
    """A value equal to the operation, from a known argument or a double negation; or None."""
    match name, args:
        case ("select", (c, a, b)) if isinstance(c, np.generic):
            return a if c else b
        case ("select", (_, a, b)) if a is b:
            return a
        case ("neg", (a,)) if not isinstance(a, np.generic) and a.id in builder.negated:
            return builder.negated[a.id]
        case ("add" | "index_add", (a, b)) if is_number(b, 0):
            return a
        case ("add" | "index_add", (a, b)) if is_number(a, 0):
            return b
        case ("sub", (a, b)) if is_number(b, 0):
            return a
        case ("mul" | "index_mul" | "index_div" | "div", (a, b)) if is_number(b, 1):
            return a
        case ("mul" | "index_mul", (a, b)) if is_number(a, 1):
            return b
        case ("mul", (a, b)) if is_number(b, -1):
            return builder.op("neg", a.dtype, a)
        case ("mul", (a, b)) if is_number(a, -1):
            return builder.op("neg", b.dtype, b)
        case ("mul" | "index_mul", (a, b)) if a.dtype.kind in "iu":
            return a.dtype.type(0) if is_number(a, 0) or is_number(b, 0) else None
        case ("and", (a, b)) if a.dtype == BOOL and isinstance(a, np.generic):
            return b if a else a
        case ("and", (a, b)) if b.dtype == BOOL and isinstance(b, np.generic):
            return a if b else b
        case ("or", (a, b)) if a.dtype == BOOL and isinstance(a, np.generic):
            return a if a else b
        case ("or", (a, b)) if b.dtype == BOOL and isinstance(b, np.generic):
            return b if b else a
    return None


def keys_of(name: str, args: Sequence[Value]) -> list:
    """Keys that are shared by operations with the same result."""
    keys: list = [
        (a.dtype.char, a.tobytes()) if isinstance(a, np.generic) else a.id for a in args
    ]
    if name in COMMUTATIVE and _order(keys[0]) > _order(keys[1]):
        keys.reverse()
    return keys


def _order(key: Any) -> tuple:
    return (1, *key) if isinstance(key, tuple) else (0, key)
