"""A program over a batch as LLVM IR: a function of one part of the samples.

`i32 part(buffers, index)` gets the data of the operands and results, and which part of the batch
it computes; parts are independent, so threads may share them. It returns 0, or 1 without memory. A
result that is summed over the batch has one row a part, which the caller adds up.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

from rbjax.threads.frame import Layout, Written
from rbjax.threads.llvm_statements import ALIGNMENT, one_sample, stored
from rbjax.threads.program import Block, If, Loop, Op, While

#: operations that are worth a part of their own: some ten microseconds
OPERATIONS_A_PART = 50_000
#: turns of a `while`, which are not known
TURNS = 10
#: each part keeps a row of its own of every summed result
PARTS_UP_TO = 1024

MALLOC = ("declare noalias ptr @malloc(i64)", "declare void @free(ptr)")


@dataclass(frozen=True)
class Parts:
    """The function `part`, with what it needs; libm: the functions of C that it calls; count: the
    parts of the batch."""

    text: str
    libm: tuple[str, ...]
    count: int


def parts(program: Written) -> Parts:
    """The function of one part of the program's batch."""
    size = math.prod(program.batch)
    each = _samples_a_part(program, size)
    sample = one_sample(program)
    lines, names = _Lines(), []
    arrays = (*program.operands, *program.results)
    layouts = (*program.layouts[0], *program.layouts[1])
    sums = dict(_summed(program, sample.workspace))
    room = max((start + n for start, n in sums.values()), default=sample.workspace)
    for k in range(len(arrays)):
        place = lines.made(f"getelementptr ptr, ptr %buffers, i64 {k}")
        names.append(lines.made(f"load ptr, ptr {place}"))
    lines += [
        f"%first = mul i64 %index, {each}",
        f"%last = add i64 %first, {each}",
        f"%stop = call i64 @llvm.smin.i64(i64 %last, i64 {size})",
    ]
    space = "null"
    if room:
        space = "%space"
        lines += [
            f"%space = call ptr @malloc(i64 {room})", "%nothing = icmp eq ptr %space, null",
            "br i1 %nothing, label %full, label %begin", "full:", "ret i32 1", "begin:",
        ]  # fmt: skip
    for k, (_, n) in sums.items():
        own = lines.made(f"mul i64 %index, {n}")
        names[k] = lines.made(f"getelementptr i8, ptr {names[k]}, i64 {own}")
        lines.append(f"call void @llvm.memset.p0.i64(ptr {names[k]}, i8 0, i64 {n}, i1 false)")
    lines += ["br label %ahead", "ahead:", "br label %turn", "turn:"]
    lines.append("%b = phi i64 [%first, %ahead], [%next, %after]")
    pointers = []
    for k, (array, layout) in enumerate(zip(arrays, layouts, strict=True)):
        if k in sums:
            pointers.append(lines.made(f"getelementptr i8, ptr %space, i64 {sums[k][0]}"))
        else:
            pointers.append(lines.sample(names[k], stored(array.dtype), layout, program.batch))
    lines.append(sample.call(pointers, space))
    for k in sums:
        lines.add_up(names[k], pointers[k], stored(arrays[k].dtype), arrays[k].size)
    lines += [
        "br label %after", "after:", "%next = add i64 %b, 1", "%more = icmp slt i64 %next, %stop",
        "br i1 %more, label %turn, label %done", "done:",
        *(["call void @free(ptr %space)"] if room else []), "ret i32 0",
    ]  # fmt: skip
    own = (*MALLOC, "declare i64 @llvm.smin.i64(i64, i64)",
           "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)")  # fmt: skip
    text = [
        *dict.fromkeys((*own, *sample.outside)), sample.text,
        "define i32 @part(ptr %buffers, i64 %index) nounwind {", *lines, "}",
    ]  # fmt: skip
    return Parts("\n".join(text), sample.libm, -(-size // each))


def _samples_a_part(program: Written, size: int) -> int:
    least = -(-size // PARTS_UP_TO)
    work = max(_operations(program.builder.block), 1)
    return max(min(max(OPERATIONS_A_PART // work, 1), size), least, 1)


def _operations(block: Block) -> int:
    """About the operations that a sample runs."""
    total = 0
    for statement in block.statements:
        match statement:
            case Op():
                total += 1
            case Loop(count=count, body=body):
                total += count * _operations(body)
            case While(test=test, body=body):
                total += TURNS * (_operations(test) + _operations(body))
            case If(then=then, otherwise=otherwise):
                total += max(_operations(then), _operations(otherwise))
    return total


def _summed(program: Written, start: int) -> list[tuple[int, tuple[int, int]]]:
    """The place in the workspace of each summed result of a sample, and its bytes."""
    out = []
    for k, (array, summed) in enumerate(zip(program.results, program.summed, strict=True)):
        if summed:
            n = array.size * array.dtype.itemsize
            out.append((len(program.operands) + k, (start, n)))
            start += -(-max(n, 1) // ALIGNMENT) * ALIGNMENT
    return out


class _Lines(list):
    """Instructions with fresh names."""

    def __init__(self) -> None:
        super().__init__()
        self.names = itertools.count()

    def made(self, text: str) -> str:
        name = f"%v{next(self.names)}"
        self.append(f"{name} = {text}")
        return name

    def sample(self, base: str, t: str, layout: Layout, batch: tuple[int, ...]) -> str:
        """The pointer to sample %b of an array."""
        rest, place = "%b", base
        for k in reversed(range(len(batch))):
            index = rest
            if k:
                index = self.made(f"urem i64 {rest}, {batch[k]}")
                rest = self.made(f"udiv i64 {rest}, {batch[k]}")
            if layout.steps[k]:
                far = self.made(f"mul i64 {index}, {layout.steps[k]}")
                place = self.made(f"getelementptr {t}, ptr {place}, i64 {far}")
        return place

    def add_up(self, total: str, term: str, t: str, count: int) -> None:
        """total[i] += term[i]."""
        if not count:
            return
        n = next(self.names)
        add = "fadd" if t in ("float", "double") else "add"
        self += [
            f"br label %before{n}", f"before{n}:", f"br label %adding{n}", f"adding{n}:",
            f"%i{n} = phi i64 [0, %before{n}], [%j{n}, %adding{n}]",
            f"%to{n} = getelementptr {t}, ptr {total}, i64 %i{n}",
            f"%of{n} = getelementptr {t}, ptr {term}, i64 %i{n}",
            f"%x{n} = load {t}, ptr %to{n}", f"%y{n} = load {t}, ptr %of{n}",
            f"%z{n} = {add} {t} %x{n}, %y{n}", f"store {t} %z{n}, ptr %to{n}",
            f"%j{n} = add i64 %i{n}, 1", f"%c{n} = icmp slt i64 %j{n}, {count}",
            f"br i1 %c{n}, label %adding{n}, label %added{n}", f"added{n}:",
        ]  # fmt: skip
