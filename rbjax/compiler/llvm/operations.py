"""The operations of a program as LLVM instructions on scalars."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rbjax.compiler.ir.program import Op
from rbjax.compiler.lower.lowering import Unsupported

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
#: of a line of the cache, and of the largest vector
ALIGNMENT = 64
#: LLVM puts vectors for which there is no register on the stack, aligned to 16 bytes unless a
#: function requests more. Most of them then cross a cache line: derivatives take 1.2 times as long.
ATTRIBUTES = f"nounwind alignstack({ALIGNMENT})"
COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")


@functools.lru_cache(64)
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


def splat(made: Callable[[str], str], lanes: int, t: str, x: str) -> str:
    """A scalar in every lane; `made` names what an instruction gives."""
    many = f"<{lanes} x {t}>"
    one = made(f"insertelement {many} poison, {t} {x}, i64 0")
    return made(f"shufflevector {many} {one}, {many} poison, <{lanes} x i32> zeroinitializer")


class Operations:
    """Writes instructions with `emit` and notes the functions that they call.

    lanes: entries of a value; with more than one, all values are vectors.
    """

    def __init__(
        self, emit: Callable[[str], None], lanes: int = 1, like: Operations | None = None
    ):
        self.emit, self.lanes = emit, lanes
        self.declared: dict[str, str] = like.declared if like else {}
        self.names: Iterator[int] = like.names if like else itertools.count()
        #: mathematical functions that are written as formulas, by name and type
        self.functions: dict[tuple[str, np.dtype], None] = {}

    @property
    def libm(self) -> list[str]:
        """The called functions of C's mathematics."""
        return sorted(name for name in self.declared if not name.startswith("llvm."))

    def type(self, dtype: Any) -> str:
        """The type of a value in a register."""
        t = llvm_type(dtype)
        return t if self.lanes == 1 else f"<{self.lanes} x {t}>"

    def number(self, x: Any, dtype: Any = None) -> str:
        """A known number, in every lane."""
        x = x if dtype is None else np.dtype(dtype).type(x)
        text = literal(x)
        return text if self.lanes == 1 else f"splat ({llvm_type(x.dtype)} {text})"

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

    def intrinsic(self, name: str, of: list[Any], result: Any, x: list[str], *more: str) -> str:
        """The text of a call of `llvm.name`, which is overloaded by the types of `of`."""
        suffix = ".".join(self.short(dtype) for dtype in of)
        args = [(self.type(of[-1]), a) for a in x] + [("i1", a) for a in more]
        return self.call(f"llvm.{name}.{suffix}", self.type(result), args)

    def short(self, dtype: Any) -> str:
        dtype = np.dtype(dtype)
        plain = f"f{8 * dtype.itemsize}" if dtype.kind == "f" else llvm_type(dtype)
        return plain if self.lanes == 1 else f"v{self.lanes}{plain}"

    def write(self, op: Op, name: str, x: list[str]) -> None:
        """name = op(x)."""
        self.made(self.text(op.name, op.dest.dtype, op.args[0].dtype, x), name)

    def text(self, what: str, kind: np.dtype, of: np.dtype, x: list[str]) -> str:
        """The instruction of an operation; kind: of its result, of: of its first argument."""
        t, truth = self.type(kind), self.type(bool)
        if what in COMPARISONS:
            return f"{_comparison(what, of)} {self.type(of)} {x[0]}, {x[1]}"
        match what:
            case "select":
                return f"select {truth} {x[0]}, {t} {x[1]}, {t} {x[2]}"
            case "cast":
                return self._cast(of, kind, x[0])
            case "not":
                return f"xor {t} {x[0]}, {self.number(~kind.type(0))}"
            case "bitcast":
                return self._bits(of, kind, x[0])
            case "isfinite":
                size = self.made(self.intrinsic("fabs", [of], of, x))
                return f"fcmp olt {self.type(of)} {size}, {self.number(np.inf, of)}"
        if kind.kind == "f":
            return self._float(what, kind, x)
        if kind.kind == "b" and what in LOGICAL:
            return f"{LOGICAL[what]} {t} {x[0]}, {x[1]}"
        if what in INTEGER:
            return f"{INTEGER[what]} {t} {x[0]}, {x[1]}"
        return self._integer(what, kind, x)

    def _float(self, what: str, kind: np.dtype, x: list[str]) -> str:
        t, truth = self.type(kind), self.type(bool)
        if what in FLOAT:
            return f"{FLOAT[what]} {t} {x[0]}, {x[1]}"
        if what == "neg":
            return f"fneg {t} {x[0]}"
        if what in ("max", "min"):  # nan if one is nan
            first = self.made(f"fcmp {'ogt' if what == 'max' else 'olt'} {t} {x[0]}, {x[1]}")
            nan = self.made(f"fcmp uno {t} {x[0]}, {x[0]}")
            either = self.made(f"or {truth} {first}, {nan}")
            return f"select {truth} {either}, {t} {x[0]}, {t} {x[1]}"
        if what in INTRINSICS:
            return self.intrinsic(INTRINSICS[what], [kind], kind, x)
        if what == "rsqrt":
            root = self.made(self.intrinsic("sqrt", [kind], kind, x))
            return f"fdiv {t} {self.number(1, kind)}, {root}"
        if what in LIBM:
            return self._function(what, kind, x)
        raise Unsupported(f"operation {what} of {kind}")

    def _function(self, what: str, kind: np.dtype, x: list[str]) -> str:
        t = self.type(kind)
        if self.lanes == 1 and what != "atan2":  # C's is wrong at subnormal numbers in XLA
            return self.call(of_c(what, kind), t, [(t, a) for a in x])
        self.functions[what, kind] = None
        return f"call {t} @{what}.{self.short(kind)}({', '.join(f'{t} {a}' for a in x)})"

    def _integer(self, what: str, kind: np.dtype, x: list[str]) -> str:
        t, signed, truth = self.type(kind), kind.kind == "i", self.type(bool)
        match what:
            case "neg":
                return f"sub {t} {self.number(0, kind)}, {x[0]}"
            case "max" | "min":
                return self.intrinsic(f"{'s' if signed else 'u'}{what}", [kind], kind, x)
            case "abs":
                if not signed:
                    return f"add {t} {x[0]}, {self.number(0, kind)}"
                return self.intrinsic("abs", [kind], kind, x, "false")
            case "popcount":
                return self.intrinsic("ctpop", [kind], kind, x)
            case "clz":
                return self.intrinsic("ctlz", [kind], kind, x, "false")
            case "shl" | "shr":  # 0 for a shift by all bits or more
                bits, zero = self.number(8 * kind.itemsize, kind), self.number(0, kind)
                inside = self.made(f"icmp ult {t} {x[1]}, {bits}")
                shifted = self.made(f"{'shl' if what == 'shl' else 'lshr'} {t} {x[0]}, {x[1]}")
                return f"select {truth} {inside}, {t} {shifted}, {t} {zero}"
            case "sar":
                most = self.number(8 * kind.itemsize - 1, kind)
                inside = self.made(f"icmp ult {t} {x[1]}, {most}")
                count = self.made(f"select {truth} {inside}, {t} {x[1]}, {t} {most}")
                return f"ashr {t} {x[0]}, {count}"
            case "idiv" | "irem":
                return self._division(what, kind, x)
        raise Unsupported(f"operation {what} of {kind}")

    def _division(self, what: str, kind: np.dtype, x: list[str]) -> str:
        """a / 0 = -1, a % 0 = a; the least integer by -1 is itself, remainder 0."""
        t, signed, truth = self.type(kind), kind.kind == "i", self.type(bool)
        none, one, ones = (self.number(k) for k in (kind.type(0), kind.type(1), ~kind.type(0)))
        zero = self.made(f"icmp eq {t} {x[1]}, {none}")
        unsafe = zero
        if signed:
            minus = self.made(f"icmp eq {t} {x[1]}, {ones}")
            unsafe = self.made(f"or {truth} {zero}, {minus}")
        by = self.made(f"select {truth} {unsafe}, {t} {one}, {t} {x[1]}")
        sign = "s" if signed else "u"
        if what == "irem":
            rest = self.made(f"{sign}rem {t} {x[0]}, {by}")
            return f"select {truth} {zero}, {t} {x[0]}, {t} {rest}"
        quotient = self.made(f"{sign}div {t} {x[0]}, {by}")
        if signed:
            opposite = self.made(f"sub {t} {none}, {x[0]}")
            quotient = self.made(f"select {truth} {minus}, {t} {opposite}, {t} {quotient}")
        return f"select {truth} {zero}, {t} {ones}, {t} {quotient}"

    def _cast(self, of: np.dtype, to: np.dtype, x: str) -> str:
        s, t = self.type(of), self.type(to)
        if to.kind == "b":
            test = "fcmp une" if of.kind == "f" else "icmp ne"
            return f"{test} {s} {x}, {self.number(0, of)}"
        if of.kind == "f" and to.kind == "f":
            word = "fpext" if to.itemsize > of.itemsize else "fptrunc"
        elif of.kind == "f":  # the nearest integer of the type, 0 for nan
            name = f"fpto{'s' if to.kind == 'i' else 'u'}i.sat"
            return self.intrinsic(name, [to, of], to, [x])
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
        return f"bitcast {self.type(of)} {x} to {self.type(to)}"


def of_c(what: str, kind: np.dtype) -> str:
    """The name of a function of C's mathematics for a type."""
    return what + ("f" if kind.itemsize == 4 else "")


def _comparison(what: str, of: np.dtype) -> str:
    if of.kind == "f":
        return f"fcmp {'une' if what == 'ne' else 'o' + what}"
    if what in ("eq", "ne"):
        return f"icmp {what}"
    return f"icmp {'s' if of.kind == 'i' else 'u'}{what}"
