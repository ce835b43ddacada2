"""Local arrays that are not needed at the same time share their memory.

An array is needed from its declaration to its last use. A loop in which it is used, and which does
not declare it, needs it to its end. Arrays of one type are placed largest first, each in the first
place that is free while it is needed: the usual greedy colouring of intervals, by size. What a
team of threads shares is needed until the next barrier: some of them may still read it.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass

from rbjax.compiler.ir.statements import (
    Array,
    Await,
    Barrier,
    Block,
    If,
    Load,
    Loop,
    Reserve,
    Store,
    While,
    walk,
)


@dataclass
class Span:
    """The statements, by their numbers, during which an array is needed."""

    first: int
    last: float

    def meets(self, other: Span) -> bool:
        return self.first <= other.last and other.first <= self.last


def share_memory(block: Block) -> None:
    """Gives arrays whose spans are apart the same memory, declared at the start."""
    spans = _spans(block)
    places: list[tuple[Array, list[Span]]] = []
    shared: dict[Array, Array] = {}
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
    block.statements[:0] = [Reserve(place) for place, _ in places]


def _spans(block: Block) -> dict[Array, Span]:
    """The span of each local array of a block."""
    spans: dict[Array, Span] = {}
    barriers: list[float] = []  # those that every run meets
    count = unsure = 0

    def visit(block: Block) -> set[Array]:
        """Numbers the statements; the arrays that are used in them."""
        nonlocal count, unsure
        used: set[Array] = set()
        for statement in block.statements:
            count += 1
            match statement:
                case Reserve(array=array):
                    spans[array] = Span(count, count)
                case Load(array=array) | Store(array=array) if array in spans:
                    spans[array].last = count
                    used.add(array)
                case Barrier() | Await() if not unsure:
                    barriers.append(count)
                case Loop(body=body):
                    used |= turns(body)
                case While(test=test, body=body):
                    unsure += 1
                    used |= turns(test, body)
                    unsure -= 1
                case If(then=then, otherwise=otherwise):
                    unsure += 1
                    used |= visit(then) | visit(otherwise)
                    unsure -= 1
        return used

    def turns(*blocks: Block) -> set[Array]:
        """The same of a loop; what is older than the loop is needed until its end."""
        nonlocal count
        start = count
        used = {array for block in blocks for array in visit(block)}
        used = {array for array in used if spans[array].first <= start}
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


def _redirect(block: Block, shared: dict[Array, Array]) -> None:
    """Replace arrays by the arrays whose memory they share, and remove the declarations."""
    for statement in walk(block):
        if isinstance(statement, Load | Store):
            statement.array = shared.get(statement.array, statement.array)
        for inner in statement.children():
            _undeclare(inner)
    _undeclare(block)


def _undeclare(block: Block) -> None:
    block.statements = [s for s in block.statements if not isinstance(s, Reserve)]
