"""The table of operations. One row defines an operation for all back ends.

To add an operation, add a row. `primitives` are the JAX primitives that are this operation on each
entry. A primitive that needs several operations has a rule in `lower` instead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbjax.compiler.ir import c_text as c
from rbjax.compiler.ir import elementary, powers
from rbjax.compiler.ir import llvm_text as llvm

Fold = Callable[..., Any]
Formula = Callable[..., elementary.Found]


@dataclass(frozen=True)
class Operation:
    """An operation on scalars.

    name: name in `ir.statements.Op`.
    arity: number of arguments.
    c: its C text.
    llvm: its LLVM text; None if only GPU programs use the operation.
    fold: numpy function that evaluates it on constants; None if the program must compute it.
    fold_types: dtype kinds of results that `fold` evaluates.
    primitives: JAX primitives that are this operation on each entry.
    formula: its formula for vectors, in double precision.
    sees_subnormals: whether the formula needs an exact conversion of subnormal float32 arguments.
    commutes: whether its two arguments may be exchanged.
    helper: C template that its C text calls.
    """

    name: str
    arity: int
    c: c.CText
    llvm: llvm.LlvmText | None
    fold: Fold | None = None
    fold_types: str = "fiub"
    primitives: tuple[str, ...] = ()
    formula: Formula | None = None
    sees_subnormals: bool = False
    commutes: bool = False
    helper: str = ""


def _binary(
    name: str, symbol: str, text: llvm.LlvmText | None, fold: Fold | None = None, *primitives: str,
    wraps: bool = False, commutes: bool = False, fold_types: str = "fiub",
) -> Operation:  # fmt: skip
    """Return the row of the table of operations for a binary operator of C."""
    return Operation(
        name, 2, c.infix(symbol, wraps), text, fold, fold_types, primitives, commutes=commutes
    )


def _comparison(name: str, symbol: str, fold: Fold | None, commutes: bool = False) -> Operation:
    return _binary(name, symbol, llvm.comparison(name), fold, name, commutes=commutes)


def _function(
    name: str, formula: Formula | None = None, fold: Fold | None = None, arity: int = 1,
    primitive: bool = True, sees_subnormals: bool = False,
) -> Operation:  # fmt: skip
    """Return the row of the table of operations for a C mathematical function."""
    text = llvm.mathematical(name)
    primitives = (name,) if primitive else ()
    return Operation(
        name, arity, c.function(name), text, fold, primitives=primitives, formula=formula,
        sees_subnormals=sees_subnormals,
    )  # fmt: skip


def _rounding(name: str, fold: Fold | None, *primitives: str, arity: int = 1) -> Operation:
    """Return the row of the table of operations for a function that is one machine instruction."""
    text = llvm.by_kind(f=llvm.intrinsic(name))
    return Operation(name, arity, c.function(name), text, fold, primitives=primitives)


def _shift_left(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    inside = (b >= 0) & (b < 8 * a.dtype.itemsize)
    return np.where(inside, np.left_shift(a, np.where(inside, b, 0)), 0)


ALL = (
    # a sum of a product may be rounded once (fma), as in XLA
    _binary("add", "+", llvm.arithmetic("fadd contract", "add", "or"), np.add, "add", "add_any",
            wraps=True, commutes=True),
    _binary("sub", "-", llvm.arithmetic("fsub contract", "sub"), np.subtract, "sub", wraps=True),
    _binary("mul", "*", llvm.arithmetic("fmul contract", "mul", "and"), np.multiply, "mul",
            wraps=True, commutes=True),
    _binary("div", "/", llvm.by_kind(f=llvm.instruction("fdiv")), np.divide, fold_types="f"),
    _binary("index_add", "+", llvm.arithmetic(None, "add"), np.add, commutes=True),
    _binary("index_mul", "*", llvm.arithmetic(None, "mul"), np.multiply, commutes=True),
    _binary("index_div", "/", None),
    _binary("index_mod", "%", None),
    Operation("neg", 1, c.negative, llvm.negative, np.negative, primitives=("neg",)),
    Operation("abs", 1, c.absolute, llvm.absolute, np.abs, primitives=("abs",)),
    Operation("max", 2, c.larger(">", "|"), llvm.larger("max", "or"), np.maximum,
              primitives=("max",)),
    Operation("min", 2, c.larger("<", "&"), llvm.larger("min", "and"), np.minimum,
              primitives=("min",)),
    _comparison("lt", "<", np.less),
    _comparison("le", "<=", np.less_equal),
    _comparison("gt", ">", np.greater),
    _comparison("ge", ">=", np.greater_equal),
    _comparison("eq", "==", np.equal, commutes=True),
    _comparison("ne", "!=", np.not_equal, commutes=True),
    Operation("isfinite", 1, lambda kind, of, x: f"(bool)isfinite({x[0]})", llvm.isfinite,
              np.isfinite, primitives=("is_finite",)),
    Operation("select", 3, c.select, llvm.select),
    # bits
    _binary("and", "&", llvm.arithmetic(None, "and"), np.bitwise_and, "and", commutes=True),
    _binary("or", "|", llvm.arithmetic(None, "or"), np.bitwise_or, "or", commutes=True),
    _binary("xor", "^", llvm.arithmetic(None, "xor"), np.bitwise_xor, "xor", commutes=True),
    Operation("not", 1, c.inverted, llvm.inverted, np.invert, primitives=("not",)),
    # operations that C leaves undefined for some arguments; defined as in XLA
    Operation("idiv", 2, c.helper("idiv"), llvm.division("idiv"), helper=c.IDIV),
    Operation("irem", 2, c.helper("irem"), llvm.division("irem"), helper=c.IREM),
    Operation("shl", 2, c.helper("shl"), llvm.shift("shl"), _shift_left,
              primitives=("shift_left",), helper=c.SHL),
    Operation("shr", 2, c.shift_right, llvm.shift("lshr"), primitives=("shift_right_logical",)),
    Operation("sar", 2, c.shift_arithmetic, llvm.by_kind(i=llvm.shift_arithmetic),
              primitives=("shift_right_arithmetic",), helper=c.SAR),
    Operation("popcount", 1, c.counted("popcount"), llvm.by_kind(i=llvm.intrinsic("ctpop")),
              primitives=("population_count",), helper=c.POPCOUNT),
    Operation("clz", 1, c.counted("clz"), llvm.counted("ctlz"), primitives=("clz",), helper=c.CLZ),
    Operation("cast", 1, c.cast, llvm.cast, lambda x: x, helper=c.TO_INTEGER),
    Operation("bitcast", 1, c.bitcast, llvm.bitcast, helper=c.BITS_OF),
    # floating-point functions that are machine instructions
    _rounding("sqrt", np.sqrt, "sqrt"),
    _rounding("floor", np.floor, "floor"),
    _rounding("ceil", np.ceil, "ceil"),
    _rounding("rint", np.rint),
    _rounding("round", None),
    _rounding("copysign", None, "copysign", arity=2),
    Operation("rsqrt", 1, lambda kind, of, x: f"RSQRT{c.suffix(kind)}({x[0]})",
              llvm.by_kind(f=llvm.inverse_root), primitives=("rsqrt",)),
    # mathematical functions
    _function("cbrt", powers.cbrt, sees_subnormals=True),
    _function("exp", elementary.exp, np.exp),
    _function("exp2", elementary.exp2),
    _function("expm1", elementary.expm1),
    _function("log", elementary.log, np.log, sees_subnormals=True),
    _function("log1p", elementary.log1p),
    _function("log2"),
    _function("sin", elementary.sin, np.sin),
    _function("cos", elementary.cos, np.cos),
    _function("tan", elementary.tan, np.tan),
    _function("asin", elementary.asin),
    _function("acos", elementary.acos),
    _function("atan", elementary.atan),
    _function("sinh", elementary.sinh),
    _function("cosh", elementary.cosh),
    _function("tanh", elementary.tanh, np.tanh),
    _function("asinh", elementary.asinh),
    _function("acosh", elementary.acosh),
    _function("atanh", elementary.atanh),
    _function("erf", powers.erf),
    _function("erfc", powers.erfc),
    _function("lgamma"),
    _function("atan2", elementary.atan2, np.arctan2, arity=2, sees_subnormals=True),
    _function("pow", powers.pow, np.power, arity=2, primitive=False, sees_subnormals=True),
    _function("fmod", arity=2, primitive=False),
    _function("nextafter", arity=2),
)  # fmt: skip

OPERATIONS = {x.name: x for x in ALL}

#: the operation of each JAX primitive that is one operation on each entry
OF_PRIMITIVE = {primitive: x for x in ALL for primitive in x.primitives}
