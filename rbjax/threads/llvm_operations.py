"""The operations of a program as LLVM instructions on scalars."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from rbjax.threads.lowering import Unsupported
from rbjax.threads.program import Op

TYPES = {"float32": "float", "float64": "double", "bool": "i1"}

#: functions of C's mathematics, f appended for float
LIBM = {
    "cbrt", "exp", "exp2", "expm1", "log", "log1p", "log2", "sin", "cos", "tan", "asin", "acos",
    "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erf", "erfc", "lgamma", "atan2",
    "pow", "fmod", "nextafter",
}  # fmt: skip
#: functions of floats that LLVM has as instructions of the machine
INTRINSICS = {
    "sqrt": "sqrt", "floor": "floor", "ceil": "ceil", "rint": "rint", "round": "round",
    "abs": "fabs", "copysign": "copysign",
}  # fmt: skip
#: sums and products may become one rounding (fma), as in XLA
FLOAT = {"add": "fadd contract", "sub": "fsub contract", "mul": "fmul contract", "div": "fdiv"}
INTEGER = {
    "add": "add", "sub": "sub", "mul": "mul", "index_add": "add", "index_mul": "mul",
    "and": "and", "or": "or", "xor": "xor",
}  # fmt: skip
LOGICAL = {**INTEGER, "add": "or", "mul": "and", "max": "or", "min": "and"}
COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")


def llvm_type(dtype: Any) -> str:
    """The type of a value in a register."""
    dtype = np.dtype(dtype)
    return TYPES.get(dtype.name) or f"i{8 * dtype.itemsize}"


def literal(x: Any) -> str:
    """A known number. Floats are given by their bits, those of float as double."""
    if x.dtype.kind == "b":
        return "true" if x else "false"
    if x.dtype.kind == "f":
        return f"0x{int(np.float64(x).view(np.uint64)):016X}"
    return str(int(x))


class Operations:
    """Writes instructions with `emit` and notes the functions that they call."""

    def __init__(self, emit: Callable[[str], None]):
        self.emit = emit
        self.declared: dict[str, str] = {}
        self.names = itertools.count()

    @property
    def libm(self) -> list[str]:
        """The called functions of C's mathematics."""
        return sorted(name for name in self.declared if not name.startswith("llvm."))

    def made(self, text: str, name: str | None = None) -> str:
        """A new value."""
        name = name or f"%v{next(self.names)}"
        self.emit(f"{name} = {text}")
        return name

    def call(self, function: str, result: str, args: list[tuple[str, str]]) -> str:
        """The text of a call."""
        types = ", ".join(t for t, _ in args)
        own = function.startswith("llvm.")
        # the functions keep their meaning to the last bit: LLVM may not replace them
        pure = "" if own else " nobuiltin nounwind willreturn memory(none)"
        self.declared[function] = f"declare {result} @{function}({types}){pure}"
        return f"call {result} @{function}({', '.join(f'{t} {x}' for t, x in args)})"

    def write(self, op: Op, name: str, x: list[str]) -> None:
        """name = op(x)."""
        self.made(self._text(op, x), name)

    def _text(self, op: Op, x: list[str]) -> str:
        kind, what = op.dest.dtype, op.name
        of = op.args[0].dtype
        t = llvm_type(kind)
        if what in COMPARISONS:
            return f"{_comparison(what, of)} {llvm_type(of)} {x[0]}, {x[1]}"
        match what:
            case "select":
                return f"select i1 {x[0]}, {t} {x[1]}, {t} {x[2]}"
            case "cast":
                return self._cast(of, kind, x[0])
            case "not":
                return f"xor {t} {x[0]}, {'true' if kind.kind == 'b' else -1}"
            case "bitcast":
                return self._bits(of, kind, x[0])
            case "isfinite":
                size = self.made(self.intrinsic("fabs", of, x))
                return f"fcmp olt {llvm_type(of)} {size}, {literal(of.type(np.inf))}"
        if kind.kind == "f":
            return self._float(what, kind, x)
        if kind.kind == "b" and what in LOGICAL:
            return f"{LOGICAL[what]} i1 {x[0]}, {x[1]}"
        if what in INTEGER:
            return f"{INTEGER[what]} {t} {x[0]}, {x[1]}"
        return self._integer(what, kind, x)

    def intrinsic(self, name: str, dtype: np.dtype, x: list[str]) -> str:
        t = llvm_type(dtype)
        return self.call(f"llvm.{name}.{_short(dtype)}", t, [(t, a) for a in x])

    def _float(self, what: str, kind: np.dtype, x: list[str]) -> str:
        t = llvm_type(kind)
        if what in FLOAT:
            return f"{FLOAT[what]} {t} {x[0]}, {x[1]}"
        if what == "neg":
            return f"fneg {t} {x[0]}"
        if what in ("max", "min"):  # nan if one is nan
            first = self.made(f"fcmp {'ogt' if what == 'max' else 'olt'} {t} {x[0]}, {x[1]}")
            nan = self.made(f"fcmp uno {t} {x[0]}, {x[0]}")
            either = self.made(f"or i1 {first}, {nan}")
            return f"select i1 {either}, {t} {x[0]}, {t} {x[1]}"
        if what in INTRINSICS:
            return self.intrinsic(INTRINSICS[what], kind, x)
        if what == "rsqrt":
            root = self.made(self.intrinsic("sqrt", kind, x))
            return f"fdiv {t} {literal(kind.type(1))}, {root}"
        if what in LIBM:
            return self.call(what + ("f" if t == "float" else ""), t, [(t, a) for a in x])
        raise Unsupported(f"operation {what} of {kind}")

    def _integer(self, what: str, kind: np.dtype, x: list[str]) -> str:
        t, signed = llvm_type(kind), kind.kind == "i"
        match what:
            case "neg":
                return f"sub {t} 0, {x[0]}"
            case "max" | "min":
                name = f"llvm.{'s' if signed else 'u'}{what}.{t}"
                return self.call(name, t, [(t, a) for a in x])
            case "abs":
                if not signed:
                    return f"add {t} {x[0]}, 0"
                return self.call(f"llvm.abs.{t}", t, [(t, x[0]), ("i1", "false")])
            case "popcount":
                return self.call(f"llvm.ctpop.{t}", t, [(t, x[0])])
            case "clz":
                return self.call(f"llvm.ctlz.{t}", t, [(t, x[0]), ("i1", "false")])
            case "shl" | "shr":  # 0 for a shift by all bits or more
                inside = self.made(f"icmp ult {t} {x[1]}, {8 * kind.itemsize}")
                shifted = self.made(f"{'shl' if what == 'shl' else 'lshr'} {t} {x[0]}, {x[1]}")
                return f"select i1 {inside}, {t} {shifted}, {t} 0"
            case "sar":
                most = 8 * kind.itemsize - 1
                inside = self.made(f"icmp ult {t} {x[1]}, {most}")
                count = self.made(f"select i1 {inside}, {t} {x[1]}, {t} {most}")
                return f"ashr {t} {x[0]}, {count}"
            case "idiv" | "irem":
                return self._division(what, t, signed, x)
        raise Unsupported(f"operation {what} of {kind}")

    def _division(self, what: str, t: str, signed: bool, x: list[str]) -> str:
        """a / 0 = -1, a % 0 = a; the least integer by -1 is itself, remainder 0."""
        zero = self.made(f"icmp eq {t} {x[1]}, 0")
        unsafe = zero
        if signed:
            minus = self.made(f"icmp eq {t} {x[1]}, -1")
            unsafe = self.made(f"or i1 {zero}, {minus}")
        by = self.made(f"select i1 {unsafe}, {t} 1, {t} {x[1]}")
        sign = "s" if signed else "u"
        if what == "irem":
            rest = self.made(f"{sign}rem {t} {x[0]}, {by}")
            return f"select i1 {zero}, {t} {x[0]}, {t} {rest}"
        quotient = self.made(f"{sign}div {t} {x[0]}, {by}")
        if signed:
            opposite = self.made(f"sub {t} 0, {x[0]}")
            quotient = self.made(f"select i1 {minus}, {t} {opposite}, {t} {quotient}")
        return f"select i1 {zero}, {t} -1, {t} {quotient}"

    def _cast(self, of: np.dtype, to: np.dtype, x: str) -> str:
        s, t = llvm_type(of), llvm_type(to)
        if to.kind == "b":
            test = "fcmp une" if of.kind == "f" else "icmp ne"
            return f"{test} {s} {x}, {literal(of.type(0))}"
        if of.kind == "f" and to.kind == "f":
            word = "fpext" if to.itemsize > of.itemsize else "fptrunc"
        elif of.kind == "f":  # the nearest integer of the type, 0 for nan
            sign = "s" if to.kind == "i" else "u"
            return self.call(f"llvm.fpto{sign}i.sat.{t}.{_short(of)}", t, [(s, x)])
        elif to.kind == "f":
            word = "sitofp" if of.kind == "i" else "uitofp"
        elif of.kind == "b" or to.itemsize > of.itemsize:
            word = "sext" if of.kind == "i" else "zext"
        else:
            word = "trunc" if to.itemsize < of.itemsize else "bitcast"
        return f"{word} {s} {x} to {t}"

    def _bits(self, of: np.dtype, to: np.dtype, x: str) -> str:
        if of.kind == "b" or to.kind == "b":
            return self._cast(of, to, x)
        return f"bitcast {llvm_type(of)} {x} to {llvm_type(to)}"


def _comparison(what: str, of: np.dtype) -> str:
    if of.kind == "f":
        return f"fcmp {'une' if what == 'ne' else 'o' + what}"
    if what in ("eq", "ne"):
        return f"icmp {what}"
    return f"icmp {'s' if of.kind == 'i' else 'u'}{what}"


def _short(dtype: np.dtype) -> str:
    return f"f{8 * dtype.itemsize}"
