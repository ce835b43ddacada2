"""Prints the statements of a program as LLVM IR for several samples, one per lane of vectors.

Values that are equal in every lane stay scalar (`analysis.find_divergence`). A local array that
differs between lanes has a vector per entry. If a condition differs, a block runs if some lane
needs it, under a mask: variables from outside the block keep their values in the other lanes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from rbjax.compiler.ir.program import Written
from rbjax.compiler.ir.statements import Array, Block, Op, Statement, Value, Var
from rbjax.compiler.llvm.operations import ALIGNMENT, Operations, definitions, llvm_type, splat
from rbjax.compiler.llvm.statements import (
    Function,
    Writer,
    memory_type,
    write_function,
)
from rbjax.compiler.passes.analysis import find_divergence, region_of
from rbjax.compiler.passes.cutting import Cuts, split_block

Step = int | None  # entries from a lane's sample to the next; None if not constant


def write_samples(
    program: Written, lanes: int, steps: Sequence[Step], tiles: Collection[int] = (),
    name: str = "samples",
) -> Function:  # fmt: skip
    """Print the function that runs one sample of a program in each lane.

    Args:
        steps: for each operand and result, the entries between samples. If a step is None, the
        argument is a pointer to an array of pointers to the samples.
        tiles: numbers of the operands and results that are tiles, with one vector per entry.
    """
    apart = {
        array.id: step
        for k, (array, step) in enumerate(
            zip((*program.operands, *program.results), steps, strict=True)
        )
        if k not in tiles
    }
    return write_function(_Vectors(lanes, program, apart), program, name)


class _Vectors(Writer):
    """An emitter of the statements of a program for one sample per lane.

    steps: distance between the samples of each array that is not a tile, in entries.
    mask: the active lanes; "" if all are active.
    part: the current divergent region.
    """

    def __init__(self, lanes: int, program: Written, steps: dict[int, Step]):
        super().__init__()
        self.lanes, self.steps = lanes, steps
        self.mask, self.part = "", 0
        self.vectors = Operations(self.lines.append, lanes, self.operations)
        differ = [a for a in program.operands if self.steps.get(a.id) != 0]
        self.found = find_divergence(program.builder.block, [*differ, *program.results])
        self.splats: list[dict[int, str]] = []

    def cuts(self, program: Written) -> Cuts | None:
        return split_block(program.builder.block, branches=False)  # all lanes run these blocks

    def piece(self, number: int, statements: list) -> None:
        outside, self.splats = self.splats, []
        super().piece(number, statements)
        self.splats = outside

    def bytes(self, x: Var | Array) -> int:
        return super().bytes(x) * (self.lanes if self.found.of(x) else 1)

    def begin(self, program: Written) -> None:
        # memory that inactive lanes read and write
        self.entry.append("%nowhere = alloca i64")
        for array in (*program.operands, *program.results):
            step = self.steps.get(array.id, 0)
            place, name = self.pointers[array.id], f"%each{array.id}"
            if step is None:
                self.entry.append(f"{name} = load {self.many('ptr')}, ptr {place}")
            elif step:
                t = f"getelementptr {memory_type(array.dtype)}, ptr {place}"
                self.entry.append(f"{name} = {t}, {self.counts(step)}")

    def counts(self, step: int = 1) -> str:
        """Return the vector of indices 0, step, 2 step, ..."""
        return f"{self.many('i64')} <{', '.join(f'i64 {k * step}' for k in range(self.lanes))}>"

    def functions(self) -> list[str]:
        return [*super().functions(), *definitions(self.vectors)]

    def many(self, t: str) -> str:
        """Return the type of a vector of entries of type t."""
        return f"<{self.lanes} x {t}>"

    # ---------------------------------------------------------------- values

    def block(self, block: Block) -> None:
        self.splats.append({})
        super().block(block)
        self.splats.pop()

    def vector(self, x: Value) -> str:
        """Return a value as a vector."""
        if not isinstance(x, Var):
            return self.vectors.number(x)
        if self.found.of(x):
            return self.current(x)
        for known in self.splats:
            if x.id in known:
                return known[x.id]
        name = self.spread(llvm_type(x.dtype), self.value(x))
        if x.id not in self.places:
            self.splats[-1][x.id] = name
        return name

    def spread(self, t: str, x: str) -> str:
        """Emit the broadcast of a scalar to every lane."""
        return splat(self.made, self.lanes, t, x)

    def kind(self, x: Var) -> str:
        return self.vectors.type(x.dtype) if self.found.of(x) else super().kind(x)

    def put(self, var: Var, value: Value) -> None:
        if not self.found.of(var):
            return super().put(var, value)
        text, t, place = self.vector(value), self.vectors.type(var.dtype), self.place_of(var)
        if self.mask and self.found.is_declared_outside(var, self.part):
            text = self.blended(t, text, self.made(f"load {t}, ptr {place}"))
        self.lines.append(f"store {t} {text}, ptr {place}")
        return None

    def blended(self, t: str, new: str, old: str) -> str:
        """Emit the selection of the new value in active lanes, else of the old value."""
        return self.made(f"select {self.many('i1')} {self.mask}, {t} {new}, {t} {old}")

    def statement(self, statement: Statement) -> None:
        if isinstance(statement, Op) and self.found.of(statement.dest):
            args = [self.vector(a) for a in statement.args]
            self.vectors.write(statement, f"%t{statement.dest.id}", args)
        else:
            super().statement(statement)

    # ---------------------------------------------------------------- memory

    def reserve(self, array: Array, lanes: int = 1) -> None:
        super().reserve(array, self.lanes if self.found.of(array) else 1)

    def load(self, dest: Var, array: Array, base: Value | None, offset: int) -> None:
        if not self.found.of(dest):
            return super().load(dest, array, base, offset)
        t = self.many(memory_type(dest.dtype))
        if self.found.of(base):
            x = self.gathered(self.running(self.pointers_at(array, base, offset)), dest.dtype)
        elif self.side_by_side(array):
            place, align = self.entry_of(array, base, offset)
            x = f"load {t}, ptr {place}, align {align}"
        else:
            x = self.gathered(self.pointers_at(array, base, offset), dest.dtype)
        if dest.dtype.kind == "b":
            x = f"icmp ne {t} {self.made(x)}, zeroinitializer"
        self.made(x, f"%t{dest.id}")
        return None

    def store(self, array: Array, base: Value | None, offset: int, value: Value) -> None:
        if not self.found.of(array):
            return super().store(array, base, offset, value)
        x, one = self.vector(value), memory_type(array.dtype)
        t = self.many(one)
        if array.dtype.kind == "b":
            x = self.made(f"zext {self.many('i1')} {x} to {t}")
        some = bool(self.mask) and self.found.is_declared_outside(array, self.part)
        if self.side_by_side(array) and not self.found.of(base):
            place, align = self.entry_of(array, base, offset)
            if some:
                x = self.blended(t, x, self.made(f"load {t}, ptr {place}, align {align}"))
            self.lines.append(f"store {t} {x}, ptr {place}, align {align}")
            return None
        pointers = self.pointers_at(array, base, offset)
        pointers = self.running(pointers) if some else pointers
        for k, place in enumerate(self.lanes_of("ptr", pointers)):
            entry = self.made(f"extractelement {t} {x}, i64 {k}")
            self.lines.append(f"store {one} {entry}, ptr {place}")
        return None

    def side_by_side(self, array: Array) -> bool:
        """Return whether the lanes' values of one entry are contiguous in memory."""
        return array.id not in self.steps or self.steps[array.id] == 1

    def entry_of(self, array: Array, base: Value | None, offset: int) -> tuple[str, int]:
        """Emit the address of an entry's values in all lanes, and return it with its alignment."""
        t, size = memory_type(array.dtype), array.dtype.itemsize
        if array.id in self.steps:
            return self.address(array, base, offset), size
        place = self.at(self.many(t), self.start(array), base, offset)
        return place, min(ALIGNMENT, size * self.lanes)

    def pointers_at(self, array: Array, base: Value | None, offset: int) -> str:
        """Emit the vector of the addresses of an entry in each lane."""
        t, places = memory_type(array.dtype), self.many("ptr")
        whole = t
        if not self.found.of(array):
            start = self.spread("ptr", self.start(array))
        elif array.id in self.steps:
            start = f"%each{array.id}"
        else:
            whole = self.many(t)
            start = self.made(f"getelementptr {t}, ptr {self.start(array)}, {self.counts()}")
        if base is not None:
            index = f"{self.vectors.type(base.dtype)} {self.vector(base)}"
            start = self.made(f"getelementptr {whole}, {places} {start}, {index}")
        if not offset:
            return start
        far = f"{self.many('i64')} splat (i64 {offset})"
        return self.made(f"getelementptr {whole}, {places} {start}, {far}")

    def running(self, pointers: str) -> str:
        """Replace the addresses in inactive lanes, which may be out of bounds, by a safe one."""
        if not self.mask:
            return pointers
        return self.blended(self.many("ptr"), pointers, self.spread("ptr", "%nowhere"))

    def lanes_of(self, t: str, x: str) -> list[str]:
        """Emit the extraction of the entries of a vector."""
        return [self.made(f"extractelement {self.many(t)} {x}, i64 {k}") for k in range(self.lanes)]

    def gathered(self, pointers: str, dtype: np.dtype) -> str:
        """Emit loads from a vector of addresses. Return the text of the last instruction."""
        t = memory_type(dtype)
        text = "poison"
        for k, place in enumerate(self.lanes_of("ptr", pointers)):
            x = self.made(f"load {t}, ptr {place}")
            before = self.made(text) if k else text
            text = f"insertelement {self.many(t)} {before}, {t} {x}, i64 {k}"
        return text

    # ---------------------------------------------------------------- control

    def any_of(self, mask: str) -> str:
        """Emit the condition that a mask has an active lane."""
        bits = self.made(f"bitcast {self.many('i1')} {mask} to i{self.lanes}")
        return self.made(f"icmp ne i{self.lanes} {bits}, 0")

    def within(self, condition: str) -> str:
        """Restrict the active lanes to those in which a condition is true."""
        if not self.mask:
            return condition
        return self.made(f"and {self.many('i1')} {self.mask}, {condition}")

    @contextmanager
    def among(self, mask: str, block: Block, condition: Value) -> Iterator[None]:
        """Emit a block under a mask. The mask and the divergent region of the block stay in effect
        in the body of the `with` statement."""
        before = self.mask, self.part
        self.mask, self.part = mask, region_of(block, condition, self.part, self.found)
        self.block(block)
        yield
        self.mask, self.part = before

    def while_(self, test: Block, condition: Value, body: Block) -> None:
        if not self.found.of(condition):
            return super().while_(test, condition, body)
        top, turn, end = self.labels("while", "turn", "leave")
        t, place = self.many("i1"), f"%run{next(self.numbers)}"
        self.entry.append(f"{place} = alloca {t}")
        self.lines.append(f"store {t} {self.mask or 'splat (i1 true)'}, ptr {place}")
        self.start_of(top)
        with self.among(self.made(f"load {t}, ptr {place}"), test, condition):
            mask = self.within(self.vector(condition))
        self.lines.append(f"store {t} {mask}, ptr {place}")
        self.lines.append(f"br i1 {self.any_of(mask)}, label %{turn}, label %{end}")
        self.start_of(turn, come=False)
        with self.among(mask, body, condition):
            self.lines.append(f"br label %{top}")
        self.start_of(end, come=False)
        return None

    def if_(self, condition: Value, then: Block, otherwise: Block) -> None:
        if not self.found.of(condition):
            return super().if_(condition, then, otherwise)
        yes = self.vector(condition)
        no = self.made(f"xor {self.many('i1')} {yes}, splat (i1 true)")
        for block, here in ((then, yes), (otherwise, no)):
            if not block.statements:
                continue
            turn, end = self.labels("some", "all")
            mask = self.within(here)
            self.lines.append(f"br i1 {self.any_of(mask)}, label %{turn}, label %{end}")
            self.start_of(turn, come=False)
            with self.among(mask, block, condition):
                self.start_of(end)
        return None
