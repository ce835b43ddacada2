"""The operations of a program as LLVM instructions, and mathematical functions of vectors."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import DTypeLike

from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.elementary import Number, widened
from rbjax.compiler.ir.operations import OPERATIONS
from rbjax.compiler.ir.statements import F64, Op, Unsupported, Var

TYPES = {"float32": "float", "float64": "double", "bool": "i1"}

#: bytes of a cache line, and of the largest vector
ALIGNMENT = 64
#: LLVM puts vectors for which there is no register on the stack. Without this attribute they are
#: aligned to 16 bytes, and most of them cross a cache line, which is slow.
ATTRIBUTES = f"nounwind alignstack({ALIGNMENT})"


@functools.lru_cache(64)
def llvm_type(dtype: np.dtype) -> str:
    """Return the LLVM type of a value in a register."""
    dtype = np.dtype(dtype)
    return TYPES.get(dtype.name) or f"i{8 * dtype.itemsize}"


def literal(x: np.generic) -> str:
    """Return a constant as LLVM IR. Floats are printed by the bits of their double value."""
    if x.dtype.kind == "b":
        return "true" if x else "false"
    if x.dtype.kind == "f":
        return f"0x{int(np.float64(x).view(np.uint64)):016X}"
    return str(int(x))


def splat(made: Callable[[str], str], lanes: int, t: str, x: str) -> str:
    """Emit the broadcast of a scalar to every lane. made: function that emits an instruction."""
    many = f"<{lanes} x {t}>"
    one = made(f"insertelement {many} poison, {t} {x}, i64 0")
    return made(f"shufflevector {many} {one}, {many} poison, <{lanes} x i32> zeroinitializer")


class Operations:
    """An emitter of LLVM instructions, by `emit`. It records the functions that they call.

    lanes: number of lanes of a value. If it is more than 1, all values are vectors.
    """

    def __init__(self, emit: Callable[[str], None], lanes: int = 1, like: Operations | None = None):
        self.emit, self.lanes = emit, lanes
        self.declared: dict[str, str] = like.declared if like else {}
        self.names: Iterator[int] = like.names if like else itertools.count()
        #: mathematical functions that are computed by formulas, by name and dtype
        self.functions: dict[tuple[str, np.dtype], None] = {}

    @property
    def libm(self) -> list[str]:
        """The C mathematical functions that the instructions call."""
        return sorted(name for name in self.declared if not name.startswith("llvm."))

    def type(self, dtype: DTypeLike) -> str:
        """Return the LLVM type of a value in a register."""
        t = llvm_type(np.dtype(dtype))
        return t if self.lanes == 1 else f"<{self.lanes} x {t}>"

    def number(self, x: float | np.generic, dtype: np.dtype | None = None) -> str:
        """Return a constant in every lane."""
        if not isinstance(x, np.generic) or dtype is not None:
            x = np.dtype(dtype).type(x)
        text = literal(x)
        return text if self.lanes == 1 else f"splat ({llvm_type(x.dtype)} {text})"

    def made(self, text: str, name: str | None = None) -> str:
        """Emit an instruction, and return the name of its result."""
        name = name or f"%v{next(self.names)}"
        self.emit(f"{name} = {text}")
        return name

    def call(self, function: str, result: str, args: list[tuple[str, str]]) -> str:
        """Return the text of a call of a function. args: (type, name) of each argument."""
        types = ", ".join(t for t, _ in args)
        own = function.startswith("llvm.")
        # nobuiltin: LLVM may not replace the functions, so results stay equal to the last bit
        pure = "" if own else " nobuiltin nounwind willreturn memory(none)"
        self.declared[function] = f"declare {result} @{function}({types}){pure}"
        return f"call {result} @{function}({', '.join(f'{t} {x}' for t, x in args)})"

    def intrinsic(
        self, name: str, of: Sequence[DTypeLike], result: DTypeLike, x: Sequence[str], *more: str
    ) -> str:
        """Return the text of a call of the intrinsic `llvm.name`, overloaded by the dtypes `of`."""
        suffix = ".".join(self.short(dtype) for dtype in of)
        args = [(self.type(of[-1]), a) for a in x] + [("i1", a) for a in more]
        return self.call(f"llvm.{name}.{suffix}", self.type(result), args)

    def short(self, dtype: DTypeLike) -> str:
        dtype = np.dtype(dtype)
        plain = f"f{8 * dtype.itemsize}" if dtype.kind == "f" else llvm_type(dtype)
        return plain if self.lanes == 1 else f"v{self.lanes}{plain}"

    def write(self, op: Op, name: str, x: list[str]) -> None:
        """Emit name = op(x)."""
        text, kind = OPERATIONS[op.name].llvm, op.dest.dtype
        last = text(self, kind, op.args[0].dtype, x) if text else None
        if last is None:
            raise Unsupported(f"operation {op.name} of {kind}")
        self.made(last, name)

    def mathematical(self, name: str, kind: np.dtype, x: Sequence[str]) -> str:
        """Return the text of a call of a C mathematical function, or of its formula for vectors."""
        t = self.type(kind)
        if self.lanes == 1 and name != "atan2":  # C's atan2 is wrong at subnormal numbers in XLA
            return self.call(of_c(name, kind), t, [(t, a) for a in x])
        self.functions[name, kind] = None
        return f"call {t} @{name}.{self.short(kind)}({', '.join(f'{t} {a}' for a in x)})"


def of_c(what: str, kind: np.dtype) -> str:
    """Return the name of a C mathematical function for this dtype."""
    return what + ("f" if kind.itemsize == 4 else "")


def definitions(vectors: Operations) -> list[str]:
    """Return the definitions of the mathematical functions that vector operations call."""
    out = []
    for what, kind in list(vectors.functions):
        if OPERATIONS[what].formula:
            out += _by_formula(vectors, what, kind)
        else:
            out.append(_lane_by_lane(vectors, what, kind, name_of(vectors, what, kind)))
    return out


def name_of(vectors: Operations, what: str, kind: np.dtype) -> str:
    return f"{what}.{vectors.short(kind)}"


def _head(vectors: Operations, name: str, kind: np.dtype, takes: list[str]) -> str:
    """Return the first line of a function definition."""
    t = vectors.type(kind)
    given = ", ".join(f"{t} {x}" for x in takes)
    return f"define internal {t} @{name}({given}) noinline {ATTRIBUTES} willreturn memory(none) {{"


def _lane_by_lane(vectors: Operations, what: str, kind: np.dtype, name: str) -> str:
    """Return the definition of a function that calls C's function once per lane."""
    t, one = vectors.type(kind), llvm_type(kind)
    takes = ["%x", "%y"][: OPERATIONS[what].arity]
    lines, out = [], "poison"
    for k in range(vectors.lanes):
        args = [(one, f"{x}{k}") for x in takes]
        lines += [f"{x}{k} = extractelement {t} {x}, i64 {k}" for x in takes]
        lines.append(f"%z{k} = {vectors.call(of_c(what, kind), one, args)}")
        lines.append(f"%r{k} = insertelement {t} {out}, {one} %z{k}, i64 {k}")
        out = f"%r{k}"
    return "\n".join([_head(vectors, name, kind, takes), *lines, f"ret {t} {out}", "}"])


