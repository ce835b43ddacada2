"""The statements of a program, which one thread runs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from rbjax.compiler.ir.values import I32, Value, Var


@dataclass(slots=True, eq=False)
class Array:
    """Memory of one thread, addressed by element.

    space: "local" (of the thread), "constant" (known numbers, `data`), "operand" (read only) or
    "result" (what the thread returns). shared: local, of a team of threads.
    """

    id: int
    dtype: np.dtype
    size: int
    space: str
    data: np.ndarray | None = None
    #: the type of its indices: int64 if int32 is too small
    index: np.dtype = I32
    #: live references while the program is written; an array without any may be updated in place
    owners: int = 0
    #: the `Builder` time of its last write
    version: int = 0
    shared: bool = False
    #: each entry is written once (in a turn of a loop), by one of several statements
    pieces: bool = False

    @property
    def mutable(self) -> bool:
        return self.space in ("local", "result")


Name = Var | Array


class Statement:
    """A statement: what it reads, what it writes, and the blocks inside it.

    `reads` and `writes` are of the statement itself, without its inner blocks.
    """

    __slots__ = ()
    #: whether it has no inner blocks
    is_leaf: ClassVar[bool] = True

    def reads(self) -> tuple[Name, ...]:
        """The variables and arrays that it reads."""
        return ()

    def writes(self) -> tuple[Name, ...]:
        """The variables and arrays that it changes."""
        return ()

    def children(self) -> tuple[Block, ...]:
        """Its inner blocks, in the order in which they run."""
        return ()


def _variable(value: Value | None) -> tuple[Var, ...]:
    return (value,) if type(value) is Var else ()


@dataclass(slots=True)
class Op(Statement):
    """dest = name(args)."""

    dest: Var
    name: str
    args: tuple[Value, ...]

    def reads(self) -> tuple[Name, ...]:
        return tuple([x for x in self.args if type(x) is Var])

    def writes(self) -> tuple[Name, ...]:
        return (self.dest,)


@dataclass(slots=True)
class Load(Statement):
    """dest = array[base + offset]; base is None for 0."""

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
    """array[base + offset] = value."""

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
    """A variable that is assigned later; its first value, or None."""

    var: Var
    value: Value | None

    def reads(self) -> tuple[Name, ...]:
        return _variable(self.value)

    def writes(self) -> tuple[Name, ...]:
        return (self.var,)


@dataclass(slots=True)
class Assign(Statement):
    """var = value."""

    var: Var
    value: Value

    def reads(self) -> tuple[Name, ...]:
        return _variable(self.value)

    def writes(self) -> tuple[Name, ...]:
        return (self.var,)


@dataclass(slots=True)
class Reserve(Statement):
    """The declaration of a local array."""

    array: Array


@dataclass(slots=True)
class Loop(Statement):
    """`counter` runs over 0 ... count - 1, or backwards.

    team: its turns do not depend on each other, and the threads of a team share them. early: it
    copies entries that are first read after the next `Await`. part: loops of the same number write
    different entries.
    """

    counter: Var
    count: int
    reverse: bool
    body: Block
    team: bool = False
    early: bool = False
    part: int = 0

    is_leaf: ClassVar[bool] = False

    def writes(self) -> tuple[Name, ...]:
        return (self.counter,)

    def children(self) -> tuple[Block, ...]:
        return (self.body,)


@dataclass(slots=True)
class Await(Statement):
    """Until here, early copies have arrived."""


@dataclass(slots=True)
class Barrier(Statement):
    """The threads of a team wait for each other (`phases.synchronised`)."""


@dataclass(slots=True)
class While(Statement):
    """Repeat: run `test`; stop if `condition` is false; run `body`."""

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
    """One of two blocks."""

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
    """All statements; those of inner blocks follow the statement that contains them."""
    for statement in block.statements:
        yield statement
        if not statement.is_leaf:
            for inner in statement.children():
                yield from walk(inner)
