"""Prints the statements of a program as LLVM IR: a function of one sample.

Scalars are values in SSA form. A variable that is assigned several times is on the stack; LLVM's
pass `sroa` moves it into a register.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rbjax.compiler.ir import statements as ir
from rbjax.compiler.ir.program import Written
from rbjax.compiler.llvm.operations import (
    ALIGNMENT,
    ATTRIBUTES,
    Operations,
    definitions,
    literal,
    llvm_type,
)
from rbjax.compiler.passes.cutting import Cuts, FrameLayout, split_block

#: larger local arrays are in the workspace, because a thread has a small stack
STACK_ARRAY_BYTES = 2048
#: the most bytes of local arrays on the stack
STACK_BYTES = 128 * 1024
MALLOC = ("declare noalias ptr @malloc(i64)", "declare void @free(ptr)")


@dataclass(frozen=True)
class Function:
    """A function of one or several samples: `void name(operands, results, space)`, all pointers.

    outside: definitions of tables and declarations that it needs.
    libm: the C mathematical functions that it calls.
    workspace: bytes of memory that it needs at `space`.
    """

    text: str
    name: str
    outside: tuple[str, ...]
    libm: tuple[str, ...]
    workspace: int

    def call(self, pointers: list[str], space: str) -> str:
        """Return a call with pointers to the operands and results. space: the workspace."""
        return f"call void @{self.name}({', '.join(f'ptr {x}' for x in (*pointers, space))})"


def write_sample(program: Written) -> Function:
    """Print the function of one sample of a program."""
    return write_function(Writer(), program, "sample")


def write_function(writer: Writer, program: Written, name: str) -> Function:
    """Print the function of a program, with statements emitted by `writer`."""
    xs = [f"%x{k}" for k in range(len(program.operands))]
    ys = [f"%y{k}" for k in range(len(program.results))]
    for array, place in zip((*program.operands, *program.results), (*xs, *ys), strict=True):
        writer.pointers[array.id] = place
    takes = [f"ptr noalias readonly {x}" for x in xs] + [f"ptr noalias {y}" for y in ys]
    takes.append("ptr noalias %space")
    writer.parts(name, program, takes)
    writer.begin(program)
    writer.block(program.builder.block)
    lines = [*writer.pieces, *writer.function(name, takes)]
    needed = writer.functions()
    outside = (
        *map(_table, program.builder.tables), *writer.operations.declared.values(), *needed
    )  # fmt: skip
    libm = tuple(writer.operations.libm)
    return Function("\n".join(lines), name, outside, libm, writer.workspace)


class Writer:
    """An emitter of the statements of a program for one sample.

    entry: stack allocations, which LLVM expects in the first block.
    """

    def __init__(self) -> None:
        self.entry: list[str] = []
        self.lines: list[str] = []
        self.operations = Operations(self.lines.append)
        self.made = self.operations.made
        self.numbers = itertools.count()
        self.places: dict[int, str] = {}  # variables on the stack
        self.pointers: dict[int, str] = {}
        self.workspace = self.stack = 0
        self.frame: FrameLayout | None = None
        self.here = 0  # number of the current function (`Cuts`)
        self.recalled: dict[int, str] = {}  # values that it has loaded from the frame
        self.pieces: list[str] = []

    def begin(self, program: Written) -> None:
        """Emit the lines before the statements."""

    def functions(self) -> list[str]:
        """Return definitions of mathematical functions that the statements call and C lacks."""
        return definitions(self.operations)

    # ---------------------------------------------------------------- functions

    def parts(self, name: str, program: Written, takes: list[str]) -> None:
        """Prepare the split of a long program into functions, if necessary. The functions share a
        frame: the memory of the variables and arrays that several of them use."""
        cuts = self.cuts(program)
        if cuts is None:
            return
        self.frame, self.name, self.program = (
            FrameLayout(cuts, self.bytes, ALIGNMENT),
            name,
            program,
        )
        self.takes, size = takes, self.frame.bytes
        if size <= STACK_BYTES:
            self.stack = size
            self.entry.append(f"%frame = alloca [{size} x i8], align {ALIGNMENT}")
        else:
            self.workspace = -(-size // ALIGNMENT) * ALIGNMENT
            self.entry.append("%frame = getelementptr i8, ptr %space, i64 0")

    def cuts(self, program: Written) -> Cuts | None:
        return split_block(program.builder.block, branches=True)

    def bytes(self, x: ir.Var | ir.Array) -> int:
        """Return the size of a variable or of a local array, in bytes."""
        return x.dtype.itemsize * (max(x.size, 1) if isinstance(x, ir.Array) else 1)

    def function(self, name: str, takes: list[str], more: str = "") -> list[str]:
        """Return the lines written so far as the text of a function. takes: its parameters."""
        return [
            f"define internal void @{name}({', '.join(takes)}) {more}{ATTRIBUTES} {{",
            "entry:", *self.entry, "br label %start", "start:", *self.lines, "ret void", "}",
        ]  # fmt: skip

    def piece(self, number: int, statements: list) -> None:
        """Emit statements as a separate function, and a call of it."""
        outside = self.entry, [*self.lines]
        self.entry, self.here, self.recalled = [], number, {}
        self.lines.clear()
        self.begin(self.program)
        self.block(ir.Block(statements))
        name, takes = f"{self.name}{number}", [*self.takes, "ptr noalias %frame"]
        self.pieces += self.function(name, takes, "noinline ")
        self.entry, self.here, self.recalled = outside[0], 0, {}
        pointers = ", ".join("ptr " + x.split()[-1] for x in takes)
        self.lines[:] = [*outside[1], f"call void @{name}({pointers})"]

    def shares(self, x: ir.Name) -> bool:
        """Return whether a variable or array is in the frame, the memory shared by functions."""
        return self.frame is not None and x in self.frame.places

    def framed(self, x: ir.Name, lines: list[str] | None = None) -> str:
        """Emit the address of a variable or array in the frame, the memory that all functions
        share."""
        assert self.frame is not None
        lines, name = self.lines if lines is None else lines, f"%p{next(self.numbers)}"
        lines.append(f"{name} = getelementptr i8, ptr %frame, i64 {self.frame.places[x]}")
        return name

    def keep(self, x: ir.Var) -> None:
        """Emit the store of a new value to the shared frame, if other functions of the program read
        it."""
        if self.shares(x):
            self.lines.append(f"store {self.kind(x)} %t{x.id}, ptr {self.framed(x)}")

    def recall(self, x: ir.Var) -> str:
        """Emit the load of a value that another function of the program has stored in the shared
        frame.
        A function loads a value once, but the main function loads it at each use."""
        if x.id not in self.recalled:
            name = f"%r{next(self.numbers)}"
            lines = self.entry if self.here else self.lines
            lines.append(f"{name} = load {self.kind(x)}, ptr {self.framed(x, lines)}")
            if not self.here:
                return name
            self.recalled[x.id] = name
        return self.recalled[x.id]

    # ---------------------------------------------------------------- memory

    def reserve(self, array: ir.Array, lanes: int = 1) -> None:
        """Allocate a local array on the stack or in the workspace."""
        if self.shares(array):
            return
        count = max(array.size, 1)
        size = lanes * count * array.dtype.itemsize
        if size <= lanes * STACK_ARRAY_BYTES and self.stack + size <= STACK_BYTES:
            self.stack += size
            name = self.pointers[array.id] = f"%a{array.id}"
            t = f"[{lanes * count} x {memory_type(array.dtype)}]"
            self.entry.append(f"{name} = alloca {t}, align {16 if lanes == 1 else ALIGNMENT}")
            return
        start, self.workspace = self.workspace, self.workspace + -(-size // ALIGNMENT) * ALIGNMENT
        text = f"getelementptr i8, ptr %space, i64 {start}"
        self.pointers[array.id] = self.made(text)

    def start(self, array: ir.Array) -> str:
        """Return the address of an array."""
        if self.shares(array):
            return self.framed(array)
        return f"@a{array.id}" if array.space == "constant" else self.pointers[array.id]

    def address(self, array: ir.Array, base: ir.Value | None, offset: int) -> str:
        return self.at(memory_type(array.dtype), self.start(array), base, offset)

    def at(self, t: str, start: str, base: ir.Value | None, offset: int) -> str:
        """Emit the address start + base + offset, in entries of type t."""
        if base is not None:
            kind, index = llvm_type(base.dtype), self.value(base)
            start = self.made(f"getelementptr {t}, ptr {start}, {kind} {index}")
        return self.made(f"getelementptr {t}, ptr {start}, i64 {offset}") if offset else start

    # ---------------------------------------------------------------- values

    def value(self, x: ir.Value) -> str:
        if not isinstance(x, ir.Var):
            return literal(x)
        return self.current(x)

    def kind(self, x: ir.Var) -> str:
        """Return the LLVM type of a variable."""
        return llvm_type(x.dtype)

    def current(self, x: ir.Var) -> str:
        """Return the current value of a variable."""
        if x.id in self.places:
            return self.made(f"load {self.kind(x)}, ptr {self.place_of(x)}")
        if self.frame is not None and self.shares(x) and self.frame.cuts.home[x] != self.here:
            return self.recall(x)
        return f"%t{x.id}"

    def place(self, var: ir.Var) -> None:
        """Allocate memory for a variable that is assigned several times."""
        self.places[var.id] = f"%m{var.id}"
        if not self.shares(var):
            self.entry.append(f"%m{var.id} = alloca {self.kind(var)}")

    def place_of(self, var: ir.Var) -> str:
        return self.framed(var) if self.shares(var) else self.places[var.id]

    def put(self, var: ir.Var, value: ir.Value) -> None:
        text = self.value(value)
        self.lines.append(f"store {self.kind(var)} {text}, ptr {self.place_of(var)}")

    # ---------------------------------------------------------------- statements

    def block(self, block: ir.Block) -> None:
        pieces = self.frame.cuts.runs.get(id(block)) if self.frame else None
        for number, statements in pieces or [(0, block.statements)]:
            if number:
                self.piece(number, statements)
                continue
            for statement in statements:
                self.statement(statement)
                if isinstance(statement, ir.Op | ir.Load):
                    self.keep(statement.dest)

    def statement(self, statement: ir.Statement) -> None:
        match statement:
            case ir.Op(dest=dest, args=args):
                self.operations.write(statement, f"%t{dest.id}", [self.value(a) for a in args])
            case ir.Load(dest=dest, array=array, base=base, offset=offset):
                self.load(dest, array, base, offset)
            case ir.Store(array=array, base=base, offset=offset, value=value):
                self.store(array, base, offset, value)
            case ir.Declare(var=var, value=value):
                self.place(var)
                if value is not None:
                    self.put(var, value)
            case ir.Assign(var=var, value=value):
                self.put(var, value)
            case ir.Reserve(array=array):
                self.reserve(array)
            case ir.Loop():
                self.loop(statement)
            case ir.While(test=test, condition=condition, body=body):
                self.while_(test, condition, body)
            case ir.If(condition=condition, then=then, otherwise=otherwise):
                self.if_(condition, then, otherwise)
            case _:
                raise TypeError(f"no such statement: {statement}")

    def load(self, dest: ir.Var, array: ir.Array, base: ir.Value | None, offset: int) -> None:
        """Emit dest = array[base + offset]."""
        address = self.address(array, base, offset)
        if dest.dtype.kind == "b":
            byte = self.made(f"load i8, ptr {address}")
            self.made(f"icmp ne i8 {byte}, 0", f"%t{dest.id}")
        else:
            self.made(f"load {llvm_type(dest.dtype)}, ptr {address}", f"%t{dest.id}")

    def store(self, array: ir.Array, base: ir.Value | None, offset: int, value: ir.Value) -> None:
        """Emit array[base + offset] = value."""
        text, address = self.value(value), self.address(array, base, offset)
        if array.dtype.kind == "b":
            text = self.made(f"zext i1 {text} to i8")
        self.lines.append(f"store {memory_type(array.dtype)} {text}, ptr {address}")

    def start_of(self, label: str, come: bool = True) -> None:
        """Begin a basic block. come: whether the previous block branches to it."""
        if come:
            self.lines.append(f"br label %{label}")
        self.lines.append(f"{label}:")

    def labels(self, *names: str) -> Iterator[str]:
        n = next(self.numbers)
        return (f"{name}{n}" for name in names)

    def loop(self, loop: ir.Loop) -> None:
        if loop.count <= 0:
            return
        (body,) = self.labels("loop")
        (end,) = self.labels("end")
        first, step = (loop.count - 1, -1) if loop.reverse else (0, 1)
        last = 0 if loop.reverse else loop.count - 1
        counter, place = loop.counter, f"%m{loop.counter.id}"
        self.entry.append(f"{place} = alloca i32")
        self.lines.append(f"store i32 {first}, ptr {place}")
        self.start_of(body)
        self.made(f"load i32, ptr {place}", f"%t{counter.id}")
        self.keep(counter)
        self.block(loop.body)
        after = self.made(f"add i32 %t{counter.id}, {step}")
        self.lines.append(f"store i32 {after}, ptr {place}")
        done = self.made(f"icmp eq i32 %t{counter.id}, {last}")
        self.lines.append(f"br i1 {done}, label %{end}, label %{body}")
        self.start_of(end, come=False)

    def while_(self, test: ir.Block, condition: ir.Value, body: ir.Block) -> None:
        top, turn, end = self.labels("while", "turn", "leave")
        self.start_of(top)
        self.block(test)
        self.lines.append(f"br i1 {self.value(condition)}, label %{turn}, label %{end}")
        self.start_of(turn, come=False)
        self.block(body)
        self.lines.append(f"br label %{top}")
        self.start_of(end, come=False)

    def if_(self, condition: ir.Value, then: ir.Block, otherwise: ir.Block) -> None:
        yes, no, end = self.labels("then", "else", "both")
        self.lines.append(f"br i1 {self.value(condition)}, label %{yes}, label %{no}")
        self.start_of(yes, come=False)
        self.block(then)
        self.lines.append(f"br label %{end}")
        self.start_of(no, come=False)
        self.block(otherwise)
        self.start_of(end)


def memory_type(dtype: np.dtype) -> str:
    """Return the LLVM type of an entry in memory."""
    return "i8" if dtype.kind == "b" else llvm_type(dtype)


def _table(array: ir.Array) -> str:
    """Return the definition of a constant array."""
    t, data = memory_type(array.dtype), array.data
    assert data is not None
    plain = data.view(np.uint8) if data.dtype.kind == "b" else data
    numbers = ", ".join(f"{t} {literal(x)}" for x in plain)
    held = f"[{numbers}]" if numbers else "zeroinitializer"
    return f"@a{array.id} = internal constant [{max(array.size, 1)} x {t}] {held}, align 16"
