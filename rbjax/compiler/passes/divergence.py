"""What differs between the lanes of a vector, when one lane runs one sample of a program.

A value that derives only from loop counters, known numbers and what all samples share is the same
in every lane, and stays a scalar. Where a condition differs, lanes part: a block runs for some of
them. What outlives such a block differs afterwards, because only some lanes have assigned it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from rbjax.compiler.ir.statements import (
    Array,
    Assign,
    Block,
    Declare,
    If,
    Load,
    Op,
    Reserve,
    Store,
    Value,
    Var,
    While,
)


@dataclass
class Divergence:
    """The ids of variables and arrays that differ between lanes.

    home: the block, of those in which lanes have parted, that declares a variable or an array.
    """

    different: set[int] = field(default_factory=set)
    home: dict[int, int] = field(default_factory=dict)

    def of(self, x: Value | Array | None) -> bool:
        """Whether a value, or what an array holds, differs."""
        return isinstance(x, Var | Array) and x.id in self.different

    def outlives(self, x: Var | Array, part: int) -> bool:
        """Whether lanes have parted since x was declared, and now run block `part`."""
        return self.home.get(x.id, 0) != part


def divergence(block: Block, different: Iterable[Array]) -> Divergence:
    """What differs if these arrays do."""
    found = Divergence({a.id for a in different})
    size = -1
    while size != len(found.different):  # a loop's later turns may change its earlier ones
        size = len(found.different)
        _visit(block, 0, found)
    return found


def _visit(block: Block, part: int, found: Divergence) -> None:
    different = found.different
    for s in block.statements:
        differs = False
        for x in s.reads():
            if x.id in different:
                differs = True
        match s:
            case Op() | Load():
                pass
            case Declare(var=declared) | Reserve(array=declared):
                found.home[declared.id] = part
            case Store(array=changed) | Assign(var=changed):
                differs = differs or found.outlives(changed, part)
        if differs:
            different.update([x.id for x in s.writes()])
        for inner in () if s.is_leaf else s.children():
            among = part
            if isinstance(s, While | If):
                among = part_of(inner, s.condition, part, found)
            _visit(inner, among, found)


def part_of(block: Block, condition: Value, part: int, found: Divergence) -> int:
    """The part of the lanes that runs a block under a condition, of those of `part`."""
    return id(block) if found.of(condition) else part
