"""Constant folding, and simplification of operations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rbjax.compiler.ir.operations import OPERATIONS
from rbjax.compiler.ir.statements import BOOL, Value, is_number

if TYPE_CHECKING:
    from rbjax.compiler.ir.builder import Builder


def folded(name: str, dtype: np.dtype, args: tuple) -> Value | None:
    """The result of an operation on known values, or None if the program must compute it."""
    operation = OPERATIONS[name]
    if operation.fold is None or dtype.kind not in operation.fold_types:
        return None
    if name == "cast" and args[0].dtype.kind == "f" and dtype.kind != "f":
        return None  # numpy's result for large numbers and nan is not XLA's
    with np.errstate(all="ignore"):
        return dtype.type(operation.fold(*args))


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
    keys: list = [(a.dtype.char, a.tobytes()) if isinstance(a, np.generic) else a.id for a in args]
    if OPERATIONS[name].commutes and _order(keys[0]) > _order(keys[1]):
        keys.reverse()
    return keys


def _order(key: tuple | int) -> tuple:
    return (1, *key) if isinstance(key, tuple) else (0, key)
