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
from rbjax.threads.llvm_jit import register_bytes
from rbjax.threads.llvm_statements import ALIGNMENT, MALLOC, one_sample, stored
from rbjax.threads.llvm_vectors import many_samples
from rbjax.threads.program import Block, If, Loop, Op, While, walk

#: operations that are worth a part of their own: some ten microseconds
OPERATIONS_A_PART = 50_000
#: turns of a `while`, which are not known
TURNS = 10
#: local arrays of all lanes that a core's own cache holds
ARRAY_BYTES = 512 * 1024
#: each part keeps a row of its own of every summed result
PARTS_UP_TO = 1024


@dataclass(frozen=True)
class Parts:
    """The function `part`, with what it needs; libm: the functions of C that it calls; count: the
    parts of the batch."""

    text: str
    libm: tuple[str, ...]
    count: int


def parts(program: Written, lanes: int | None = None) -> Parts:
    """The function of one part of the program's batch.

    Args:
        lanes: samples that run at once, as lanes of vectors, if the batch has so many; as many as
            fit into a register by default. The last ones of a part may run twice.
    """
    size = math.prod(program.batch)
    lanes = _lanes(program) if lanes is None else lanes
    lanes = lanes if size >= lanes else 1
    layouts = (*program.layouts[0], *program.layouts[1])
    arrays = (*program.operands, *program.results)
    steps = [_lane_step(layout, program.batch, lanes) for layout in layouts]
    sample = one_sample(program) if lanes == 1 else many_samples(program, lanes, steps)
    each, count = _shares(program, size, lanes)
    lines, names = _Lines(), []
    sums = dict(_summed(program, sample.workspace, lanes))
    room = max((start + n for start, n in sums.values()), default=sample.workspace)
    for k in range(len(arrays)):
        place = lines.made(f"getelementptr ptr, ptr %buffers, i64 {k}")
        names.append(lines.made(f"load ptr, ptr {place}"))
    tables = {k for k, step in enumerate(steps) if step is None and k not in sums}
    for k in tables:
        lines.append(f"%table{k} = alloca [{lanes} x ptr], align {ALIGNMENT}")
    lines += [
        f"%first = mul i64 %index, {each}", f"%last = icmp eq i64 %index, {count - 1}",
        f"%end = add i64 %first, {each}", f"%stop = select i1 %last, i64 {size}, i64 %end",
    ]  # fmt: skip
    space = "null"
    if room:
        space = "%space"
        lines += [
            f"%memory = call ptr @malloc(i64 {room + ALIGNMENT})",
            "%nothing = icmp eq ptr %memory, null",
            "br i1 %nothing, label %full, label %begin", "full:", "ret i32 1", "begin:",
            "%address = ptrtoint ptr %memory to i64", "%low = sub i64 0, %address",
            f"%gap = and i64 %low, {ALIGNMENT - 1}",
            "%space = getelementptr i8, ptr %memory, i64 %gap",
        ]  # fmt: skip
    for k, (_, n) in sums.items():
        n //= lanes
        own = lines.made(f"mul i64 %index, {n}")
        names[k] = lines.made(f"getelementptr i8, ptr {names[k]}, i64 {own}")
        lines.append(f"call void @llvm.memset.p0.i64(ptr {names[k]}, i8 0, i64 {n}, i1 false)")
    lines += ["br label %ahead", "ahead:", "br label %turn", "turn:"]
    lines.append("%wanted = phi i64 [%first, %ahead], [%next, %after]")
    lines.append(f"%b = call i64 @llvm.smin.i64(i64 %wanted, i64 {size - lanes})")
    pointers = []
    for k, (array, layout) in enumerate(zip(arrays, layouts, strict=True)):
        t = stored(array.dtype)
        if k in sums:
            pointers.append(lines.made(f"getelementptr i8, ptr %space, i64 {sums[k][0]}"))
        elif k in tables:
            lines.fill(f"%table{k}", names[k], t, layout, program.batch, lanes)
            pointers.append(f"%table{k}")
        else:
            pointers.append(lines.sample(names[k], t, layout, program.batch, "%b"))
    lines.append(sample.call(pointers, space))
    for k in sums:
        lines.add_up(names[k], pointers[k], stored(arrays[k].dtype), arrays[k].size, lanes)
    lines += [
        "br label %after", "after:", f"%next = add i64 %wanted, {lanes}",
        "%more = icmp slt i64 %next, %stop",
        "br i1 %more, label %turn, label %done", "done:",
        *(["call void @free(ptr %memory)"] if room else []), "ret i32 0",
    ]  # fmt: skip
    text = [
        *MALLOC, "declare i64 @llvm.smin.i64(i64, i64)",
        "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)", *lines.declared, *sample.outside,
    ]  # fmt: skip
    body = ["define i32 @part(ptr %buffers, i64 %index) nounwind {", *lines, "}"]
    return Parts("\n".join([*dict.fromkeys(text), sample.text, *body]), sample.libm, count)


def _lanes(program: Written) -> int:
    """The samples whose numbers fit into a register; one if their local arrays need much memory."""
    arrays = (*program.operands, *program.results)
    values = [s.dest for s in walk(program.builder.block) if isinstance(s, Op)]
    dtypes = {x.dtype for x in (*arrays, *values)}
    floats = [t.itemsize for t in dtypes if t.kind == "f"] or [t.itemsize for t in dtypes]
    lanes = register_bytes() // max(floats, default=8)
    return lanes if lanes * program.array_bytes <= ARRAY_BYTES else 1


