"""Functions of mathematics on vectors, as LLVM IR: formulas, and C's functions lane by lane."""

from __future__ import annotations

import numpy as np

from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.elementary import widened
from rbjax.compiler.ir.expressions import Number
from rbjax.compiler.ir.operations import OPERATIONS
from rbjax.compiler.ir.statements import F64, Op, Var
from rbjax.compiler.llvm.operations import ATTRIBUTES, Operations, llvm_type, of_c


def definitions(vectors: Operations) -> list[str]:
    """The functions that vector operations call."""
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
    """How a function begins."""
    t = vectors.type(kind)
    given = ", ".join(f"{t} {x}" for x in takes)
    return f"define internal {t} @{name}({given}) noinline {ATTRIBUTES} willreturn memory(none) {{"


def _lane_by_lane(vectors: Operations, what: str, kind: np.dtype, name: str) -> str:
    """A function of C's mathematics, called once a lane."""
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
    """A function by its formula, in double precision; where that does not hold, lane by lane."""
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
