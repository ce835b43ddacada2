"""Functions of mathematics on vectors."""

from __future__ import annotations

import numpy as np

from rbjax.threads.llvm_operations import Operations, llvm_type, of_c

#: functions of two arguments
OF_TWO = {"atan2", "pow", "fmod", "nextafter"}


def definitions(vectors: Operations) -> list[str]:
    """The functions that vector operations call."""
    return [lane_by_lane(vectors, what, kind) for what, kind in list(vectors.functions)]


def lane_by_lane(vectors: Operations, what: str, kind: np.dtype) -> str:
    """A function of C's mathematics, called once a lane."""
    t, one = vectors.type(kind), llvm_type(kind)
    takes = ["%x", "%y"][: 1 + (what in OF_TWO)]
    lines, out = [], "poison"
    for k in range(vectors.lanes):
        args = [(one, f"{x}{k}") for x in takes]
        lines += [f"{x}{k} = extractelement {t} {x}, i64 {k}" for x in takes]
        lines.append(f"%z{k} = {Operations.call(vectors, of_c(what, kind), one, args)}")
        lines.append(f"%r{k} = insertelement {t} {out}, {one} %z{k}, i64 {k}")
        out = f"%r{k}"
    name = f"{what}.{vectors.short(kind)}"
    head = f"define internal {t} @{name}({', '.join(f'{t} {x}' for x in takes)}) nounwind noinline"
    return "\n".join([f"{head} {{", *lines, f"ret {t} {out}", "}"])