def _lane_step(layout: Layout, batch: tuple[int, ...], lanes: int) -> int | None:
    """The entries from a sample to the next one within a vector, or None if they differ."""
    if not layout.axes:  # shared, or a sum
        return 0
    axes = [(n, step) for n, step in zip(batch, layout.steps, strict=True) if n > 1]
    if not axes:
        return 0
    together, step = 1, axes[-1][1]  # the samples that lie at equal distances
    for n, far in reversed(axes):
        if far != together * step:
            return None if together % lanes else step
        together *= n
    return step


def _shares(program: Written, size: int, lanes: int) -> tuple[int, int]:
    """The samples of a part, and the parts. The last one has the rest of the batch too."""
    work = max(_operations(program.builder.block), 1)
    wanted = max(OPERATIONS_A_PART * max(lanes // 2, 1) // work, -(-size // PARTS_UP_TO), 1)
    each = min(-(-wanted // lanes) * lanes, size)
    return each, max(size // each, 1)


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


def _summed(program: Written, start: int, lanes: int) -> list[tuple[int, tuple[int, int]]]:
    """The place in the workspace of each summed result of a sample, and its bytes."""
    out = []
    for k, (array, summed) in enumerate(zip(program.results, program.summed, strict=True)):
        if summed:
            n = lanes * array.size * array.dtype.itemsize
            out.append((len(program.operands) + k, (start, n)))
            start += -(-max(n, 1) // ALIGNMENT) * ALIGNMENT
    return out


class _Lines(list):
    """Instructions with fresh names."""

    def __init__(self) -> None:
        super().__init__()
        self.names = itertools.count()
        self.declared: list[str] = []

    def made(self, text: str) -> str:
        name = f"%v{next(self.names)}"
        self.append(f"{name} = {text}")
        return name

    def sample(
        self, base: str, t: str, layout: Layout, batch: tuple[int, ...], sample: str
    ) -> str:
        """The pointer to a sample of an array."""
        rest, place = sample, base
        for k in reversed(range(len(batch))):
            index = rest
            if k:
                index = self.made(f"urem i64 {rest}, {batch[k]}")
                rest = self.made(f"udiv i64 {rest}, {batch[k]}")
            if layout.steps[k]:
                far = self.made(f"mul i64 {index}, {layout.steps[k]}")
                place = self.made(f"getelementptr {t}, ptr {place}, i64 {far}")
        return place

    def fill(
        self, table: str, base: str, t: str, layout: Layout, batch: tuple[int, ...], lanes: int
    ) -> None:
        """The pointers to the samples from %b on, in a table."""
        for k in range(lanes):
            sample = self.made(f"add i64 %b, {k}")
            place = self.sample(base, t, layout, batch, sample)
            slot = self.made(f"getelementptr ptr, ptr {table}, i64 {k}")
            self.append(f"store ptr {place}, ptr {slot}")

    def add_up(self, total: str, term: str, t: str, count: int, lanes: int) -> None:
        """total[i] += term[i]."""
        if not count:
            return
        n = next(self.names)
        add = "fadd" if t in ("float", "double") else "add"
        of = t if lanes == 1 else f"<{lanes} x {t}>"
        self += [
            f"br label %before{n}", f"before{n}:", f"br label %adding{n}", f"adding{n}:",
            f"%i{n} = phi i64 [0, %before{n}], [%j{n}, %adding{n}]",
            f"%to{n} = getelementptr {t}, ptr {total}, i64 %i{n}",
            f"%of{n} = getelementptr {of}, ptr {term}, i64 %i{n}",
            f"%x{n} = load {t}, ptr %to{n}", f"%y{n} = load {of}, ptr %of{n}",
        ]  # fmt: skip
        y = f"%y{n}" if lanes == 1 else self.sum_of(f"%y{n}", t, lanes)
        self += [
            f"%z{n} = {add} {t} %x{n}, {y}", f"store {t} %z{n}, ptr %to{n}",
            f"%j{n} = add i64 %i{n}, 1", f"%c{n} = icmp slt i64 %j{n}, {count}",
            f"br i1 %c{n}, label %adding{n}, label %added{n}", f"added{n}:",
        ]  # fmt: skip

    def sum_of(self, x: str, t: str, lanes: int) -> str:
        """The sum of the lanes whose samples have not run before."""
        many, kind = f"<{lanes} x {t}>", {"float": "f32", "double": "f64"}.get(t, t)
        counts = ", ".join(f"i64 {k}" for k in range(lanes))
        again = self.made("sub i64 %wanted, %b")
        one = self.made(f"insertelement <{lanes} x i64> poison, i64 {again}, i64 0")
        where = f"<{lanes} x i32> zeroinitializer"
        all_ = self.made(f"shufflevector <{lanes} x i64> {one}, <{lanes} x i64> poison, {where}")
        first = self.made(f"icmp uge <{lanes} x i64> <{counts}>, {all_}")
        y = self.made(f"select <{lanes} x i1> {first}, {many} {x}, {many} zeroinitializer")
        if kind == t:
            name = f"llvm.vector.reduce.add.v{lanes}{t}"
            self.declared.append(f"declare {t} @{name}({many})")
            return self.made(f"call {t} @{name}({many} {y})")
        name = f"llvm.vector.reduce.fadd.v{lanes}{kind}"
        self.declared.append(f"declare {t} @{name}({t}, {many})")
        return self.made(f"call reassoc {t} @{name}({t} -0.0, {many} {y})")
