"""Analyses of a program: operation counts, and values that differ between the lanes of a vector.

A value that depends only on loop counters, constants and shared operands is the same in every
lane, so it stays scalar. If a condition differs between lanes, the lanes diverge, and a block runs
for some of them. A variable that is declared outside a divergent block and assigned inside it
differs between lanes. The exception is the counter of a `while` loop: lanes that still run have run
the same turns.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from rbjax.compiler.ir import statements as ir


def count_operations(block: ir.Block, turns: Sequence[int] = (1,)) -> int:
    """Count the executed operations, with the longer branch of each condition.

    turns: as in `count_accesses`.
    """
    total = 0
    for s in block.statements:
        inner = [count_operations(x, _turns_inside(s, turns)) for x in s.children()]
        runs = max(inner) if isinstance(s, ir.If) else sum(inner)
        total += isinstance(s, ir.Op) + _iterations(s, turns) * runs
    return total


def count_accesses(block: ir.Block, turns: Sequence[int] = (1,)) -> Counter[int]:
    """Count the reads and writes of each array, by its id.

    turns: the iterations of a `while` loop, of one inside it, and so on; the last ones for all
        further loops.
    """
    total: Counter[int] = Counter()
    for s in block.statements:
        if isinstance(s, ir.Load | ir.Store):
            total[s.array.id] += 1
        for inner in s.children():
            found = count_accesses(inner, _turns_inside(s, turns))
            total.update({k: _iterations(s, turns) * n for k, n in found.items()})
    return total


def _turns_inside(s: ir.Statement, turns: Sequence[int]) -> Sequence[int]:
    return turns[1:] or turns if isinstance(s, ir.While) else turns


def _iterations(s: ir.Statement, turns: Sequence[int]) -> int:
    return s.count if isinstance(s, ir.Loop) else turns[0] if isinstance(s, ir.While) else 1


@dataclass
class LaneDivergence:
    """The ids of variables and arrays that differ between lanes.

    home: for each id, the divergent region in which the variable or array is declared.
    counters: the ids of counters of `while` loops (`_counters`).
    """

    different: set[int] = field(default_factory=set)
    home: dict[int, int] = field(default_factory=dict)
    counters: set[int] = field(default_factory=set)

    def of(self, x: ir.Value | ir.Array | None) -> bool:
        """Return whether a value, or the content of an array, differs between lanes."""
        return isinstance(x, ir.Var | ir.Array) and x.id in self.different

    def is_declared_outside(self, x: ir.Var | ir.Array, part: int) -> bool:
        """Return whether x was declared outside the divergent region `part`."""
        return self.home.get(x.id, 0) != part


def find_divergence(block: ir.Block, different: Iterable[ir.Array]) -> LaneDivergence:
    """Find the values that differ between lanes if the content of these arrays does."""
    found = LaneDivergence({a.id for a in different}, counters=_counters(block))
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
                differs |= found.is_declared_outside(changed, part) and (
                    changed.id not in found.counters
                )
        if differs:
            different.update([x.id for x in s.writes()])
        for inner in () if s.is_leaf else s.children():
            among = part
            if isinstance(s, ir.While | ir.If):
                among = region_of(inner, s.condition, part, found)
            _visit(inner, among, found)


def _counters(block: ir.Block) -> set[int]:
    """Return the ids of the counters of `while` loops: variables that are declared before the loop,
    that each turn increases by a number, and that nothing else changes or reads."""
    found, changes, reads = set[int](), Counter[int](), _reads(block)
    changes.update(s.var.id for s in ir.walk(block) if isinstance(s, ir.Assign))
    for outer in (block, *(inner for s in ir.walk(block) for inner in s.children())):
        begun = {
            s.var for s in outer.statements if isinstance(s, ir.Declare) and s.value is not None
        }
        for loop in outer.statements:
            if isinstance(loop, ir.While):
                own = _reads(ir.Block([loop]))
                found |= {
                    x.id
                    for x in _increased(loop.body)
                    if x in begun and changes[x.id] == 1 and own[x.id] == reads[x.id]
                }
    return found


def _increased(block: ir.Block) -> set[ir.Var]:
    """Return the variables to which a block itself adds a number."""
    sums = {
        s.dest: s.args[0]
        for s in block.statements
        if isinstance(s, ir.Op) and s.name == "add" and isinstance(s.args[1], np.generic)
    }
    changed = (s for s in block.statements if isinstance(s, ir.Assign))
    return {s.var for s in changed if isinstance(s.value, ir.Var) and sums.get(s.value) is s.var}


def _reads(block: ir.Block) -> Counter[int]:
    return Counter(x.id for s in ir.walk(block) for x in s.reads())


def region_of(block: ir.Block, condition: ir.Value, part: int, found: LaneDivergence) -> int:
    """Return the divergent region of a block that runs under a condition in region `part`."""
    return id(block) if found.of(condition) else part
