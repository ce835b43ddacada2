"""The statements of a program, which one thread runs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

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


@dataclass(slots=True)
class Op:
    """dest = name(args)."""

    dest: Var
    name: str
    args: tuple


@dataclass(slots=True)
class Load:
    """dest = array[base + offset]; base is None for 0."""

    dest: Var
    array: Array
    base: Value | None
    offset: int


@dataclass(slots=True)
class Store:
    """array[base + offset] = value."""

    array: Array
    base: Value | None
    offset: int
    value: Value


@dataclass(slots=True)
class Declare:
    """A variable that is assigned later; its first value, or None."""

    var: Var
    value: Value | None


@dataclass(slots=True)
class Assign:
    """var = value."""

    var: Var
    value: Value


@dataclass(slots=True)
class Reserve:
    """The declaration of a local array."""

    array: Array


@dataclass(slots=True)
class Loop:
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


@dataclass(slots=True)
class Await:
    """Until here, early copies have arrived."""


@dataclass(slots=True)
class Barrier:
    """The threads of a team wait for each other (`phases.synchronised`)."""


@dataclass(slots=True)
class While:
    """Repeat: run `test`; stop if `condition` is false; run `body`."""

    test: Block
    condition: Value
    body: Block


@dataclass(slots=True)
class If:
    """One of two blocks."""

    condition: Value
    then: Block
    otherwise: Block


@dataclass(slots=True)
class Block:
    """A sequence of statements."""

    statements: list = field(default_factory=list)


def walk(block: Block) -> Iterator[Any]:
    """All statements; those of inner blocks follow the statement that contains them."""
    for statement in block.statements:
        yield statement
        match statement:
            case Loop(body=body):
                yield from walk(body)
            case While(test=test, body=body):
                yield from walk(test)
                yield from walk(body)
            case If(then=then, otherwise=otherwise):
                yield from walk(then)
                yield from walk(otherwise)
