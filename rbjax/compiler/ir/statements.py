"""The values and the statements of a program, which one thread runs.

A value is a variable (`Var`) or a constant (a numpy scalar).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

BOOL: np.dtype = np.dtype(bool)
I32: np.dtype = np.dtype(np.int32)
I64: np.dtype = np.dtype(np.int64)
F64: np.dtype = np.dtype(np.float64)


class Unsupported(Exception):
    """An error: the compiler does not support a primitive, an operation or a dtype."""


@dataclass(frozen=True, slots=True, eq=False)
class Var:
    """A scalar variable that is computed at run time."""

    id: int
    dtype: np.dtype


Value = Var | np.generic


def is_number(x: Value, number: int) -> bool:
    """Return whether a value is the constant `number`, and not a boolean."""
    return isinstance(x, np.generic) and x.dtype != BOOL and x == number


@dataclass(slots=True, eq=False)
class Array:
    """An array in memory, addressed by entry.

    space: "local", "constant" (a table of the numbers `data`), "operand" (read only) or "result".
    index: dtype of its indices; int64 if int32 is too small.
    reference_count: number of live references during lowering. At 0, the array may be updated in
        place.
    version: `Builder.time` of its last store.
    shared: whether the threads of a team share it; only for local arrays.
    write_once: whether each entry is written at most once per iteration.
    """

    id: int
    dtype: np.dtype
    size: int
    space: str
    data: np.ndarray | None = None
    index: np.dtype = I32
    reference_count: int = 0
    version: int = 0
    shared: bool = False
    write_once: bool = False

    @property
    def mutable(self) -> bool:
        return self.space in ("local", "result")


Name = Var | Array


class Statement:
    """A base class of statements. `reads` and `writes` exclude the inner blocks (`children`)."""

    __slots__ = ()
    is_leaf: ClassVar[bool] = True

    def reads(self) -> tuple[Name, ...]:
        """Return the variables and arrays that this statement reads."""
        return ()

    def writes(self) -> tuple[Name, ...]:
        """Return the variables and arrays that this statement changes."""
        return ()

    def children(self) -> tuple[Block, ...]:
        """Return the inner blocks, in the order in which they run."""
        return ()


def _variable(value: Value | None) -> tuple[Var, ...]:
    return (value,) if type(value) is Var else ()


@dataclass(slots=True)
class Op(Statement):
    """An operation: dest = name(args)."""

    dest: Var
    name: str
    args: tuple[Value, ...]

    def reads(self) -> tuple[Name, ...]:
        return tuple([x for x in self.args if type(x) is Var])

    def writes(self) -> tuple[Name, ...]:
        return (self.dest,)


@dataclass(slots=True)
class Load(Statement):
    """A load: dest = array[base + offset]. base is None for 0."""

    dest: Var
    array: Array
    base: Value | None
    offset: int

    def reads(self) -> tuple[Name, ...]:
        return (self.array,) if not isinstance(self.base, Var) else (self.array, self.base)

    def writes(self) -> tuple[Name, ...]:
        return (self.dest,)


@dataclass(slots=True)
class Store(Statement):
    """A store: array[base + offset] = value. base is None for 0."""

    array: Array
    base: Value | None
    offset: int
    value: Value

    def reads(self) -> tuple[Name, ...]:
        return _variable(self.base) + _variable(self.value)

    def writes(self) -> tuple[Name, ...]:
        return (self.array,)


@dataclass(slots=True)
class Declare(Statement):
    """A declaration of a variable that may be assigned later. value: its initial value, or None."""

    var: Var
    value: Value | None

    def reads(self) -> tuple[Name, ...]:
        return _variable(self.value)

    def writes(self) -> tuple[Name, ...]:
        return (self.var,)


@dataclass(slots=True)
class Assign(Statement):
    """An assignment: var = value."""

    var: Var
    value: Value

    def reads(self) -> tuple[Name, ...]:
        return _variable(self.value)

    def writes(self) -> tuple[Name, ...]:
        return (self.var,)


@dataclass(slots=True)
class Reserve(Statement):
    """A declaration of a local array."""

    array: Array


@dataclass(slots=True)
class Loop(Statement):
    """A loop whose `counter` runs over 0 ... count - 1, or backwards if `reverse`.

    team: its iterations are independent, and the threads of a team share them.
    prefetch: it copies entries that are first read after the next `Await`.
    group: team loops of the same group, except 0, write disjoint entries.
    """

    counter: Var
    count: int
    reverse: bool
    body: Block
    team: bool = False
    prefetch: bool = False
    group: int = 0

    is_leaf: ClassVar[bool] = False

    def writes(self) -> tuple[Name, ...]:
        return (self.counter,)

    def children(self) -> tuple[Block, ...]:
        return (self.body,)


@dataclass(slots=True)
class Await(Statement):
    """A wait for the copies of prefetching loops."""


@dataclass(slots=True)
class Barrier(Statement):
    """A barrier of a team of threads (`phases.insert_barriers`)."""


@dataclass(slots=True)
class While(Statement):
    """A `while` loop: run `test`, stop if `condition` is false, run `body`, repeat."""

    test: Block
    condition: Value
    body: Block

    is_leaf: ClassVar[bool] = False

    def reads(self) -> tuple[Name, ...]:
        return _variable(self.condition)

    def children(self) -> tuple[Block, ...]:
        return (self.test, self.body)


@dataclass(slots=True)
class If(Statement):
    """A branch: run `then` if the condition is true, else `otherwise`."""

    condition: Value
    then: Block
    otherwise: Block

    is_leaf: ClassVar[bool] = False

    def reads(self) -> tuple[Name, ...]:
        return _variable(self.condition)

    def children(self) -> tuple[Block, ...]:
        return (self.then, self.otherwise)


@dataclass(slots=True)
class Block:
    """A sequence of statements."""

    statements: list[Statement] = field(default_factory=list)


def walk(block: Block) -> Iterator[Statement]:
    """Yield all statements in order, each one before the statements of its inner blocks."""
    for statement in block.statements:
        yield statement
        if not statement.is_leaf:
            for inner in statement.children():
                yield from walk(inner)
