"""Prints the statements of a program as C, for NVRTC and for a host's C compiler."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping

import numpy as np

from rbjax.compiler.ir import statements as ir
from rbjax.compiler.ir.c_text import c_type
from rbjax.compiler.ir.operations import OPERATIONS
from rbjax.compiler.ir.program import BatchLayout, Written

PREAMBLE = "".join(x.helper for x in OPERATIONS.values()) + "\n"

#: iterations of a copying loop that run as one group, and the most statements of its body
GROUP, SHORT_BODY = 16, 10


def literal(x: np.generic) -> str:
    """Return a constant as C text."""
    kind = x.dtype.kind
    if kind == "b":
        return "true" if x else "false"
    if kind in "iu":
        n = int(x)
        suffix = {"int64": "ll", "uint64": "ull", "uint32": "u"}.get(x.dtype.name, "")
        if x.dtype == np.int64 and n == np.iinfo(np.int64).min:
            return "(-9223372036854775807ll-1)"
        if x.dtype == np.int32 and n == np.iinfo(np.int32).min:
            return "(-2147483647-1)"
        text = f"{n}{suffix}"
        return f"({text})" if n < 0 else text
    f = "f" if x.dtype == np.float32 else ""
    number = float(x)
    if math.isnan(number):
        return f"((c_{c_type(x.dtype)})NAN)"
    if math.isinf(number):
        return f"({'-' if number < 0 else ''}(c_{c_type(x.dtype)})INFINITY)"
    text = f"{number!r}{f}"
    return f"({text})" if math.copysign(1.0, number) < 0 else text


def _is_elementwise(loop: ir.Loop) -> bool:
    """Return whether a short loop computes entries of local arrays, and no iteration reads what
    another one writes.

    Such a loop runs in groups of iterations, which load all their entries before they store any. A
    thread then waits for memory once per group.
    """
    body = loop.body.statements
    if loop.count < GROUP or loop.reverse or len(body) > SHORT_BODY:
        return False
    if not all(isinstance(s, ir.Op | ir.Load | ir.Store) for s in body):
        return False
    stores = [s for s in body if isinstance(s, ir.Store)]
    places = {s.array: (s.base, s.offset) for s in stores}
    own = all(
        (s.base, s.offset) == places[s.array] and s.base is loop.counter
        for s in body
        if isinstance(s, ir.Load) and s.array in places
    )
    return own and len(places) == len(stores) > 0 and all(a.space == "local" for a in places)


class Printer:
    """A printer of blocks as C text.

    names: the C name of each array, by its id.
    in_step: the loops whose turns all warps of a block begin together (`lockstep`), by `id`.
    shared: pointers to the arrays in shared memory (`shared_arrays`), by the array's id.
    """

    def __init__(
        self, names: dict[int, str], in_step: Collection[int] = (),
        shared: Mapping[int, str] | None = None,
    ):  # fmt: skip
        self.names, self.in_step, self.shared = names, in_step, shared or {}

    def value(self, x: ir.Value) -> str:
        return f"t{x.id}" if isinstance(x, ir.Var) else literal(x)

    def place(self, array: ir.Array, base: ir.Value | None, offset: int) -> str:
        name = self.names.get(array.id) or self.names.setdefault(array.id, _name(array))
        if array.id in self.shared:
            index = f"{offset}" if base is None else f"({self.value(base)}+{offset})"
            return f"{name}[{index}*THREADS]"
        if base is None:
            return f"{name}[{offset}]"
        return f"{name}[{self.value(base)}{f'+{offset}' if offset > 0 else offset or ''}]"

    def lines(self, block: ir.Block) -> Iterator[str]:
        for statement in block.statements:
            yield from self._lines(statement)

    def _lines(self, statement: ir.Statement) -> Iterator[str]:
        v = self.value
        match statement:
            case ir.Op(dest=dest):
                yield f"const {c_type(dest.dtype)} {v(dest)}={self.expression(statement)};"
            case ir.Load(dest=dest, array=array, base=base, offset=offset):
                yield f"const {c_type(dest.dtype)} {v(dest)}={self.place(array, base, offset)};"
            case ir.Store(array=array, base=base, offset=offset, value=value):
                yield f"{self.place(array, base, offset)}={v(value)};"
            case ir.Declare(var=var, value=None):
                yield f"{c_type(var.dtype)} {v(var)};"
            case ir.Declare(var=var, value=value) if value is not None:
                yield f"{c_type(var.dtype)} {v(var)}={v(value)};"
            case ir.Assign(var=var, value=value):
                yield f"{v(var)}={v(value)};"
            case ir.Reserve(array=array) if array.id in self.shared:
                yield f"{c_type(array.dtype)}* const a{array.id}={self.shared[array.id]};"
            case ir.Reserve(array=array):
                yield f"{c_type(array.dtype)} a{array.id}[{max(array.size, 1)}];"
            case ir.Loop() if _is_elementwise(statement):
                yield from self._in_groups(statement)
            case ir.Loop(counter=counter, count=count, reverse=reverse, body=body):
                i = v(counter)
                yield "#pragma unroll 1"
                if reverse:
                    yield f"for(int {i}={count - 1};{i}>=0;{i}--){{"
                else:
                    yield f"for(int {i}=0;{i}<{count};{i}++){{"
                if id(statement) in self.in_step:
                    yield "__syncthreads();"
                yield from self.lines(body)
                yield "}"
            case ir.While(test=test, condition=condition, body=body):
                yield "#pragma unroll 1"
                yield "for(;;){"
                yield from self.lines(test)
                together = id(statement) in self.in_step
                yield f"if(!{'__syncthreads_or' if together else ''}({v(condition)}))break;"
                if together:
                    yield f"if({v(condition)})"
                yield "{"
                yield from self.lines(body)
                yield "}}"
            case ir.If(condition=condition, then=then, otherwise=otherwise):
                yield f"if({v(condition)}){{"
                yield from self.lines(then)
                if otherwise.statements:
                    yield "}else{"
                    yield from self.lines(otherwise)
                yield "}"
            case ir.Await() | ir.Barrier():  # only in programs of a team
                return
            case _:
                raise TypeError(f"no such statement: {statement}")

    def _in_groups(self, loop: ir.Loop) -> Iterator[str]:
        """Print groups of iterations, which load all their entries before they store any."""
        body, i = loop.body.statements, self.value(loop.counter)
        own = {self.value(s.dest) for s in body if isinstance(s, ir.Op | ir.Load)} | {i}
        name = re.compile("|".join(rf"\b{x}\b" for x in own))
        first = [s for s in body if not isinstance(s, ir.Store)]
        last = [s for s in body if isinstance(s, ir.Store)]
        reads, writes = ([x for s in some for x in self._lines(s)] for some in (first, last))
        rounds, rest = divmod(loop.count, GROUP)
        for start, turns, size in ((0, rounds, GROUP), (rounds * GROUP, 1, rest)):
            if not turns * size:
                continue
            yield "#pragma unroll 1"
            yield f"for(int g{i}={start};g{i}<{start + turns * size};g{i}+={size}){{"
            yield from (f"const int {i}_{k}=g{i}+{k};" for k in range(size))
            for lines in (reads, writes):
                for k in range(size):
                    yield from (name.sub(rf"\g<0>_{k}", x) for x in lines)
            yield "}"

    def expression(self, op: ir.Op) -> str:
        kind, of = op.dest.dtype, op.args[0].dtype
        text = OPERATIONS[op.name].c(kind, of, [self.value(a) for a in op.args])
        if text is None:
            raise ir.Unsupported(f"operation {op.name} of {kind}")
        return text


def _by_bits(array: ir.Array) -> bool:
    """Return whether a table has infinities or nan, which are printed by their bits."""
    return array.data is not None and array.dtype.kind == "f" and not np.isfinite(array.data).all()


def _name(array: ir.Array) -> str:
    if _by_bits(array):
        return f"((const {c_type(array.dtype)}*)a{array.id})"
    return f"a{array.id}"


def table(array: ir.Array, qualifier: str) -> str:
    """Return the definition of a constant array."""
    data = array.data
    if _by_bits(array):
        data = np.asarray(data).view(f"uint{8 * array.dtype.itemsize}")
    assert data is not None
    numbers = ",".join(literal(x) for x in data) or "0"
    return f"{qualifier} {c_type(data.dtype)} a{array.id}[{max(array.size, 1)}]={{{numbers}}};"


def parameters(program: Written, restrict: str) -> str:
    """Return the pointer parameters of a program's function: operands, then results."""
    reads = [f"const {c_type(a.dtype)}* {restrict} p{k}" for k, a in enumerate(program.operands)]
    writes = [f"{c_type(a.dtype)}* {restrict} r{k}" for k, a in enumerate(program.results)]
    return ", ".join(reads + writes)


def sample_index(batch: tuple[int, ...]) -> list[str]:
    """Return the C text of the index along each axis of the batch, from the linear index b."""
    out, rest = [], "b"
    for k in reversed(range(len(batch))):
        if k == 0:
            out.append(rest)
        else:
            out.append(f"({rest}%{batch[k]})")
            rest = f"({rest}/{batch[k]})"
    return list(reversed(out))


def offset(layout: BatchLayout, index: list[str]) -> str:
    """Return the C text of the offset of a sample, in entries."""
    terms = [f"{i}*{step}ll" for i, step in zip(index, layout.steps, strict=True) if step]
    return "+".join(terms) or "0"
