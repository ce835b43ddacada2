"""The statements of a program as LLVM IR: a function of one sample.

Scalars are values of SSA form. A variable that is assigned several times is a place on the stack,
which LLVM's `sroa` turns into a register.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbjax.threads.frame import Written
from rbjax.threads.llvm_operations import Operations, literal, llvm_type
from rbjax.threads.program import (
    Array,
    Assign,
    Block,
    Declare,
    If,
    Load,
    Loop,
    Op,
    Reserve,
    Store,
    Value,
    Var,
    While,
)

#: larger local arrays lie in the workspace, not on the stack, of which a thread has little
STACK_ARRAY_BYTES = 2048
#: bytes of all local arrays on the stack
STACK_BYTES = 128 * 1024
ALIGNMENT = 64


@dataclass(frozen=True)
class Function:
    """The function of one sample, `void name(operands, results, space)`, all of them pointers.

    outside: the tables and declarations that it needs. libm: the functions of C's mathematics that
    it calls. workspace: bytes at `space`.
    """

    text: str
    name: str
    outside: tuple[str, ...]
    libm: tuple[str, ...]
    workspace: int

    def call(self, pointers: list[str], space: str) -> str:
        """A call with these operands and results."""
        return f"call void @{self.name}({', '.join(f'ptr {x}' for x in (*pointers, space))})"


def one_sample(program: Written, name: str = "sample") -> Function:
    """The function of one sample of a program."""
    writer = _Writer()
    xs = [f"%x{k}" for k in range(len(program.operands))]
    ys = [f"%y{k}" for k in range(len(program.results))]
    for array, place in zip((*program.operands, *program.results), (*xs, *ys), strict=True):
        writer.pointers[array.id] = place
    writer.block(program.builder.block)
    takes = [f"ptr noalias readonly {x}" for x in xs] + [f"ptr noalias {y}" for y in ys]
    lines = [
        f"define internal void @{name}({', '.join((*takes, 'ptr noalias %space'))}) nounwind {{",
        "entry:", *writer.entry, "br label %start", "start:", *writer.lines, "ret void", "}",
    ]  # fmt: skip
    outside = (*map(_table, program.builder.tables), *writer.operations.declared.values())
    libm = tuple(writer.operations.libm)
    return Function("\n".join(lines), name, outside, libm, writer.workspace)


class _Writer:
    """Writes statements; `entry` has the stack places, which LLVM wants in the first block."""

    def __init__(self) -> None:
        self.entry: list[str] = []
        self.lines: list[str] = []
        self.operations = Operations(self.lines.append)
        self.made = self.operations.made
        self.labels = itertools.count()
        self.places: dict[int, str] = {}  # variables on the stack
        self.pointers: dict[int, str] = {}
        self.workspace = self.stack = 0

    # ---------------------------------------------------------------- memory

    def reserve(self, array: Array) -> None:
        """A local array, on the stack or in the workspace."""
        size = max(array.size, 1) * array.dtype.itemsize
        if size <= STACK_ARRAY_BYTES and self.stack + size <= STACK_BYTES:
            self.stack += size
            name = self.pointers[array.id] = f"%a{array.id}"
            count = max(array.size, 1)
            self.entry.append(f"{name} = alloca [{count} x {stored(array.dtype)}], align 16")
            return
        start, self.workspace = self.workspace, self.workspace + -(-size // ALIGNMENT) * ALIGNMENT
        text = f"getelementptr i8, ptr %space, i64 {start}"
        self.pointers[array.id] = self.made(text)

    def address(self, array: Array, base: Value | None, offset: int) -> str:
        known = f"@a{array.id}" if array.space == "constant" else self.pointers[array.id]
        t = stored(array.dtype)
        if base is not None:
            kind, index = llvm_type(base.dtype), self.value(base)
            known = self.made(f"getelementptr {t}, ptr {known}, {kind} {index}")
        return self.made(f"getelementptr {t}, ptr {known}, i64 {offset}") if offset else known

    # ---------------------------------------------------------------- values

    def value(self, x: Value) -> str:
        if not isinstance(x, Var):
            return literal(x)
        if x.id not in self.places:
            return f"%t{x.id}"
        return self.made(f"load {llvm_type(x.dtype)}, ptr {self.places[x.id]}")

    def place(self, var: Var) -> str:
        name = self.places[var.id] = f"%m{var.id}"
        self.entry.append(f"{name} = alloca {llvm_type(var.dtype)}")
        return name

    def put(self, var: Var, value: Value) -> None:
        text = self.value(value)
        self.lines.append(f"store {llvm_type(var.dtype)} {text}, ptr {self.places[var.id]}")

    # ---------------------------------------------------------------- statements

    def block(self, block: Block) -> None:
        for statement in block.statements:
            self.statement(statement)

    def statement(self, statement: Any) -> None:
        match statement:
            case Op(dest=dest, args=args):
                self.operations.write(statement, f"%t{dest.id}", [self.value(a) for a in args])
            case Load(dest=dest, array=array, base=base, offset=offset):
                self._load(dest, self.address(array, base, offset))
            case Store(array=array, base=base, offset=offset, value=value):
                self._store(array, self.value(value), self.address(array, base, offset))
            case Declare(var=var, value=value):
                self.place(var)
                if value is not None:
                    self.put(var, value)
            case Assign(var=var, value=value):
                self.put(var, value)
            case Reserve(array=array):
                self.reserve(array)
            case Loop():
                self._loop(statement)
            case While(test=test, condition=condition, body=body):
                self._while(test, condition, body)
            case If(condition=condition, then=then, otherwise=otherwise):
                self._if(condition, then, otherwise)
            case _:
                raise TypeError(f"no such statement: {statement}")

    def _load(self, dest: Var, address: str) -> None:
        if dest.dtype.kind == "b":
            byte = self.made(f"load i8, ptr {address}")
            self.made(f"icmp ne i8 {byte}, 0", f"%t{dest.id}")
        else:
            self.made(f"load {llvm_type(dest.dtype)}, ptr {address}", f"%t{dest.id}")

    def _store(self, array: Array, value: str, address: str) -> None:
        if array.dtype.kind == "b":
            value = self.made(f"zext i1 {value} to i8")
        self.lines.append(f"store {stored(array.dtype)} {value}, ptr {address}")

    def _start(self, label: str, come: bool = True) -> None:
        """A new block of instructions, to which the one before goes on."""
        if come:
            self.lines.append(f"br label %{label}")
        self.lines.append(f"{label}:")

    def _labels(self, *names: str) -> Iterator[str]:
        n = next(self.labels)
        return (f"{name}{n}" for name in names)

    def _loop(self, loop: Loop) -> None:
        if loop.count <= 0:
            return
        (body,) = self._labels("loop")
        (end,) = self._labels("end")
        first, step = (loop.count - 1, -1) if loop.reverse else (0, 1)
        last = 0 if loop.reverse else loop.count - 1
        counter, place = loop.counter, self.place(loop.counter)
        self.lines.append(f"store i32 {first}, ptr {place}")
        self._start(body)
        # within a turn the counter is one value
        del self.places[counter.id]
        self.made(f"load i32, ptr {place}", f"%t{counter.id}")
        self.block(loop.body)
        after = self.made(f"add i32 %t{counter.id}, {step}")
        self.lines.append(f"store i32 {after}, ptr {place}")
        done = self.made(f"icmp eq i32 %t{counter.id}, {last}")
        self.lines.append(f"br i1 {done}, label %{end}, label %{body}")
        self._start(end, come=False)

    def _while(self, test: Block, condition: Value, body: Block) -> None:
        top, turn, end = self._labels("while", "turn", "leave")
        self._start(top)
        self.block(test)
        self.lines.append(f"br i1 {self.value(condition)}, label %{turn}, label %{end}")
        self._start(turn, come=False)
        self.block(body)
        self.lines.append(f"br label %{top}")
        self._start(end, come=False)

    def _if(self, condition: Value, then: Block, otherwise: Block) -> None:
        yes, no, end = self._labels("then", "else", "both")
        self.lines.append(f"br i1 {self.value(condition)}, label %{yes}, label %{no}")
        self._start(yes, come=False)
        self.block(then)
        self.lines.append(f"br label %{end}")
        self._start(no, come=False)
        self.block(otherwise)
        self._start(end)


def stored(dtype: np.dtype) -> str:
    """The type of an entry in memory."""
    return "i8" if dtype.kind == "b" else llvm_type(dtype)


def _table(array: Array) -> str:
    """The definition of a constant array."""
    t, data = stored(array.dtype), array.data
    assert data is not None
    plain = data.view(np.uint8) if data.dtype.kind == "b" else data
    numbers = ", ".join(f"{t} {literal(x)}" for x in plain) or f"{t} 0"
    return f"@a{array.id} = internal constant [{max(array.size, 1)} x {t}] [{numbers}], align 16"
