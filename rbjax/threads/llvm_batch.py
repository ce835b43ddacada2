"""A program over a batch as LLVM IR: a function of one part of the samples.

`i32 part(buffers, index)` gets the data of the operands and results, and which part of the batch
it computes; parts are independent, so threads may share them. It returns 0, or 1 without memory. A
result that is summed over the batch has one row a part, which the caller adds up.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

from rbjax.threads.arrays import row_major
from rbjax.threads.frame import Layout, Written
from rbjax.threads.llvm_jit import register_bytes
from rbjax.threads.llvm_samples import Lines
from rbjax.threads.llvm_statements import ALIGNMENT, MALLOC, one_sample, stored
from rbjax.threads.llvm_vectors import Step, many_samples
from rbjax.threads.program import Block, If, Load, Loop, Op, Store, While, walk

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
    steps: list[Step] = [_lane_step(layout, program.batch, lanes) for layout in layouts]
    sums = [k + len(program.operands) for k, s in enumerate(program.summed) if s]
    tiles = _in_tiles(program, steps, sums) if lanes > 1 else []
    if lanes > 1:
        sample = many_samples(program, lanes, steps, (*sums, *tiles))
    else:
        sample = one_sample(program)
    each, count = _shares(program, size, lanes)
    lines, names = Lines(), []
    room, places = sample.workspace, {}
    for k in (*sums, *tiles):
        places[k], room = room, room + lanes * _up(arrays[k].size * arrays[k].dtype.itemsize)
    for k in range(len(arrays)):
        place = lines.made(f"getelementptr ptr, ptr %buffers, i64 {k}")
        names.append(lines.made(f"load ptr, ptr {place}"))
    tables = [k for k, step in enumerate(steps) if step is None and k not in places]
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
    for k in sums:
        n = arrays[k].size * arrays[k].dtype.itemsize
        own = lines.made(f"mul i64 %index, {n}")
        names[k] = lines.made(f"getelementptr i8, ptr {names[k]}, i64 {own}")
        lines.append(f"call void @llvm.memset.p0.i64(ptr {names[k]}, i8 0, i64 {n}, i1 false)")
    lines += ["br label %ahead", "ahead:", "br label %turn", "turn:"]
    lines.append("%wanted = phi i64 [%first, %ahead], [%next, %after]")
    lines.append(f"%b = call i64 @llvm.smin.i64(i64 %wanted, i64 {size - lanes})")
    pointers, after = [], Lines(lines)
    for k, (array, layout) in enumerate(zip(arrays, layouts, strict=True)):
        t, step = stored(array.dtype), steps[k]
        if k in places:
            pointers.append(lines.made(f"getelementptr i8, ptr %space, i64 {places[k]}"))
        if k in tiles or k in tables:
            rows = lines.each(names[k], t, layout, program.batch, lanes, step)
        if k in tables:
            lines.fill(f"%table{k}", rows)
            pointers.append(f"%table{k}")
        elif k in tiles and k < len(program.operands):
            lines.tile_of_rows(pointers[k], rows, t, array.size)
        elif k in tiles:
            after.rows_of_tile(rows, pointers[k], t, array.size)
        elif k not in sums:
            pointers.append(lines.sample(names[k], t, layout, program.batch, "%b"))
    lines.append(sample.call(pointers, space))
    for k in sums:
        lines.add_up(names[k], pointers[k], stored(arrays[k].dtype), arrays[k].size, lanes)
    lines += [
        *after, "br label %after", "after:", f"%next = add i64 %wanted, {lanes}",
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


def _up(n: int) -> int:
    """A multiple of the alignment."""
    return -(-max(n, 1) // ALIGNMENT) * ALIGNMENT


def _in_tiles(program: Written, steps: list[Step], sums: list[int]) -> list[int]:
    """The arrays whose samples are rows that are turned into vectors, and back.

    The program must name most of their entries; of others it reads and writes what it needs."""
    named = Counter(s.array.id for s in walk(program.builder.block) if isinstance(s, Load | Store))
    arrays = (*program.operands, *program.results)
    layouts = (*program.layouts[0], *program.layouts[1])
    return [
        k for k, (array, layout, step) in enumerate(zip(arrays, layouts, steps, strict=True))
        if step not in (0, 1) and k not in sums and 0 < array.size <= 2 * named[array.id]
        and layout.strides == row_major(layout.sample)
    ]  # fmt: skip


def _lanes(program: Written) -> int:
    """The samples whose numbers fit into a register; one if their local arrays need much memory."""
    values = [s.dest for s in walk(program.builder.block) if isinstance(s, Op)]
    dtypes = {x.dtype for x in values} | {x.dtype for x in (*program.operands, *program.results)}
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
    each = max(min(-(-wanted // lanes) * lanes, size), 1)
    return each, size // each


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
