"""The LLVM text of operations. Each function in this module is an `LlvmText` or returns one.

An `LlvmText` maps the writer of instructions, the dtype of the result, the dtype of the first
argument, and the names of the arguments to the text of the last instruction. It writes any earlier
instructions. It returns None for unsupported dtypes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import DTypeLike


class Instructions(Protocol):
    """The interface of the writer of LLVM instructions (`llvm.operations.Operations`)."""

    def type(self, dtype: DTypeLike) -> str: ...
    def number(self, x: float | np.generic, dtype: np.dtype | None = None) -> str: ...
    def made(self, text: str, name: str | None = None) -> str: ...
    def mathematical(self, name: str, kind: np.dtype, x: Sequence[str]) -> str: ...
    def intrinsic(
        self, name: str, of: Sequence[DTypeLike], result: DTypeLike, x: Sequence[str], *more: str
    ) -> str: ...


LlvmText = Callable[[Instructions, np.dtype, np.dtype, Sequence[str]], str | None]


def instruction(name: str) -> LlvmText:
    """Return the text of an instruction whose two arguments have the type of the result."""
    return lambda w, kind, of, x: f"{name} {w.type(kind)} {x[0]}, {x[1]}"


def by_kind(
    f: LlvmText | None = None, i: LlvmText | None = None, b: LlvmText | None = None
) -> LlvmText:
    """Choose an operation's text by the kind of its result: f (floats), i (integers), b (booleans).
    Booleans are integers of one bit if b is None."""
    texts = {"f": f, "i": i, "u": i, "b": b or i}

    def text(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str | None:
        of_kind = texts[kind.kind]
        return of_kind(w, kind, of, x) if of_kind else None

    return text


def arithmetic(f: str | None, i: str, b: str | None = None) -> LlvmText:
    """Return the text of the instruction for floats (f), integers (i) or booleans (b)."""
    return by_kind(*(instruction(name) if name else None for name in (f, i, b)))


def comparison(name: str) -> LlvmText:
    def text(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
        if of.kind == "f":
            test = f"fcmp {'une' if name == 'ne' else 'o' + name}"
        elif name in ("eq", "ne"):
            test = f"icmp {name}"
        else:
            test = f"icmp {'s' if of.kind == 'i' else 'u'}{name}"
        return f"{test} {w.type(of)} {x[0]}, {x[1]}"

    return text


def intrinsic(name: str) -> LlvmText:
    """Return the text of an LLVM intrinsic."""
    return lambda w, kind, of, x: w.intrinsic(name, [kind], kind, x)


def counted(name: str) -> LlvmText:
    """Return the text of a bit-counting intrinsic that is defined for all arguments."""
    return by_kind(i=lambda w, kind, of, x: w.intrinsic(name, [kind], kind, x, "false"))


def mathematical(name: str) -> LlvmText:
    """Return the text of a C mathematical function, or of its formula for vectors."""
    return by_kind(f=lambda w, kind, of, x: w.mathematical(name, kind, x))


def larger(name: str, logical: str) -> LlvmText:
    """Return the text of the maximum or minimum. The result is nan if the first argument is nan."""

    def floats(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
        t, truth = w.type(kind), w.type(bool)
        first = w.made(f"fcmp {'ogt' if name == 'max' else 'olt'} {t} {x[0]}, {x[1]}")
        nan = w.made(f"fcmp uno {t} {x[0]}, {x[0]}")
        either = w.made(f"or {truth} {first}, {nan}")
        return f"select {truth} {either}, {t} {x[0]}, {t} {x[1]}"

    def integers(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
        return w.intrinsic(f"{'s' if kind.kind == 'i' else 'u'}{name}", [kind], kind, x)

    return by_kind(floats, integers, instruction(logical))


def negative(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    if kind.kind == "f":
        return f"fneg {w.type(kind)} {x[0]}"
    return f"sub {w.type(kind)} {w.number(0, kind)}, {x[0]}"


def absolute(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    if kind.kind == "f":
        return w.intrinsic("fabs", [kind], kind, x)
    if kind.kind == "i":
        return w.intrinsic("abs", [kind], kind, x, "false")
    return f"add {w.type(kind)} {x[0]}, {w.number(0, kind)}"


def inverted(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    return f"xor {w.type(kind)} {x[0]}, {w.number(~kind.type(0))}"


def select(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    t = w.type(kind)
    return f"select {w.type(bool)} {x[0]}, {t} {x[1]}, {t} {x[2]}"


def isfinite(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    size = w.made(w.intrinsic("fabs", [of], of, x))
    return f"fcmp olt {w.type(of)} {size}, {w.number(np.inf, of)}"


def inverse_root(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    root = w.made(w.intrinsic("sqrt", [kind], kind, x))
    return f"fdiv {w.type(kind)} {w.number(1, kind)}, {root}"


def shift(name: str) -> LlvmText:
    """Return the text of a shift. A shift by all bits or more returns 0."""

    def text(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
        t, truth = w.type(kind), w.type(bool)
        bits, zero = w.number(8 * kind.itemsize, kind), w.number(0, kind)
        inside = w.made(f"icmp ult {t} {x[1]}, {bits}")
        shifted = w.made(f"{name} {t} {x[0]}, {x[1]}")
        return f"select {truth} {inside}, {t} {shifted}, {t} {zero}"

    return by_kind(i=text)


def shift_arithmetic(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    t, truth = w.type(kind), w.type(bool)
    most = w.number(8 * kind.itemsize - 1, kind)
    inside = w.made(f"icmp ult {t} {x[1]}, {most}")
    count = w.made(f"select {truth} {inside}, {t} {x[1]}, {t} {most}")
    return f"ashr {t} {x[0]}, {count}"


def division(name: str) -> LlvmText:
    """Return the text of an integer division or remainder, defined for all arguments as in XLA.
    a / 0 = -1 and a % 0 = a. The least integer divided by -1 is itself, with remainder 0."""

    def text(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
        t, signed, truth = w.type(kind), kind.kind == "i", w.type(bool)
        none, one, ones = (w.number(k) for k in (kind.type(0), kind.type(1), ~kind.type(0)))
        zero = w.made(f"icmp eq {t} {x[1]}, {none}")
        unsafe = zero
        if signed:
            minus = w.made(f"icmp eq {t} {x[1]}, {ones}")
            unsafe = w.made(f"or {truth} {zero}, {minus}")
        by = w.made(f"select {truth} {unsafe}, {t} {one}, {t} {x[1]}")
        sign = "s" if signed else "u"
        if name == "irem":
            rest = w.made(f"{sign}rem {t} {x[0]}, {by}")
            return f"select {truth} {zero}, {t} {x[0]}, {t} {rest}"
        quotient = w.made(f"{sign}div {t} {x[0]}, {by}")
        if signed:
            opposite = w.made(f"sub {t} {none}, {x[0]}")
            quotient = w.made(f"select {truth} {minus}, {t} {opposite}, {t} {quotient}")
        return f"select {truth} {zero}, {t} {ones}, {t} {quotient}"

    return by_kind(i=text)


def cast(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    s, t = w.type(of), w.type(kind)
    if kind.kind == "b":
        test = "fcmp une" if of.kind == "f" else "icmp ne"
        return f"{test} {s} {x[0]}, {w.number(0, of)}"
    if of.kind == "f" and kind.kind == "f":
        word = "fpext" if kind.itemsize > of.itemsize else "fptrunc"
    elif of.kind == "f":  # the nearest integer; 0 for nan
        name = f"fpto{'s' if kind.kind == 'i' else 'u'}i.sat"
        return w.intrinsic(name, [kind, of], kind, [x[0]])
    elif kind.kind == "f":
        word = "sitofp" if of.kind == "i" else "uitofp"
    elif of.kind == "b" or kind.itemsize > of.itemsize:
        word = "sext" if of.kind == "i" else "zext"
    else:
        word = "trunc" if kind.itemsize < of.itemsize else "bitcast"
    return f"{word} {s} {x[0]} to {t}"


def bitcast(w: Instructions, kind: np.dtype, of: np.dtype, x: Sequence[str]) -> str:
    if of.kind == "b" or kind.kind == "b":
        return cast(w, kind, of, x)
    return f"bitcast {w.type(of)} {x[0]} to {w.type(kind)}"
