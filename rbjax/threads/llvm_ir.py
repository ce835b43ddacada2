"""A program of one sample as LLVM IR: a function that is called with numpy arrays.

`int run(known, operands, results)` gets two tuples of arrays and reads their data in place. `known`
holds the address of numpy's type of arrays and those of the operands' dtypes. It returns 0; or 1 if
an operand is not an array of the type and shape of the program, whose entries lie one after
another; or -1 without memory. It knows nothing of Python, so it runs without the GIL.

Scalars are values of SSA form. A variable that is assigned several times is a place on the stack,
which LLVM's `sroa` turns into a register.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbjax.threads import numpy_abi
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
class Module:
    """LLVM IR, and the functions of C's mathematics that it calls."""

    text: str
    libm: tuple[str, ...]


def module(program: Written) -> Module:
    """The function `run` of a program without a batch."""
    writer = _Writer()
    writer.operands(program)
    for k, array in enumerate(program.results):
        y = writer.field("%ys", numpy_abi.ITEMS + 8 * k, "ptr")
        writer.pointers[array.id] = writer.field(y, numpy_abi.DATA, "ptr")
    writer.block(program.builder.block)
    tables = [_table(array) for array in program.builder.tables]
    heap, free = [], []
    if writer.workspace:
        tables += ["declare noalias ptr @malloc(i64)", "declare void @free(ptr)"]
        heap = [
            f"%space = call ptr @malloc(i64 {writer.workspace})",
            "%nothing = icmp eq ptr %space, null",
            "br i1 %nothing, label %full, label %start",
            "full:", "ret i32 -1",
        ]  # fmt: skip
        free = ["call void @free(ptr %space)"]
    lines = [
        *tables, *writer.operations.declared.values(),
        "define i32 @run(ptr %known, ptr %xs, ptr %ys) nounwind {",
        "entry:", *writer.entry, "br label %check", "check:", *writer.checks,
        *(heap or ["br label %start"]), "start:", *writer.lines, *free, "ret i32 0",
        "other:", "ret i32 1", "}",
    ]  # fmt: skip
    return Module("\n".join(lines), tuple(writer.operations.libm))


class _Writer:
    """Writes statements; `entry` has the stack places, which LLVM wants in the first block."""

    def __init__(self) -> None:
        self.entry: list[str] = []
        self.lines: list[str] = []
        self.operations = Operations(lambda line: self.lines.append(line))
        self.made = self.operations.made
        self.labels = itertools.count()
        self.places: dict[int, str] = {}  # variables on the stack
        self.pointers: dict[int, str] = {}
        self.checks: list[str] = []
        self.workspace = self.stack = 0

    # ---------------------------------------------------------------- memory

    def field(self, array: str, offset: int, t: str) -> str:
        """A member of a numpy array's struct."""
        place = self.made(f"getelementptr i8, ptr {array}, i64 {offset}")
        return self.made(f"load {t}, ptr {place}")

    def operands(self, program: Written) -> None:
        """The data of the operands, after checks that they are what the program expects."""
        body, self.lines = self.lines, self.checks
        self._expect("%xs", numpy_abi.COUNT, "i64", str(len(program.operands)))
        for k, (array, layout) in enumerate(zip(program.operands, program.layouts[0], strict=True)):
            x = self.field("%xs", numpy_abi.ITEMS + 8 * k, "ptr")
            self._expect(x, numpy_abi.TYPE, "ptr", self.field("%known", 0, "ptr"))
            self._expect(x, numpy_abi.DESCR, "ptr", self.field("%known", 8 * (k + 1), "ptr"))
            self._expect(x, numpy_abi.ND, "i32", str(len(layout.shape)))
            flags = self.field(x, numpy_abi.FLAGS, "i32")
            plain = self.made(f"and i32 {flags}, {numpy_abi.PLAIN}")
            self._same("i32", plain, str(numpy_abi.PLAIN))
            if layout.shape:
                sizes = self.field(x, numpy_abi.DIMENSIONS, "ptr")
            for axis, size in enumerate(layout.shape):
                self._expect(sizes, 8 * axis, "i64", str(size))
            self.pointers[array.id] = self.field(x, numpy_abi.DATA, "ptr")
        self.lines = body

    def _expect(self, x: str, offset: int, t: str, wanted: str) -> None:
        self._same(t, self.field(x, offset, t), wanted)

    def _same(self, t: str, found: str, wanted: str) -> None:
        """Goes on only if two values are equal."""
        (good,) = self._labels("good")
        same = self.made(f"icmp eq {t} {found}, {wanted}")
        self.lines += [f"br i1 {same}, label %{good}, label %other", f"{good}:"]

    def reserve(self, array: Array) -> None:
        """A local array, on the stack or in the workspace."""
        size = max(array.size, 1) * array.dtype.itemsize
        if size <= STACK_ARRAY_BYTES and self.stack + size <= STACK_BYTES:
            self.stack += size
            name = self.pointers[array.id] = f"%a{array.id}"
            count = max(array.size, 1)
            self.entry.append(f"{name} = alloca [{count} x {_stored(array.dtype)}], align 16")
            return
        start, self.workspace = self.workspace, self.workspace + -(-size // ALIGNMENT) * ALIGNMENT
        text = f"getelementptr i8, ptr %space, i64 {start}"
        self.pointers[array.id] = self.made(text)

    def address(self, array: Array, base: Value | None, offset: int) -> str:
        known = f"@a{array.id}" if array.space == "constant" else self.pointers[array.id]
        t = _stored(array.dtype)
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
        self.lines.append(f"store {_stored(array.dtype)} {value}, ptr {address}")

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


def _stored(dtype: np.dtype) -> str:
    """The type of an entry in memory."""
    return "i8" if dtype.kind == "b" else llvm_type(dtype)


def _table(array: Array) -> str:
    """The definition of a constant array."""
    t, data = _stored(array.dtype), array.data
    assert data is not None
    plain = data.view(np.uint8) if data.dtype.kind == "b" else data
    numbers = ", ".join(f"{t} {literal(x)}" for x in plain) or f"{t} 0"
    return f"@a{array.id} = internal constant [{max(array.size, 1)} x {t}] [{numbers}], align 16"
