"""Analyses of a program: operation counts, and values that differ between the lanes of a vector.

A value that depends only on loop counters, constants and shared operands is the same in every
lane, so it stays scalar. If a condition differs between lanes, the lanes diverge, and a block runs
for some of them. A variable that is declared outside a divergent block and assigned inside it
differs between lanes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from rbjax.compiler.ir import statements as ir


def count_operations(block: ir.Block, turns: int = 1) -> int:
    """Count the executed operations: the longer branch, `turns` iterations of a `while` loop."""
    total = 0
    for s in block.statements:
        inner = [count_operations(x, turns) for x in s.children()]
        runs = max(inner) if isinstance(s, ir.If) else sum(inner)
        total += isinstance(s, ir.Op) + _iterations(s, turns) * runs
    return total


def count_accesses(block: ir.Block) -> Counter[int]:
    """Count the reads and writes of each array, by its id, with one iteration of a `while` loop."""
    total: Counter[int] = Counter()
    for s in block.statements:
        if isinstance(s, ir.Load | ir.Store):
            total[s.array.id] += 1
        for inner in s.children():
            total.update({k: _iterations(s) * n for k, n in count_accesses(inner).items()})
    return total


def _iterations(s: ir.Statement, turns: int = 1) -> int:
    return s.count if isinstance(s, ir.Loop) else turns if isinstance(s, ir.While) else 1


@dataclass
class LaneDivergence:
    """The ids of variables and arrays that differ between lanes.

    home: for each id, the divergent region in which the variable or array is declared.
    """

    different: set[int] = field(default_factory=set)
    home: dict[int, int] = field(default_factory=dict)

    def of(self, x: ir.Value | ir.Array | None) -> bool:
        """Return whether a value, or the content of an array, differs between lanes."""
        return isinstance(x, ir.Var | ir.Array) and x.id in self.different

    def is_declared_outside(self, x: ir.Var | ir.Array, part: int) -> bool:
        """Return whether x was declared outside the divergent region `part`."""
        return self.home.get(x.id, 0) != part


def find_divergence(block: ir.Block, different: Iterable[ir.Array]) -> LaneDivergence:
    """Find the values that differ between lanes if the content of these arrays does."""
    found = LaneDivergence({a.id for a in different})
    size = -1
    while size != len(found.different):  # a later iteration may change an earlier statement
        size = len(found.different)
        _visit(block, 0, found)
    return found


def _visit(block: ir.Block, part: int, found: LaneDivergence) -> None:
    different = found.different
    for s in block.statements:
        differs = False
        for x in s.reads():
            if x.id in different:
                differs = True
        match s:
            case ir.Op() | ir.Load():
                pass
            case ir.Declare(var=declared) | ir.Reserve(array=declared):
                found.home[declared.id] = part
            case ir.Store(array=changed) | ir.Assign(var=changed):
                differs = differs or found.is_declared_outside(changed, part)
        if differs:
            different.update([x.id for x in s.writes()])
        for inner in () if s.is_leaf else s.children():
            among = part
            if isinstance(s, ir.While | ir.If):
                among = region_of(inner, s.condition, part, found)
            _visit(inner, among, found)


def region_of(block: ir.Block, condition: ir.Value, part: int, found: LaneDivergence) -> int:
    """Return the divergent region of a block that runs under a condition in region `part`."""
    return id(block) if found.of(condition) else part
