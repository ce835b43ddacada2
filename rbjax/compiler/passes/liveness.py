"""Liveness: dead code elimination, and local arrays that share memory."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass

from rbjax.compiler.ir import statements as ir


def prune(block: ir.Block) -> None:
    """Remove the statements on which no result and no condition depends."""
    _keep(block, _needed(block))


def _needed(block: ir.Block) -> set[ir.Name]:
    """Return the variables and arrays that results and conditions depend on."""
    sources: dict[ir.Name, list[ir.Name]] = {}
    reached: list[ir.Name] = []
    for statement in ir.walk(block):
        if isinstance(statement, ir.If | ir.While):
            reached.extend(statement.reads())
        elif isinstance(statement, ir.Store) and statement.array.space == "result":
            reached.extend((statement.array, *statement.reads()))
        else:
            for x in statement.writes():
                sources.setdefault(x, []).extend(statement.reads())
    needed: set[ir.Name] = set()
    while reached:
        x = reached.pop()
        if x not in needed:
            needed.add(x)
            reached.extend(sources.get(x, ()))
    return needed


def _keep(block: ir.Block, needed: set[ir.Name]) -> None:
    """Remove the statements of a block and its inner blocks that are not needed."""
    kept = []
    for statement in block.statements:
        for inner in () if statement.is_leaf else statement.children():
            _keep(inner, needed)
        if not needed.isdisjoint(statement.writes()) or _is_needed(statement, needed):
            kept.append(statement)
    block.statements = kept


def _is_needed(statement: ir.Statement, needed: set[ir.Name]) -> bool:
    """Return whether to keep a statement that writes no needed variable: a barrier, a loop or
    branch with statements in it, the memory of a needed array."""
    match statement:
        case ir.Op() | ir.Load() | ir.Store():
            return False
        case ir.Loop() | ir.If():
            return any(inner.statements for inner in statement.children())
        case ir.Reserve(array=array):
            return array in needed
    return isinstance(statement, ir.While | ir.Await | ir.Barrier)


@dataclass
class LiveRange:
    """The live range of an array, from its first to its last statement number."""

    first: int
    last: float

    def meets(self, other: LiveRange) -> bool:
        return self.first <= other.last and other.first <= self.last


def share_memory(block: ir.Block) -> None:
    """Give arrays with disjoint live ranges the same memory, declared at the start.

    An array lives from its declaration to its last use. If a loop uses but does not declare it, the
    array lives to the end of the loop. An array that a team shares lives until the next barrier.
    Arrays of one dtype are placed largest first, in the first free place (interval coloring).
    """
    spans = _live_ranges(block)
    places: list[tuple[ir.Array, list[LiveRange]]] = []
    shared: dict[ir.Array, ir.Array] = {}
    for array, span in sorted(spans.items(), key=lambda x: -x[0].size):
        for place, taken in places:
            alike = place.dtype == array.dtype and place.shared == array.shared
            if alike and not any(span.meets(x) for x in taken):
                break
        else:
            place, taken = array, []
            places.append((place, taken))
        taken.append(span)
        shared[array] = place
    _redirect(block, shared)
    block.statements[:0] = [ir.Reserve(place) for place, _ in places]


def _live_ranges(block: ir.Block) -> dict[ir.Array, LiveRange]:
    """Return the live range of each local array of a block."""
    spans: dict[ir.Array, LiveRange] = {}
    barriers: list[float] = []  # barriers outside of branches
    count = unsure = 0

    def visit(block: ir.Block) -> set[ir.Array]:
        """Number the statements of a block, and return the arrays that they use."""
        nonlocal count, unsure
        used: set[ir.Array] = set()
        for statement in block.statements:
            count += 1
            if isinstance(statement, ir.Reserve):
                spans[statement.array] = LiveRange(count, count)
            elif isinstance(statement, ir.Barrier | ir.Await):
                if not unsure:
                    barriers.append(count)
            elif statement.is_leaf:
                for x in (*statement.reads(), *statement.writes()):
                    if isinstance(x, ir.Array) and x in spans:
                        spans[x].last = count
                        used.add(x)
            else:
                unsure += not isinstance(statement, ir.Loop)
                run = branches if isinstance(statement, ir.If) else turns
                used |= run(*statement.children())
                unsure -= not isinstance(statement, ir.Loop)
        return used

    def branches(*blocks: ir.Block) -> set[ir.Array]:
        return {array for block in blocks for array in visit(block)}

    def turns(*blocks: ir.Block) -> set[ir.Array]:
        """Number the statements of a loop. Arrays from outside the loop live until its end."""
        nonlocal count
        start = count
        used = {array for array in branches(*blocks) if spans[array].first <= start}
        count += 1
        for array in used:
            spans[array].last = count
        return used

    visit(block)
    for array, span in spans.items():
        if array.shared:
            at = bisect_left(barriers, span.last)
            span.last = barriers[at] if at < len(barriers) else math.inf
    return spans


def _redirect(block: ir.Block, shared: dict[ir.Array, ir.Array]) -> None:
    """Replace arrays by the arrays whose memory they share, and remove all declarations."""
    for statement in ir.walk(block):
        if isinstance(statement, ir.Load | ir.Store):
            statement.array = shared.get(statement.array, statement.array)
        for inner in statement.children():
            _undeclare(inner)
    _undeclare(block)


def _undeclare(block: ir.Block) -> None:
    block.statements = [s for s in block.statements if not isinstance(s, ir.Reserve)]