def _by_formula(vectors: Operations, what: str, kind: np.dtype) -> list[str]:
    """Return the definition of a function by its formula in double precision.
    Lanes in which the formula is not valid are computed by C's function."""
    builder, operation = Builder(), OPERATIONS[what]
    assert operation.formula is not None
    given = [builder.var(kind) for _ in range(operation.arity)]
    numbers = [Number(builder, x) for x in given]
    wide = [widened(x) if operation.sees_subnormals else x.cast(F64) for x in numbers]
    y, far = operation.formula(*wide)
    y = y.cast(kind)
    lines: list[str] = []
    inner = Operations(lines.append, vectors.lanes, vectors)

    def text(x: Var | np.generic) -> str:
        return f"%t{x.id}" if isinstance(x, Var) else vectors.number(x)

    for op in builder.block.statements:
        assert isinstance(op, Op)
        inner.write(op, text(op.dest), [text(a) for a in op.args])
    t, truth, many = vectors.type(kind), vectors.type(bool), vectors.lanes
    takes, name = [text(x) for x in given], name_of(vectors, what, kind)
    head = _head(vectors, name, kind, takes)
    if far is None:
        return ["\n".join([head, *lines, f"ret {t} {text(y.value)}", "}"])]
    args = ", ".join(f"{t} {x}" for x in takes)
    lines += [
        f"%bits = bitcast {truth} {text(far.value)} to i{many}",
        f"%some = icmp ne i{many} %bits, 0", "br i1 %some, label %far, label %near",
        "near:", f"ret {t} {text(y.value)}", "far:",
        f"%each = call {t} @{name}.each({args})",
        f"%all = select {truth} {text(far.value)}, {t} %each, {t} {text(y.value)}",
        f"ret {t} %all",
    ]  # fmt: skip
    each = _lane_by_lane(vectors, what, kind, f"{name}.each")
    return [each, "\n".join([head, *lines, "}"])]
