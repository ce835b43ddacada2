"""What differs between the lanes of a vector, when one lane runs one sample of a program.

A value that derives only from loop counters, known numbers and what all samples share is the same
in every lane, and stays a scalar. Where a condition differs, lanes part: a block runs for some of
them. What outlives such a block differs afterwards, because only some lanes have assigned it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from rbjax.compiler.ir.program import (
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
    of, add = found.of, found.different.add
    for s in block.statements:
        match s:
            case Op(dest=dest, args=args):
                if any(map(of, args)):
                    add(dest.id)
            case Load(dest=dest, array=array, base=base):
                if of(array) or of(base):
                    add(dest.id)
            case Store(array=array, base=base, value=value):
                if of(value) or of(base) or found.outlives(array, part):
                    add(array.id)
            case Declare(var=var, value=value):
                found.home[var.id] = part
                if of(value):
                    add(var.id)
            case Assign(var=var, value=value):
                if of(value) or found.outlives(var, part):
                    add(var.id)
            case Reserve(array=array):
                found.home[array.id] = part
            case Loop(body=body):
                _visit(body, part, found)
            case While(test=test, condition=condition, body=body):
                _visit(test, part_of(test, condition, part, found), found)
                _visit(body, part_of(body, condition, part, found), found)
            case If(condition=condition, then=then, otherwise=otherwise):
                _visit(then, part_of(then, condition, part, found), found)
                _visit(otherwise, part_of(otherwise, condition, part, found), found)


def part_of(block: Block, condition: Value, part: int, found: Divergence) -> int:
    """The part of the lanes that runs a block under a condition, of those of `part`."""
    return id(block) if found.of(condition) else part
