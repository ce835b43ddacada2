"""Prints a program over a batch as LLVM IR: a function that computes one part of the samples.

`i32 part(buffers, index)` receives the addresses of the operands and results, and the number of a
part of the batch. Parts are independent, so several threads may compute them. The function returns
0, or 1 if memory runs out. A result that is summed over the batch has one row per part, and the
caller adds the rows.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

from rbjax.compiler.ir.program import BatchLayout, Written, row_major
from rbjax.compiler.ir.statements import Array, Load, Op, Store, walk
from rbjax.compiler.llvm.jit import register_bytes
from rbjax.compiler.llvm.operations import ALIGNMENT
from rbjax.compiler.llvm.samples import Lines
from rbjax.compiler.llvm.statements import MALLOC, memory_type, write_sample
from rbjax.compiler.llvm.vectors import Step, write_samples
from rbjax.compiler.passes.analysis import count_accesses, count_operations

#: the least operations of a part, some ten microseconds
OPERATIONS_A_PART = 50_000
#: assumed iterations of a `while` loop
TURNS = 10
#: the most bytes of the local arrays of all lanes, which must fit into a core's own cache
ARRAY_BYTES = 512 * 1024
#: the most bytes, for all lanes, of a tile that loops read or write
TILE_BYTES = 64 * 1024
#: the most parts, because each one has its own row of every summed result
PARTS_UP_TO = 1024


@dataclass(frozen=True)
class BatchParts:
    """The LLVM IR of the function `part`.

    libm: the C functions that it calls.
    count: the number of parts of the batch.
    """

    text: str
    libm: tuple[str, ...]
    count: int


def write_parts(
    program: Written, lanes: int | None = None, samples: int | None = None
) -> BatchParts:
    """Print the function that computes one part of the program's batch.

    Args:
        lanes: number of samples that run at once, in the lanes of vectors; by default, as many as
            fit into a register. The last samples of a part may run twice.
        samples: number of samples of a part, a divisor of the batch; by default, enough to make a
            thread worthwhile.
    """
    size = math.prod(program.batch)
    lanes = _lanes(program) if lanes is None else lanes
    return _Frame(program, lanes if size >= lanes else 1).write_parts(samples)


class _Frame:
    """A printer of the function `part`, which calls the function of one sample, or one per lane.

    The operands and then the results are numbered consecutively. places: for each sum or tile, its
    byte offset in the memory %space.
    """

    def __init__(self, program: Written, lanes: int):
        self.program, self.lanes, self.size = program, lanes, math.prod(program.batch)
        self.arrays = (*program.operands, *program.results)
        self.layouts = (*program.layouts[0], *program.layouts[1])
        self.steps: list[Step] = [_lane_step(x, program.batch, lanes) for x in self.layouts]
        self.sums = [k + len(program.operands) for k, s in enumerate(program.summed) if s]
        self.tiles = self.in_tiles() if lanes > 1 else []
        if lanes > 1:
            self.samples = write_samples(program, lanes, self.steps, (*self.sums, *self.tiles))
        else:
            self.samples = write_sample(program)
        self.room, self.places = self.samples.workspace, {}
        for k in (*self.sums, *self.tiles):
            self.places[k] = self.room
            self.room += lanes * -(-self.bytes_of(k) // ALIGNMENT) * ALIGNMENT
        self.tables = [
            k for k, step in enumerate(self.steps) if step is None and k not in self.places
        ]
        self.lines = Lines()

    def bytes_of(self, k: int) -> int:
        return self.arrays[k].size * self.arrays[k].dtype.itemsize

    def in_tiles(self) -> list[int]:
        """Return the indices of the arrays whose rows are transposed to tiles of vectors and back.

        An array is tiled only if most of its entries are accessed. In short arrays each iteration
        of a loop counts as an access. In long arrays each statement counts once.
        """
        block = self.program.builder.block
        named = Counter(s.array.id for s in walk(block) if isinstance(s, Load | Store))
        reached = count_accesses(block)

        def most(k: int, array: Array) -> bool:
            short = self.lanes * self.bytes_of(k) <= TILE_BYTES
            return array.size <= 2 * (reached if short else named)[array.id]

        every = zip(self.arrays, self.layouts, self.steps, strict=True)
        return [
            k for k, (array, layout, step) in enumerate(every)
            if step not in (0, 1) and k not in self.sums
            and array.size and most(k, array)
            and layout.strides == row_major(layout.sample)
        ]  # fmt: skip

    def write_parts(self, share: int | None = None) -> BatchParts:
        each, count = _shares(self.program, self.size, self.lanes)
        if share is not None:
            each, count = share, self.size // share
        lines, samples = self.lines, self.samples
        names = self.begin(each, count)
        lines += ["br label %ahead", "ahead:", "br label %turn", "turn:"]
        lines.append("%wanted = phi i64 [%first, %ahead], [%next, %after]")
        lines.append(f"%b = call i64 @llvm.smin.i64(i64 %wanted, i64 {self.size - self.lanes})")
        pointers, after = self.pointers(names)
        lines.append(samples.call(pointers, "%space" if self.room else "null"))
        for k in self.sums:
            t = memory_type(self.arrays[k].dtype)
            lines.add_up(names[k], pointers[k], t, self.arrays[k].size, self.lanes)
        lines += [
            *after, "br label %after", "after:", f"%next = add i64 %wanted, {self.lanes}",
            "%more = icmp slt i64 %next, %stop",
            "br i1 %more, label %turn, label %done", "done:",
            *(["call void @free(ptr %memory)"] if self.room else []), "ret i32 0",
        ]  # fmt: skip
        declared = [
            *MALLOC, "declare i64 @llvm.smin.i64(i64, i64)",
            "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)", *lines.declared,
            *samples.outside,
        ]  # fmt: skip
        part = ["define i32 @part(ptr %buffers, i64 %index) nounwind {", *lines, "}"]
        text = "\n".join([*dict.fromkeys(declared), samples.text, *part])
        return BatchParts(text, samples.libm, count)

    def begin(self, each: int, count: int) -> list[str]:
        """Emit the range of samples of the function `part`, and the allocation of its workspace.
        Return the addresses of the arrays. each: samples of a part. count: number of parts."""
        lines, names = self.lines, []
        for k in range(len(self.arrays)):
            place = lines.made(f"getelementptr ptr, ptr %buffers, i64 {k}")
            names.append(lines.made(f"load ptr, ptr {place}"))
        for k in self.tables:
            lines.append(f"%table{k} = alloca [{self.lanes} x ptr], align {ALIGNMENT}")
        lines += [
            f"%first = mul i64 %index, {each}", f"%last = icmp eq i64 %index, {count - 1}",
            f"%end = add i64 %first, {each}",
            f"%stop = select i1 %last, i64 {self.size}, i64 %end",
        ]  # fmt: skip
        if self.room:
            lines += [
                f"%memory = call ptr @malloc(i64 {self.room + ALIGNMENT})",
                "%nothing = icmp eq ptr %memory, null",
                "br i1 %nothing, label %full, label %begin", "full:", "ret i32 1", "begin:",
                "%address = ptrtoint ptr %memory to i64", "%low = sub i64 0, %address",
                f"%gap = and i64 %low, {ALIGNMENT - 1}",
                "%space = getelementptr i8, ptr %memory, i64 %gap",
            ]  # fmt: skip
        for k in self.sums:
            n = self.bytes_of(k)
            own = lines.made(f"mul i64 %index, {n}")
            names[k] = lines.made(f"getelementptr i8, ptr {names[k]}, i64 {own}")
            lines.append(f"call void @llvm.memset.p0.i64(ptr {names[k]}, i8 0, i64 {n}, i1 false)")
        return names

    def pointers(self, names: list[str]) -> tuple[list[str], Lines]:
        """Return the pointers to pass to the function of one vector of samples, the first of which
        is %b. Also return the lines that follow the call, which copy tiles of results back to
        memory."""
        lines, batch, out = self.lines, self.program.batch, []
        after = Lines(lines)
        for k, (array, layout) in enumerate(zip(self.arrays, self.layouts, strict=True)):
            t = memory_type(array.dtype)
            if k in self.tiles or k in self.tables:
                rows = lines.each(names[k], t, layout, batch, self.lanes, self.steps[k])
            if k in self.places:
                out.append(lines.made(f"getelementptr i8, ptr %space, i64 {self.places[k]}"))
                if k in self.tiles and k < len(self.program.operands):
                    lines.tile_of_rows(out[k], rows, t, array.size)
                elif k in self.tiles:
                    after.rows_of_tile(rows, out[k], t, array.size)
            elif k in self.tables:
                lines.fill(f"%table{k}", rows)
                out.append(f"%table{k}")
            else:
                out.append(lines.sample(names[k], t, layout, batch, "%b"))
        return out, after


def _lanes(program: Written) -> int:
    """Return the number of samples that fit into a register; 1 if local arrays need much memory."""
    values = [s.dest for s in walk(program.builder.block) if isinstance(s, Op)]
    dtypes = {x.dtype for x in values} | {x.dtype for x in (*program.operands, *program.results)}
    floats = [t.itemsize for t in dtypes if t.kind == "f"] or [t.itemsize for t in dtypes]
    lanes = register_bytes() // max(floats, default=8)
    return lanes if lanes * program.array_bytes <= ARRAY_BYTES else 1


def _lane_step(layout: BatchLayout, batch: tuple[int, ...], lanes: int) -> int | None:
    """Return the distance between the samples of a vector, in entries; None if it varies."""
    if not layout.axes:  # shared by all samples, or a sum
        return 0
    axes = [(n, step) for n, step in zip(batch, layout.steps, strict=True) if n > 1]
    if not axes:
        return 0
    together, step = 1, axes[-1][1]  # number of equally spaced samples
    for n, far in reversed(axes):
        if far != together * step:
            return None if together % lanes else step
        together *= n
    return step


def _shares(program: Written, size: int, lanes: int) -> tuple[int, int]:
    """Return the number of samples of a part, and the number of parts.
    The last part also contains the remainder of the batch, unless a part is one vector."""
    work = max(count_operations(program.builder.block, (TURNS,)), 1)
    wanted = max(OPERATIONS_A_PART * max(lanes // 2, 1) // work, -(-size // PARTS_UP_TO), 1)
    each = max(min(-(-wanted // lanes) * lanes, size), 1)
    single = each == lanes and not any(program.summed)
    return each, -(-size // each) if single else size // each
